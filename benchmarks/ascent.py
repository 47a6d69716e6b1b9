"""Whether climbing over the sphere finds the best view: `python benchmarks/ascent.py METHOD DATA [OBJECTS]`.

METHOD is `volume` (opacity entropy of a grid of densities, 32³) or `mesh` (depth entropy of at most 500 faces, rendered softly);
DATA is any source of objects, from whose test split OBJECTS (100) are taken evenly. Images are 64×64. From each object's 40
Fibonacci viewpoints the camera climbs; the same objective on a dense grid of 2,562 directions says how high it could have come.
Shown are the shares of objects whose best start, and of all single starts that, came within 5 % of the grid's maximum, and within
5 % of its range, which is harder where every view is nearly as good; and seconds per object for all starts.

Results go to `benchmarks/results/ascent_METHOD.json` object by object, and the command goes on where it stopped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import numpy as np
import trimesh

from data_pipeline.files import read_json, write_json
from data_pipeline.meshes import EmptyMesh, Mesh, load_object, open_source
from data_pipeline.volumes import decimate, voxelise
from mevs_jax import Camera, cameras_at, fibonacci_sphere
from mevs_jax.rendering import ascend, corners_of_cells, march, opacity_entropy, render_mesh, soft_depth_entropy

RESULTS = Path(__file__).parent / "results"
SIDE, FACES, STARTS = 64, 512, 40


def triangles_of(mesh: Mesh) -> np.ndarray:
    simpler = decimate(mesh, 500)
    padded = np.zeros((FACES, 3, 3), np.float32)
    padded[: len(simpler.faces)] = simpler.vertices[simpler.faces][:FACES]
    return padded


def depth_entropy_of(triangles: jax.Array) -> Callable[[jax.Array], jax.Array]:
    def objective(pose: jax.Array) -> jax.Array:
        seen = render_mesh(triangles, Camera(pose, resolution=SIDE))
        return soft_depth_entropy(seen.depth, seen.silhouette)

    return objective


def opacity_entropy_of(cells: jax.Array) -> Callable[[jax.Array], jax.Array]:
    return lambda pose: opacity_entropy(march(cells, Camera(pose, resolution=SIDE)).opacity)


METHODS: dict[str, tuple[Callable[[Mesh], Any], Callable]] = {
    "mesh": (triangles_of, depth_entropy_of),
    "volume": (lambda mesh: corners_of_cells(voxelise(mesh)), opacity_entropy_of),
}


def summary(rows: list[dict[str, Any]]) -> str:
    reached = {}
    for name, slack in (
        ("maximum", lambda row: 0.05 * abs(row["best"])),
        ("range", lambda row: 0.05 * (row["best"] - row["worst"])),
    ):
        near = [np.array(row["values"]) >= row["best"] - slack(row) for row in rows]
        reached[name] = (np.mean([of_object.any() for of_object in near]), np.mean(near))
    seconds = np.array([row["seconds"] for row in rows])
    parts = [
        f"within 5 % of the {name}: {100 * best:.1f} % of objects, {100 * single:.1f} % of single starts"
        for name, (best, single) in reached.items()
    ]
    return (
        f"{len(rows)} objects; "
        + "; ".join(parts)
        + f"; {np.median(seconds):.1f} s an object (median), {seconds.max():.1f} s at most"
    )


def main() -> None:
    if len(sys.argv) not in (3, 4) or sys.argv[1] not in METHODS:
        print("usage: python benchmarks/ascent.py mesh|volume DATA [OBJECTS]", file=sys.stderr)
        sys.exit(2)
    prepare, objective_of = METHODS[sys.argv[1]]
    count = int(sys.argv[3]) if len(sys.argv) == 4 else 100
    source = open_source(sys.argv[2], train_per_class=1, test_per_class=count // 10)
    entries = [entry for entry in source.entries if entry.split == "test"]
    chosen = [entries[index] for index in np.linspace(0, len(entries) - 1, count).astype(int)]
    starts = cameras_at(fibonacci_sphere(STARTS)).pose
    dense = cameras_at(np.asarray(trimesh.creation.icosphere(4).vertices, np.float32)).pose
    climb = jax.jit(lambda thing: ascend(objective_of(thing), starts))
    look = jax.jit(lambda thing: jax.lax.map(objective_of(thing), dense))

    path = RESULTS / f"ascent_{sys.argv[1]}.json"
    rows: list[dict[str, Any]] = read_json(path)["rows"] if path.exists() else []
    done = {row["object"] for row in rows}
    for entry in chosen:
        if entry.name in done:
            continue
        try:
            thing = prepare(load_object(entry))
        except EmptyMesh as reason:
            print(f"left out: {entry.name}: {reason}")
            continue
        if not rows:
            jax.block_until_ready(climb(thing))  # compiles
        begun = time.perf_counter()
        found = jax.block_until_ready(climb(thing))
        seconds = time.perf_counter() - begun
        grid = np.asarray(look(thing))
        rows.append(
            {
                "object": entry.name,
                "best": float(grid.max()),
                "worst": float(grid.min()),
                "values": np.asarray(found.values, float).round(5).tolist(),
                "steps": float(found.steps.mean()),
                "seconds": round(seconds, 2),
            }
        )
        write_json(path, {"summary": summary(rows), "rows": rows})
        print(f"{len(rows)} {entry.name}: {found.values.max():.4f} of {grid.max():.4f}, {seconds:.1f} s", flush=True)
    print(summary(rows))


if __name__ == "__main__":
    main()
