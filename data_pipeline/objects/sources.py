"""Sources of objects.

A *source* lists objects. Each is an `ObjectEntry` whose `recipe` is small, picklable, and makes the mesh in the process that
needs it. There are four kinds: procedural ones (`PROCEDURAL`), a folder of class folders, a zip archive of the same layout, such
as ModelNet's, and an archive of voxel grids. Capture workers import this module, so it must not import JAX, which would slow
their start.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath

from data_pipeline.errors import DataError
from data_pipeline.objects.archives import list_zip
from data_pipeline.objects.folders import list_folder
from data_pipeline.objects.layout import (
    SPLIT_FOLDERS,
    Found,
    Listing,
    by_class_folders,
    by_split_folders,
    has_split_folders,
    names_of,
    without_copies,
)
from data_pipeline.objects.mesh import (
    MODELNET10_CLASSES,
    SOURCE_SPLITS,
    UNKNOWN_OBJECT,
    Mesh,
    ObjectEntry,
    ObjectSource,
    normalise,
)
from data_pipeline.objects.names import kind_of_ignored, plain_class, say_ignored
from data_pipeline.objects.recipes import FamilyPiece, FurniturePiece, Stranger, Turned
from data_pipeline.objects.splits import SAME_OBJECTS, divide
from data_pipeline.objects.voxels import voxel_archive
from mevs_jax.meshes import AXIS_DECLARED, MESH_SUFFIXES, Up
from mevs_jax.meshes.reading import read_mesh, shown

_LAID_OUT = "<class>/train/*.off and <class>/test/*.off"


@dataclass(frozen=True)
class Reading:
    """How the meshes of a folder or zip are read.

    Attributes:
        up: which axis of the files is up.
        split: empty for folders of splits, a share of training objects, or the path of a list.
        seed: seed of the choice by share.
        keep_splits: whether `split` is for files without folders of splits alone.
        all_tested: whether no object is for training: those for testing are taken if the folders name a split, else all.
    """

    up: Up = "auto"
    split: str = ""
    seed: int = 0
    keep_splits: bool = False
    all_tested: bool = False


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
    counts = _pieces("furniture10", train_per_class, test_per_class)
    entries = (
        ObjectEntry(f"{name}_{split}_{index:04d}", label, split, FurniturePiece(name, first + index))
        for label, name in enumerate(MODELNET10_CLASSES)
        for split in SOURCE_SPLITS
        for count, first in [counts[split]]
        for index in range(count)
    )
    return ObjectSource("furniture10", MODELNET10_CLASSES, tuple(entries))


def _pieces(name: str, train_per_class: int, test_per_class: int) -> dict[str, tuple[int, int]]:
    """Number of pieces per class of each split, and the first of their seeds, which no two splits share."""
    if train_per_class < 2 or test_per_class < 1:
        needed = "at least 2 training pieces and 1 test piece per class"
        raise DataError(f"{name} needs {needed}, got {train_per_class} and {test_per_class}")
    return {"train": (train_per_class, 0), "val": (test_per_class, 2_000_000), "test": (test_per_class, 1_000_000)}


_FAMILIES_OF: dict[str, dict[str, tuple[str, ...]]] = {
    "furniture10-families": {"train": ("train",), "val": ("val",), "test": ("test",)},
    "furniture10-families-seen": {"train": ("train",), "test": ("train",)},
    "furniture10-families-all": {"train": ("train", "val", "test"), "test": ("train", "val", "test")},
}
"""For each source of families and each of its splits: the splits of the families whose pieces it has."""


def furniture_families(name: str, train_per_class: int, test_per_class: int) -> ObjectSource:
    """Returns procedural furniture of many families, by turns. Pieces of different splits are made from different seeds.

    Args:
        name: `furniture10-families`, whose training, validation and test pieces are of different families;
            `furniture10-families-seen`, whose test pieces are of the families for training; or `furniture10-families-all`, all of
            whose pieces are of all families.
        train_per_class: pieces for training.
        test_per_class: pieces for testing, and as many for validation where families are for that.

    Raises:
        DataError: if there are fewer than 2 training pieces or no test pieces per class.
    """
    from data_pipeline.objects.furniture.families import FAMILIES  # imported late: it needs trimesh

    counts = _pieces(name, train_per_class, test_per_class)
    entries: list[ObjectEntry] = []
    for label, of_class in enumerate(MODELNET10_CLASSES):
        for split, kinds in _FAMILIES_OF[name].items():
            families = [(kind, family) for kind in kinds for family in FAMILIES[of_class][kind]]
            count, first = counts[split]
            for index, (kind, family) in zip(range(count), itertools.cycle(families), strict=False):
                recipe = FamilyPiece(of_class, kind, family, first + index)
                entries.append(ObjectEntry(f"{of_class}_{family}_{split}_{index:04d}", label, split, recipe))
    return ObjectSource(name, MODELNET10_CLASSES, tuple(entries))


def strangers(train_per_class: int, test_per_class: int) -> ObjectSource:
    """Returns procedural shapes that are no furniture, as one class: for training, validation and testing of other kinds.

    They are as many as pieces of all ten classes of furniture, of each kind in turn.

    Raises:
        DataError: if there are fewer than 2 training pieces or no test pieces per class.
    """
    from data_pipeline.objects.strangers import KINDS  # imported late: it needs trimesh

    counts = _pieces("strangers", train_per_class, test_per_class)
    entries: list[ObjectEntry] = []
    for split, (count, first) in counts.items():
        kinds = itertools.cycle([name for name, kind in KINDS.items() if kind.split == split])
        for index, kind in zip(range(len(MODELNET10_CLASSES) * count), kinds, strict=False):
            entries.append(ObjectEntry(f"{kind}_{split}_{index:04d}", 0, split, Stranger(kind, first + index)))
    return ObjectSource("strangers", (UNKNOWN_OBJECT,), tuple(entries))


PROCEDURAL: dict[str, Callable[[int, int], ObjectSource]] = {
    "furniture10": furniture10,
    **{name: partial(furniture_families, name) for name in _FAMILIES_OF},
    "strangers": strangers,
}
"""The sources that are made and not read, by name, as functions of the numbers of pieces per class for training and testing."""


def _arranged(listing: Listing, name: str, where: str, reading: Reading) -> ObjectSource:
    """Returns the source that the files of a folder or zip make."""
    found = list(listing.found)
    if not any(one.recipe is not None for one in found):
        unread = f" ({len(found)} files cannot be read: {found[0].path} {found[0].reason})" if found else ""
        others = f"(or {', '.join(MESH_SUFFIXES[1:])}){unread}"
        raise DataError(f"{where} has no meshes laid out as {_LAID_OUT} {others}; pass --data a folder that has")
    with_splits = has_split_folders(found)
    placed = by_split_folders(found) if with_splits else by_class_folders(found)
    notes: tuple[str, ...] = ()
    if reading.all_tested:
        placed, notes = _all_tested(placed)
    elif reading.split and not (reading.keep_splits and with_splits):
        placed = divide(placed, reading.split, reading.seed, where)
        notes = (SAME_OBJECTS,) if any(isinstance(one.recipe, Turned) for one in placed) else ()
    elif not with_splits:
        folders = {one.class_name for one in placed if one.class_name}
        there = f"{len(found)} meshes in {len(folders)} class folders and no meshes laid out as {_LAID_OUT}"
        advice = "add --dataset.split 0.8 to train on 80 % of each class, 1 to train and test on the same objects"
        raise DataError(f"{where} has {there}; {advice}, or a .json or .csv list of splits")
    placed = sorted(without_copies(placed), key=lambda one: (one.class_name, one.split, one.parts))
    members = [one for one in placed if one.recipe is not None and one.class_name and one.split]
    _check_classes(placed, members, where, all_tested=reading.all_tested)
    classes = tuple(sorted({one.class_name for one in members}))
    entries: list[ObjectEntry] = []
    left_out: dict[str, dict[str, str]] = {}
    for one, unique in zip(placed, names_of(placed), strict=True):
        if one.recipe is not None and one.class_name and one.split:
            entries.append(ObjectEntry(unique, classes.index(one.class_name), one.split, one.recipe))
        else:
            reason = one.reason or "lies in no folder of a class with train, val or test"
            left_out.setdefault(one.split or "other", {})[unique] = reason
    said = (*say_ignored(listing.ignored), *listing.notes)
    return ObjectSource(name, classes, tuple(entries), left_out, (*notes, *_axes(members, reading.up)), said)


def _all_tested(placed: list[Found]) -> tuple[list[Found], tuple[str, ...]]:
    """The files for testing; all files of classes, now for testing, if there are none. A sentence says which."""
    tested = [one for one in placed if one.split == "test" or not one.class_name]
    if not any(one.split for one in tested):
        named = any(one.split for one in placed)
        note = ("no file is for testing, so that all are used, also those for training",) if named else ()
        return [replace(one, split="test") if one.class_name else one for one in placed], note
    others = [one for one in placed if one.class_name and one.split != "test"]
    lost = sorted({one.class_name for one in others} - {one.class_name for one in tested})
    notes = (f"{len(others)} files for training or validation are not used",) if others else ()
    return tested, (*notes, *[f"classes without files for testing: {', '.join(lost)}"] * bool(lost))


def _check_classes(placed: list[Found], members: list[Found], where: str, *, all_tested: bool) -> None:
    """Raises DataError if fewer than two classes have meshes, or a class lacks meshes of a split that it needs."""
    classes = sorted({one.class_name for one in placed if one.class_name and one.split})
    there = Counter((one.class_name, one.split) for one in members)
    for name in classes:
        if not any(there[name, split] for split in set(SPLIT_FOLDERS.values())):
            first = next(one for one in placed if one.class_name == name)
            why = f"no file of class {name} can be read ({first.path} {first.reason})"
            raise DataError(f"{where}: {why}; mend or remove the class")
    if all_tested and members:
        return
    if len(classes) < 2:
        only = classes[0] if classes else "none"
        raise DataError(f"{where} has one class only ({only}); add the folder of at least one other class")
    for name in classes:
        for split in SOURCE_SPLITS:
            if not there[name, split]:
                raise DataError(f"{where} has no meshes in {name}/{split}; add some, or remove the class folder")


def _axes(members: list[Found], up: Up) -> tuple[str, ...]:
    """Returns a sentence on which axis of the files was taken as up, unless all were z up without being turned."""
    counts = Counter(PurePosixPath(one.parts[-1]).suffix.lower() for one in members)
    declared = sum(counts[suffix] for suffix in AXIS_DECLARED)
    if up == "auto" and declared:
        kinds = ", ".join(f"{counts[suffix]} {suffix}" for suffix in AXIS_DECLARED if counts[suffix])
        others = f"; the other {len(members) - declared} were taken as z up" if declared < len(members) else ""
        return (f"turned to z up from the axis that their format declares: {kinds}{others} (--dataset.up auto)",)
    return (f"all {len(members)} files were taken as {up} up (--dataset.up {up})",) if up != "auto" else ()


def mesh_folder(folder: Path, reading: Reading = Reading()) -> ObjectSource:
    """Returns the objects of a folder of class folders, at any depth.

    Raises:
        DataError: if the layout is not known, a class has no meshes for a split, or there are fewer than two classes.
    """
    listing = list_folder(folder, reading.up)
    inside = {one.parts[:2] for one in listing.found}
    for child in sorted(folder.iterdir()):
        if kind_of_ignored(child.name) or not child.is_dir():
            continue
        if not any(child.iterdir()):
            raise DataError(f"class folder {child} is empty; put meshes into its train and test folders, or remove it")
        for part in child.iterdir():
            is_split = part.name.lower() in SPLIT_FOLDERS and part.is_dir()
            if is_split and (shown(child.name), shown(part.name)) not in inside:
                raise DataError(f"class folder {part} is empty; add meshes, or remove the class folder")
    return _arranged(listing, shown(folder.name), shown(str(folder)), reading)


def mesh_zip(archive: Path, reading: Reading = Reading()) -> ObjectSource:
    """Returns the objects of a zip archive laid out as in `mesh_folder`, such as ModelNet10.zip; it is never unpacked.

    Raises:
        DataError: as `mesh_folder`, or if the archive is not readable or contains paths outside of it.
    """
    return _arranged(list_zip(archive, reading.up), shown(archive.stem), shown(str(archive)), reading)


def _of_meshes(data: str, reading: Reading, known: str) -> ObjectSource | None:
    """Returns the objects of a folder or zip of meshes; None for anything else that exists."""
    path = Path(os.path.expanduser(data))
    if "://" in data:
        raise DataError(f"objects are read from this machine's disk, not from {data}; copy them here first")
    if data not in PROCEDURAL and not os.path.exists(path):
        raise DataError(f"no such file or folder: {data}; --data takes {known}")
    if path.is_dir():
        return mesh_folder(path.resolve(), reading)
    return mesh_zip(path.resolve(), reading) if path.suffix.lower() == ".zip" else None


def _is_made_or_voxels(data: str) -> bool:
    return data in PROCEDURAL or data.lower().endswith(".npz")


def objects_to_test(data: str, up: Up = "auto") -> ObjectSource:
    """Returns the objects of a folder, zip or `.npz` to test a system on: those for testing, or all where no split is named.

    Raises:
        DataError: as `open_source`, but one class is enough, and none needs objects for training.
    """
    known = f"a folder or zip of meshes in class folders, an .npz of voxel grids, or {', '.join(PROCEDURAL)}"
    if (meshes := _of_meshes(data, Reading(up, all_tested=True), known)) is not None:
        return meshes
    if up != "auto" and _is_made_or_voxels(data):
        raise DataError(f"--up goes with meshes, not with {data}; leave it out")
    source = open_source(data, train_per_class=2, test_per_class=20)
    return replace(source, entries=tuple(entry for entry in source.entries if entry.split == "test"))


def open_source(
    data: str,
    *,
    train_per_class: int,
    test_per_class: int,
    up: Up = "auto",
    split: str = "",
    seed: int = 0,
    keep_splits: bool = False,
) -> ObjectSource:
    """Returns the source for `data`: a name of `PROCEDURAL`, or the path of a folder, a .zip or an .npz.

    Raises:
        DataError: if the file does not exist or is not usable as a data set.
    """
    if (split or up != "auto") and _is_made_or_voxels(data):
        raise DataError(f"--dataset.split and --dataset.up go with a folder or zip of meshes, not with {data}")
    if data in PROCEDURAL:
        return PROCEDURAL[data](train_per_class, test_per_class)
    known = "furniture10, furniture10-families, strangers, modelnet10, modelnet40, a folder of class folders, a .zip or a .npz"
    if (meshes := _of_meshes(data, Reading(up, split, seed, keep_splits), known)) is not None:
        return meshes
    path = Path(os.path.expanduser(data))
    if path.suffix.lower() == ".npz":
        return voxel_archive(path.resolve())
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise DataError(f"{data} is not a data set; --data takes a folder of class folders, a .zip or a .npz")
    read_mesh(path, up)  # raises if it is damaged
    raise DataError(f"{data} is a single mesh; --data takes a folder laid out as {_LAID_OUT}")


def together(sources: Sequence[ObjectSource]) -> ObjectSource:
    """Returns the objects of several sources as one. Classes of one name are one class (`plain_class`), called as in the first.

    The objects of the first source keep their names; before those of others stands the name of their source, with a number if
    it is not the only one of that name.
    """
    first, classes = sources[0], list(sources[0].classes)
    entries, left_out = list(first.entries), {split: dict(reasons) for split, reasons in first.left_out.items()}
    notes, said, prefixes = list(first.notes), list(first.said), {first.name}
    names = {entry.name for entry in entries} | {name for reasons in left_out.values() for name in reasons}
    for source in sources[1:]:
        own = [entry.name for entry in source.entries] + [name for of in source.left_out.values() for name in of]
        prefix = next(
            prefix
            for number in itertools.count(1)
            if (prefix := _numbered(source.name, number)) not in prefixes
            and not names & {f"{prefix}/{name}" for name in own}
        )
        prefixes.add(prefix)
        names |= {f"{prefix}/{name}" for name in own}
        for name in source.classes:
            known = {plain_class(one): one for one in classes}
            if (same := known.get(plain_class(name))) is None:
                classes.append(name)
            elif same != name:
                notes.append(f"{prefix}: class {name} was taken as {same}")
        label_of = {plain_class(name): label for label, name in enumerate(classes)}
        entries += [
            replace(entry, name=f"{prefix}/{entry.name}", label=label_of[plain_class(source.classes[entry.label])])
            for entry in source.entries
        ]
        for split, reasons in source.left_out.items():
            left_out.setdefault(split, {}).update({f"{prefix}/{name}": reason for name, reason in reasons.items()})
        notes += [f"{prefix}: {note}" for note in source.notes]
        said += [f"{prefix}: {sentence}" for sentence in source.said]
    name = " + ".join(source.name for source in sources)
    return ObjectSource(name, tuple(classes), tuple(entries), left_out, tuple(notes), tuple(said))


def _numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name} {number}"
