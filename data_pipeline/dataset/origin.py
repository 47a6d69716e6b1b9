"""Where the objects of a data set are from: the sources that its settings name, and the state of their files."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from data_pipeline.dataset.config import DataConfig
from data_pipeline.errors import DataError
from data_pipeline.objects.downloads import ARCHIVES, download, download_folder, local
from data_pipeline.objects.folders import list_folder
from data_pipeline.objects.mesh import SOURCE_SPLITS, ObjectEntry, ObjectSource
from data_pipeline.objects.sources import PROCEDURAL, Reading, mesh_zip, open_source, together
from data_pipeline.progress import console
from mevs_jax.meshes.reading import shown


def open_objects(config: DataConfig) -> ObjectSource:
    """Returns the source of objects, with those of `config.more`.

    Raises:
        DataError: if a source is not usable or given twice, or `config.archive` is set for another kind of source.
    """
    if not config.more:
        if config.source == "strangers":
            raise DataError(
                "strangers are one class, of unknown objects; give --data others and add --dataset.more strangers"
            )
        return _open_first(config)
    _check_apart((config.source, *config.more))
    return together([_open_first(_alone(config, data), keep_splits=True) for data in (config.source, *config.more)])


def objects_named(config: DataConfig, names: Sequence[str]) -> list[ObjectEntry]:
    """Returns the objects of these names, of which a data set has views; raises `DataError` if one is there no more."""
    entries = {entry.name: entry for entry in open_objects(config).entries}
    if gone := [name for name in names if name not in entries]:
        raise DataError(
            f"{config.source} has the object {gone[0]!r} no more; put it back, or make a run in another --out"
        )
    return [entries[name] for name in names]


def _check_apart(every: Sequence[str]) -> None:
    """Raises DataError if two sources are the same, or one lies in another: an object would be there twice.

    Copies of objects under other names are not noticed.
    """
    if {"modelnet10", "modelnet40"} <= set(every):
        raise DataError("modelnet40 holds the objects of modelnet10; leave one of them out")
    families = [data for data in every if data.startswith("furniture10-families")]
    if len(families) > 1:
        raise DataError(f"{' and '.join(families)} share pieces; leave one of them out")
    named = {*PROCEDURAL, *ARCHIVES}
    paths = [Path(data).expanduser().resolve() if data not in named else Path(data) for data in every]
    for index, path in enumerate(paths):
        for number, other in enumerate(paths):
            if number != index and (path == other or other in path.parents):
                twice = "is given twice, as --data or in --dataset.more, or lies in another of them"
                raise DataError(f"{every[max(index, number)]} {twice}; leave one out")


def _alone(config: DataConfig, data: str) -> DataConfig:
    """Returns the settings of one of several sources. Options for files of meshes are for those alone, lists and archives for
    `--data`."""
    of_meshes = data not in ARCHIVES and data not in PROCEDURAL and not data.lower().endswith(".npz")
    listed = config.split.lower().endswith((".json", ".csv"))
    first = data == config.source
    return replace(
        config,
        source=data,
        more=(),
        archive=config.archive if first else "",
        up=config.up if of_meshes else "auto",
        split=config.split if of_meshes and (first or not listed) else "",
    )


def _open_first(config: DataConfig, keep_splits: bool = False) -> ObjectSource:
    """Returns the source of objects. Official archives are downloaded, unless `config.archive` names a local file.

    Args:
        keep_splits: whether `config.split` is for meshes without folders of splits alone.
    """
    official = ARCHIVES.get(config.source)
    if official is None:
        if config.archive:
            raise DataError(f"--archive goes with --data {' or '.join(ARCHIVES)}, not with {config.source}")
        return open_source(
            config.source,
            train_per_class=config.train_per_class,
            test_per_class=config.test_per_class,
            up=config.up,
            split=config.split,
            seed=config.seed,
            keep_splits=keep_splits,
        )
    if config.archive:
        path = local(official, Path(config.archive).expanduser().resolve())
    else:
        path = download(official, download_folder())
    source = mesh_zip(path, Reading(config.up, config.split, config.seed))
    counts = {split: sum(entry.split == split for entry in source.entries) for split in SOURCE_SPLITS}
    if (len(source.classes), counts["train"], counts["test"]) != (official.classes, official.train, official.test):
        console.print(
            f"{path} has {len(source.classes)} classes, {counts['train']} training and {counts['test']} test objects; "
            f"{official.name} has {official.classes}, {official.train} and {official.test}"
        )
    return replace(source, name=official.name)


def state_of(config: DataConfig) -> dict[str, str] | None:
    """Returns the state of the sources' files, or None if they have none or they are an official archive's."""
    data = config.archive if config.source in ARCHIVES else config.source
    found = source_state(data, config.split) if data else None
    for one in config.more:
        if (more := None if one in ARCHIVES else source_state(one)) is not None:
            found = (found or {}) | {f"{one}: {name}": stamp for name, stamp in more.items()}
    return found


def source_state(data: str, split: str = "") -> dict[str, str] | None:
    """Returns the state of each file of a source: size and time of files, checksum and size of members of archives.

    Args:
        data: path of a folder, .zip or .npz.
        split: path of a list of splits, or anything else.

    Returns:
        the states by path; None if there are no files, or they cannot be read.
    """
    path = Path(os.path.expanduser(data))
    try:
        if path.is_dir():
            found = {one.path: getattr(one.recipe, "stamp", "") for one in list_folder(path).found}
            # The last part, the time of the last change of any kind, differs between copies of one file.
            state = {name: stamp.rsplit("-", 1)[0] for name, stamp in found.items()}
        elif path.suffix.lower() in (".zip", ".npz"):
            with zipfile.ZipFile(path) as archive:
                state = {shown(info.filename): f"{info.CRC:08x}-{info.file_size}" for info in archive.infolist()}
        else:
            return None
        if split.lower().endswith((".json", ".csv")):
            state["the list of --dataset.split"] = f"{zlib.crc32(Path(split).expanduser().read_bytes()):08x}"
    except (OSError, DataError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return None
    return state


def changes_between(before: dict[str, str], now: dict[str, str]) -> str:
    """Returns how many files changed, came and went, with an example; empty if none did."""
    changed = sorted(name for name in before.keys() & now.keys() if before[name] != now[name])
    new, gone = sorted(now.keys() - before.keys()), sorted(before.keys() - now.keys())
    counts = [f"{len(names)} {kind}" for names, kind in ((changed, "changed"), (new, "new"), (gone, "gone")) if names]
    return f"{', '.join(counts)}, such as {(changed + new + gone)[0]}" if counts else ""
