"""Measurements of `mevs study learned`: each lattice, unknown poses, classes left out of policy training, and decision time.

Results are stored in the folder of the seed and reused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.inputs import depth_and_normals
from data_pipeline.dataset.statistics import DatasetStatistics, load_statistics
from data_pipeline.distributed import is_first
from data_pipeline.errors import DataError
from data_pipeline.files import read_json, write_npz
from data_pipeline.progress import console
from eval.learned.comparison import ByObject, seeds_together
from eval.learned.poses import UnknownPose, of_any_rotation, of_unknown_yaw
from eval.learned.stopping import MOVEMENT_COSTS, VIEW_COSTS
from eval.learned.study import novel_classes, study
from eval.learned.walks import Learner, OnLattice
from eval.numbers.timing import milliseconds
from eval.tables import load_view_tables
from eval.thesis.results import machine
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.models.view_policy import expected_gain
from train.choosing.expected import FITTED_AS
from train.choosing.stages import Aside, Stages, lattice_data
from train.choosing.variants import VARIANTS
from train.results.finite import check_results
from train.results.identity import made_by
from train.results.kept import kept_json

_FORM = 10
"""Version of the stored walks; another version makes them stale."""
APART = 2
"""Parts of the validation objects; stopping rules are fitted on walks of policies that were trained without their objects."""


def check_parts(statistics: DatasetStatistics) -> None:
    """Raises `DataError` if there are too few validation objects to fit stopping rules on."""
    if (count := statistics.objects_of(("val",))) < APART:
        raise DataError(
            f"mevs study learned fits stopping rules on {APART} parts of the validation objects, and the data set has {count}; "
            f"raise --dataset.validation-share, or give more objects"
        )


def measure(stages: Stages) -> dict[str, Any]:
    """Returns the metrics of one seed, by number of candidate views.

    The first seed also has unknown yaw, separate candidate directions for each object, ablations, classes left out of policy
    training, and objects in any rotation.
    """
    own, config = stages.dataset.capture.views, stages.config

    def on_lattice(views: int, **given: Any) -> dict[str, Any]:
        data = lattice_data(stages.dataset, stages.out, views)
        return _walks(stages, f"lattice_{views}", data, **given)

    found = {"lattices": {str(views): on_lattice(views) for views in (own, *config.lattices)}}
    if stages.seed != config.seed:
        return found
    found["decision"] = _decision(stages)
    found["unposed"] = {str(own): on_lattice(own, posed=False)}
    found["scattered"] = {str(own): _walks(stages, "turned", stages.turned)}
    if config.ablations:
        found["ablations"] = {str(own): on_lattice(own, ablations=config.ablations)}
    if config.novel:
        found["novel"] = _novel(stages)
    if config.rotation_epochs:
        found["rotated"] = {str(own): _rotated(stages)}
    return found


def together(seeds: Sequence[Stages], found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over all seeds, by number of candidate views; `found` holds the result of `measure` for each seed."""
    lattices = {}
    for views, first in found[0]["lattices"].items():
        each = []
        for stages in seeds:
            with np.load(stages.folder / f"walks_lattice_{views}.npz") as kept:
                each.append(
                    {
                        name: ByObject(**{field.name: kept[f"{name} {field.name}"] for field in fields(ByObject)})
                        for name in first["policies"]
                    }
                )
        lattices[views] = seeds_together([one["lattices"][views] for one in found], each, "learned")
    return lattices


def learner_of(stages: Stages, name: str, aside: Aside | None = None) -> Learner:
    """Returns a variant of the view policy by its name in `VARIANTS`, trained first if it is not yet.

    Args:
        aside: part of the validation objects that it is not trained on.
    """
    variant = VARIANTS[name]
    made_as = variant.network or name
    fusion = stages.fusion(posed=variant.posed, summed=True) if variant.summed else None
    return Learner(name, variant.title, stages.policy(made_as, aside=aside), variant.by, made_as, fusion)


def _walks(
    stages: Stages, views: str, data: Path, ablations: tuple[str, ...] = (), posed: bool = True
) -> dict[str, Any]:
    """Metrics of the walks on one data set, of all policies or of the method and its ablations.

    `views` names the data set in the files of features and walks.
    """
    config, method = stages.config, "learned" if posed else "learned_unposed"
    names = [method, *ablations, *["learned_and_table"] * (posed and not ablations)]
    if "cloud" in names and not stages.has_clouds:
        console.print(
            f"The ablation with PointNet++ embeddings is left out; train PointNet++ with: mevs train --out {stages.out}"
        )
        names.remove("cloud")
    learners = [learner_of(stages, name) for name in names]
    learners[0] = replace(learners[0], name="learned")
    costs = posed and not ablations and data == stages.out / "data"
    kind = ("" if posed else "_unposed") + ("_ablations" if ablations else "")
    path = stages.folder / f"walks_{views}{kind}.json"

    def objects_of(split: str) -> OnLattice:
        features = stages.features(f"{views}_{split}", data, split)
        if "cloud" in names:
            features = replace(features, clouds=stages.clouds(data, split))
        return OnLattice(features, *_entropies(stages.out, data, split), load_statistics(data).neighbours)

    def walk() -> dict[str, Any]:
        validation, test = map(objects_of, ("val", "test"))
        if costs:  # their parts are identified by position
            learned_from = stages.features("turned_val", stages.turned, "val")
            assert np.array_equal(validation.features.labels, learned_from.labels), "the objects have another order"
        pose = "" if posed else ", unknown yaw"
        objects, count, _ = test.features.logits.shape
        around = ", separate for each object" if data == stages.turned else ""
        around = ", objects in any rotation" if stages.upright is not None else around
        console.print(
            f"Walking {objects} test objects, {count} candidate views{around}{pose}{', ablations' * bool(ablations)}"
        )
        found, each = study(
            stages.fusion(posed=posed),
            learners,
            validation,
            test,
            max_views=config.max_views,
            draws=config.draws,
            fitting_starts=config.fitting_starts,
            seed=stages.seed,
            apart=[learner_of(stages, method, (part, APART)) for part in range(APART)] if costs else (),
            others=not ablations,
            known=_known(stages, posed, test.features.directions[0]),
        )
        arrays = {f"{name} {key}": value for name, policy in each.items() for key, value in vars(policy).items()}
        check_results(found, f"walks by the recogniser in {stages.recogniser_folder()}")
        if is_first():
            write_npz(path.with_suffix(".npz"), **arrays)
        return found

    identity = {
        "form": _FORM,
        "made_by": made_by(load_statistics(data), stages.recogniser_folder()),
        "policies": [
            read_json(stages.policy_folder(learner.made_as) / "summary.json")["identity"] for learner in learners
        ],
        "walks": [
            names,
            config.max_views,
            config.draws,
            config.fitting_starts,
            _entropy_tables(stages.out, data, "test") is not None,
            costs and [VIEW_COSTS, MOVEMENT_COSTS],
            FITTED_AS,
        ],
    }
    return kept_json(path, identity, walk)


def _known(stages: Stages, posed: bool, directions: Float[Array, "views 3"]) -> ExpectedViews | UnknownPose | None:
    """What is known about views for objects of known pose, of unknown yaw, or in any rotation."""
    if posed:
        return stages.expected_views()
    if (head := stages.pose_head()) is None:
        return None
    of_poses = of_unknown_yaw if stages.upright is None else of_any_rotation
    return of_poses(head, stages.expected_views(), directions)


def _rotated(stages: Stages) -> dict[str, Any]:
    """Metrics for objects in any rotation, after further training of the recogniser on such objects."""
    rotated = stages.rotated()
    rotated.train_recogniser()
    return _walks(rotated, "turned", stages.turned, posed=False)


def _novel(stages: Stages) -> dict[str, Any]:
    """Metrics of policies on classes that they were trained without; encoder and fusion were trained on all classes."""
    views, classes = stages.dataset.capture.views, len(stages.statistics.classes)
    data = lattice_data(stages.dataset, stages.out, views)
    half = classes // 2
    pairs = [(first, first + half) for first in range(min(stages.config.novel, half))]
    policies = [(pair, stages.policy(without=pair)) for pair in pairs]
    identity = {
        "made_by": made_by(load_statistics(data), stages.recogniser_folder()),
        "form": _FORM,
        "policy": read_json(stages.policy_folder() / "summary.json")["identity"],
        "walks": [pairs, stages.config.max_views, stages.config.draws, FITTED_AS],
    }

    def walk() -> dict[str, Any]:
        test = stages.features(f"lattice_{views}_test", data, "test")
        console.print(f"Walking test objects of {2 * len(pairs)} classes that a policy was trained without")
        return novel_classes(
            stages.fusion(),
            policies,
            stages.policy(),
            test,
            stages.config.max_views,
            stages.config.draws,
            stages.seed,
            load_statistics(data).neighbours,
            stages.expected_views(),
        )

    return kept_json(stages.folder / "walks_novel.json", identity, walk)


def _decision(stages: Stages) -> dict[str, Any]:
    policy = read_json(stages.policy_folder() / "summary.json")["identity"]
    identity = {"policy": policy, "machine": machine(), "candidates": stages.dataset.capture.views}
    return kept_json(stages.folder / "decision.json", identity, partial(_decision_times, stages))


def _decision_times(stages: Stages, calls: int = 200) -> dict[str, Any]:
    """Time of one decision among all candidate views (ms), from stored features and from the latest depth image."""
    camera, most, recogniser = stages.dataset.capture, stages.config.max_views, stages.recogniser()
    structure, weights = nnx.split((recogniser, stages.policy()))
    fusion, classes = stages.fusion(), len(stages.statistics.classes)
    candidates = jnp.asarray(stages.statistics.viewpoints, jnp.float32)
    seen, present = candidates[:most], jnp.arange(most) < most - 1

    @jax.jit
    def from_features(weights: nnx.State, given: tuple[Array, Array]) -> Array:
        features, logits = given
        belief = fusion(features, seen, present)
        views = jax.nn.log_softmax(logits / fusion.single, axis=-1)
        gain_if = nnx.merge(structure, weights)[1](belief, views, seen, present, candidates)[1]
        return jnp.argmax(expected_gain(belief, gain_if).at[:most].set(-jnp.inf))

    @jax.jit
    def from_image(weights: nnx.State, given: tuple[Array, Array, Array]) -> Array:
        image, features, logits = given
        newest = nnx.merge(structure, weights)[0].see(depth_and_normals(image, camera))
        features, logits = features.at[most - 2].set(newest[:-classes]), logits.at[most - 2].set(newest[-classes:])
        return from_features(weights, (features, logits))

    depth = open_split(stages.turned, "test")[0]["depth"]
    random = np.random.default_rng(0)
    width = recogniser.encoder.head.in_features
    inputs = [
        (depth[i % len(depth)], *(random.normal(size=(most, n)).astype(np.float32) for n in (width, classes)))
        for i in range(calls)
    ]
    times = {
        "from_features": milliseconds(partial(from_features, weights), [given[1:] for given in inputs]),
        "from_image": milliseconds(partial(from_image, weights), inputs),
    }
    return {
        name: {f"p{share}": float(np.percentile(taken, share)) for share in (50, 99)} for name, taken in times.items()
    }


def _entropy_tables(out: Path, data: Path, split: str) -> Path | None:
    """Path of the view tables of `mevs run` for this data set, or None."""
    path = out / "tables" / f"{split}.npz"
    return path if data == out / "data" and path.exists() else None


def _entropies(out: Path, data: Path, split: str) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Predicted and true entropies of the split, or None for each without view tables of `mevs run`."""
    path = _entropy_tables(out, data, split)
    if path is None:
        return None, None
    tables = load_view_tables(path)
    return tables.predicted_entropy, tables.entropy
