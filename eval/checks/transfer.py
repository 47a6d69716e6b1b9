"""How a trained system does on objects that it has never seen, of any makers: `mevs check transfer`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from data_pipeline.capture.casting import Rig, capture
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.errors import DataError, EmptyMesh, reason_of
from data_pipeline.objects.formats import Up
from data_pipeline.objects.mesh import ObjectSource
from data_pipeline.objects.names import plain_class
from data_pipeline.objects.sources import load_object, objects_to_test
from data_pipeline.progress import progress_bar
from eval.checks.agent import STOPS
from eval.checks.walks import BASELINE, AccuracyRow, Observer, Walker, Walks, rows_of, with_interval
from eval.numbers.confidence import stopping
from eval.system import USABLE
from mevs_jax.geometry.cameras import pixel_directions
from mevs_jax.selection.loop import ViewTable
from mevs_jax.trained import TrainedSystem
from train.results.records import named

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
class StoppingRow:
    """Walks that stop at the probability `stop`, 1 − risk; as `eval.numbers.confidence.stopping` has it."""

    risk: float
    sure: float
    error: float | None
    excess: list[float]
    accuracy: float
    views: float
    stop: float


@dataclass(frozen=True)
class StrangerRow:
    """How well strangeness tells objects of unknown classes from the others after some random views.

    Attributes:
        auroc: area under the ROC curve (½ is chance, 1 perfect) of one walk of each object, averaged over draws.
        unknown_found, known_refused: shares of unknown and of known objects that are stranger than 95 % of the validation
            objects.
    """

    views: int
    auroc: float
    unknown_found: float
    known_refused: float


@dataclass(frozen=True)
class Strangers:
    """Number of objects of unknown classes, and how well they are distinguished from the others."""

    objects: int
    after: list[StrangerRow]


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
        unknown_objects: None where there are none, or the system cannot tell them; all that follows on walks is of known ones.
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
    single_view: SingleView
    policies: list[AccuracyRow]
    by_class: list[ClassRow]
    calibration: list[CalibrationRow]
    stopping: list[StoppingRow]
    unknown_objects: Strangers | None
    answers: list[Answer]


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
    rig = Rig(np.asarray(poses, np.float32), np.asarray(directions, np.float32), camera.radians)
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
    if not known.any():
        raise DataError(f"{data} has no object left of a class that the system knows; {len(objects.left_out)} left out")
    of_known = jax.tree.map(lambda leaf: leaf[known], objects.tables)
    best = system.description.best if posed else system.description.best_unposed
    walker = Walker(system)
    policies = [name for name in dict.fromkeys((BASELINE, *USABLE, best)) if system.can_run(name, posed)]
    times = {name: draws if name == BASELINE else 1 for name in policies}
    walks = {name: walker.walk(of_known, name, max_views, posed=posed, draws=times[name]) for name in policies}
    return Transfer(
        system=system.name,
        data=data,
        posed=posed,
        metres=None if np.isnan(metres) or system.description.size is None else metres,
        best=best,
        objects=len(objects.names),
        known=int(known.sum()),
        strangers=int((~known).sum()),
        classes=dict(Counter(objects.folders)),
        known_as={folder: system.classes[label] for folder, label in labels.items() if label != STRANGER},
        left_out=objects.left_out,
        notes=[*source.notes, *source.said],
        single_view=SingleView(*with_interval(walks[BASELINE].accuracy[:, 0])),
        policies=rows_of(walks, VIEWS),
        by_class=_by_class(objects.labels[known], system.classes, walks[BASELINE].accuracy, walks[best].accuracy),
        calibration=[row for name in dict.fromkeys((BASELINE, best)) for row in _calibration(name, walks[name])],
        stopping=_stops(walks[best]),
        unknown_objects=strangers(system, objects.tables, known),
        answers=_answers(objects, known, walks[best]),
    )


def _stops(walks: Walks) -> list[StoppingRow]:
    rows = stopping(walks.confidence, walks.right, [1 - stop for stop in STOPS])
    return [StoppingRow(**row, stop=1 - row["risk"]) for row in rows]


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


def _answers(objects: Objects, known: np.ndarray, walks: Walks) -> list[Answer]:
    names = [name for name, is_known in zip(objects.names, known, strict=True) if is_known]
    return [Answer(name, float(row[0]), float(row[-1])) for name, row in zip(names, walks.accuracy, strict=True)]


def strangers(
    system: TrainedSystem, tables: ViewTable, known: np.ndarray, draws: int = 32, seed: int = 0
) -> Strangers | None:
    """How well strangeness tells objects of unknown classes from the others, on random walks; None if one kind is missing."""
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
        refused = float(beyond[~known].mean()), float(beyond[known].mean())
        rows.append(StrangerRow(count, float(np.mean(areas)), *refused))
    return Strangers(int((~known).sum()), rows)


def auroc(scores: np.ndarray, positive: np.ndarray) -> float:
    """Probability that a positive has a higher score than a negative; equal scores count half."""
    from scipy.stats import rankdata  # late, since it takes a quarter of a second

    ranks, count = rankdata(scores), int(positive.sum())
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(scores) - count)))
