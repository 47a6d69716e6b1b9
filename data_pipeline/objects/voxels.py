"""Objects from occupancy grids, whose surfaces are extracted by marching cubes."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.errors import Damage, DataError, EmptyMesh, naming, reason_of
from data_pipeline.objects.mesh import MODELNET10_CLASSES, SOURCE_SPLITS, ObjectEntry, ObjectSource
from mevs_jax.meshes.reading import shown

FEWEST_VOXELS = 5
"""Grids with fewer occupied cells are treated as empty."""

LARGEST_GRIDS = 4 << 30
"""Largest size in bytes of the unpacked grids of a split. They are read in parts and kept as one bit per cell."""

MOST_OBJECTS = 1_000_000
"""Largest number of objects of a split."""

LARGEST_LABELS = 64 << 20
"""Largest size in bytes of unpacked labels or class names, and of grids in Fortran's order, which are not read in parts."""

_BYTES_PER_PART = 16 << 20


@dataclass(frozen=True)
class VoxelGrid:
    """A cubic occupancy grid, packed to one bit per cell; its surface is the level 0.5."""

    bits: bytes
    side: int

    @property
    def stamp(self) -> str:
        """Checksum of the grid. Captures of another grid of the same name are not used."""
        return f"{zlib.crc32(self.bits):08x}"

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

    The file has cubic grids `X_train` and `X_test` (n, side, side, side), where a positive number is an occupied cell, and labels
    `y_train` and `y_test` (n,). An optional array `classes` names the classes. Without it, ten classes are those of
    ModelNet10, in alphabetical order. Nothing is unpickled.

    Raises:
        DataError: if the file is not readable, an array is missing or of another kind, shapes do not match, a split is empty, or
            the labels are not 0 to n − 1.
    """
    where = shown(str(path))
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            missing = [key for key in ("X_train", "y_train", "X_test", "y_test") if key not in members]
            if missing:
                need = "a voxel archive has X_train, y_train, X_test and y_test"
                raise DataError(f"{where} has no {', '.join(missing)}; {need}")

            def read(key: str, reader: Callable[..., Any], *more: Any) -> Any:
                with naming(f"{where}: {key}", DataError):
                    return reader(archive, members[key], *more)

            named = read("classes", _names) if "classes" in members else None
            labels = {split: read(f"y_{split}", _labels) for split in SOURCE_SPLITS}
            with naming(f"{where}:", DataError):
                count = _count_of_classes(labels, named)
            if count < 2:
                raise DataError(f"{where} has one class only; add objects of at least one other class")
            classes = named or (MODELNET10_CLASSES if count == 10 else tuple(f"class_{i}" for i in range(count)))
            entries = []
            for split in SOURCE_SPLITS:
                grids = read(f"X_{split}", _grids, len(labels[split]))
                for index, (recipe, label) in enumerate(zip(grids, labels[split].tolist(), strict=True)):
                    entries.append(ObjectEntry(f"{classes[label]}_{split}_{index:04d}", label, split, recipe))
    except DataError:
        raise
    except Exception as error:  # damaged archives raise errors of zipfile, zlib, struct, NumPy and others
        raise DataError(f"{where} is not a readable .npz archive ({reason_of(error)}); download it again") from error
    return ObjectSource(shown(path.stem), classes, tuple(entries))


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns the shape, Fortran order and type of an array from the head of its file, which is open."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, fortran, kind = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, fortran, kind = np.lib.format.read_array_header_2_0(file)
    else:
        raise Damage(f"has version {version} of the .npy format; save it with numpy.savez")
    if kind.hasobject:
        raise Damage("holds Python objects, which are never unpickled; save numbers")
    return shape, fortran, kind


def _small_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    if info.file_size > LARGEST_LABELS:
        raise Damage(f"unpacks to more than {LARGEST_LABELS >> 20} MB; save it smaller")
    with archive.open(info) as file:
        shape, fortran, kind = _header(file)
        content = file.read(LARGEST_LABELS + 1)
    count = math.prod(shape)
    if len(content) != count * kind.itemsize:
        raise Damage(f"is cut short: {len(content)} of {count * kind.itemsize} bytes; download it again")
    array = np.frombuffer(content, kind) if kind.itemsize else np.zeros(count, kind)
    return array.reshape(shape, order="F" if fortran else "C")


def _names(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[str, ...]:
    names = _small_array(archive, info)
    if names.dtype.kind not in "US" or names.ndim != 1:
        raise Damage(f"has type {names.dtype} and shape {names.shape}; give a list of strings")
    found = tuple(name.decode("utf-8", "replace") if isinstance(name, bytes) else name for name in names.tolist())
    if len(set(found)) < len(found) or not all(found) or not all(name.isprintable() for name in found):
        raise Damage("has a name twice, an empty one, or one that cannot be printed; correct it")
    return found


def _labels(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Returns the labels of a split, (n,) int64."""
    labels = _small_array(archive, info)
    kind, shape = labels.dtype, labels.shape
    whole = "give whole numbers from 0 on"
    if kind.kind in "US":
        raise Damage(f"holds strings; {whole}, and the names of the classes as an array `classes`")
    if labels.ndim == 2 and shape[1] > 1:
        raise Damage(f"has shape {shape}, as labels coded one-hot have; give one number for each object (argmax)")
    if kind.kind not in "biuf" or labels.ndim not in (1, 2):
        raise Damage(f"has type {kind} and shape {shape}; give whole numbers (n,)")
    labels = labels.reshape(-1)
    if not len(labels):
        raise Damage("is empty; a voxel archive needs training and test objects")
    if len(labels) > MOST_OBJECTS:
        raise Damage(f"has {len(labels):,} labels, more than {MOST_OBJECTS:,}; divide the archive")
    if not np.isfinite(labels).all() or (labels != np.floor(labels)).any():
        raise Damage(f"has labels that are not whole numbers; {whole}")
    if labels.min() < 0:
        below = f"the label {int(labels.min())}, and {int((labels < 0).sum())} labels below 0"
        raise Damage(f"has {below}; take objects without a class out, and number the classes from 0 on")
    if labels.max() > 2**31:
        raise Damage(f"has the label {int(labels.max())}; number the classes from 0 on")
    return labels.astype(np.int64)


def _count_of_classes(labels: dict[str, np.ndarray], named: tuple[str, ...] | None) -> int:
    """Returns the number of classes after a check that every class has training objects."""
    present = np.unique(labels["train"])
    count = max(int(labels[split].max()) for split in SOURCE_SPLITS) + 1
    if named is not None and count != len(named):
        raise Damage(f"classes has {len(named)} names, and the labels go up to {count - 1}; correct one of them")
    if len(present) < count:
        absent = next(label for label in range(count) if label >= len(present) or present[label] != label)
        from_one = absent == 0 and len(present) == count - 1
        advice = "subtract 1 from all labels" if from_one else "number the classes from 0 on"
        raise Damage(f"labels go up to {count - 1}, and no training object has the label {absent}; {advice}")
    return count


def _grids(archive: zipfile.ZipFile, info: zipfile.ZipInfo, count: int) -> list[VoxelGrid]:
    """Returns the grids of a split, which are read in parts."""
    found = []
    with archive.open(info) as file:
        shape, fortran, kind = _header(file)
        if len(shape) != 4 or len(set(shape[1:])) != 1 or shape[0] != count:
            expected = f"expected ({count}, side, side, side) for {count} labels"
            raise Damage(f"has shape {shape}, {expected}; correct the file")
        if kind.kind not in "biuf":
            raise Damage(f"has type {kind}; give grids of 0 and 1")
        side = shape[1]
        size = side**3 * kind.itemsize
        limit = LARGEST_LABELS if fortran or size > LARGEST_LABELS else LARGEST_GRIDS
        if not side or size * count > limit:
            grids = f"{count} grids of {side}³ cells as {kind}"
            raise Damage(f"has {grids}, which is nothing or more than {limit >> 20} MB; save smaller ones as uint8")
        per_part = count if fortran else max(1, _BYTES_PER_PART // size)
        for first in range(0, count, per_part):
            part = min(per_part, count - first)
            content = file.read(part * size)
            if len(content) < part * size:
                raise Damage(f"is cut short: {first} of {count} grids are there; download it again")
            stored = np.frombuffer(content, kind)
            cells = (stored.reshape(shape, order="F") if fortran else stored).reshape(part, -1)
            if kind.kind == "f" and not np.isfinite(cells).all():
                raise Damage("has cells that are not finite (NaN or infinite); correct the file")
            found += [VoxelGrid(bits.tobytes(), side) for bits in np.packbits(cells > 0, axis=1)]
        if file.read(1):
            raise Damage(f"is longer than its shape {shape}; save it again with numpy.savez")
    return found
