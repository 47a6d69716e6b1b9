"""Where objects come from, and what makes a mesh fit to be captured.

A *source* lists its objects, each an `ObjectEntry` whose `recipe` is small, picklable and turns into a mesh wherever it is
needed. Four sources: `furniture10` (procedural), a folder `<class>/{train,test}/*.off|obj|stl|ply|glb`, a ModelNet zip of the
same layout, and an archive of voxel grids. This module imports no JAX, so that capture workers start quickly.
"""

from __future__ import annotations

import io
import os
import zipfile
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Protocol

import numpy as np
import trimesh

from data_pipeline.furniture import CLASSES as FURNITURE_CLASSES
from data_pipeline.furniture import furniture

MESH_SUFFIXES = (".off", ".obj", ".stl", ".ply", ".glb")
SOURCE_SPLITS = ("train", "test")
FEWEST_VOXELS = 5
# Alphabetical, as the labels of the voxel archive are.
VOXEL_CLASSES = FURNITURE_CLASSES


class DataError(ValueError):
    """The data cannot be used: what was wrong, where, and what to do, in one sentence."""


class DamagedMesh(DataError):
    """A file that should be a mesh and is not, or is cut short, or holds numbers that are not finite."""


class EmptyMesh(Exception):
    """A sound mesh with nothing to see: it is left out of the data set, named and counted."""


@dataclass(frozen=True)
class Mesh:
    """Triangles of one normalised object: centred, in the unit sphere, z up.

    Attributes:
        vertices: (n, 3) float32.
        faces: (m, 3) int32.
        extent: (3,) size of the bounding box before normalisation, in the units of the file.
    """

    vertices: np.ndarray
    faces: np.ndarray
    extent: np.ndarray


class Recipe(Protocol):
    """How to make one mesh."""

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n, 3) and triangles (m, 3), as they are."""


@dataclass(frozen=True)
class ObjectEntry:
    """One object of a source: a unique name, its label, `train` or `test`, and how to load it."""

    name: str
    label: int
    split: str
    recipe: Recipe = field(repr=False)


@dataclass(frozen=True)
class ObjectSource:
    """A list of objects, their `name` together, and the names of their classes."""

    name: str
    classes: tuple[str, ...]
    entries: tuple[ObjectEntry, ...]


# ---------------------------------------------------------------------------------------------------------------- recipes


@dataclass(frozen=True)
class FurniturePiece:
    class_name: str
    seed: int

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        piece = furniture(self.class_name, self.seed)
        return piece.vertices, piece.faces


@dataclass(frozen=True)
class MeshFile:
    path: str

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        try:
            content = Path(self.path).read_bytes()
        except OSError as error:
            raise DamagedMesh(f"{self.path} cannot be read: {error.strerror}") from error
        return parse_mesh(content, Path(self.path).suffix.lower(), self.path)


@dataclass(frozen=True)
class ZipMember:
    archive: str
    member: str

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        where = f"{self.member} in {self.archive}"
        try:
            with zipfile.ZipFile(self.archive) as archive:
                content = archive.read(self.member)
        except (OSError, zipfile.BadZipFile, EOFError) as error:
            raise DamagedMesh(f"{where} cannot be unpacked: {error}") from error
        return parse_mesh(content, PurePosixPath(self.member).suffix.lower(), where)


@dataclass(frozen=True)
class VoxelGrid:
    """A cube of occupied cells, one bit each; its surface by marching cubes at one half."""

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


# ---------------------------------------------------------------------------------------------------------------- parsing


def parse_mesh(content: bytes, suffix: str, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a mesh file.

    Args:
        content: the file.
        suffix: which format, one of `MESH_SUFFIXES`.
        where: its name, for messages.

    Raises:
        DamagedMesh: not a mesh, cut short, or with coordinates that are not finite.
    """
    if suffix == ".off":
        return parse_off(content, where)
    try:
        mesh = trimesh.load_mesh(io.BytesIO(content), file_type=suffix[1:], process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # trimesh raises whatever its parsers raise
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DamagedMesh(f"{where} is not a readable {suffix} mesh ({reason}); repair it or take it away") from error
    if len(vertices) == 0:
        raise DamagedMesh(
            f"{where} is not a readable {suffix} mesh (nothing was found in it); repair it or take it away"
        )
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def parse_off(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """An OFF file, with the quirks of ModelNet's: `OFF490 518 0` on one line, comments, polygons, trailing colours."""
    try:
        text = content.decode("ascii")
    except UnicodeDecodeError as error:
        raise DamagedMesh(
            f"{where} is not an OFF mesh: it holds bytes that are not text; repair it or take it away"
        ) from error
    lines = [line.split("#", 1)[0].split() for line in text.splitlines()]
    lines = [line for line in lines if line]
    if not lines or lines[0][0][:3].upper() != "OFF":
        raise DamagedMesh(f"{where} is not an OFF mesh: it does not begin with 'OFF'; repair it or take it away")
    lines[0] = ([lines[0][0][3:]] if lines[0][0][3:] else []) + lines[0][1:]
    counts = [word for line in lines[:2] for word in line][:3]
    try:
        vertex_count, face_count = int(counts[0]), int(counts[1])
        if vertex_count < 0 or face_count < 0 or len(counts) < 3:
            raise ValueError
    except (IndexError, ValueError) as error:
        raise DamagedMesh(f"{where} is not an OFF mesh: its counts are missing; repair it or take it away") from error
    body = lines[1 if lines[0] else 2 :]
    vertex_lines, face_lines = body[:vertex_count], body[vertex_count : vertex_count + face_count]
    whole = [line for line in vertex_lines if len(line) >= 3]
    if len(whole) < vertex_count:
        raise DamagedMesh(
            f"{where} is cut short: {len(whole)} of {vertex_count} vertices are there; fetch or export it again"
        )
    try:
        vertices = np.array([line[:3] for line in vertex_lines], np.float64).reshape(-1, 3)
        triangles: list[tuple[int, int, int]] = []
        for number, line in enumerate(face_lines):  # colours may follow a face's corners
            corners = int(line[0])
            if len(line) < corners + 1:
                face_lines = face_lines[:number]
                break
            face = [int(word) for word in line[1 : corners + 1]]
            triangles += [(face[0], face[i], face[i + 1]) for i in range(1, corners - 1)]
    except ValueError as error:
        raise DamagedMesh(f"{where} is not an OFF mesh: {error}; repair it or take it away") from error
    if len(face_lines) < face_count:
        raise DamagedMesh(
            f"{where} is cut short: {len(face_lines)} of {face_count} faces are there; fetch or export it again"
        )
    return vertices, np.array(triangles, np.int64).reshape(-1, 3)


def normalise(vertices: np.ndarray, faces: np.ndarray, where: str) -> Mesh:
    """Centred on its bounding box and scaled into the unit sphere; only vertices that a face uses count.

    Raises:
        DamagedMesh: coordinates that are not finite, or faces that name vertices that are not there.
        EmptyMesh: no faces, or none with an area.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices).all(axis=1)).sum())
        raise DamagedMesh(
            f"{where} has {bad} vertices that are not finite (NaN or infinite); repair it or take it away"
        )
    if len(faces) == 0 or len(vertices) == 0:
        raise EmptyMesh("mesh has no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise DamagedMesh(f"{where} has faces that name vertices beyond its {len(vertices)}; repair it or take it away")
    used, compact = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], compact.reshape(faces.shape)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centred = vertices - (low + high) / 2
    radius = np.linalg.norm(centred, axis=1).max()
    if radius == 0:
        raise EmptyMesh("mesh is a single point")
    centred /= radius
    corners = centred[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    if area.sum() < 1e-9:
        raise EmptyMesh("mesh has no area: all its faces are degenerate")
    return Mesh(centred.astype(np.float32), faces[area > 0].astype(np.int32), (high - low).astype(np.float32))


def load_object(entry: ObjectEntry) -> Mesh:
    """The normalised mesh of one object; raises `EmptyMesh` or `DamagedMesh`."""
    vertices, faces = entry.recipe.load()
    return normalise(vertices, faces, entry.name)


# ---------------------------------------------------------------------------------------------------------------- sources


def furniture10(train_per_class: int, test_per_class: int) -> ObjectSource:
    """Procedural furniture, the same for the same numbers; test pieces come from other seeds than training ones."""
    if train_per_class < 2 or test_per_class < 1:
        raise DataError(
            f"furniture10 needs at least 2 training and 1 test pieces a class, got {train_per_class} and {test_per_class}"
        )
    entries = []
    for label, name in enumerate(FURNITURE_CLASSES):
        for split, count, first in (("train", train_per_class, 0), ("test", test_per_class, 1_000_000)):
            for seed in range(first, first + count):
                entries.append(
                    ObjectEntry(f"{name}_{split}_{seed - first:04d}", label, split, FurniturePiece(name, seed))
                )
    return ObjectSource("furniture10", FURNITURE_CLASSES, tuple(entries))


def _layout(files: list[PurePosixPath], where: str) -> dict[tuple[str, str], list[PurePosixPath]]:
    """Files by (class, split), from paths that end in `<class>/<train|test>/<file>`."""
    found: dict[tuple[str, str], list[PurePosixPath]] = {}
    for path in sorted(files):
        if path.suffix.lower() in MESH_SUFFIXES and len(path.parts) >= 3 and path.parts[-2] in SOURCE_SPLITS:
            found.setdefault((path.parts[-3], path.parts[-2]), []).append(path)
    if not found:
        raise DataError(
            f"{where} holds no meshes laid out as <class>/train/*.off and <class>/test/*.off "
            f"(or {', '.join(MESH_SUFFIXES[1:])}); point --data at a folder that does"
        )
    return found


def _entries(
    found: dict[tuple[str, str], list[PurePosixPath]], recipe_of, where: str
) -> tuple[tuple[str, ...], list[ObjectEntry]]:
    classes = tuple(sorted({name for name, _ in found}))
    if len(classes) < 2:
        raise DataError(f"{where} has one class only ({classes[0]}); a classifier needs at least two class folders")
    entries = []
    for (name, split), paths in sorted(found.items()):
        for path in paths:
            entries.append(ObjectEntry(f"{name}/{split}/{path.name}", classes.index(name), split, recipe_of(path)))
    for name in classes:
        for split in SOURCE_SPLITS:
            if (name, split) not in found:
                raise DataError(f"{where} has no meshes in {name}/{split}; add some, or take the class folder away")
    return classes, entries


def mesh_folder(folder: Path) -> ObjectSource:
    """A folder `<class>/{train,test}/*.{off,obj,stl,ply,glb}`, ModelNet's own layout, at any depth."""
    files = [PurePosixPath(path.relative_to(folder).as_posix()) for path in sorted(folder.rglob("*")) if path.is_file()]
    for child in sorted(folder.iterdir()):
        splits = [child / split for split in SOURCE_SPLITS if (child / split).is_dir()]
        if child.is_dir() and not child.name.startswith(".") and not any(child.iterdir()):
            raise DataError(
                f"class folder {child} is empty; put meshes into its train and test folders, or take it away"
            )
        for part in splits:
            if not any(path.suffix.lower() in MESH_SUFFIXES for path in part.iterdir()):
                raise DataError(f"class folder {part} is empty; put meshes there, or take the class folder away")
    found = _layout(files, str(folder))
    classes, entries = _entries(found, lambda path: MeshFile(str(folder / path)), str(folder))
    return ObjectSource(folder.name, classes, tuple(entries))


def mesh_zip(archive: Path) -> ObjectSource:
    """A zip of that layout, such as ModelNet10.zip; read in place, never unpacked."""
    try:
        with zipfile.ZipFile(archive) as opened:
            infos = [info for info in opened.infolist() if not info.is_dir()]
    except (zipfile.BadZipFile, OSError) as error:
        raise DataError(f"{archive} is not a readable zip file ({error}); download it again") from error
    for info in infos:
        path = PurePosixPath(info.filename.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or (path.parts and ":" in path.parts[0]):
            raise DataError(
                f"{archive} holds {info.filename!r}, a path that leaves its folder; do not trust this archive"
            )
    usable = [info for info in infos if "__MACOSX" not in info.filename]
    found = _layout([PurePosixPath(info.filename) for info in usable], str(archive))
    classes, entries = _entries(found, lambda path: ZipMember(str(archive), str(path)), str(archive))
    return ObjectSource(archive.stem, classes, tuple(entries))


def voxel_archive(path: Path) -> ObjectSource:
    """An .npz of cubic grids `X_train`, `X_test` (n, side, side, side) of 0 and 1, and labels `y_train`, `y_test`.

    With labels 0..9 the classes are ModelNet10's, in alphabetical order.
    """
    try:
        with np.load(path) as archive:
            missing = [key for key in ("X_train", "y_train", "X_test", "y_test") if key not in archive.files]
            if missing:
                raise DataError(
                    f"{path} lacks {', '.join(missing)}; a voxel archive holds X_train, y_train, X_test and y_test"
                )
            grids = {split: archive[f"X_{split}"] for split in SOURCE_SPLITS}
            labels = {split: archive[f"y_{split}"].astype(int).reshape(-1) for split in SOURCE_SPLITS}
    except (zipfile.BadZipFile, OSError, EOFError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path} is not a readable .npz archive ({error}); fetch it again") from error
    for split in SOURCE_SPLITS:
        shape = grids[split].shape
        if len(shape) != 4 or len(set(shape[1:])) != 1 or shape[0] != len(labels[split]):
            raise DataError(f"{path}: X_{split} has shape {shape}, expected (n, side, side, side) and n labels")
    count = max(int(labels[split].max()) for split in SOURCE_SPLITS) + 1
    classes = VOXEL_CLASSES if count == len(VOXEL_CLASSES) else tuple(f"class_{i}" for i in range(count))
    entries = []
    for split in SOURCE_SPLITS:
        packed = np.packbits(grids[split].reshape(len(grids[split]), -1) > 0, axis=1)
        for index, (bits, label) in enumerate(zip(packed, labels[split], strict=True)):
            recipe = VoxelGrid(bits.tobytes(), grids[split].shape[1])
            entries.append(ObjectEntry(f"{classes[label]}_{split}_{index:04d}", int(label), split, recipe))
    return ObjectSource(path.stem, classes, tuple(entries))


def open_source(data: str, *, train_per_class: int, test_per_class: int) -> ObjectSource:
    """The source that `data` names: `furniture10`, a folder, a .zip or an .npz.

    Raises:
        DataError: where there is no such file or it is none of these.
    """
    if data == "furniture10":
        return furniture10(train_per_class, test_per_class)
    path = Path(os.path.expanduser(data))
    if not path.exists():
        raise DataError(
            f"no such file or folder: {data}; --data takes furniture10, modelnet10, modelnet40, a folder of class folders, "
            f"a .zip or a .npz"
        )
    if path.is_dir():
        return mesh_folder(path.resolve())
    if path.suffix.lower() == ".zip":
        return mesh_zip(path.resolve())
    if path.suffix.lower() == ".npz":
        return voxel_archive(path.resolve())
    if path.suffix.lower() in MESH_SUFFIXES:
        vertices, faces = MeshFile(str(path)).load()  # says so if it is damaged
        normalise(vertices, faces, str(path))
        raise DataError(
            f"{data} is a single mesh; --data takes a folder laid out as <class>/train/*.off and <class>/test/*.off"
        )
    raise DataError(f"{data} is not a data set: not a mesh folder, a .zip or a .npz")
