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
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from data_pipeline.errors import EmptyMesh
from data_pipeline.files import read_json, write_json
from data_pipeline.objects.sources import load_object, open_source
from eval.rendering.ascent import METHODS, ascend_on_sphere, look_everywhere

RESULTS = Path(__file__).parent / "results"
SIDE, STARTS = 64, 40


def row_of(name: str, values: np.ndarray, grid: np.ndarray, seconds: float) -> dict[str, Any]:
    """What is kept of an object: the grid's ends, the highest climb, and the shares of starts that came near."""
    best, worst = float(grid.max()), float(grid.min())
    return {
        "object": name,
        "best": best,
        "worst": worst,
        "highest": float(values.max()),
        "near_maximum": float((values >= best - 0.05 * abs(best)).mean()),
        "near_range": float((values >= best - 0.05 * (best - worst)).mean()),
        "seconds": round(seconds, 2),
    }


def summary(rows: list[dict[str, Any]]) -> str:
    parts = []
    for name in ("maximum", "range"):
        near = np.array([row[f"near_{name}"] for row in rows])
        parts.append(
            f"within 5 % of the {name}: {100 * (near > 0).mean():.1f} % of objects, {100 * near.mean():.1f} % of single starts"
        )
    seconds = np.array([row["seconds"] for row in rows])
    parts.append(f"{np.median(seconds):.1f} s an object (median), {seconds.max():.1f} s at most")
    return f"{len(rows)} objects; " + "; ".join(parts)


def main() -> None:
    if len(sys.argv) not in (3, 4) or sys.argv[1] not in METHODS:
        print("usage: python benchmarks/ascent.py mesh|volume DATA [OBJECTS]", file=sys.stderr)
        sys.exit(2)
    method = METHODS[sys.argv[1]]
    count = int(sys.argv[3]) if len(sys.argv) == 4 else 100
    source = open_source(sys.argv[2], train_per_class=1, test_per_class=count // 10)
    entries = [entry for entry in source.entries if entry.split == "test"]
    chosen = [entries[index] for index in np.linspace(0, len(entries) - 1, count).astype(int)]
    dense = np.asarray(trimesh.creation.icosphere(4).vertices)
    climb_on = jax.jit(lambda thing: ascend_on_sphere(method, thing, STARTS, SIDE))
    look = jax.jit(lambda thing: look_everywhere(method, thing, dense, SIDE))

    path = RESULTS / f"ascent_{sys.argv[1]}.json"
    rows: list[dict[str, Any]] = read_json(path)["rows"] if path.exists() else []
    done, left_out = {row["object"] for row in rows}, 0
    for entry in chosen:
        if entry.name in done:
            continue
        try:
            thing = jnp.asarray(method.prepare(load_object(entry)))
        except EmptyMesh as reason:
            print(f"left out: {entry.name}: {reason}")
            left_out += 1
            continue
        if not rows:
            jax.block_until_ready(climb_on(thing))  # compiles
        begun = time.perf_counter()
        found = jax.block_until_ready(climb_on(thing))
        seconds = time.perf_counter() - begun
        rows.append(row_of(entry.name, np.asarray(found.values), np.asarray(look(thing)), seconds))
        write_json(path, {"summary": summary(rows), "rows": rows})
        print(
            f"{len(rows)} {entry.name}: {rows[-1]['highest']:.4f} of {rows[-1]['best']:.4f}, {seconds:.1f} s",
            flush=True,
        )
    print(f"{summary(rows)}; {left_out} objects left out")


if __name__ == "__main__":
    main()
