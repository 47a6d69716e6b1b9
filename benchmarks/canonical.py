"""How well images of any depth camera become those of the data set's camera: `python benchmarks/canonical.py [FOLDER]`.

Random cameras take images of objects (`eval.checks.camera`), `mevs_jax.canonical_view` converts them, and the results are
compared with what the data set's camera takes from the same directions: the overlap (intersection over union) of the masks, and
depth where both images show the object. "Visible" is the share of the object's pixels that the random camera sees at all,
which bounds the overlap. Then the conversion is timed. The objects are furniture10's, or the meshes in FOLDER and below.

The tables are written to `benchmarks/results/canonical.json` and `canonical.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from benchmarks.reporting import RESULTS, Row, Table, keep, machine_name, refuse
from data_pipeline.objects.mesh import Mesh, normalise
from data_pipeline.objects.recipes import MeshFile
from data_pipeline.objects.sources import furniture10, load_object
from eval.checks.camera import SIZES, agreements, milliseconds, summary
from mevs_jax import ViewCamera
from mevs_jax.meshes import MESH_SUFFIXES

DISTANCES = (2.0, 1.5, 3.0, 4.0, 5.0, 6.0)
AGREEMENT = Table(
    "radii | views | overlap | 5th percentile | visible | 5th percentile | error of depth, % of the radius | unknown",
    "{distance:g} | {views} | {overlap_median:.3f} | {overlap_low:.3f} | {visible_median:.3f} | {visible_low:.3f} | "
    "{error_percent:.2g} | {unknown_median:.3f}",
)
TIMES = Table(
    "source | radii | pixels a side | p50, ms | p99, ms",
    "{width}×{height} | {distance:g} | {resolution} | {p50_ms:.2f} | {p99_ms:.2f}",
)


def objects(folder: Path | None, per_class: int) -> list[Mesh]:
    if folder is None:
        return [load_object(entry) for entry in furniture10(2, per_class).entries if entry.split == "test"]
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
    return [normalise(*MeshFile(str(path)).load(), path.name) for path in paths]


def compare(meshes: list[Mesh], shots: int, camera: ViewCamera) -> Iterator[Row]:
    for distance in DISTANCES:
        row = summary(list(agreements(meshes, distance, shots=shots, camera=camera)))
        yield {"distance": distance, **row, "error_percent": 100 * row["error_median"]}


def time_all(mesh: Mesh) -> Iterator[Row]:
    for resolution in (64, 224):
        for width, height in SIZES:
            for distance in (2.0, 4.0):
                taken = milliseconds(mesh, (width, height), ViewCamera(resolution), distance=distance)
                p50, p99 = np.quantile(taken, (0.5, 0.99)).tolist()
                row = {"width": width, "height": height, "distance": distance, "resolution": resolution}
                yield {**row, "p50_ms": p50, "p99_ms": p99}


def main(
    folder: Annotated[Path | None, tyro.conf.Positional] = None,
    per_class: int = 1,
    shots: int = 20,
    resolution: int = 64,
) -> None:
    """Measures, shows and keeps.

    Args:
        folder: of meshes; furniture10 without one.
        per_class: pieces of each of furniture10's ten classes.
        shots: cameras for each object and distance.
        resolution: pixels along each side of the data set's images.
    """
    meshes = objects(folder, per_class)
    if not meshes:
        refuse(f"no meshes in {folder}; give a folder of mesh files")
    name = f"{len(meshes)} objects of {folder.name if folder else 'furniture10'}"
    print(f"Measured on: {machine_name()}. {name}.")
    compared = AGREEMENT.show(compare(meshes, shots, ViewCamera(resolution)))
    timed = TIMES.show(time_all(meshes[0]))
    if folder is not None:
        return  # the results that are kept are those of furniture10
    keep(
        RESULTS / "canonical.json",
        {"objects": name, "agreement": compared, "times": timed},
        f"{name}, images of {resolution} pixels a side, cameras of 320×240 to 1280×720.",
        "Agreement with the data set's camera, medians over the views.",
        AGREEMENT.markdown(compared),
        "Milliseconds of one conversion.",
        TIMES.markdown(timed),
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
