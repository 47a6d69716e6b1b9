"""Where the objects of a data set are from: the sources that its settings name, and the state of their files."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from data_pipeline.dataset.config import DataConfig
from data_pipeline.errors import DataError
from data_pipeline.objects.changes import source_state
from data_pipeline.objects.downloads import ARCHIVES, download, download_folder, local
from data_pipeline.objects.mesh import SOURCE_SPLITS, ObjectSource
from data_pipeline.objects.sources import Reading, mesh_zip, open_source, together
from data_pipeline.progress import console


def open_objects(config: DataConfig) -> ObjectSource:
    """Returns the source of objects, with those of `config.more`.

    Raises:
        DataError: if a source is not usable or given twice, or `config.archive` is set for another kind of source.
    """
    first = _open_first(config)
    if not config.more:
        return first
    every = (config.source, *config.more)
    if twice := [data for data, times in Counter(every).items() if times > 1]:
        raise DataError(f"{twice[0]} is given twice, as --data or in --dataset.more; leave one out")
    return together([first, *(_open_first(_alone(config, data)) for data in config.more)])


def _alone(config: DataConfig, data: str) -> DataConfig:
    """Returns the settings of one of the further sources; options for files of meshes are for those alone, lists for `--data`."""
    of_meshes = data not in ARCHIVES and data != "furniture10" and not data.lower().endswith(".npz")
    listed = config.split.lower().endswith((".json", ".csv"))
    alone = replace(config, source=data, archive="", more=(), split="" if listed else config.split)
    return alone if of_meshes else replace(alone, up="auto", split="")


def _open_first(config: DataConfig) -> ObjectSource:
    """Returns the source of objects. Official archives are downloaded, unless `config.archive` names a local file."""
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
