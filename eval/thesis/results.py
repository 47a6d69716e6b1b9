"""From the outputs of the thesis's networks to `thesis.json`: all numbers of its tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.numbers.comparison import class_mean, intervals
from eval.numbers.study import HEADLINE_CT, HEADLINE_MV, exactly_random, headline_confusion
from eval.tables import ViewTables
from eval.walks.grid import FIRST_MV, THRESHOLDS, GridConfig, Results, run_grid
from eval.walks.ladder import SCRAMBLED, ladder
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.registry import PolicyRecord, policy_record
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


# ------------------------------------------------------------------------------------------------------- single networks


def single_views(tables: dict[int, LatticeTables]) -> dict[str, dict[str, Any]]:
    """Accuracy of every backbone on single views of both data sets (Table 6)."""
    out: dict[str, dict[str, Any]] = {}
    for backbone in BACKBONES:
        out[backbone.name] = {}
        for views, lattice in tables.items():
            right = (lattice.logits[backbone.name].argmax(-1) == lattice.labels[:, None]).mean(axis=1)
            out[backbone.name][str(views)] = {
                "accuracy": float(right.mean()),
                "interval": intervals(right),
                "by_object": right.tolist(),
            }
    return out


def _by_class(errors: np.ndarray, labels: np.ndarray, classes: Sequence[str]) -> dict[str, list[float]]:
    """Mean and standard deviation over clouds, from (objects, views)."""
    rows = {name: errors[labels == label] for label, name in enumerate(classes)} | {"all": errors}
    return {name: [float(of.mean()), float(of.std())] for name, of in rows.items() if of.size}


def entropy_learning(lattice: LatticeTables, statistics: DatasetStatistics) -> dict[str, Any]:
    """Errors of the predicted entropies on test objects by frame and class, and of two predictors that receive no view.

    `every_side` is the error of the mean prediction over the clouds of all views, approximately the best that clouds allow.
    """
    true, labels, classes = lattice.entropy, lattice.labels, statistics.classes
    errors = {frame: np.square(lattice.predicted_entropy[frame] - true[:, None]).mean(axis=-1) for frame in FRAMES}
    mean_map = np.square(np.array(statistics.mean_map) - true).mean(axis=1, keepdims=True)
    class_map = np.square(np.array(statistics.class_mean_maps)[labels] - true).mean(axis=1, keepdims=True)
    every_side = np.square(lattice.predicted_entropy["world"].mean(axis=1) - true).mean(axis=1, keepdims=True)
    variance = float(true.var())
    per_object = {frame: of.mean(axis=1) for frame, of in errors.items()}
    return {
        "frames": {
            frame: {
                "mse": float(of.mean()),
                "interval": intervals(of),
                "by_object": of.tolist(),
                "explained_variance": 1 - float(of.mean()) / variance,
                "by_class": _by_class(errors[frame], labels, classes),
            }
            for frame, of in per_object.items()
        },
        "every_side": _by_class(every_side, labels, classes),
        "variance": variance,
        "mean_map": _by_class(mean_map, labels, classes),
        "class_mean_map": _by_class(class_map, labels, classes),
        "camera_minus_world": {
            "mse": float((per_object["camera"] - per_object["world"]).mean()),
            "interval": intervals(per_object["camera"] - per_object["world"]),
        },
    }


# ---------------------------------------------------------------------------------------------------------------- walking


POLICIES = ("random", "random_with_repetition", "predicted_entropy", "oracle_entropy")
"""The policies of `ladder` that the thesis evaluates."""


def walk(
    lattice: LatticeTables, graph: ViewGraph, config: GridConfig, frame: Frame, policies: Sequence[PolicyRecord]
) -> dict[str, Results]:
    """The grid (backbones, objects, MV, CT) of every policy; random selection in exact expectation where possible."""
    table = lattice.stacked(frame)
    max_views = min(config.max_views, lattice.entropy.shape[1])
    key = jax.random.key(config.seed)
    found = run_grid(key, table, graph, None, policies, max_views=max_views, draws=config.draws)
    if "random" in found:
        everywhere = np.ones(lattice.entropy.shape[1], bool)
        found["random"], _ = exactly_random(found["random"], table.logits, table.label, everywhere)
    return found


def _gain(policy: Results, base: Results, field: str = "right") -> dict[str, Any]:
    """Difference between two policies, mean over backbones, (MV, CT), with intervals over objects."""
    each = np.asarray(getattr(policy, field)) - np.asarray(getattr(base, field))
    gain = np.moveaxis(each.mean(axis=0), 0, -1)
    return {
        "difference": gain.mean(axis=-1).tolist(),
        "interval": intervals(gain),
        "mean": float(gain.mean()),
        "mean_interval": intervals(gain.mean(axis=(0, 1))),
        "by_object": gain.mean(axis=(0, 1)).tolist(),
        "above_zero": int((gain.mean(axis=-1) > 0).sum()),
    }


def _accuracy(results: Results) -> dict[str, Any]:
    right, used = np.asarray(results.right), np.asarray(results.used)
    return {
        "accuracy": right.mean(axis=1).tolist(),  # (backbones, MV, CT)
        "interval": intervals(np.moveaxis(right.mean(axis=0), 0, -1)),  # of the mean over backbones
        "views_used": used.mean(axis=1).tolist(),
    }


def best_cells(test: Results, validation: Results, labels: np.ndarray) -> list[dict[str, Any]]:
    """The best cell of each backbone, chosen on test objects as in the thesis, and chosen on validation objects."""
    out = []
    for right, held_out in zip(np.asarray(test.right), np.asarray(validation.right), strict=True):
        by_cell = np.moveaxis(right, 0, -1)
        found = {}
        for chosen_on, scores in (("test", by_cell.mean(axis=-1)), ("validation", held_out.mean(axis=0))):
            row, column = np.unravel_index(scores.argmax(), scores.shape)
            cell = by_cell[row, column]
            found[chosen_on] = {
                "max_views": int(row) + FIRST_MV,
                "threshold": THRESHOLDS[column],
                "accuracy": float(cell.mean()),
                "interval": intervals(cell),
                "class_accuracy": float(class_mean(cell, labels)),
            }
        out.append(found)
    return out


def pipeline(
    test: LatticeTables, validation: LatticeTables, statistics: DatasetStatistics, config: GridConfig
) -> dict[str, Any]:
    """The thesis's multi-view grid on one lattice: Tables 7–8 and 10–15, and the confusion matrices of Fig. 23."""
    graph = statistics.graph
    policies = [*(policy for policy in ladder() if policy.name in POLICIES), SCRAMBLED]
    found = walk(test, graph, config, "world", policies)
    camera = walk(test, graph, config, "camera", [policy for policy in policies if policy.knows == "networks"])
    chosen = walk(validation, graph, config, "world", [policy_record("predicted_entropy")])
    max_views = found["random"].after.shape[-1]
    confusion = {}
    for name in ("random", "predicted_entropy"):
        walks = np.asarray(found[name].views)[0, :, :, 0]  # with the backbone of the thesis's first test
        of = test.of(PIPELINE[0].name, "world")
        confusion[name] = headline_confusion(walks, of, min(HEADLINE_MV, max_views)).tolist()
    camera_found = {f"camera_{name}": results for name, results in camera.items()}
    return {
        "max_views": list(range(FIRST_MV, max_views + 1)),
        "policies": {name: _accuracy(results) for name, results in (found | camera_found).items()},
        "gain": {
            "text": _gain(found["predicted_entropy"], found["random"]),
            "camera": _gain(camera["predicted_entropy"], found["random"]),
            "repetition": _gain(found["predicted_entropy"], found["random_with_repetition"]),
            "published_code": _gain(camera["scrambled_entropy"], found["random_with_repetition"]),
            "oracle": _gain(found["oracle_entropy"], found["random"]),
        },
        "views_used_gain": _gain(found["predicted_entropy"], found["random"], "used"),
        "best": {
            backbone.name: best
            for backbone, best in zip(
                PIPELINE, best_cells(found["predicted_entropy"], chosen["predicted_entropy"], test.labels), strict=True
            )
        },
        "confusion": {"max_views": min(HEADLINE_MV, max_views), "threshold": HEADLINE_CT, "policies": confusion},
    }


# ---------------------------------------------------------------------------------------------------------------- machine


def all_results(
    test: dict[int, LatticeTables],
    validation: dict[int, LatticeTables],
    statistics: dict[int, DatasetStatistics],
    config: GridConfig,
) -> dict[str, Any]:
    """All results that are computed from the outputs of the networks, most of them by lattice."""
    return {
        "objects": {str(views): len(lattice.labels) for views, lattice in test.items()},
        "classes": next(iter(statistics.values())).classes,
        "thresholds": list(THRESHOLDS),
        "evaluation": asdict(config),
        "single_views": single_views(test),
        "entropy": {str(views): entropy_learning(test[views], statistics[views]) for views in test},
        "pipeline": {str(views): pipeline(test[views], validation[views], statistics[views], config) for views in test},
    }
