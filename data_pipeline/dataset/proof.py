"""Proof that a data set is as it was written: its settings, statistics and shards.

ArrayRecord checks every record when it is read. Sizes and CRCs of all files, kept in the data set's `checks.json`, find damage
before a training begins, so that the shards can be made again.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, SupportsIndex

from data_pipeline.dataset.statistics import SPLITS, SUMMARY, DatasetStatistics, load_statistics
from data_pipeline.differences import differences, in_words
from data_pipeline.distributed import is_first
from data_pipeline.errors import DataError, Unreadable, reason_of
from data_pipeline.files import (
    as_read,
    checks_in,
    damage_in,
    keep_json,
    read_json,
    size_of_file,
    was_written,
    why_not_written,
)
from data_pipeline.progress import console

SHARDS = "shards"
"""Folder of the shards in the folder of a data set."""

CAPTURES = "captures"
"""Folder of the captures in the folder of a data set that is not finished."""

SOURCE_STATE = "source.json"
"""File name of the state of the source's files in the folder of a data set."""

_LARGE = 4 * 2**30
"""Of shards with more bytes in all than this, only the sizes are compared: reading them all would take more than seconds."""


def _checked(folder: Path) -> list[str]:
    return [name for name in checks_in(folder) if name.startswith(f"{SHARDS}/")]


def folder_of_shards(folder: Path) -> Path | None:
    """Returns the folder that holds the shards of the data set in `folder`, or None if there is none."""
    found = sorted((folder / SHARDS).glob("*/*/features.json"))
    return found[-1].parent if found else None


def damage_of_shards(folder: Path) -> str | None:
    """Returns what is missing or damaged of the shards of the data set in `folder`, or None."""
    names, where = _checked(folder), folder_of_shards(folder)
    if where is None:
        return f"the shards in {folder / SHARDS} are missing"
    if not names:  # made by an older version
        lost = next((split for split in SPLITS if not any(where.glob(f"*-{split}.array_record*"))), None)
        return None if lost is None else f"the shards of {lost} in {where} are missing"
    if (damage := damage_in(folder, names, size_of_file)) is not None:
        return damage
    if sum((folder / name).stat().st_size for name in names) > _LARGE:
        return None
    return damage_in(folder, names)


def _unusable(folder: Path, damage: str) -> DataError:
    out = os.path.dirname(folder) or "."
    return DataError(f"{damage}; delete {folder / SHARDS}, and make it again with: mevs data --out {out}")


def open_split(folder: Path, split: str, only: Sequence[str] = ()) -> Any:
    """Returns a random-access source of the objects of one split: `source[i]` is a dictionary of NumPy arrays.

    Args:
        only: keys of that dictionary; only these, where the data set has them, are decoded. All by default.

    Raises:
        DataError: if there are no shards, or damaged ones.
    """
    return Objects(folder, split, only)


class Objects:
    """The objects of one split, see `open_split`."""

    def __init__(self, folder: Path, split: str, only: Sequence[str] = ()):
        import tensorflow_datasets as tfds

        where = folder_of_shards(folder)
        if where is None:
            raise DataError(
                f"no shards in {folder}; create them with: mevs data --out {os.path.dirname(folder) or '.'}"
            )
        if (damage := damage_in(folder, _checked(folder), size_of_file)) is not None:
            raise _unusable(folder, damage)
        self._folder = folder
        try:
            builder = tfds.builder_from_directory(str(where))
            # TFDS's own partial decoding needs TensorFlow, and its data sources do not have it.
            raw = tfds.decode.DeserializeMethod.RAW_BYTES
            self._records = builder.as_data_source(split=split, deserialize_method=raw)
            self._length = len(self._records)
            features = builder.info.features
            if only:
                features = tfds.features.FeaturesDict({key: features[key] for key in only if key in features})
            self._decode = features.deserialize_example_np
        except Exception as error:  # of TFDS, ArrayRecord or Riegeli, each with kinds of its own
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> Exception:
        if isinstance(error, MemoryError | DataError) or why_not_written(error) is not None:
            return error
        return _unusable(self._folder, f"the shards of {self._folder} cannot be read ({reason_of(error)[:120]})")

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: SupportsIndex) -> dict[str, Any]:
        index = operator.index(index)
        if not -self._length <= index < self._length:
            raise IndexError(index)
        try:
            return self._decode(self._records[index])
        except Exception as error:
            raise self._damaged(error) from error

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[index] for index in range(self._length))


def state_before(folder: Path) -> dict[str, str] | None:
    """Returns the state of the source's files when the data set in `folder` was made, or None if it is not known."""
    try:
        return read_json(folder / SOURCE_STATE)
    except FileNotFoundError:
        return None
    except Unreadable as error:
        console.print(
            f"{error.path} cannot be read ({error.reason}), so changes of the source are not noticed", markup=False
        )
        return None


def damage_of_settings(folder: Path, identity: dict[str, Any]) -> str | None:
    """Returns why it is not known with which settings the data set in `folder` was made; None if with these, or there is none.

    Of a run that did not finish, captures fit also if damaged files are left out now and were not before.

    Raises:
        DataError: if it was made with other settings.
    """
    path, differs = folder / "config.json", ""
    try:
        was = read_json(path)
        if was == identity:
            return None
        if isinstance(was, dict):
            found = differences(was, as_read(identity))
            if not (folder / SUMMARY).exists():
                _check_unfinished(folder, found)
                return None
            differs = f" ({in_words(found)})"
    except FileNotFoundError:
        if not (folder / SUMMARY).exists():
            return None
        damage = f"{path} is missing"
    except Unreadable as error:
        damage = f"{path} cannot be read ({error.reason})"
    if not differs and was_written(path, identity):
        console.print(f"{damage}, so it is written again", markup=False)
        if is_first():
            keep_json(path, identity)
        return None
    if not differs and path.name not in checks_in(folder):
        return damage
    raise DataError(f"{folder} has a data set made with other settings{differs}; choose another --out, or delete it")


def _check_unfinished(folder: Path, differs: dict[str, tuple[Any, Any]]) -> None:
    """Raises `DataError` if captures of a run that did not finish do not fit the settings, whose differences are given."""
    begun = any((folder / name).is_dir() and any((folder / name).iterdir()) for name in (CAPTURES, SHARDS))
    if begun and differs != {"skip_damaged": (False, True)}:
        raise DataError(
            f"{folder} has captures of a run with other settings that did not finish ({in_words(differs)}); give the same again "
            f"to go on with it, delete the folder, or choose another --out"
        )


def found_in(folder: Path, damage: str | None) -> DatasetStatistics | str:
    """Returns the statistics of the data set in `folder`, or what of it is damaged (`damage`, if its settings are)."""
    try:
        statistics = load_statistics(folder)
    except Unreadable as error:
        return f"{error.path} cannot be read ({error.reason})"
    return damage or damage_of_shards(folder) or statistics
