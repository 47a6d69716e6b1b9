"""Policies by differentiable rendering (thesis §4.2.1): the next view is an optimum found by gradient ascent over the sphere.

For each view of each test object, the points of that view are converted to a surface (Poisson reconstruction) or a
grid of densities, on which gradient ascent runs. As an upper bound it also runs on the whole object, which a robot
does not have. The result is a score for every candidate view. `mevs study rendering` computes these tables for one
object after another, then evaluates and reports again.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from data_pipeline.capture.casting import DEPTH_SCALE
from data_pipeline.dataset.builder import DataConfig, open_split
from data_pipeline.dataset.origin import objects_named
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError
from data_pipeline.files import npz_of, write_npz
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.reconstruction import (
    decimate,
    normals_towards,
    reconstruct,
    require_open3d,
    voxelise,
    voxelise_cloud,
)
from data_pipeline.objects.sources import load_object
from data_pipeline.processes import shared, usable_cpus
from data_pipeline.progress import console, progress_bar
from eval.config import RenderingConfig
from eval.numbers.comparison import difference, summarise
from eval.numbers.metrics import Ascents
from eval.numbers.study import Setting, listed
from eval.rendering.ascent import METHODS, ascend_on_sphere, padded_triangles
from eval.tables import ViewTables, objects_of
from eval.walks.grid import GridConfig
from eval.walks.ladder import BY_ASCENT, ladder
from mevs_jax.geometry.cameras import Camera, partial_cloud
from mevs_jax.rendering import corners_of_cells, distinct_optima
from train.results.identity import stamp_of

COMPARED = ("random", "farthest", "predicted_entropy", "oracle_entropy")
"""The policies that are evaluated on the same objects for comparison."""


@dataclass(frozen=True)
class AscentScores:
    """Scores of candidate views for the chosen test objects.

    Attributes:
        chosen: (objects,) positions of the objects in the split.
        scores: by policy, (objects, views, views); row i holds the scores after seeing view i.
        without_surface: number of views that show too little for a surface.
        config: settings with which the scores were computed.
    """

    chosen: np.ndarray
    scores: dict[str, np.ndarray]
    without_surface: int
    config: RenderingConfig


def view_scores(
    poses: Float[Array, "starts 4 4"], values: Float[Array, " starts"], points: Float[Array, "views 3"]
) -> Float[Array, " views"]:
    """Scores of candidate views from the ends of gradient ascents.

    Each distinct optimum, from the best on, takes the nearest candidate that is not yet taken; these candidates come
    first, in that order. The other candidates follow by their distance to the best optimum.
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

    return jax.lax.platform_dependent(things, cpu=partial(jax.lax.map, one), default=jax.vmap(one))


def _surface(points: np.ndarray, camera: np.ndarray, faces: int) -> np.ndarray | None:
    """A surface through the points that a camera saw, as triangles; None if there are too few points."""
    try:
        return padded_triangles(reconstruct(points, normals_towards(points, camera), faces), faces)
    except DataError:
        return None


def scores_of_object(
    mesh: Mesh, depth: np.ndarray, poses: np.ndarray, field_of_view: float, points: Array, config: RenderingConfig
) -> dict[str, np.ndarray]:
    """Scores after each view of one object, by policy.

    Args:
        mesh: the whole object.
        depth: (views, resolution, resolution) metric depth, 0 where nothing was hit.
        poses: (views, 4, 4) poses of the cameras.
        points: (views, 3) unit vectors to the candidate views.

    Returns:
        Scores (views, views) for each policy of `BY_ASCENT`, and `without_surface`, the number of views that show too
        little for a surface.
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
    """The folder of the scores of one data set with these settings."""
    made = (str(value) for name, value in asdict(config).items() if name != "objects")
    name = "_".join((stamp_of("rendering", statistics.fingerprint), *made))
    older = out / "climbed" / name  # where version 0.1 stored them
    return older if older.exists() else out / "rendering" / name


def chosen_objects(config: RenderingConfig, objects: int) -> np.ndarray:
    """Positions of the chosen objects in a split of `objects` objects."""
    return np.unique(np.linspace(0, objects - 1, min(config.objects, objects)).round().astype(int))


_Job = tuple[int, ObjectEntry]


def _ascend_one(job: _Job, data: Path, statistics: DatasetStatistics, folder: Path, config: RenderingConfig) -> None:
    position, entry = job
    example = open_split(data, "test")[position]
    field_of_view = np.radians(statistics.camera.field_of_view)
    depth = example["depth"].reshape(statistics.views, statistics.camera.resolution, -1) / DEPTH_SCALE
    points = jnp.array(statistics.viewpoints, jnp.float32)
    found = scores_of_object(load_object(entry), depth, example["pose"], field_of_view, points, config)
    write_npz(npz_of(folder, entry.name), **found)


def _name_of(job: _Job) -> str:
    return job[1].name


def ascend_objects(dataset: DataConfig, statistics: DatasetStatistics, out: Path, config: RenderingConfig) -> None:
    """Computes the scores of the chosen test objects and stores each object in its own file; stored objects are skipped.

    On a CPU several processes run at a time, because one ascent uses one core.
    """
    if min(config.objects, config.starts - 1, config.faces) < 1 or config.resolution < 8:
        raise DataError(
            "--rendering.objects and --rendering.faces must be at least 1, --rendering.starts at least 2 and "
            "--rendering.resolution at least 8"
        )
    names = objects_of(out / "data", "test", statistics)[0]
    folder, chosen = _folder(out, statistics, config), chosen_objects(config, len(names))
    entries = objects_named(dataset, [names[at] for at in chosen])
    jobs = [
        (int(at), entry) for at, entry in zip(chosen, entries, strict=True) if not npz_of(folder, entry.name).exists()
    ]
    if jobs:
        require_open3d()
    given = out / "data", statistics, folder, config
    with progress_bar("objects") as bar:
        line = bar.add_task("Gradient ascent", total=len(chosen), completed=len(chosen) - len(jobs), note="")
        workers = min(len(jobs), usable_cpus())
        if jax.default_backend() != "cpu" or workers < 2:
            for job in jobs:
                _ascend_one(job, *given)
                bar.advance(line)
            return
        with shared(_ascend_one, jobs, given=given, workers=workers, name_of=_name_of, chunk=1) as done:
            for _ in done:
                bar.advance(line)


def load_ascent_scores(out: Path, statistics: DatasetStatistics, config: RenderingConfig) -> AscentScores | None:
    """Returns the stored scores, or None if some chosen objects are missing."""
    folder = _folder(out, statistics, config)
    if not folder.exists():
        return None
    names = objects_of(out / "data", "test", statistics)[0]
    chosen = chosen_objects(config, len(names))
    paths = [npz_of(folder, names[at]) for at in chosen]
    if not all(path.exists() for path in paths):
        return None
    scores: dict[str, list[np.ndarray]] = {policy.name: [] for policy in BY_ASCENT}
    missing = 0
    for path in paths:
        with np.load(path) as stored:
            missing += int(stored["without_surface"])
            for name, of_all in scores.items():
                of_all.append(stored[name])
    return AscentScores(chosen, {name: np.stack(of_all) for name, of_all in scores.items()}, missing, config)


def ascent_study(
    tables: ViewTables, statistics: DatasetStatistics, climbed: AscentScores, config: GridConfig
) -> Ascents:
    """Metrics of these policies and of some others on the chosen objects, from every start view.

    Differences from random selection and from the thesis's predicted entropy are paired by object.
    """
    chosen, some = climbed.chosen, tables.of_objects(climbed.chosen)
    scores = {name: jnp.asarray(scores, jnp.float32) for name, scores in climbed.scores.items()}
    compared = [policy for policy in ladder(BY_ASCENT) if policy.name in COMPARED or policy in BY_ASCENT]
    console.print(f"Walking {len(chosen)} test objects by differentiable rendering")
    setting = Setting.of(statistics.graph, None, config)
    found, _ = setting.with_random(replace(some.stacked(), ascent_scores=scores), compared)
    return Ascents(
        objects=len(chosen),
        views_without_surface=climbed.without_surface,
        views=len(chosen) * tables.entropy.shape[1],
        settings=climbed.config,
        ladder=listed(compared),
        policies={name: summarise(result, some.labels) for name, result in found.items()},
        against={
            base: {name: difference(result, found[base]) for name, result in found.items() if name != base}
            for base in ("random", "predicted_entropy")
        },
    )
