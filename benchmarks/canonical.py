"""How well images of any depth camera become those of the data set's camera: `python benchmarks/canonical.py [FOLDER]`.

Random cameras take images of objects (`eval.checks.camera`), `mevs_jax.canonical_view` converts them, and the results are
compared with what the data set's camera takes from the same directions: the overlap (intersection over union) of the masks, and
depth where both images show the object. "Visible" is the share of the object's pixels that the random camera sees at all,
which bounds the overlap. Then the conversion is timed. The objects are furniture10's, or the meshes in FOLDER and below.

The tables are written to `benchmarks/results/canonical.json` and `canonical.md`.
"""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import numpy as np
import tyro

from data_pipeline.files import write_json, write_text
from data_pipeline.objects.formats import MESH_SUFFIXES
from data_pipeline.objects.mesh import Mesh, normalise
from data_pipeline.objects.recipes import MeshFile
from data_pipeline.objects.sources import furniture10, load_object
from eval.checks.camera import SIZES, agreements, milliseconds, summary
from mevs_jax import ViewCamera
from mevs_jax.markdown import markdown_row, markdown_table

RESULTS = Path(__file__).parent / "results" / "canonical.json"
DISTANCES = (2.0, 1.5, 3.0, 4.0, 5.0, 6.0)
AGREEMENT = (
    "radii",
    "views",
    "overlap",
    "5th percentile",
    "visible",
    "5th percentile",
    "error of depth, % of the radius",
    "unknown",
)
TIMES = ("source", "radii", "pixels a side", "p50, ms", "p99, ms")


@dataclass(frozen=True)
class Options:
    """What is measured."""

    folder: Annotated[Path | None, tyro.conf.Positional] = None
    """meshes; furniture10 without one"""
    per_class: int = 1
    """pieces of each of furniture10's ten classes"""
    shots: int = 20
    """cameras for each object and distance"""
    resolution: int = 64
    """pixels along each side of the data set's images"""


def objects(options: Options) -> list[Mesh]:
    if options.folder is None:
        source = furniture10(2, options.per_class)
        return [load_object(entry) for entry in source.entries if entry.split == "test"]
    paths = sorted(path for path in options.folder.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
    return [normalise(*MeshFile(str(path)).load(), path.name) for path in paths]


def agreement_cells(row: dict[str, float]) -> list[str]:
    shares = [row[name] for name in ("overlap_median", "overlap_low", "visible_median", "visible_low")]
    cells = [f"{row['distance']:g}", f"{row['views']:.0f}", *(f"{share:.3f}" for share in shares)]
    return [*cells, f"{100 * row['error_median']:.2g}", f"{row['unknown_median']:.3f}"]


def time_cells(row: dict[str, float]) -> list[str]:
    cells = [f"{row['width']:.0f}×{row['height']:.0f}", f"{row['distance']:g}", f"{row['resolution']:.0f}"]
    return [*cells, f"{row['p50_ms']:.2f}", f"{row['p99_ms']:.2f}"]


def compare(meshes: list[Mesh], options: Options) -> list[dict[str, float]]:
    rows = []
    for distance in DISTANCES:
        camera = ViewCamera(options.resolution)
        found = list(agreements(meshes, distance, shots=options.shots, camera=camera))
        rows.append({"distance": distance, **summary(found)})
        print(markdown_row(agreement_cells(rows[-1])), flush=True)
    return rows


def time_all(mesh: Mesh, resolutions: tuple[int, ...]) -> list[dict[str, float]]:
    rows = []
    for resolution in resolutions:
        for width, height in SIZES:
            for distance in (2.0, 4.0):
                taken = milliseconds(mesh, (width, height), ViewCamera(resolution), distance=distance)
                p50, p99 = np.quantile(taken, (0.5, 0.99))
                row = {"width": width, "height": height, "distance": distance, "resolution": resolution}
                rows.append({**row, "p50_ms": float(p50), "p99_ms": float(p99)})
                print(markdown_row(time_cells(rows[-1])), flush=True)
    return rows


def main(options: Options) -> None:
    machine = f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, JAX {jax.__version__}"
    meshes = objects(options)
    if not meshes:
        sys.exit(f"no meshes in {options.folder}; give a folder of mesh files")
    name = f"{len(meshes)} objects of {options.folder.name if options.folder else 'furniture10'}"
    print(f"Measured on: {machine}. {name}.\n\n{markdown_table(AGREEMENT, [])}")
    compared = compare(meshes, options)
    print(f"\n{markdown_table(TIMES, [])}")
    timed = time_all(meshes[0], (64, 224))
    if options.folder is not None:
        return  # the results that are kept are those of furniture10
    write_json(RESULTS, {"machine": machine, "objects": name, "agreement": compared, "times": timed})
    write_text(
        RESULTS.with_suffix(".md"),
        f"{machine}. {name}, images of {options.resolution} pixels a side, cameras of 320×240 to 1280×720.\n\n"
        f"Agreement with the data set's camera, medians over the views.\n\n"
        f"{markdown_table(AGREEMENT, [agreement_cells(row) for row in compared])}\n\n"
        f"Milliseconds of one conversion.\n\n{markdown_table(TIMES, [time_cells(row) for row in timed])}\n",
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__.splitlines()[0]))
