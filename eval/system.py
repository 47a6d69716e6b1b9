"""From a finished run to a trained system: networks, calibration, knowledge and the figures of its evaluation in one folder.

Nothing here uses test objects, except the figures, which are copied from the run's metrics. The policy by default and all
temperatures come from validation objects. Knowledge (the class × view table, the fixed order) is fitted on the same objects, so
each half of them walks with the knowledge of the other half.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from data_pipeline.dataset.inputs import view_camera
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError
from data_pipeline.files import as_read, digest_of
from data_pipeline.progress import console
from eval.numbers.confidence import logits_along
from eval.numbers.metrics import Metrics
from eval.run_file import versions_of
from eval.runs import Run
from eval.tables import ViewTables
from eval.walks.grid import run_grid
from eval.walks.knowledge import learn
from eval.walks.ladder import ladder
from mevs_jax.beliefs.calibration import fit_temperature
from mevs_jax.beliefs.fusing import running_sum
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.models.shapes import EncoderShape, PointNet2Shape, ResNetShape
from mevs_jax.policies.base import Knowledge
from mevs_jax.trained import (
    CloudInput,
    DataDescription,
    Description,
    ImageInput,
    Network,
    Parts,
    TrainedSystem,
    UnreadableSystem,
    fit_strangeness,
    save,
    verify,
)
from mevs_jax.trained.description import FORM
from train.loop import RANDOM
from train.results.identity import stamp_of, summary_of, why_other_stamp
from train.tasks.classifier import ResNetConfig
from train.tasks.entropy import EntropyTask
from train.tasks.own_encoder import OwnEncoderConfig

_USABLE = tuple(
    policy
    for policy in ladder()
    if policy.knows in ("nothing", "networks", "others") and policy.name != "random_with_repetition"
)
USABLE = tuple(policy.name for policy in _USABLE)
"""Policies of the ladder that a robot can use: those that know nothing, predictions of networks, or other objects."""

MADE_WITH = ("mevs-jax", "jax", "flax", "numpy")
"""Packages whose versions a system names."""

_COUNTED = slice(1, 4)
"""The numbers of views, 2 to 4, whose accuracy decides which policy is the best."""
_WITHOUT_YAW = "farthest"
"""The best policy of a classifier for objects of unknown yaw: all others need the object's frame, except random selection."""


def stored_system(folder: Path, made_by: str) -> bool:
    """Whether a folder holds the sound trained system that `made_by` identifies; says why not if it holds another one."""
    try:
        reason = why_other_stamp(verify(folder).made_by, made_by)
    except FileNotFoundError:
        return False
    except UnreadableSystem as error:
        console.print(f"{str(error).split(';')[0]}, so it is made again", markup=False)
        return False
    if reason is not None:
        console.print(f"{folder} is made anew: {reason}", markup=False)
    return reason is None


@dataclass(frozen=True)
class OnValidation:
    """Walks of the usable policies over validation objects.

    Attributes:
        temperatures: by policy, (steps,) of the sum of logits after 1, 2, … views.
        after: by policy, (steps,) share of the walks with the right prediction.
    """

    temperatures: dict[str, np.ndarray]
    after: dict[str, np.ndarray]

    @property
    def best(self) -> str:
        """The policy with the highest mean accuracy after two to four views; of equal ones the first."""
        return max(self.after, key=lambda name: float(self.after[name][_COUNTED].mean()))


@jax.jit
def _fit(logits: Float[Array, "walks steps classes"], labels: Int[Array, " walks"]) -> Array:
    return jax.vmap(fit_temperature, (1, None))(jax.vmap(running_sum)(logits), labels)


def walk_validation(tables: ViewTables, graph: ViewGraph, max_views: int, seed: int = 0) -> OnValidation:
    """Walks every validation object from every view by every usable policy, with knowledge of the other half of them."""
    half = np.argsort(np.random.default_rng(seed).permutation(len(tables.labels))) % 2
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in USABLE}
    for held in range(2):
        walking, other = (tables.of_objects(np.flatnonzero((half == held) == inside)) for inside in (True, False))
        knowledge = learn(other.logits, other.labels)
        found = run_grid(jax.random.key(seed), walking.stacked(), graph, knowledge, _USABLE, max_views=max_views)
        for name in USABLE:
            views = jnp.asarray(found[name].views)[0, :, :, 0].astype(jnp.int32)
            along = np.asarray(logits_along(views, jnp.asarray(walking.logits)))
            parts[name].append((along.reshape(-1, *along.shape[2:]), np.repeat(walking.labels, along.shape[1])))
    temperatures, after = {}, {}
    for name, pieces in parts.items():
        logits, labels = (np.concatenate(piece) for piece in zip(*pieces, strict=True))
        temperatures[name] = np.asarray(_fit(jnp.asarray(logits), jnp.asarray(labels)))
        after[name] = (np.cumsum(logits, axis=1).argmax(-1) == labels[:, None]).mean(axis=0)
    return OnValidation(temperatures, after)


def resnet_shape(config: ResNetConfig, channels: int) -> ResNetShape:
    """Returns the shape of an encoder as the tasks make it."""
    return ResNetShape(config.depth, config.width, channels, config.standardise and channels == 3, config.stem)


def pointnet2_shape(task: EntropyTask) -> tuple[PointNet2Shape, CloudInput]:
    """Returns the shape of an entropy predictor, and its input."""
    shape = task.network_config
    directions = shape.directions and shape.frame == "world"
    return (
        PointNet2Shape(shape.abstractions, shape.global_layers, shape.head_layers),
        CloudInput(shape.points, shape.frame, directions),
    )


def save_system(system: TrainedSystem, folder: Path) -> None:
    """Writes a system.

    Raises:
        DataError: if the folder holds something else.
    """
    try:
        save(system, folder)
    except FileExistsError as error:
        raise DataError(str(error)) from error


def data_of(statistics: DatasetStatistics) -> DataDescription:
    """Describes a data set in a trained system."""
    objects = {split: statistics.objects_of([split]) for split in statistics.counts}
    return DataDescription(statistics.source, statistics.fingerprint, objects)


def figures_of(metrics: Metrics) -> dict[str, Any]:
    """Figures of a run's evaluation that a system carries: accuracy by policy and number of views."""
    return {
        "objects": metrics.objects,
        "single_view": metrics.single_view.accuracy,
        "after_views": {name: of.after_views.tolist() for name, of in metrics.policies.items() if name in USABLE},
    }


def system_of_run(run: Run, evaluation: dict[str, Any], max_views: int, made_by: str) -> TrainedSystem:
    """Returns the trained system of a run: classifier, entropy predictor, class × view table.

    Args:
        evaluation: figures to carry.
        max_views: number of views that temperatures are fitted for.
        made_by: identifies what the system is made from.
    """
    statistics, graph, validation = run.statistics, run.statistics.graph, run.tables("val")
    console.print(f"Calibrating {len(USABLE)} policies on {len(validation.labels)} validation objects")
    walks = walk_validation(validation, graph, min(max_views, statistics.views))
    logits, labels = jnp.asarray(validation.logits), jnp.asarray(validation.labels)
    knowledge = learn(validation.logits, validation.labels)
    shape, cloud = pointnet2_shape(run.predict)
    network = run.classify.network_config
    assert not isinstance(network, OwnEncoderConfig)  # of an encoder of the user's no system is made
    encoder = network if isinstance(network, EncoderShape) else resnet_shape(network, network.channels)
    start = summary_of(run.out / "classifier")["start"]
    description = Description(
        form=FORM,
        kind="classifier",
        classes=tuple(statistics.classes),
        camera=view_camera(statistics.camera),
        image=ImageInput(run.classify.images, network.channels),
        encoder=encoder,
        best=walks.best,
        best_unposed=_WITHOUT_YAW,
        chosen_by="highest mean accuracy after 2 to 4 views on validation objects",
        data=data_of(statistics),
        made_by=made_by,
        made_with=versions_of(*MADE_WITH),
        entropy=shape,
        cloud=cloud,
        start="" if start == RANDOM else start,
        evaluation=evaluation
        | {"validation_after_views": {name: after.tolist() for name, after in walks.after.items()}},
    )
    parts = Parts(
        encoder=Network.of(run.classifier()),
        viewpoints=graph.points,
        neighbours=graph.neighbours,
        single=fit_temperature(logits.reshape(-1, logits.shape[-1]), jnp.repeat(labels, statistics.views)),
        entropy=Network.of(run.predictor()),
        knowledge=Knowledge(knowledge.order, knowledge.expected_logits),
        temperatures={name: jnp.asarray(values) for name, values in walks.temperatures.items()},
        strangeness=fit_strangeness(validation.logits, statistics.views),
    )
    return TrainedSystem(description, parts)


def make_run_system(run: Run, metrics: Metrics) -> Path:
    """Writes the trained system of a run, with these metrics, into `system/`, unless it is there; returns the folder."""
    folder, figures, max_views = run.out / "system", figures_of(metrics), run.settings.evaluation.max_views
    made = stamp_of("system", digest_of(as_read([run.made_by(), figures, max_views])))
    if not stored_system(folder, made):
        save_system(system_of_run(run, figures, max_views, made), folder)
    return folder
