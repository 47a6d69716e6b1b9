"""Sources of objects.

A *source* lists objects. Each is an `ObjectEntry` whose `recipe` is small, picklable, and makes the mesh in the process that
needs it. There are four sources: `furniture10` (procedural), a folder `<class>/{train,test}/*.off|obj|stl|ply|glb`, a zip
archive of the same layout such as ModelNet's, and an archive of voxel grids. Capture workers import this module, so it must
not import JAX, which would slow their start.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path, PurePosixPath

from data_pipeline.errors import DataError
from data_pipeline.objects.formats import MESH_SUFFIXES
from data_pipeline.objects.furniture import CLASSES as FURNITURE_CLASSES
from data_pipeline.objects.mesh import SOURCE_SPLITS, Mesh, ObjectEntry, ObjectSource, normalise
from data_pipeline.objects.recipes import FurniturePiece, MeshFile, ZipMember
from data_pipeline.objects.voxels import voxel_archive


def load_object(entry: ObjectEntry) -> Mesh:
    """Returns the normalised mesh of one object.

    Raises:
        EmptyMesh: if there is no surface.
        DamagedMesh: if the file is not a readable mesh.
    """
    vertices, faces = entry.recipe.load()
    return normalise(vertices, faces, entry.name)


def furniture10(train_per_class: int, test_per_class: int) -> ObjectSource:
    """Returns procedural furniture. Training and test pieces are made from different seeds.

    Raises:
        DataError: if there are fewer than 2 training pieces or no test pieces per class.
    """
    if train_per_class < 2 or test_per_class < 1:
        raise DataError(
            f"furniture10 needs at least 2 training pieces and 1 test piece per class, got {train_per_class} and {test_per_class}"
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
    """Returns files by (class, split), from paths that end in `<class>/<train|test>/<file>`."""
    found: dict[tuple[str, str], list[PurePosixPath]] = {}
    for path in sorted(files):
        if path.suffix.lower() in MESH_SUFFIXES and len(path.parts) >= 3 and path.parts[-2] in SOURCE_SPLITS:
            found.setdefault((path.parts[-3], path.parts[-2]), []).append(path)
    if not found:
        raise DataError(
            f"{where} has no meshes laid out as <class>/train/*.off and <class>/test/*.off "
            f"(or {', '.join(MESH_SUFFIXES[1:])}); pass --data a folder that has"
        )
    return found


def _entries(
    found: dict[tuple[str, str], list[PurePosixPath]], recipe_of, where: str
) -> tuple[tuple[str, ...], list[ObjectEntry]]:
    """Returns the classes and entries of `found` (see `_layout`); `recipe_of` makes the recipe of a path."""
    classes = tuple(sorted({name for name, _ in found}))
    if len(classes) < 2:
        raise DataError(f"{where} has one class only ({classes[0]}); add the folder of at least one other class")
    entries = []
    for (name, split), paths in sorted(found.items()):
        for path in paths:
            entries.append(ObjectEntry(f"{name}/{split}/{path.name}", classes.index(name), split, recipe_of(path)))
    for name in classes:
        for split in SOURCE_SPLITS:
            if (name, split) not in found:
                raise DataError(f"{where} has no meshes in {name}/{split}; add some, or remove the class folder")
    return classes, entries


def mesh_folder(folder: Path) -> ObjectSource:
    """Returns the objects of a folder `<class>/{train,test}/*.{off,obj,stl,ply,glb}`, ModelNet's layout, at any depth.

    Raises:
        DataError: if the layout differs, a class has no meshes for a split, or there are fewer than two classes.
    """
    files = [PurePosixPath(path.relative_to(folder).as_posix()) for path in sorted(folder.rglob("*")) if path.is_file()]
    for child in sorted(folder.iterdir()):
        splits = [child / split for split in SOURCE_SPLITS if (child / split).is_dir()]
        if child.is_dir() and not child.name.startswith(".") and not any(child.iterdir()):
            raise DataError(f"class folder {child} is empty; put meshes into its train and test folders, or remove it")
        for part in splits:
            if not any(path.suffix.lower() in MESH_SUFFIXES for path in part.iterdir()):
                raise DataError(f"class folder {part} is empty; add meshes, or remove the class folder")
    found = _layout(files, str(folder))
    classes, entries = _entries(found, lambda path: MeshFile(str(folder / path)), str(folder))
    return ObjectSource(folder.name, classes, tuple(entries))


def mesh_zip(archive: Path) -> ObjectSource:
    """Returns the objects of a zip archive laid out as in `mesh_folder`, such as ModelNet10.zip; it is never unpacked.

    Raises:
        DataError: as `mesh_folder`, or if the archive is not readable or contains paths outside of it.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            infos = [info for info in opened.infolist() if not info.is_dir()]
    except (zipfile.BadZipFile, OSError) as error:
        raise DataError(f"{archive} is not a readable zip file ({error}); download it again") from error
    for info in infos:
        path = PurePosixPath(info.filename.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or (path.parts and ":" in path.parts[0]):
            raise DataError(
                f"{archive} contains {info.filename!r}, a path that leaves its folder; do not trust this archive"
            )
    usable = [info for info in infos if "__MACOSX" not in info.filename]
    found = _layout([PurePosixPath(info.filename) for info in usable], str(archive))
    classes, entries = _entries(found, lambda path: ZipMember(str(archive), str(path)), str(archive))
    return ObjectSource(archive.stem, classes, tuple(entries))


def open_source(data: str, *, train_per_class: int, test_per_class: int) -> ObjectSource:
    """Returns the source for `data`: `furniture10`, or the path of a folder, a .zip or an .npz.

    Raises:
        DataError: if the file does not exist or is not usable as a data set.
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
        vertices, faces = MeshFile(str(path)).load()  # raises if it is damaged
        normalise(vertices, faces, str(path))
        raise DataError(
            f"{data} is a single mesh; --data takes a folder laid out as <class>/train/*.off and <class>/test/*.off"
        )
    raise DataError(f"{data} is not a data set; --data takes a folder of class folders, a .zip or a .npz")
