"""How a trained system does on objects that it has never seen, of any makers: `mevs check transfer`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from data_pipeline.capture.casting import Rig, capture
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.errors import DataError, EmptyMesh, reason_of
from data_pipeline.objects.formats import Up
from data_pipeline.objects.mesh import ObjectSource
from data_pipeline.objects.names import plain_class
from data_pipeline.objects.sources import load_object, objects_to_test
from data_pipeline.progress import progress_bar
from eval.checks.agent import STOPS
from eval.checks.walks import BASELINE, Observer, Walker, Walks, rows_of
from eval.numbers.comparison import intervals
from eval.numbers.confidence import stopping
from eval.system import USABLE
from mevs_jax.geometry.cameras import pixel_directions
from mevs_jax.selection.loop import ViewTable
from mevs_jax.trained import TrainedSystem

VIEWS = (1, 2, 3, 4, 8)
"""Numbers of views after which accuracy is reported."""
STRANGER = -1
"""Label of an object whose class the system does not know."""


@dataclass(frozen=True)
class Objects:
    """Objects as a system sees them.

    Attributes:
        names: of the objects.
        folders: the class of each, as the source calls it.
        labels: the system's label of that class, or `STRANGER`.
        tables: what the networks compute from every view.
        left_out: reasons by name.
    """

    names: list[str]
    folders: list[str]
    labels: Int[np.ndarray, " objects"]
    tables: ViewTable
    left_out: dict[str, str]


def matched(classes: Sequence[str], known: Sequence[str], renamed: Mapping[str, str]) -> dict[str, int]:
    """Returns the system's label of each class of a source, `STRANGER` where there is none.

    Case, spaces, punctuation and a plural s do not matter: `Night Stands` is `night_stand`.

    Args:
        classes: of the source.
        known: names of the system's classes, by label.
        renamed: the system's class for classes that are called otherwise.

    Raises:
        DataError: if no class is known, or `renamed` names a class that is not there.
    """
    labels = {plain_class(name): label for label, name in enumerate(known)}
    for folder, name in renamed.items():
        if folder not in classes:
            raise DataError(f"--names {folder}={name}: the objects have no class {folder}, but {', '.join(classes)}")
        if plain_class(name) not in labels:
            raise DataError(f"--names {folder}={name}: the system knows no class {name}, but {', '.join(known)}")
    found = {folder: labels.get(plain_class(renamed.get(folder, folder)), STRANGER) for folder in classes}
    if all(label == STRANGER for label in found.values()):
        raise DataError(
            f"none of the classes {', '.join(classes)} is one that the system knows ({', '.join(known)}); if one only has "
            f"another name, say so: --names FOLDER=CLASS"
        )
    return found


def see_objects(system: TrainedSystem, source: ObjectSource, labels: Mapping[str, int], metres: float) -> Objects:
    """Captures every object of a source from the system's viewpoints, by its camera, for its networks.

    An object that cannot be read, or that no view shows, is left out with its reason.

    Args:
        system: the trained system.
        source: of the objects.
        labels: the system's label of each class of the source.
        metres: in one unit of the files, for a system that uses sizes; NaN: sizes are unknown.

    Raises:
        DataError: if none is left.
    """
    camera, poses = system.description.camera, jnp.asarray(system.poses)
    directions = jax.vmap(lambda pose: pixel_directions(camera.at(pose)))(poses)
    rig = Rig(np.asarray(poses, np.float32), np.asarray(directions, np.float32), np.deg2rad(camera.field_of_view))
    left_out = {name: reason for by_name in source.left_out.values() for name, reason in by_name.items()}
    names, folders, observer = [], [], Observer(system)
    with progress_bar("objects") as bar:
        line = bar.add_task("Capture", total=len(source.entries), note="")
        for entry in source.entries:
            bar.advance(line)
            try:
                mesh = load_object(entry)
                depth = capture(mesh, rig).depth
            except (DataError, EmptyMesh) as error:
                left_out[entry.name] = reason_of(error)
                continue
            if not depth.any():
                left_out[entry.name] = "no view shows it"
                continue
            names.append(entry.name)
            folders.append(source.classes[entry.label])
            observer.add(np.asarray(metric_depth(depth)), mesh.radius * metres)
    if not names:
        first = next(iter(left_out.items()))
        raise DataError(
            f"{source.name} has no object that can be used ({len(left_out)} left out: {first[0]} {first[1]})"
        )
    found = np.array([labels[folder] for folder in folders])
    return Objects(names, folders, found, observer.tables(found), left_out)


def check_transfer(
    system: TrainedSystem,
    data: str,
    *,
    up: Up = "auto",
    renamed: Mapping[str, str] | None = None,
    posed: bool = True,
    metres: float = np.nan,
    max_views: int = 8,
    draws: int = 4,
) -> dict[str, Any]:
    """Measures a system on other objects.

    Args:
        system: the trained system.
        data: a folder or zip of meshes in class folders, or an `.npz` of voxel grids. Objects for testing are used where the
            folders name a split, else all.
        up: upward axis of the meshes.
        renamed: the system's class for classes of the data that are called otherwise.
        posed: whether the yaw of the objects is known; it is then that of the files.
        metres: in one unit of the files, for a system that uses sizes; NaN: sizes are unknown.
        max_views: number of views of each walk.
        draws: random walks from each first view.

    Returns:
        What `transfer.json` holds: counts, accuracies, differences from random selection, calibration, classes, strangers.

    Raises:
        DataError: if the data cannot be used.
    """
    source = objects_to_test(data, up)
    labels = matched(source.classes, system.classes, renamed or {})
    objects = see_objects(system, source, labels, metres)
    known = objects.labels != STRANGER
    if not known.any():
        raise DataError(f"{data} has no object left of a class that the system knows; {len(objects.left_out)} left out")
    of_known = jax.tree.map(lambda leaf: leaf[known], objects.tables)
    best = system.description.best if posed else system.description.best_unposed
    policies = [name for name in dict.fromkeys((BASELINE, *USABLE, best)) if system.can_run(name, posed)]
    walker, walks = Walker(system), {}
    for name in policies:
        times = draws if name == BASELINE else 1
        walks[name] = walker.walk(of_known, name, max_views, posed=posed, draws=times)
    single = walks[BASELINE].accuracy[:, 0]
    return {
        "system": system.name,
        "data": data,
        "posed": posed,
        "metres": None if np.isnan(metres) or system.description.size is None else metres,
        "best": best,
        "objects": len(objects.names),
        "known": int(known.sum()),
        "strangers": int((~known).sum()),
        "classes": dict(Counter(objects.folders)),
        "known_as": {folder: system.classes[label] for folder, label in labels.items() if label != STRANGER},
        "left_out": objects.left_out,
        "notes": [*source.notes, *source.said],
        "single_view": {"accuracy": float(single.mean()), "interval": intervals(single)},
        "policies": rows_of(walks, VIEWS),
        "by_class": _by_class(objects, known, system.classes, walks, best),
        "calibration": _calibration(walks, (BASELINE, best)),
        "stopping": [row | {"stop": 1 - row["risk"]} for row in _stops(walks[best])],
        "unknown_objects": strangers(system, objects.tables, known),
        "answers": _answers(objects, known, walks[best]),
    }


def _stops(walks: Walks) -> list[dict[str, Any]]:
    return stopping(walks.confidence, walks.right, [1 - stop for stop in STOPS])


def _by_class(
    objects: Objects, known: np.ndarray, classes: Sequence[str], walks: dict[str, Walks], best: str
) -> list[dict[str, Any]]:
    """Accuracy of each known class from single views, and by the best policy after up to four views."""
    labels, rows = objects.labels[known], []
    for label in np.unique(labels):
        single, chosen = walks[BASELINE].accuracy[labels == label], walks[best].accuracy[labels == label]
        row = {"class": classes[label], "objects": len(single), "single": float(single[:, 0].mean())}
        rows.append(row | {"chosen": chosen[:, :4].mean(axis=0).tolist()})
    return rows


def _calibration(walks: dict[str, Walks], names: Sequence[str]) -> list[dict[str, Any]]:
    """Mean calibrated probability beside accuracy, and the 95 % interval over objects of their difference."""
    rows = []
    for name in dict.fromkeys(names):
        found = walks[name]
        confidence = found.confidence.mean(axis=1)
        for count in (count for count in VIEWS if count <= confidence.shape[1]):
            gap = confidence[:, count - 1] - found.accuracy[:, count - 1]
            rows.append(
                {
                    "policy": name,
                    "views": count,
                    "confidence": float(confidence[:, count - 1].mean()),
                    "accuracy": float(found.accuracy[:, count - 1].mean()),
                    "too_sure": float(gap.mean()),
                    "interval": intervals(gap),
                }
            )
    return rows


def _answers(objects: Objects, known: np.ndarray, walks: Walks) -> list[dict[str, Any]]:
    """For each known object: how often it was right after one view, and at the end of the best policy's walks."""
    names = [name for name, is_known in zip(objects.names, known, strict=True) if is_known]
    right = walks.accuracy
    return [
        {"object": name, "single": float(of[0]), "last": float(of[-1])} for name, of in zip(names, right, strict=True)
    ]


def strangers(
    system: TrainedSystem, tables: ViewTable, known: np.ndarray, draws: int = 32, seed: int = 0
) -> dict[str, Any] | None:
    """How well strangeness tells objects of unknown classes from the others, on random walks; None if one kind is missing.

    Returns:
        For 1, 2, 4 views: the area under the ROC curve (½ is chance, 1 perfect) of one walk of each object, averaged over
        draws, and the shares of unknown and of known objects that are stranger than 95 % of the validation objects.
    """
    if system.parts.strangeness is None or known.all() or not known.any():
        return None
    views, measure, rows = tables.logits.shape[1], jax.jit(jax.vmap(system.parts.strangeness.of)), []
    random, all_logits = np.random.default_rng(seed), np.asarray(tables.logits)
    energy = -np.asarray(jax.nn.logsumexp(tables.logits, axis=-1))
    for count in (count for count in (1, 2, 4) if count <= views):
        areas, beyond = [], np.zeros(len(known))
        for _ in range(draws):
            chosen = np.argsort(random.random((len(known), views)), axis=1)[:, :count]
            areas.append(auroc(np.take_along_axis(energy, chosen, axis=1).mean(axis=1), ~known))
            logits = jnp.asarray(np.take_along_axis(all_logits, chosen[..., None], axis=1))
            beyond += (np.asarray(measure(logits, jnp.ones((len(known), count), bool))) > 0.95) / draws
        rows.append(
            {
                "views": count,
                "auroc": float(np.mean(areas)),
                "unknown_found": float(beyond[~known].mean()),
                "known_refused": float(beyond[known].mean()),
            }
        )
    return {"objects": int((~known).sum()), "after": rows}


def auroc(scores: np.ndarray, positive: np.ndarray) -> float:
    """Probability that a positive has a higher score than a negative; equal scores count half."""
    from scipy.stats import rankdata  # late, since it takes a quarter of a second

    ranks, count = rankdata(scores), int(positive.sum())
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(scores) - count)))
