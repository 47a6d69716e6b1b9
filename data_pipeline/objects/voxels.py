"""Objects from occupancy grids, whose surfaces are extracted by marching cubes."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_pipeline.errors import DataError, EmptyMesh
from data_pipeline.objects.furniture import CLASSES as FURNITURE_CLASSES
from data_pipeline.objects.mesh import SOURCE_SPLITS, ObjectEntry, ObjectSource

FEWEST_VOXELS = 5
"""Grids with fewer occupied cells are treated as empty."""

VOXEL_CLASSES = FURNITURE_CLASSES
"""Class names of an archive of ten classes, in alphabetical order, as its labels are."""


@dataclass(frozen=True)
class VoxelGrid:
    """A cubic occupancy grid, packed to one bit per cell; its surface is the level 0.5."""

    bits: bytes
    side: int

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        from skimage.measure import marching_cubes

        grid = np.unpackbits(np.frombuffer(self.bits, np.uint8), count=self.side**3).reshape((self.side,) * 3)
        filled = int(grid.sum())
        if filled < FEWEST_VOXELS:
            raise EmptyMesh(f"voxel grid has {filled} of {grid.size} cells filled, fewer than {FEWEST_VOXELS}")
        vertices, faces, _, _ = marching_cubes(np.pad(grid, 1).astype(np.float32), 0.5)
        return vertices - 1, faces[:, ::-1]


def voxel_archive(path: Path) -> ObjectSource:
    """Returns the objects of an .npz file of occupancy grids.

    The file has cubic grids `X_train` and `X_test` (n, side, side, side) of 0 and 1, and labels `y_train` and `y_test`. With
    labels 0 to 9 the classes are those of ModelNet10, in alphabetical order.

    Raises:
        DataError: if the file is not readable, an array is missing, or shapes do not match.
    """
    try:
        with np.load(path) as archive:
            missing = [key for key in ("X_train", "y_train", "X_test", "y_test") if key not in archive.files]
            if missing:
                raise DataError(
                    f"{path} has no {', '.join(missing)}; a voxel archive has X_train, y_train, X_test and y_test"
                )
            grids = {split: archive[f"X_{split}"] for split in SOURCE_SPLITS}
            labels = {split: archive[f"y_{split}"].astype(int).reshape(-1) for split in SOURCE_SPLITS}
    except (zipfile.BadZipFile, OSError, EOFError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path} is not a readable .npz archive ({error}); download it again") from error
    for split in SOURCE_SPLITS:
        shape = grids[split].shape
        if len(shape) != 4 or len(set(shape[1:])) != 1 or shape[0] != len(labels[split]):
            raise DataError(
                f"{path}: X_{split} has shape {shape}, expected (n, side, side, side) and n labels; correct the file"
            )
    count = max(int(labels[split].max()) for split in SOURCE_SPLITS) + 1
    classes = VOXEL_CLASSES if count == len(VOXEL_CLASSES) else tuple(f"class_{i}" for i in range(count))
    entries = []
    for split in SOURCE_SPLITS:
        packed = np.packbits(grids[split].reshape(len(grids[split]), -1) > 0, axis=1)
        for index, (bits, label) in enumerate(zip(packed, labels[split], strict=True)):
            recipe = VoxelGrid(bits.tobytes(), grids[split].shape[1])
            entries.append(ObjectEntry(f"{classes[label]}_{split}_{index:04d}", int(label), split, recipe))
    return ObjectSource(path.stem, classes, tuple(entries))
