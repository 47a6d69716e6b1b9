"""Whether gradient ascent over the sphere finds the best view: `python benchmarks/ascent.py METHOD DATA [OBJECTS]`.

METHOD is `volume` (opacity entropy of a grid of densities, 32³) or `mesh` (depth entropy of at most 500 faces,
rendered softly). DATA is any source of objects; OBJECTS (100) are taken evenly from its test split. Images are 64×64.
The ascent starts from the 40 Fibonacci viewpoints of each object. The maximum of the objective over a dense grid of
2,562 directions is the reference. The summary gives the share of objects whose best start, and the share of single
starts that, end within 5 % of that maximum, and within 5 % of the grid's range, which is harder if all views are
nearly equal; and the seconds per object for all starts.

Results are written to `benchmarks/results/ascent_METHOD.json` after each object; a stopped command continues where it stopped.
"""

from __future__ import annotations

import time
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

from benchmarks.reporting import RESULTS, Row
from data_pipeline.errors import EmptyMesh
from data_pipeline.files import read_json, write_json
from data_pipeline.objects.sources import load_object, open_source
from eval.rendering.ascent import METHODS, ascend_on_sphere, look_everywhere

SIDE, STARTS = 64, 40


def row_of(name: str, values: np.ndarray, grid: np.ndarray, seconds: float) -> Row:
    """Result of an object: range of the grid, best value of the ascent, and shares of starts that ended near the maximum."""
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


def summary(rows: list[Row]) -> str:
    parts = []
    for name in ("maximum", "range"):
        near = np.array([row[f"near_{name}"] for row in rows])
        parts.append(
            f"within 5 % of the {name}: {100 * (near > 0).mean():.1f} % of objects, {100 * near.mean():.1f} % of single starts"
        )
    seconds = np.array([row["seconds"] for row in rows])
    parts.append(f"{np.median(seconds):.1f} s an object (median), {seconds.max():.1f} s at most")
    return f"{len(rows)} objects; " + "; ".join(parts)


def main(
    method: Annotated[Literal["mesh", "volume"], tyro.conf.Positional],
    data: Annotated[str, tyro.conf.Positional],
    objects: Annotated[int, tyro.conf.Positional] = 100,
) -> None:
    """Measures, shows and keeps.

    Args:
        method: mesh or volume.
        data: any source of objects.
        objects: how many of its test objects.
    """
    how, path = METHODS[method], RESULTS / f"ascent_{method}.json"
    source = open_source(data, train_per_class=1, test_per_class=-(-objects // 10))
    entries = [entry for entry in source.entries if entry.split == "test"]
    dense = np.asarray(trimesh.creation.icosphere(4).vertices)
    run_ascent = jax.jit(lambda thing: ascend_on_sphere(how, thing, STARTS, SIDE))
    evaluate_grid = jax.jit(lambda thing: look_everywhere(how, thing, dense, SIDE))
    rows: list[Row] = read_json(path)["rows"] if path.exists() else []
    done, left_out = {row["object"] for row in rows}, 0
    for entry in (entries[index] for index in np.linspace(0, len(entries) - 1, objects).astype(int)):
        if entry.name in done:
            continue
        try:
            thing = jnp.asarray(how.prepare(load_object(entry)))
        except EmptyMesh as reason:
            print(f"left out: {entry.name}: {reason}")
            left_out += 1
            continue
        if not rows:
            jax.block_until_ready(run_ascent(thing))  # compiles
        begun = time.perf_counter()
        ends = jax.block_until_ready(run_ascent(thing))
        seconds = time.perf_counter() - begun
        rows.append(row_of(entry.name, np.asarray(ends.values), np.asarray(evaluate_grid(thing)), seconds))
        write_json(path, {"summary": summary(rows), "rows": rows})
        best, highest = rows[-1]["best"], rows[-1]["highest"]
        print(f"{len(rows)} {entry.name}: {highest:.4f} of {best:.4f}, {seconds:.1f} s", flush=True)
    print(f"{summary(rows)}; {left_out} objects left out")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
