"""From the outputs of the thesis's networks to `thesis.json`: all numbers of its tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.numbers.comparison import class_mean, interval_of
from eval.numbers.study import HEADLINE_CT, HEADLINE_MV, Setting, headline_confusion
from eval.tables import ViewTables
from eval.thesis.timing import Measured
from eval.walks.grid import FIRST_MV, THRESHOLDS, GridConfig, Results
from eval.walks.ladder import SCRAMBLED, ladder
from mevs_jax.policies.registry import policy_record
from mevs_jax.selection.loop import ViewTable
from train.many.thesis import BACKBONES, FRAMES, PIPELINE, Frame

ORACLE_MV = 5
"""The largest limit on views of the thesis's oracle (Table 15)."""


@dataclass(frozen=True)
class LatticeTables:
    """The outputs of all networks for the objects of one split and one lattice.

    Attributes:
        names, labels, entropy: as in `ViewTables`.
        logits: by backbone, (objects, views, classes).
        predicted_entropy: by frame, (objects, views, views).
    """

    names: list[str]
    labels: np.ndarray
    entropy: np.ndarray
    logits: dict[str, np.ndarray]
    predicted_entropy: dict[Frame, np.ndarray]

    def stacked(self, frame: Frame) -> ViewTable:
        """Returns a `ViewTable` whose logits have an axis of the three backbones of the pipeline."""
        logits = np.stack([self.logits[backbone.name] for backbone in PIPELINE], axis=1)
        of_frame = jnp.asarray(self.predicted_entropy[frame])
        return ViewTable(jnp.asarray(logits), of_frame, jnp.asarray(self.entropy), jnp.asarray(self.labels))

    def of(self, backbone: str, frame: Frame) -> ViewTables:
        return ViewTables(self.names, self.labels, self.logits[backbone], self.predicted_entropy[frame], self.entropy)


# ---------------------------------------------------------------------------------------------------------------- records

_Pair = Float[np.ndarray, "2"]
_Grid = Float[np.ndarray, "limits thresholds"]
_GridIntervals = Float[np.ndarray, "limits thresholds 2"]
_Objects = Float[np.ndarray, " objects"]
ByClass = dict[str, tuple[float, float]]
"""Mean and standard deviation by class, and for all of them."""


@dataclass(frozen=True)
class SingleView:
    """Accuracy of a backbone on single views."""

    accuracy: float
    interval: _Pair
    by_object: _Objects


@dataclass(frozen=True)
class FrameErrors:
    """Squared error of the entropies that a network predicts from clouds in one frame."""

    mse: float
    interval: _Pair
    by_object: _Objects
    explained_variance: float
    by_class: ByClass


@dataclass(frozen=True)
class ErrorDifference:
    """A difference of squared errors."""

    mse: float
    interval: _Pair


@dataclass(frozen=True)
class EntropyLearning:
    """Errors of the predicted entropies on test objects, and of two predictors that receive no view.

    `every_side` is the error of the mean prediction over the clouds of all views, approximately the best that clouds allow.
    """

    frames: dict[str, FrameErrors]
    every_side: ByClass
    variance: float
    mean_map: ByClass
    class_mean_map: ByClass
    camera_minus_world: ErrorDifference


@dataclass(frozen=True)
class PolicyGrid:
    """A policy by limit on views and threshold; the interval is of the mean over backbones."""

    accuracy: Float[np.ndarray, "backbones limits thresholds"]
    interval: _GridIntervals
    views_used: Float[np.ndarray, "backbones limits thresholds"]


@dataclass(frozen=True)
class Gain:
    """The difference between two policies, mean over backbones."""

    difference: _Grid
    interval: _GridIntervals
    mean: float
    mean_interval: _Pair
    by_object: _Objects
    above_zero: int


@dataclass(frozen=True)
class BestCell:
    """A cell of the grid."""

    max_views: int
    threshold: float
    accuracy: float
    interval: _Pair
    class_accuracy: float


@dataclass(frozen=True)
class Confusions:
    """Confusion matrices by policy in one cell of the grid."""

    max_views: int
    threshold: float
    policies: dict[str, Float[np.ndarray, "classes classes"]]


@dataclass(frozen=True)
class Pipeline:
    """The thesis's multi-view grid on one lattice; `best` is by backbone and by the objects it was chosen on."""

    max_views: Int[np.ndarray, " limits"]
    policies: dict[str, PolicyGrid]
    gain: dict[str, Gain]
    views_used_gain: Gain
    best: dict[str, dict[str, BestCell]]
    confusion: Confusions


@dataclass(frozen=True)
class Grids:
    """What is computed from the outputs of the networks, most of it by number of views."""

    objects: dict[int, int]
    classes: list[str]
    thresholds: Float[np.ndarray, " thresholds"]
    evaluation: GridConfig
    single_views: dict[str, dict[int, SingleView]]
    entropy: dict[int, EntropyLearning]
    pipeline: dict[int, Pipeline]


@dataclass(frozen=True)
class BackboneTraining:
    """The training of a classifier (Table 5)."""

    train_loss: float
    val_loss: float
    epochs: int
    best_epoch: int
    start: str


@dataclass(frozen=True)
class ThesisResults(Measured, Grids):
    """All that `thesis.json` holds but its identity."""

    backbones: dict[str, BackboneTraining]
    training_seconds: dict[str, float]
    left_out: dict[int, dict[str, dict[str, str]]]


# ------------------------------------------------------------------------------------------------------- single networks


def single_view(lattice: LatticeTables, backbone: str) -> SingleView:
    """Accuracy of a backbone on single views (Table 6)."""
    right = (lattice.logits[backbone].argmax(-1) == lattice.labels[:, None]).mean(axis=1)
    return SingleView(float(right.mean()), interval_of(right), right)


def _by_class(errors: np.ndarray, labels: np.ndarray, classes: Sequence[str]) -> ByClass:
    """Mean and standard deviation over clouds, from (objects, views)."""
    rows = {name: errors[labels == label] for label, name in enumerate(classes)} | {"all": errors}
    return {name: (float(of.mean()), float(of.std())) for name, of in rows.items() if of.size}


def entropy_learning(lattice: LatticeTables, statistics: DatasetStatistics) -> EntropyLearning:
    """Errors of the predicted entropies on test objects by frame and class, and of predictors that receive no view."""
    true, labels, classes = lattice.entropy, lattice.labels, statistics.classes
    variance = float(true.var())
    errors = {frame: np.square(lattice.predicted_entropy[frame] - true[:, None]).mean(axis=-1) for frame in FRAMES}
    per_object = {frame: of.mean(axis=1) for frame, of in errors.items()}
    difference = per_object["camera"] - per_object["world"]

    def of_map(predicted: np.ndarray) -> ByClass:
        return _by_class(np.square(predicted - true).mean(axis=1, keepdims=True), labels, classes)

    def of_frame(frame: Frame) -> FrameErrors:
        each = per_object[frame]
        mean, by_class = float(each.mean()), _by_class(errors[frame], labels, classes)
        return FrameErrors(mean, interval_of(each), each, 1 - mean / variance, by_class)

    return EntropyLearning(
        frames={frame: of_frame(frame) for frame in FRAMES},
        every_side=of_map(lattice.predicted_entropy["world"].mean(axis=1)),
        variance=variance,
        mean_map=of_map(np.array(statistics.mean_map)),
        class_mean_map=of_map(np.array(statistics.class_mean_maps)[labels]),
        camera_minus_world=ErrorDifference(float(difference.mean()), interval_of(difference)),
    )


# ---------------------------------------------------------------------------------------------------------------- walking


GAINS = {
    "text": ("predicted_entropy", "random"),
    "camera": ("camera_predicted_entropy", "random"),
    "repetition": ("predicted_entropy", "random_with_repetition"),
    "published_code": ("camera_scrambled_entropy", "random_with_repetition"),
    "oracle": ("oracle_entropy", "random"),
}
"""Policy and baseline of each gain."""
POLICIES = ("random", "random_with_repetition", "predicted_entropy", "oracle_entropy")
"""The policies of `ladder` that the thesis evaluates."""


def _gain(policy: Results, base: Results, field: str = "right") -> Gain:
    """Difference between two policies, with intervals over objects."""
    each = np.asarray(getattr(policy, field)) - np.asarray(getattr(base, field))
    gain = np.moveaxis(each.mean(axis=0), 0, -1)
    return Gain(
        difference=gain.mean(axis=-1),
        interval=interval_of(gain),
        mean=float(gain.mean()),
        mean_interval=interval_of(gain.mean(axis=(0, 1))),
        by_object=gain.mean(axis=(0, 1)),
        above_zero=int((gain.mean(axis=-1) > 0).sum()),
    )


def _grid_of(results: Results) -> PolicyGrid:
    right, used = np.asarray(results.right), np.asarray(results.used)
    interval = interval_of(np.moveaxis(right.mean(axis=0), 0, -1))
    return PolicyGrid(right.mean(axis=1), interval, used.mean(axis=1))


def best_cells(test: Results, validation: Results, labels: np.ndarray) -> list[dict[str, BestCell]]:
    """The best cell of each backbone, chosen on test objects as in the thesis, and chosen on validation objects."""

    def best(right: np.ndarray, scores: np.ndarray) -> BestCell:
        row, column = np.unravel_index(scores.argmax(), scores.shape)
        cell = right[:, row, column]
        recall = float(class_mean(cell, labels))
        return BestCell(int(row) + FIRST_MV, THRESHOLDS[column], float(cell.mean()), interval_of(cell), recall)

    pairs = zip(np.asarray(test.right), np.asarray(validation.right), strict=True)
    return [
        {"test": best(right, right.mean(axis=0)), "validation": best(right, held_out.mean(axis=0))}
        for right, held_out in pairs
    ]


def pipeline(
    test: LatticeTables, validation: LatticeTables, statistics: DatasetStatistics, config: GridConfig
) -> Pipeline:
    """The thesis's multi-view grid on one lattice: Tables 7–8 and 10–15, and the confusion matrices of Fig. 23."""
    setting = Setting.of(statistics.graph, None, config)
    policies = [*(policy for policy in ladder() if policy.name in POLICIES), SCRAMBLED]
    found, _ = setting.with_random(test.stacked("world"), policies)
    camera = setting.walk(test.stacked("camera"), [policy for policy in policies if policy.knows == "networks"])
    chosen = setting.walk(validation.stacked("world"), [policy_record("predicted_entropy")])
    max_views = found["random"].after.shape[-1]
    headline_mv = min(HEADLINE_MV, max_views)
    confusions = {
        name: headline_confusion(
            np.asarray(found[name].views)[0, :, :, 0], test.of(PIPELINE[0].name, "world"), headline_mv
        )
        for name in ("random", "predicted_entropy")  # with the backbone of the thesis's first test
    }
    best = best_cells(found["predicted_entropy"], chosen["predicted_entropy"], test.labels)
    grids = found | {f"camera_{name}": results for name, results in camera.items()}
    return Pipeline(
        max_views=np.arange(FIRST_MV, max_views + 1),
        policies={name: _grid_of(results) for name, results in grids.items()},
        gain={name: _gain(grids[policy], found[base]) for name, (policy, base) in GAINS.items()},
        views_used_gain=_gain(found["predicted_entropy"], found["random"], "used"),
        best={backbone.name: cells for backbone, cells in zip(PIPELINE, best, strict=True)},
        confusion=Confusions(headline_mv, HEADLINE_CT, confusions),
    )


def grids_of(
    test: dict[int, LatticeTables],
    validation: dict[int, LatticeTables],
    statistics: dict[int, DatasetStatistics],
    config: GridConfig,
) -> Grids:
    """All results that are computed from the outputs of the networks."""
    return Grids(
        objects={views: len(lattice.labels) for views, lattice in test.items()},
        classes=next(iter(statistics.values())).classes,
        thresholds=np.array(THRESHOLDS),
        evaluation=config,
        single_views={
            backbone.name: {views: single_view(lattice, backbone.name) for views, lattice in test.items()}
            for backbone in BACKBONES
        },
        entropy={views: entropy_learning(test[views], statistics[views]) for views in test},
        pipeline={views: pipeline(test[views], validation[views], statistics[views], config) for views in test},
    )
