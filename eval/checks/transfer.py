"""How a trained system does on objects that it has never seen, of any makers: `mevs check transfer`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from data_pipeline.capture.casting import capture, rig_at
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.errors import DataError, EmptyMesh, reason_of
from data_pipeline.objects.mesh import ObjectSource
from data_pipeline.objects.names import plain_class
from data_pipeline.objects.sources import load_object, objects_to_test
from data_pipeline.progress import progress_bar
from eval.checks.agent import STOPS
from eval.checks.promise import PromiseRow, Strangers, promises, strangers
from eval.checks.walks import BASELINE, AccuracyRow, Observer, Walker, Walks, rows_of, with_interval
from eval.numbers.confidence import stops_of
from eval.numbers.metrics import Stop
from eval.system import USABLE
from mevs_jax.meshes import Up
from mevs_jax.selection.loop import ViewTable
from mevs_jax.trained import TrainedSystem
from mevs_jax.trained.description import UNKNOWN_OBJECT
from train.results.records import named

VIEWS = (1, 2, 3, 4, 8)
"""Numbers of views after which accuracy is reported."""
STRANGER = -1
"""Label of an object whose class the system does not know."""
_NONE_KNOWN = "the system knows none of these classes; if one only has another name, say so: --names FOLDER=CLASS"


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


@dataclass(frozen=True)
class ClassRow:
    """Accuracy for the objects of one known class, from single views and by the best policy after 1, 2, 3 and 4 views."""

    objects: int
    single: float
    chosen: Float[np.ndarray, " views"]
    name: str = named("class")


@dataclass(frozen=True)
class CalibrationRow:
    """Mean calibrated probability beside accuracy; `interval` is of `too_sure`, their difference, 95 % over objects."""

    policy: str
    views: int
    confidence: float
    accuracy: float
    too_sure: float
    interval: list[float]


@dataclass(frozen=True)
class StoppingRow(Stop):
    """Walks that stop at the probability `stop`, 1 − risk."""

    stop: float


@dataclass(frozen=True)
class Answer:
    """How often one known object was right after one random view, and at the end of the best policy's walks."""

    object: str
    single: float
    last: float


@dataclass(frozen=True)
class SingleView:
    """Accuracy of single views, and its 95 % interval over objects."""

    accuracy: float
    interval: list[float]


@dataclass(frozen=True)
class Transfer:
    """A trained system on objects of any makers; `transfer.json`.

    Attributes:
        posed: whether the yaw of the objects is known.
        metres: in one unit of the files; None where sizes are unknown.
        best: the policy that the system names as its best.
        objects, known, strangers: number of all objects, of those of known and of unknown classes.
        classes, known_as: number of objects, and the system's class, by class of the data.
        left_out: reasons by name.
        single_view: of known objects, as all figures of walks but `promises` and `unknown_objects`; None without any.
        promises: what agents would say, of known and of unknown objects.
        unknown_objects: None where there are none, or no known ones, or the system cannot tell them.
    """

    system: str
    data: str
    posed: bool
    metres: float | None
    best: str
    objects: int
    known: int
    strangers: int
    classes: dict[str, int]
    known_as: dict[str, str]
    left_out: dict[str, str]
    notes: list[str]
    single_view: SingleView | None
    policies: list[AccuracyRow]
    by_class: list[ClassRow]
    calibration: list[CalibrationRow]
    stopping: list[StoppingRow]
    promises: list[PromiseRow]
    unknown_objects: Strangers | None
    answers: list[Answer]


def matched(classes: Sequence[str], known: Sequence[str], renamed: Mapping[str, str]) -> dict[str, int]:
    """Returns the system's label of each class of a source, `STRANGER` where there is none.

    Case, spaces, punctuation and a plural s do not matter: `Night Stands` is `night_stand`.

    Args:
        classes: of the source.
        known: names of the system's classes, by label.
        renamed: the system's class for classes that are called otherwise.

    A class of unknown objects, of the source or of the system, is none that is known.

    Raises:
        DataError: if `renamed` names a class that is not there.
    """
    labels = {plain_class(name): label for label, name in enumerate(known) if name != UNKNOWN_OBJECT}
    for folder, name in renamed.items():
        if folder not in classes:
            raise DataError(f"--names {folder}={name}: the objects have no class {folder}, but {', '.join(classes)}")
        if plain_class(name) not in labels:
            raise DataError(f"--names {folder}={name}: the system knows no class {name}, but {', '.join(known)}")
    return {folder: labels.get(plain_class(renamed.get(folder, folder)), STRANGER) for folder in classes}


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
    rig = rig_at(system.description.camera.at(system.poses))
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
) -> Transfer:
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

    Raises:
        DataError: if the data cannot be used.
    """
    source = objects_to_test(data, up)
    labels = matched(source.classes, system.classes, renamed or {})
    objects = see_objects(system, source, labels, metres)
    known = objects.labels != STRANGER
    best = system.description.best if posed else system.description.best_unposed
    walker = Walker(system)
    policies = [name for name in dict.fromkeys((BASELINE, *USABLE, best)) if system.can_run(name, posed)]
    times = {name: draws if name == BASELINE else 1 for name in policies}
    walked = policies if known.any() else list(dict.fromkeys((BASELINE, best)))
    every = {name: walker.walk(objects.tables, name, max_views, posed=posed, draws=times[name]) for name in walked}
    budgets = [count for count in VIEWS if count <= every[best].right.shape[-1]]
    return Transfer(
        system=system.name,
        data=data,
        posed=posed,
        metres=None if np.isnan(metres) or not system.description.uses_size else metres,
        best=best,
        objects=len(objects.names),
        known=int(known.sum()),
        strangers=int((~known).sum()),
        classes=dict(Counter(objects.folders)),
        known_as={folder: system.classes[label] for folder, label in labels.items() if label != STRANGER},
        left_out=objects.left_out,
        notes=[*source.notes, *source.said, *[_NONE_KNOWN] * (not known.any() and source.classes != (UNKNOWN_OBJECT,))],
        **_of_known(system, objects, {name: walks.some(known) for name, walks in every.items()}, best),
        promises=promises(every[best], known, STOPS, budgets),
        unknown_objects=strangers(every[BASELINE], known),
    )


def _of_known(system: TrainedSystem, objects: Objects, walks: dict[str, Walks], best: str) -> dict[str, Any]:
    """The figures of a `Transfer` that known objects alone have, from their walks."""
    labels, names = (np.asarray(values)[objects.labels != STRANGER] for values in (objects.labels, objects.names))
    if not len(labels):
        return {"single_view": None, "policies": [], "by_class": [], "calibration": [], "stopping": [], "answers": []}
    accuracy = walks[best].accuracy
    return {
        "single_view": SingleView(*with_interval(walks[BASELINE].accuracy[:, 0])),
        "policies": rows_of(walks, VIEWS),
        "by_class": _by_class(labels, system.classes, walks[BASELINE].accuracy, accuracy),
        "calibration": [row for name in dict.fromkeys((BASELINE, best)) for row in _calibration(name, walks[name])],
        "stopping": _stops(walks[best]),
        "answers": [
            Answer(str(name), float(row[0]), float(row[-1])) for name, row in zip(names, accuracy, strict=True)
        ],
    }


def _stops(walks: Walks) -> list[StoppingRow]:
    rows = stops_of(walks.sureness, walks.right, [1 - stop for stop in STOPS])
    return [StoppingRow(**vars(row), stop=1 - row.risk) for row in rows]


def _by_class(
    labels: Int[np.ndarray, " objects"], classes: Sequence[str], single: np.ndarray, chosen: np.ndarray
) -> list[ClassRow]:
    """Accuracy of each known class, from accuracies by object and number of random and of chosen views."""
    rows = []
    for label in np.unique(labels):
        of_class = labels == label
        after = chosen[of_class, :4].mean(axis=0)
        rows.append(ClassRow(int(of_class.sum()), float(single[of_class, 0].mean()), after, classes[label]))
    return rows


def _calibration(policy: str, walks: Walks) -> list[CalibrationRow]:
    rows, confidences = [], walks.confidence.mean(axis=1)
    for count in (count for count in VIEWS if count <= confidences.shape[1]):
        confidence, accuracy = confidences[:, count - 1], walks.accuracy[:, count - 1]
        means = float(confidence.mean()), float(accuracy.mean())
        rows.append(CalibrationRow(policy, count, *means, *with_interval(confidence - accuracy)))
    return rows
