"""From a finished learned study to a trained system: recogniser, fusion and view policies of the first seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp

from data_pipeline.dataset.inputs import view_camera
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.distributed import agreed, is_first, wait_for_all
from data_pipeline.files import as_read, digest_of
from eval.learned.study import learn
from eval.run_file import versions_of
from eval.system import MADE_WITH, data_of, resnet_shape, save_system, stored_system
from mevs_jax.models import ViewPolicy
from mevs_jax.models.shapes import PoseShape, SetFusionShape, ViewPolicyShape
from mevs_jax.trained import Description, ImageInput, Network, Parts, TrainedSystem, fit_strangeness
from mevs_jax.trained.description import FORM
from mevs_jax.trained.system import EXPECTED_VIEWS, UNPOSED
from train.choosing.expected import FITTED_AS
from train.choosing.stages import Stages, lattice_data
from train.results.identity import made_by, stamp_of

POLICIES = {"learned": True, "learned_unposed": False}
"""The view policies of a system, and whether they know the object's pose."""


def figures_of(found: dict[str, Any], views: int) -> dict[str, Any]:
    """Figures of the study that a system carries, of one seed: accuracy by policy and number of views."""
    usable = ("random", "farthest", "fixed_order", EXPECTED_VIEWS, "learned", "learned_and_table")
    of_lattice = found["lattices"][str(views)]
    policies = {name: of for name, of in of_lattice["policies"].items() if name in usable}
    figures = {
        "objects": of_lattice["objects"],
        "single_view": of_lattice["single_view"],
        "after_views": {name: of["after_views"] for name, of in policies.items()},
        "interval": {name: of["interval"] for name, of in policies.items()},
    }
    unposed = found.get("unposed", {}).get(str(views))
    if unposed is not None:
        figures["unknown_yaw"] = {
            "after_views": {name: of["after_views"] for name, of in unposed["policies"].items() if name in usable}
        }
    return figures


def make_learned_system(stages: Stages, found: dict[str, Any]) -> Path:
    """Writes the trained system of a seed into `learned/system/`, unless it is there already; returns the folder.

    Args:
        stages: of the first seed, with everything trained.
        found: its metrics.
    """
    views, folder = stages.dataset.capture.views, stages.out / "learned" / "system"
    figures = figures_of(found, views)
    networks = [stages.policy_folder(name) for name in POLICIES]
    made_from = stamp_of("features", made_by(stages.statistics, stages.recogniser_folder()))
    summaries = [(network / "summary.json").read_text() for network in networks]
    made = stamp_of("system", digest_of(as_read([made_from, [FITTED_AS, *summaries], figures])))
    if not agreed(stored_system(folder, made)):
        system = learned_system(stages, found, figures, made)
        if is_first():
            save_system(system, folder)
        wait_for_all("a system is stored")
    return folder


def learned_system(stages: Stages, found: dict[str, Any], figures: dict[str, Any], made: str) -> TrainedSystem:
    """Returns the trained system of a seed.

    Args:
        stages: with everything trained.
        found: its metrics, with temperatures of every policy's walks.
        figures: to carry.
        made: identifies what the system is made from.
    """
    views, config = stages.dataset.capture.views, stages.config
    data = lattice_data(stages.dataset, stages.out, views)
    recogniser = stages.recogniser()
    validation, expected = stages.features(f"lattice_{views}_val", data, "val"), stages.expected_views()
    graph = load_statistics(data).graph
    fusions = {"posed": stages.fusion(), "unposed": stages.fusion(posed=False)}
    policies = {name: stages.policy(name) for name in POLICIES}
    walks = found["lattices"][str(views)]["policies"]
    temperatures = {name: of["temperatures"] for name, of in walks.items() if name in figures["after_views"]}
    finds_pose = recogniser.pose is not None
    if "unposed" in found:
        unposed = found["unposed"][str(views)]["policies"]
        temperatures["learned_unposed"] = unposed["learned"]["temperatures"]
        if finds_pose:
            temperatures[EXPECTED_VIEWS + UNPOSED] = unposed[EXPECTED_VIEWS]["temperatures"]
    shape = config.recogniser.fusion
    description = Description(
        form=FORM,
        kind="recogniser",
        classes=tuple(stages.statistics.classes),
        camera=view_camera(stages.statistics.camera),
        image=ImageInput("depth_and_normals", config.recogniser.network.channels, config.recogniser.mirrored),
        encoder=resnet_shape(config.recogniser.network, config.recogniser.network.channels),
        best=EXPECTED_VIEWS,
        best_unposed=EXPECTED_VIEWS if finds_pose else "learned_unposed",
        chosen_by="validation objects of another study, on candidates that all objects share",
        data=data_of(stages.statistics),
        made_by=made,
        made_with=versions_of(*MADE_WITH),
        size=recogniser.size_input,
        pose=PoseShape(recogniser.pose.shape[1], recogniser.pose.width) if recogniser.pose else None,
        fusion=SetFusionShape(shape.width, shape.heads, shape.blocks),
        view_policies={name: _shape_of(policy, config.policy) for name, policy in policies.items()},
        evaluation=figures,
    )
    parts = Parts(
        encoder=Network.of(recogniser.encoder),
        size=None if recogniser.size is None else recogniser.size[...],
        viewpoints=graph.points,
        neighbours=graph.neighbours,
        single=fusions["posed"].single,
        fusion=fusions,
        view_policies={name: Network.of(policy) for name, policy in policies.items()},
        pose=Network.of(recogniser.pose) if recogniser.pose else None,
        knowledge=learn(fusions["posed"], validation, expected, min(config.max_views, views))[0],
        expected=expected,
        temperatures={name: jnp.asarray(values, jnp.float32) for name, values in temperatures.items()},
        strangeness=fit_strangeness(validation.logits, views),
    )
    return TrainedSystem(description, parts)


def _shape_of(policy: ViewPolicy, config: Any) -> ViewPolicyShape:
    return ViewPolicyShape(config.width, config.heads, config.blocks, policy.posed, policy.utility, policy.floor)
