"""Enrolled objects recognised by galleries and by a plain baseline, on the same views: `python -m benchmarks.enrolment FOLDER`.

The baseline is the textbook's: images of 16×16 depths and masks of every object from all viewpoints at 24 yaws, reduced to 64
principal components; differences are normal and independent, with a variance for each component from views of other shapes.
Both see the same random views with errors of real cameras, of objects at an unknown yaw whose sphere is up to 5 % off.

The table is written to `benchmarks/results/enrolment.json`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from scipy.special import logsumexp

import mevs_jax
from benchmarks.reporting import RESULTS, Row, Table, keep
from data_pipeline.capture.casting import capture
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.objects.mesh import Mesh
from data_pipeline.objects.sources import load_object, objects_to_test
from eval.checks.instances import CONDITIONS, VIEWS, Seen, seen_with_errors
from eval.checks.walks import Observer, beliefs_along
from mevs_jax.gallery.grid import STEPS, interpolated
from mevs_jax.gallery.matching import WEIGHTS, small_image
from mevs_jax.trained import TrainedSystem
from train.tasks.matcher import MatcherConfig, kinds_in_turn, sighted, turned_rig

TURNS, COMPONENTS, SHAPES = 24, 64, 60
WALKS = 40
ROWS = Table("sizes | method | views | right, %", "{sizes} | {method} | {views} | {right:.1f}")


def main(data: Annotated[Path, tyro.conf.Positional], seed: int = 0) -> None:
    """Compares both on meshes.

    Args:
        data: folder of meshes in class folders, in metres; every mesh is an object of its own.
        seed: of yaws, errors and walks.
    """
    system = mevs_jax.load("objects")
    meshes = [load_object(entry) for entry in objects_to_test(str(data)).entries]
    print(f"{len(meshes)} objects")
    baseline = Baseline(system, meshes)
    rows = ROWS.show(row for sized in (False, True) for row in compared(system, meshes, baseline, sized, seed))
    keep(RESULTS / "enrolment.json", {"objects": len(meshes), "rows": rows})


class Baseline:
    """Principal components of all views of all objects, at all yaws."""

    def __init__(self, system: TrainedSystem, meshes: list[Mesh]) -> None:
        camera = system.description.camera
        turns = 2 * np.pi * np.arange(TURNS) / TURNS
        self.radii = np.array([mesh.radius for mesh in meshes])
        images = [[views_of(system, mesh, turn)[0] for turn in turns] for mesh in meshes]
        flat = np.asarray(images).reshape(-1, len(WEIGHTS))
        _, vectors = np.linalg.eigh(np.cov(flat, rowvar=False))
        self.components = vectors[:, -COMPONENTS:]
        errors = []
        for one in sighted(kinds_in_turn("val", SHAPES, 0), MatcherConfig(), camera, 0):
            for image, known, direction in zip(one.images, one.known, one.directions, strict=True):
                predicted = np.asarray(interpolated(jnp.asarray(one.gallery[None]), jnp.asarray(direction)))[0, one.yaw]
                errors.append(known * (image - predicted / STEPS) @ self.components)
        self.deviation = np.std(errors, axis=0)
        self.gallery = np.asarray(images)  # objects, turns, views, pixels

    def log_likelihood(self, image: np.ndarray, known: np.ndarray, view: int) -> Float[np.ndarray, "objects turns"]:
        """Of one view under each object and yaw."""
        apart = (known * (image - self.gallery[:, :, view])) @ self.components / self.deviation
        return -0.5 * np.square(apart).sum(axis=-1)


def views_of(system: TrainedSystem, mesh: Mesh, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Small images of an object from all viewpoints, and what is known of them."""
    depth = metric_depth(
        jnp.asarray(capture(mesh, turned_rig(system.description.camera, system.viewpoints, yaw)).depth)
    )
    return small_images(system, np.asarray(depth))


def small_images(system: TrainedSystem, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    images, known = jax.vmap(small_image, (0, None))(jnp.asarray(depth), system.description.camera.distance)
    return np.asarray(images), np.asarray(known)


def compared(system: TrainedSystem, meshes: list[Mesh], baseline: Baseline, sized: bool, seed: int) -> Iterator[Row]:
    """Right answers of both after each number of views."""
    condition = next(one for one in CONDITIONS if one.name == ("mesh, true size" if sized else "mesh"))
    named = {str(number): (mesh.vertices * mesh.radius, mesh.faces) for number, mesh in enumerate(meshes)}
    known = mevs_jax.enrol(named, system, true_size=sized)
    random = np.random.default_rng(seed)
    right: dict[str, list[np.ndarray]] = {"baseline": [], "gallery": []}
    for label, mesh in enumerate(meshes):
        seen = seen_with_errors(
            system, condition, mesh, random.uniform(0, 2 * np.pi), jax.random.key(label + 1000 * seed)
        )
        walks = np.argsort(random.random((WALKS, len(system.viewpoints))), axis=1)[:, : max(VIEWS)]
        right["baseline"].append(by_baseline(system, baseline, seen, walks, sized) == label)
        right["gallery"].append(by_gallery(known, seen, walks, sized) == label)
    for method, found in right.items():
        shares = 100 * np.stack(found).mean(axis=(0, 1))
        for count, share in zip(VIEWS, shares, strict=True):
            yield {"sizes": "known" if sized else "unknown", "method": method, "views": count, "right": float(share)}


def by_baseline(system: TrainedSystem, baseline: Baseline, seen: Seen, walks: np.ndarray, sized: bool) -> np.ndarray:
    images, known = small_images(system, seen.depth)
    each = np.stack([baseline.log_likelihood(*pair, view) for view, pair in enumerate(zip(images, known, strict=True))])
    size = -0.5 * np.square(np.log(seen.radius / baseline.radii) / 0.05) if sized else 0.0
    objects = logsumexp(np.cumsum(each[walks], axis=1), axis=-1) + size
    return objects.argmax(axis=-1)


def by_gallery(known: TrainedSystem, seen: Seen, walks: np.ndarray, sized: bool) -> np.ndarray:
    """The likeliest of the objects, as if none were unknown."""
    observer = Observer(known)
    observer.add(seen.depth, seen.radius if sized else np.nan)
    table = jax.tree.map(lambda leaf: leaf[0], observer.tables(np.zeros(1, int)))
    beliefs = jax.lax.map(lambda walk: beliefs_along(known.parts, table, walk, posed=False), jnp.asarray(walks))
    return np.asarray(jnp.argmax(beliefs[..., :-1], axis=-1))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
