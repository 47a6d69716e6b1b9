"""The settings of a data set: what identifies it, and whether a data set was made with them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.capture.viewpoints import FILE, identified, is_file, viewpoints_of
from data_pipeline.dataset.statistics import SUMMARY, load_statistics
from data_pipeline.differences import differences, in_words
from data_pipeline.errors import DataError, Unreadable
from data_pipeline.files import as_read, read_json
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.meshes import Up


@dataclass(frozen=True)
class DataConfig:
    """Which objects the data set contains, and how they are captured."""

    source: str = "furniture10"
    """furniture10, furniture10-families (also -seen and -all), modelnet10 or modelnet40 (downloaded), a folder of
    <class>/{train,test}/ meshes, a zip of the same layout, or an .npz of voxel grids"""
    archive: str = ""
    """local ModelNet10.zip or ModelNet40.zip to use instead of the download"""
    train_per_class: int = 60
    """training objects per class, for furniture10 and its families (including those for validation)"""
    test_per_class: int = 20
    """test objects per class, for furniture10 and its families (there also for validation)"""
    validation_share: float = 0.2
    """share of the training objects of each class that is used for validation"""
    seed: int = 0
    """seed of the split into training and validation"""
    skip_damaged: bool = False
    """leave damaged files out instead of stopping at the first one"""
    up: Up = "auto"
    """which axis of mesh files is up: the one that the format declares (glTF, COLLADA), else z (auto), or always z or y"""
    split: str = ""
    """for a folder or zip without train and test folders: the share of training objects of each class, such as 0.8; or 1, to
    train and test on the same objects, turned, where a class has one or few; or a .json or .csv list of splits"""
    more: tuple[str, ...] = ()
    """further sources of any of these kinds, whose objects are added: classes of one name are one class; or strangers: shapes
    that belong to no class, as many as of ten classes"""
    capture: CaptureConfig = CaptureConfig()


def identity_of(config: DataConfig, folder: Path | None = None) -> dict[str, Any]:
    """Returns the settings that identify a data set. Later settings are left out at their defaults, as in older data sets.

    Args:
        folder: of the data set, which does not need its file of viewpoints any more once it is finished.
    """
    made = None
    if is_file(config.capture.lattice) and folder is not None and (folder / SUMMARY).exists():
        made = load_statistics(folder).capture
    identity, default = asdict(replace(config, capture=identified(config.capture, made))), asdict(DataConfig())
    later = ("up", "split", "more")
    return as_read({key: value for key, value in identity.items() if key not in later or value != default[key]})


def made_with_other_settings(config: DataConfig, folder: Path) -> dict[str, tuple[Any, Any]]:
    """Returns the settings of the data set in `folder` that differ from `config`, by name: as it was made, and as in `config`.

    There are none if there is no data set, or its settings cannot be read. Settings that only one of them has are left out.
    """
    if not (folder / SUMMARY).exists():
        return {}
    try:
        was = read_json(folder / "config.json")
    except (FileNotFoundError, Unreadable):
        return {}
    later = {"up": "auto", "split": "", "more": []}  # which are left out at their defaults
    return differences(later | was, later | as_read(identity_of(config, folder)), "dataset", shared=True)


def check_same_data(config: DataConfig, folder: Path) -> None:
    """Raises `DataError` if the data set in `folder` was made with other settings; names what differs."""
    if found := made_with_other_settings(config, folder):
        raise DataError(
            f"{folder} has a data set made with other settings ({in_words(found)}); leave these options out, or "
            f"choose another --out"
        )


def check_viewpoints(capture: CaptureConfig, finished: bool) -> None:
    """Raises `DataError` if there are no such viewpoints, or no graph of their neighbours."""
    if is_file(capture.lattice):
        if finished:  # they are in its summary
            return
        found = viewpoints_of(capture)
        try:
            ViewGraph.from_points(found.points, found.neighbours)
        except ValueError as error:
            raise DataError(f"{error}: give the neighbours in {capture.lattice.removeprefix(FILE)}") from error
        return
    try:
        viewpoints_of(capture)
    except ValueError as error:
        raise DataError(f"{error}; choose another --views or --dataset.capture.lattice") from error
