"""What reality costs a trained system: `mevs check reality`. Accuracy by condition and policy, and what training wins back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_pipeline.capture.casting import DEPTH_SCALE
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.errors import DataError, EmptyMesh, reason_of
from data_pipeline.files import digest_of, short_hash, write_npz
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.sources import load_object, objects_to_test
from data_pipeline.progress import console, progress_bar
from eval.checks.scenes import CONDITIONS, UPPER, Condition, Placed, reachable_in, version, views_in
from eval.checks.transfer import STRANGER, matched
from eval.checks.walks import BASELINE, AccuracyRow, Observer, Walker, Walks, with_interval
from eval.numbers.confidence import stops_of
from mevs_jax.meshes import Up
from mevs_jax.selection.loop import ViewTable
from mevs_jax.trained import TrainedSystem
from train.results.records import named

VIEWS = (1, 2, 4)
"""Numbers of views after which accuracy is reported."""
THESIS = "predicted_entropy"
_UNKNOWN = 65535
"""Stored where it is unknown what is there."""
_VERSION = 3
"""Raised when the same numbers make other images."""
STOP = 0.95
"""Calibrated probability at which walks stop, to see whether those who are sure are right."""


@dataclass(frozen=True)
class RealityConfig:
    """The check of systems in scenes.

    Attributes:
        conditions: names of the conditions; all if empty.
        objects: number of test objects, spread over all; 0 for all of them.
        renamed: the systems' class for classes that the data calls otherwise.
        draws: random walks from each first view.
        seed: of everything that is drawn.
    """

    conditions: tuple[str, ...] = ()
    objects: int = 0
    renamed: tuple[tuple[str, str], ...] = ()
    draws: int = 4
    seed: int = 0


@dataclass(frozen=True)
class Stop:
    """Walks that stop at a calibrated probability: how often they are wrong (None if none stops), their share, and views."""

    at: float
    error: float | None
    stopped: float
    views: float


@dataclass(frozen=True)
class SceneRow(AccuracyRow):
    """Accuracy in a condition of a policy, by its part in the table: random, thesis or best.

    Attributes:
        name: of the policy.
        stop: of its whole walks.
        loss: against perfect images and all views; None where the policy cannot run there.
        loss_there: against perfect images of the views that can be reached.
    """

    condition: str
    name: str
    stop: Stop
    loss: float | None = named(omitted=True)
    loss_interval: list[float] | None = named(omitted=True)
    loss_there: float | None = named(omitted=True)
    loss_there_interval: list[float] | None = named(omitted=True)


@dataclass(frozen=True)
class WonRow:
    """Accuracy of a system less that of the first one, on the same images, with its 95 % interval over objects."""

    condition: str
    policy: str
    views: int
    difference: float
    interval: list[float]


@dataclass(frozen=True)
class Reality:
    """Trained systems in scenes; `reality.json`.

    Attributes:
        objects, strangers: number of objects that were seen, and of those of classes that the systems do not know.
        left_out: reasons by name.
        conditions: titles by name.
        systems, won_back: by system, the latter of all but the first.
    """

    data: str
    objects: int
    strangers: int
    left_out: dict[str, str]
    notes: list[str]
    conditions: dict[str, str]
    systems: dict[str, list[SceneRow]]
    won_back: dict[str, list[WonRow]]


def conditions_of(names: Sequence[str]) -> tuple[Condition, ...]:
    """Returns the conditions of these names, and perfect images, which all are compared with.

    Raises:
        DataError: for a name that does not exist.
    """
    known = {condition.name: condition for condition in CONDITIONS}
    if wrong := next((name for name in names if name not in known), None):
        raise DataError(f"there is no condition {wrong!r}; it is one of {', '.join(known)}")
    base = [condition.name for condition in CONDITIONS if not names or condition.name in names]
    wanted = {"clean", *base, *("upper" for name in base if known[name].upper)}
    return tuple(condition for condition in CONDITIONS if condition.name in wanted)


def check_reality(
    systems: Mapping[str, TrainedSystem],
    data: str,
    folder: Path,
    config: RealityConfig,
    up: Up = "auto",
) -> Reality:
    """Measures systems on test objects in every condition; all see the same images.

    Args:
        systems: by the name that results have; the first is the one that others are compared with.
        data: the objects, as `mevs check transfer` takes them.
        folder: where the images are kept, so that an interrupted check goes on.
        config: which conditions and objects.
        up: upward axis of the meshes.

    Raises:
        DataError: if the data cannot be used, or the systems do not see the same views.
    """
    conditions, first = conditions_of(config.conditions), next(iter(systems.values()))
    for name, system in systems.items():
        same = system.classes == first.classes and np.array_equal(system.viewpoints, first.viewpoints)
        if not same or system.description.camera != first.description.camera:
            raise DataError(f"{name} has other classes, viewpoints or another camera than the first system")
    source = objects_to_test(data, up)
    labels = matched(source.classes, first.classes, dict(config.renamed))
    entries = [entry for entry in source.entries if labels[source.classes[entry.label]] != STRANGER]
    meshes, left_out = meshes_of(entries, config.objects)
    left_out |= {name: reason for by_name in source.left_out.values() for name, reason in by_name.items()}
    if len(meshes) < 2:
        why = "".join(f"; left out: {name} {reason}" for name, reason in list(left_out.items())[:2])
        raise DataError(
            f"this check needs at least 2 objects of classes that the systems know; {data} has {len(meshes)}{why}"
        )
    truth = np.array([labels[source.classes[entry.label]] for entry, _ in meshes])
    tables = _tables(systems, conditions, meshes, truth, folder, config.seed)
    walks = {}
    for name, system in systems.items():
        walker = Walker(system)
        walks[name] = {one.name: _walks(walker, tables[name][one.name], one, config) for one in conditions}
    return Reality(
        data=data,
        objects=len(meshes),
        strangers=len(source.entries) - len(entries),
        left_out=left_out,
        notes=[*source.notes, *source.said],
        conditions={one.name: one.title for one in conditions},
        systems={name: _rows(system, walks[name], conditions) for name, system in systems.items()},
        won_back={name: _won_back(walks[next(iter(systems))], walks[name]) for name in list(systems)[1:]},
    )


def meshes_of(entries: Sequence[ObjectEntry], most: int) -> tuple[list[tuple[ObjectEntry, Mesh]], dict[str, str]]:
    """Returns at most so many objects, spread over all (0 for all of them), and why others are left out, by name."""
    wanted = min(most or len(entries), len(entries))
    spread = [number * len(entries) // wanted for number in range(wanted)] if wanted else []
    found: dict[int, Mesh] = {}
    left_out: dict[str, str] = {}
    for number in (*spread, *sorted(set(range(len(entries))) - set(spread))):  # others where some cannot be used
        if len(found) == wanted:
            break
        try:
            found[number] = load_object(entries[number])
        except (DataError, EmptyMesh) as error:
            left_out[entries[number].name] = reason_of(error)
    return [(entries[number], found[number]) for number in sorted(found)], left_out


def _tables(
    systems: Mapping[str, TrainedSystem],
    conditions: Sequence[Condition],
    meshes: Sequence[tuple[ObjectEntry, Mesh]],
    truth: np.ndarray,
    folder: Path,
    seed: int,
) -> dict[str, dict[str, ViewTable]]:
    """View tables of every system in every condition, of all objects."""
    first = next(iter(systems.values()))
    observers: dict[str, dict[str, Observer]] = {}
    for name, system in systems.items():
        program = Observer(system)
        observers[name] = {one.name: Observer(system, like=program) for one in conditions}
    with progress_bar("objects") as bar:
        line = bar.add_task("Scenes", total=len(meshes), note="")
        for number, (entry, mesh) in enumerate(meshes):
            other = meshes[(number + len(meshes) // 2) % len(meshes)][1]  # most often of another class
            for name, depth in images_of(first, conditions, entry, mesh, other, folder, seed).items():
                for by_condition in observers.values():
                    by_condition[name].add(depth)
            bar.advance(line)
    return {
        name: {condition: observer.tables(truth) for condition, observer in by_condition.items()}
        for name, by_condition in observers.items()
    }


def images_of(
    system: TrainedSystem,
    conditions: Sequence[Condition],
    entry: ObjectEntry,
    mesh: Mesh,
    other: Mesh,
    folder: Path,
    seed: int,
) -> dict[str, Float[np.ndarray, "views side side"]]:
    """Images of one object in every condition, in radii; those that were made before are read."""
    camera, viewpoints = system.description.camera, system.viewpoints
    images: dict[str, np.ndarray] = {}
    placed: Placed | None = None
    meshes = [_VERSION, version(), repr(camera), viewpoints.tolist(), entry.name, seed, _hash_of(mesh), _hash_of(other)]
    for one in conditions:
        if one == UPPER:  # fewer views can be reached of the same images
            images[one.name] = images["clean"]
            continue
        made = digest_of([*meshes, repr(one)])
        path = folder / one.name / f"{made}.npz"
        if (stored := _stored(path)) is None:
            placed = placed or Placed(mesh, other)
            drawn = int(digest_of([entry.name, seed, one.name]), 16)
            depth = views_in(one, placed, viewpoints, camera, (drawn,))
            stored = np.where(np.isnan(depth), _UNKNOWN, np.round(depth * DEPTH_SCALE)).astype(np.uint16)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_npz(path, depth=stored)
        images[one.name] = np.where(stored == _UNKNOWN, np.float32(np.nan), np.asarray(metric_depth(stored)))
    return images


def _hash_of(mesh: Mesh) -> str:
    return short_hash(mesh.vertices.tobytes() + mesh.faces.tobytes())


def _stored(path: Path) -> np.ndarray | None:
    if not path.exists():
        return None
    try:
        with np.load(path) as stored:
            return stored["depth"]
    except Exception as error:  # the content of a damaged file decides which
        console.print(f"{path} cannot be read ({reason_of(error)}), so it is made again", markup=False)
        return None


def _policies(system: TrainedSystem, posed: bool) -> dict[str, str]:
    """Names of the policies by their part in the table."""
    best = system.description.best if posed else system.description.best_unposed
    parts = {BASELINE: BASELINE, "thesis": THESIS, "best": best}
    return {part: name for part, name in parts.items() if system.can_run(name, posed)}


def _walks(walker: Walker, tables: ViewTable, condition: Condition, config: RealityConfig) -> dict[str, Walks]:
    posed, reachable = not condition.turned, reachable_in(condition, walker.system.viewpoints)
    walks = {}
    for part, name in _policies(walker.system, posed).items():
        draws = config.draws if part == BASELINE else 1
        walks[part] = walker.walk(
            tables, name, max(VIEWS), posed=posed, reachable=reachable, draws=draws, seed=config.seed
        )
    return walks


def _rows(system: TrainedSystem, walks: dict[str, dict[str, Walks]], conditions: Sequence[Condition]) -> list[SceneRow]:
    rows, names = [], {posed: _policies(system, posed) for posed in (True, False)}
    for one in conditions:
        for part, found in walks[one.name].items():
            perfect, there = walks["clean"].get(part), walks["upper" if one.upper else "clean"].get(part)
            (stops,) = stops_of(found.sureness, found.right, [1 - STOP])
            stop = Stop(STOP, stops.error, stops.sure, stops.views)
            for views in _numbers(found):
                right = found.accuracy[:, views - 1]
                gain = right - walks[one.name][BASELINE].accuracy[:, views - 1]
                losses = [
                    with_interval(base.accuracy[:, views - 1] - right) if base else (None, None)
                    for base in (perfect, there)
                ]
                shown = *with_interval(right), *with_interval(gain), one.name, names[not one.turned][part], stop
                rows.append(SceneRow(part, views, *shown, *losses[0], *losses[1]))
    return rows


def _numbers(walks: Walks) -> list[int]:
    return [views for views in VIEWS if views <= walks.right.shape[-1]]


def _won_back(base: dict[str, dict[str, Walks]], walks: dict[str, dict[str, Walks]]) -> list[WonRow]:
    """What a system wins over the first one, by walks of both by condition and policy."""
    return [
        WonRow(condition, part, views, *with_interval((found.accuracy - before.accuracy)[:, views - 1]))
        for condition, by_part in walks.items()
        for part, found in by_part.items()
        if (before := base[condition].get(part)) is not None
        for views in _numbers(before)
    ]
