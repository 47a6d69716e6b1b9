"""Views per second of ray casting, of the array program, and of a whole capture to files: `python benchmarks/capture.py`.

The objects are deformed spheres of 320 to 81,920 faces, seen from 40 viewpoints at three resolutions. The images of
both renderers are compared before they are timed in turns. Ray casting has one thread here, the array program the
whole device. Further tables show the time of each stage of a capture, and the time for 100 pieces of furniture by
number of processes.

The tables are written to `benchmarks/results/capture.json` and `capture.md`.
"""

from __future__ import annotations

import platform
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from data_pipeline.capture import casting
from data_pipeline.capture.casting import CaptureConfig, capture, rig_for, save_capture
from data_pipeline.capture.workers import capture_all
from data_pipeline.files import write_json, write_text
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.sources import load_object
from mevs_jax import Camera
from mevs_jax.markdown import markdown_row, markdown_table
from mevs_jax.rendering import pad_triangles, render_depth

RESULTS = Path(__file__).parent / "results" / "capture.json"
VIEWS = 40
AT_ONCE = 1 if jax.default_backend() == "cpu" else VIEWS


def wobbly_ball(subdivisions: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions)
    x, y, z = ball.vertices.T
    radius = 0.75 + 0.2 * np.sin(5 * x) * np.cos(4 * y + 3 * z)
    vertices = (ball.vertices * radius[:, None]).astype(np.float32)
    return Mesh(vertices, ball.faces.astype(np.int32), np.ptp(vertices, axis=0))


@partial(jax.jit, static_argnums=2)
def depths(triangles: jax.Array, poses: jax.Array, side: int) -> jax.Array:
    return jax.lax.map(
        lambda pose: render_depth(triangles, Camera(pose, resolution=side)).depth, poses, batch_size=AT_ONCE
    )


def median_seconds(calls: list[Callable[[], Any]], rounds: int) -> list[float]:
    """Median time of each call in seconds; the calls take turns, after one warm-up round."""
    taken = np.empty((len(calls), rounds))
    for turn in range(-1, rounds):
        for number, call in enumerate(calls):
            start = time.perf_counter()
            jax.block_until_ready(call())
            if turn >= 0:
                taken[number, turn] = time.perf_counter() - start
    return list(np.median(taken, axis=1))


def renderers(mesh: Mesh, side: int, rounds: int) -> dict[str, float]:
    rig = rig_for(CaptureConfig(views=VIEWS, resolution=side))
    triangles, poses = jnp.asarray(pad_triangles(mesh.vertices[mesh.faces])), jnp.asarray(rig.poses)
    ours = np.asarray(depths(triangles, poses, side))
    theirs = capture(mesh, rig).depth
    agree = np.abs(np.where(np.isfinite(ours), ours, 0) * 10_000 - theirs) < 5
    taken = median_seconds([lambda: depths(triangles, poses, side), lambda: capture(mesh, rig)], rounds)
    row = {
        "faces": len(mesh.faces),
        "resolution": side,
        "array_program": VIEWS / taken[0],
        "ray_casting": VIEWS / taken[1],
        "agreement": float(agree.mean()),
    }
    print(markdown_row(renderer_cells(row)), flush=True)
    return row


def renderer_cells(row: dict[str, float]) -> list[str]:
    return [
        f"{row['faces']:,}",
        str(row["resolution"]),
        f"{row['ray_casting']:,.0f}",
        f"{row['array_program']:,.0f}",
        f"{row['array_program'] / row['ray_casting']:.2g}",
        f"{100 * row['agreement']:.3f} %",
    ]


def stages(side: int, objects: int = 10) -> dict[str, float]:
    """Milliseconds of each stage for one piece of furniture."""
    rig = rig_for(CaptureConfig(views=VIEWS, resolution=side))
    spent = dict.fromkeys(("load", "cast", "shade, store", "save"), 0.0)

    def timed_caster(mesh: Mesh) -> casting.Cast:
        cast = casting.default_caster()(mesh)

        def timed(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            start = time.perf_counter()
            found = cast(origins, directions)
            spent["cast"] += time.perf_counter() - start
            return found

        return timed

    with tempfile.TemporaryDirectory() as folder:
        for index in range(-1, objects):
            if index == 0:
                spent = dict.fromkeys(spent, 0.0)
            begun = time.perf_counter()
            mesh = load_object(furniture(index))
            loaded, before = time.perf_counter(), spent["cast"]
            seen = capture(mesh, rig, timed_caster)
            captured = time.perf_counter()
            save_capture(Path(folder) / "one.npz", seen)
            spent["load"] += loaded - begun
            spent["shade, store"] += captured - loaded - (spent["cast"] - before)
            spent["save"] += time.perf_counter() - captured
    row = {"resolution": side} | {name: 1000 * seconds / objects for name, seconds in spent.items()}
    print(markdown_row(stage_cells(row)), flush=True)
    return row


def stage_cells(row: dict[str, float]) -> list[str]:
    total = sum(value for name, value in row.items() if name != "resolution")
    parts = [f"{row[name]:.1f}" for name in ("load", "cast", "shade, store", "save")]
    return [str(row["resolution"]), *parts, f"{1000 * VIEWS / total:,.0f}"]


def furniture(index: int) -> ObjectEntry:
    names = ("chair", "bathtub", "desk", "toilet", "sofa")
    return ObjectEntry(f"object_{index}", 0, "train", FurniturePiece(names[index % 5], index + 1))


def whole(side: int, processes: int, objects: int = 100) -> dict[str, float]:
    entries = [furniture(index) for index in range(objects)]
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        capture_all(entries, CaptureConfig(views=VIEWS, resolution=side), Path(folder), workers=processes)
        seconds = time.perf_counter() - start
    row = {"resolution": side, "processes": processes, "views_per_second": objects * VIEWS / seconds}
    print(markdown_row(whole_cells(row)), flush=True)
    return row


def whole_cells(row: dict[str, float]) -> list[str]:
    return [str(row["resolution"]), str(row["processes"]), f"{row['views_per_second']:,.0f}"]


TABLES = (
    (
        "Views a second: faces, resolution, ray casting (one thread), array program, ratio, equal pixels.",
        ("faces", "pixels a side", "ray casting", "array program", "ratio", "equal"),
        renderer_cells,
    ),
    (
        "Milliseconds for 40 views of a piece of furniture, one process.",
        ("pixels a side", "make the mesh", "cast rays", "shade and store", "compress and save", "views a second"),
        stage_cells,
    ),
    (
        "100 objects to files, their processes' start included.",
        ("pixels a side", "processes", "views a second"),
        whole_cells,
    ),
)


def main() -> None:
    machine = f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, JAX {jax.__version__}"
    print(f"Measured on: {machine}.")
    rows = [
        renderers(wobbly_ball(subdivisions), side, 3 if side * 4**subdivisions > 100_000 else 7)
        for subdivisions in (2, 3, 4, 6)
        for side in (64, 128, 224)
    ]
    found = [rows, [stages(side) for side in (64, 128, 224)], [whole(side, n) for side in (64, 224) for n in (1, 2)]]
    write_json(RESULTS, {"machine": machine, **dict(zip(("renderers", "stages", "whole"), found, strict=True))})
    parts = [f"{machine}."]
    for (title, header, cells), measured in zip(TABLES, found, strict=True):
        parts.append(f"{title}\n\n{markdown_table(header, [cells(row) for row in measured])}")
    write_text(RESULTS.with_suffix(".md"), "\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
