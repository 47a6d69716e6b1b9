"""Policies by differentiable rendering (thesis §4.2.1): look next where a climb over the sphere ends.

For each test object and each of its views, what that view alone shows becomes a surface (Poisson) or a grid of densities, and
the camera climbs on it; once more on the whole object, which no robot has, as the upper bound. What is kept is a score for every
candidate view. `mevs study rendering` makes these tables object by object, then evaluates and reports again.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from data_pipeline.capture.casting import DEPTH_SCALE
from data_pipeline.dataset.builder import DataConfig, open_objects, open_split
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError
from data_pipeline.files import npz_of, write_npz
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.reconstruction import decimate, normals_towards, reconstruct, voxelise, voxelise_cloud
from data_pipeline.objects.sources import load_object
from data_pipeline.progress import console, progress_bar
from eval.numbers.comparison import difference, summarise
from eval.numbers.study import exactly_random, reachable_views
from eval.rendering.ascent import METHODS, ascend_on_sphere, padded_triangles
from eval.tables import ViewTables, objects_of
from eval.walks.grid import GridConfig, run_grid
from eval.walks.ladder import ASCENT_RUNGS, KNOWS, Rung, ladder
from mevs_jax.cameras import Camera, partial_cloud
from mevs_jax.rendering import corners_of_cells, distinct_optima
from mevs_jax.viewpoints import ViewGraph

COMPARED = ("random", "farthest", "predicted_entropy", "oracle_entropy")
"""The other policies on the same objects."""


@dataclass(frozen=True)
class RenderingConfig:
    """Where differentiable rendering would look next, for many test objects."""

    objects: int = 200
    """test objects, spread evenly over the split"""
    starts: int = 6
    """viewpoints to climb from"""
    resolution: int = 32
    """pixels along each side of what is rendered"""
    faces: int = 200
    """of a surface at most"""


@dataclass(frozen=True)
class AscentScores:
    """Scores of candidate views for the chosen test objects.

    Attributes:
        chosen: (objects,) their positions in the split.
        scores: by method, (objects, views, views); row i is what to look at after seeing view i.
        without_surface: views from which too little was seen for a surface; nothing can be climbed there.
        config: how they were made.
    """

    chosen: np.ndarray
    scores: dict[str, np.ndarray]
    without_surface: int
    config: RenderingConfig


def view_scores(
    poses: Float[Array, "starts 4 4"], values: Float[Array, " starts"], points: Float[Array, "views 3"]
) -> Float[Array, " views"]:
    """Scores of candidate views from where climbs ended.

    Distinct optima, from the best on, each take the candidate nearest to them that is not taken yet, and these come first in
    that order. The other candidates follow by how near they are to the best optimum.
    """
    order, kept = distinct_optima(poses, values)
    directions = poses[order, :3, 3]
    nearness = directions @ points.T / jnp.linalg.norm(directions, axis=-1, keepdims=True)

    def take(scores: Array, optimum: tuple[Array, Array, Array]) -> tuple[Array, None]:
        near, keeps, rank = optimum
        nearest = jnp.argmax(jnp.where(scores <= 1.5, near, -jnp.inf))  # cosines are at most 1
        return scores.at[nearest].set(jnp.where(keeps, rank, scores[nearest])), None

    ranks = 1.0 + jnp.arange(len(values), 0, -1)
    return jax.lax.scan(take, nearness[0], (nearness, kept, ranks))[0]


@partial(jax.jit, static_argnames=("method", "config"))
def _scores(method: str, things: Array, points: Array, config: RenderingConfig) -> Float[Array, "things views"]:
    def one(thing: Array) -> Array:
        found = ascend_on_sphere(METHODS[method], thing, config.starts, config.resolution)
        return view_scores(found.poses, found.values, points)

    at_once = None if jax.default_backend() == "cpu" else len(things)
    return jax.lax.map(one, things, batch_size=at_once)


def _surface(points: np.ndarray, camera: np.ndarray, faces: int) -> np.ndarray | None:
    """A surface through what a camera saw, as triangles; None where there is too little."""
    try:
        return padded_triangles(reconstruct(points, normals_towards(points, camera), faces), faces)
    except DataError:
        return None


def scores_of_object(
    mesh: Mesh, depth: np.ndarray, poses: np.ndarray, field_of_view: float, points: Array, config: RenderingConfig
) -> dict[str, np.ndarray]:
    """Scores after each view of one object, by method.

    Args:
        mesh: the whole object.
        depth: (views, resolution, resolution) metric, 0 where nothing was hit.
        poses: (views, 4, 4) of the cameras that saw it.
        points: (views, 3) unit vectors to the candidates.

    Returns:
        (views, views) by the names of `ASCENT_RUNGS`, and `without_surface`, how many views show too little for one.
    """
    volumes, surfaces, missing = [], [], 0
    nothing = np.zeros((config.faces, 3, 3), np.float32)
    for image, pose in zip(depth, poses, strict=True):
        seen, real = partial_cloud(image, Camera(jnp.asarray(pose), field_of_view, len(image)))
        cloud = np.asarray(seen)[np.asarray(real)]
        volumes.append(corners_of_cells(voxelise_cloud(cloud)))
        surface = _surface(cloud, pose[:3, 3], config.faces)
        missing += surface is None
        surfaces.append(nothing if surface is None else surface)
    volumes.append(corners_of_cells(voxelise(mesh)))
    surfaces.append(padded_triangles(decimate(mesh, config.faces), config.faces))
    out: dict[str, np.ndarray] = {"without_surface": np.array(missing)}
    for method, things in (("volume", volumes), ("mesh", surfaces)):
        found = np.asarray(_scores(method, jnp.stack([jnp.asarray(thing) for thing in things]), points, config))
        out[f"diff_{method}"] = found[:-1]
        out[f"diff_{method}_whole"] = np.broadcast_to(found[-1], found[:-1].shape)
    return out


# ---------------------------------------------------------------------------------------------------------- many objects


def _folder(out: Path, statistics: DatasetStatistics, config: RenderingConfig) -> Path:
    """Of one data set and one way to climb."""
    made = (str(value) for name, value in asdict(config).items() if name != "objects")
    return out / "rendering" / "_".join((statistics.fingerprint, *made))


def chosen_objects(config: RenderingConfig, objects: int) -> np.ndarray:
    """Positions of the chosen objects in a split of so many."""
    return np.unique(np.linspace(0, objects - 1, min(config.objects, objects)).round().astype(int))


_Job = tuple[int, ObjectEntry]
_worker: Callable[[_Job], None] | None = None


def _ascend_one(job: _Job, data: Path, statistics: DatasetStatistics, folder: Path, config: RenderingConfig) -> None:
    position, entry = job
    example = open_split(data, "test")[position]
    field_of_view = np.radians(statistics.camera.field_of_view)
    depth = example["depth"].reshape(statistics.views, statistics.camera.resolution, -1) / DEPTH_SCALE
    points = jnp.array(statistics.viewpoints, jnp.float32)
    found = scores_of_object(load_object(entry), depth, example["pose"], field_of_view, points, config)
    write_npz(npz_of(folder, entry.name), **found)


def _start_worker(data: Path, statistics: DatasetStatistics, folder: Path, config: RenderingConfig) -> None:
    global _worker
    _worker = partial(_ascend_one, data=data, statistics=statistics, folder=folder, config=config)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers Ctrl-C and ends its workers


def _work(job: _Job) -> None:
    assert _worker is not None
    _worker(job)


def ascend_objects(dataset: DataConfig, statistics: DatasetStatistics, out: Path, config: RenderingConfig) -> None:
    """Climbs on the chosen test objects, each into a file of its own; those that are there are not climbed on again.

    On a CPU several processes at a time: a climb uses one core.
    """
    if min(config.objects, config.starts - 1, config.faces) < 1 or config.resolution < 8:
        raise DataError(
            "--rendering.objects and faces must be at least 1, --rendering.starts 2 and --rendering.resolution 8"
        )
    entries = {entry.name: entry for entry in open_objects(dataset).entries}
    names = objects_of(out / "data", "test", statistics)[0]
    folder, chosen = _folder(out, statistics, config), chosen_objects(config, len(names))
    for at in chosen:
        if names[at] not in entries:
            raise DataError(f"{dataset.source} has no object {names[at]!r}; give the --data that {out} was made of")
    jobs = [(int(at), entries[names[at]]) for at in chosen if not npz_of(folder, names[at]).exists()]
    given = out / "data", statistics, folder, config
    with progress_bar("objects") as bar:
        line = bar.add_task("Climbing", total=len(chosen), completed=len(chosen) - len(jobs), note="")
        workers = min(len(jobs), os.cpu_count() or 1)
        if jax.default_backend() != "cpu" or workers < 2:
            for job in jobs:
                _ascend_one(job, *given)
                bar.advance(line)
            return
        with multiprocessing.get_context("spawn").Pool(workers, _start_worker, given) as pool:
            for _ in pool.imap_unordered(_work, jobs):
                bar.advance(line)


def load_ascent_scores(out: Path, statistics: DatasetStatistics, config: RenderingConfig) -> AscentScores | None:
    """What was climbed, or None where some chosen objects are missing."""
    folder = _folder(out, statistics, config)
    if not folder.exists():
        return None
    names = objects_of(out / "data", "test", statistics)[0]  # reads the whole split
    chosen = chosen_objects(config, len(names))
    paths = [npz_of(folder, names[at]) for at in chosen]
    if not all(path.exists() for path in paths):
        return None
    scores: dict[str, list[np.ndarray]] = {rung.policy: [] for rung in ASCENT_RUNGS}
    missing = 0
    for path in paths:
        with np.load(path) as stored:
            missing += int(stored["without_surface"])
            for name, of_all in scores.items():
                of_all.append(stored[name])
    return AscentScores(chosen, {name: np.stack(of_all) for name, of_all in scores.items()}, missing, config)


def ascent_study(
    tables: ViewTables, statistics: DatasetStatistics, climbed: AscentScores, config: GridConfig
) -> dict[str, Any]:
    """The ladder of these policies beside others, on the chosen objects, from every start.

    Every difference is paired by object: from random selection, and from the thesis's predicted entropy.
    """
    viewpoints = np.array(statistics.viewpoints)
    can_reach = reachable_views(viewpoints, config.lowest_elevation)
    chosen = climbed.chosen
    some = replace(
        tables,
        names=[tables.names[at] for at in chosen],
        **{name: getattr(tables, name)[chosen] for name in ("labels", "logits", "predicted_entropy", "entropy")},
    )
    table = some.stacked()
    table = replace(
        table,
        logits=table.logits[:, None],
        ascent_scores={name: jnp.asarray(scores, jnp.float32) for name, scores in climbed.scores.items()},
    )
    compared = [rung for rung in ladder(config.draws) if rung.policy in COMPARED]
    rungs: tuple[Rung, ...] = tuple(sorted((*compared, *ASCENT_RUNGS), key=lambda rung: [*KNOWS].index(rung.knows)))
    console.print(f"Walking {len(chosen)} test objects by differentiable rendering")
    found = run_grid(
        jax.random.key(config.seed),
        table,
        ViewGraph.from_points(viewpoints),
        None,
        rungs,
        max_views=min(config.max_views, int(can_reach.sum())),
        reachable=None if can_reach.all() else jnp.asarray(can_reach),
    )
    found["random"], _ = exactly_random(found["random"], table.logits, table.label, can_reach)
    return {
        "objects": len(chosen),
        "views_without_surface": climbed.without_surface,
        "views": len(chosen) * tables.entropy.shape[1],
        "settings": asdict(climbed.config),
        "ladder": [{"policy": rung.policy, "title": rung.title, "knows": rung.knows} for rung in rungs],
        "policies": {name: summarise(result, some.labels) for name, result in found.items()},
        "against": {
            base: {name: difference(result, found[base]) for name, result in found.items() if name != base}
            for base in ("random", "predicted_entropy")
        },
    }
