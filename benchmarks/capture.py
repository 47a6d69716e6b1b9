"""Views per second of ray casting, of the array program, and of a whole capture to files: `python benchmarks/capture.py`.

The objects are deformed spheres of 320 to 81,920 faces, seen from 40 viewpoints at three resolutions. The images of
both renderers are compared before they are timed in turns. Ray casting has one thread here, the array program the
whole device. Further tables show the time of each stage of a capture, and the time for 100 pieces of furniture by
number of processes.

The tables are written to `benchmarks/results/capture.json` and `capture.md`.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

from benchmarks.comparing import seconds_of
from benchmarks.reporting import RESULTS, Row, Table, keep, machine_name
from data_pipeline.capture import casting
from data_pipeline.capture.casting import CaptureConfig, Rig, capture, rig_for, save_capture
from data_pipeline.capture.workers import capture_all
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.sources import load_object
from mevs_jax import Camera
from mevs_jax.rendering import pad_triangles, render_depth

VIEWS = 40
AT_ONCE = 1 if jax.default_backend() == "cpu" else VIEWS
SIDES = (64, 128, 224)
RENDERERS = Table(
    "faces | pixels a side | ray casting | array program | ratio | equal",
    "{faces:,} | {resolution} | {ray_casting:,.0f} | {array_program:,.0f} | {ratio:.2g} | {agreement:.3%}",
)
STAGES = Table(
    "pixels a side | make the mesh | cast rays | shade and store | compress and save | views a second",
    "{resolution} | {load:.1f} | {cast:.1f} | {shade, store:.1f} | {save:.1f} | {views_per_second:,.0f}",
)
WHOLE = Table(
    "pixels a side | processes | views a second",
    "{resolution} | {processes} | {views_per_second:,.0f}",
)


def wobbly_ball(subdivisions: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions)
    x, y, z = ball.vertices.T
    radius = 0.75 + 0.2 * np.sin(5 * x) * np.cos(4 * y + 3 * z)
    vertices = (ball.vertices * radius[:, None]).astype(np.float32)
    return Mesh(vertices, ball.faces.astype(np.int32), np.ptp(vertices, axis=0))


def rig_of(side: int) -> Rig:
    return rig_for(CaptureConfig(views=VIEWS, resolution=side))


@partial(jax.jit, static_argnums=2)
def depths(triangles: jax.Array, poses: jax.Array, side: int) -> jax.Array:
    return jax.lax.map(
        lambda pose: render_depth(triangles, Camera(pose, resolution=side)).depth, poses, batch_size=AT_ONCE
    )


def share_equal(rendered: jax.Array, theirs: np.ndarray) -> float:
    """The share of pixels in which depth of the array program is that of ray casting, up to rounding."""
    ours = np.asarray(rendered)
    return float((np.abs(np.where(np.isfinite(ours), ours, 0) * 10_000 - theirs) < 5).mean())


def renderers() -> Iterator[Row]:
    for subdivisions in (2, 3, 4, 6):
        mesh = wobbly_ball(subdivisions)
        triangles = jnp.asarray(pad_triangles(mesh.vertices[mesh.faces]))
        for side in SIDES:
            rig = rig_of(side)
            calls = (partial(depths, triangles, jnp.asarray(rig.poses), side), partial(capture, mesh, rig))
            agreement = share_equal(calls[0](), calls[1]().depth)
            rounds = 3 if side * 4**subdivisions > 100_000 else 7
            taken = np.median([[seconds_of(call) for call in calls] for _ in range(rounds)], axis=0).tolist()
            row = {"faces": len(mesh.faces), "resolution": side, "agreement": agreement, "ratio": taken[1] / taken[0]}
            yield row | {"array_program": VIEWS / taken[0], "ray_casting": VIEWS / taken[1]}


def stages(objects: int = 10) -> Iterator[Row]:
    """Milliseconds of each stage for one piece of furniture."""
    for side in SIDES:
        with tempfile.TemporaryDirectory() as folder:
            _stages_of(furniture(0), rig_of(side), Path(folder))  # warm-up
            each = [_stages_of(furniture(index), rig_of(side), Path(folder)) for index in range(objects)]
        spent = {name: 1000 * sum(one[name] for one in each) / objects for name in each[0]}
        yield {"resolution": side} | spent | {"views_per_second": 1000 * VIEWS / sum(spent.values())}


def _stages_of(entry: ObjectEntry, rig: Rig, folder: Path) -> dict[str, float]:
    """Seconds of each stage."""
    casting_took = 0.0

    def timed_caster(mesh: Mesh) -> casting.Cast:
        cast = casting.default_caster()(mesh)

        def timed(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nonlocal casting_took
            start = time.perf_counter()
            hits = cast(origins, directions)
            casting_took += time.perf_counter() - start
            return hits

        return timed

    begun = time.perf_counter()
    mesh = load_object(entry)
    loaded = time.perf_counter()
    seen = capture(mesh, rig, timed_caster)
    captured = time.perf_counter()
    save_capture(folder / "one.npz", seen)
    saved = time.perf_counter()
    rest = captured - loaded - casting_took
    return {"load": loaded - begun, "cast": casting_took, "shade, store": rest, "save": saved - captured}


def furniture(index: int) -> ObjectEntry:
    names = ("chair", "bathtub", "desk", "toilet", "sofa")
    return ObjectEntry(f"object_{index}", 0, "train", FurniturePiece(names[index % 5], index + 1))


def whole(objects: int = 100) -> Iterator[Row]:
    entries = [furniture(index) for index in range(objects)]
    for side, processes in ((64, 1), (64, 2), (224, 1), (224, 2)):
        config = CaptureConfig(views=VIEWS, resolution=side)
        with tempfile.TemporaryDirectory() as folder:
            seconds = seconds_of(partial(capture_all, entries, config, Path(folder), workers=processes))
        yield {"resolution": side, "processes": processes, "views_per_second": objects * VIEWS / seconds}


def main() -> None:
    print(f"Measured on: {machine_name()}.")
    rendered, staged, complete = RENDERERS.show(renderers()), STAGES.show(stages()), WHOLE.show(whole())
    keep(
        RESULTS / "capture.json",
        {"renderers": rendered, "stages": staged, "whole": complete},
        "",
        "Views a second: faces, resolution, ray casting (one thread), array program, ratio, equal pixels.",
        RENDERERS.markdown(rendered),
        "Milliseconds for 40 views of a piece of furniture, one process.",
        STAGES.markdown(staged),
        "100 objects to files, their processes' start included.",
        WHOLE.markdown(complete),
    )


if __name__ == "__main__":
    tyro.cli(main)
