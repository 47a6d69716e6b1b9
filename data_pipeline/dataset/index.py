"""The index of a data set: what is asked of its objects beside their views, in an Arrow file for every shard.

Whoever asks for these reads no record, which would unpack the pixels of all views. Data sets of older versions get an index at
the first question.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.dataset.proof import open_split
from data_pipeline.errors import DataError, reason_of
from data_pipeline.files import check_of_file, checks_in, damage_in, keep_checks, write_bytes
from data_pipeline.progress import console

INDEX = "index"
"""Folder of the index in the folder of a data set."""

_IN_RECORDS = ("name", "label", "entropy", "extent", "radius")


def index_path(folder: Path, split: str, number: int, of: int) -> Path:
    """Returns the path of the index of shard `number` of `of` of a split."""
    return folder / INDEX / f"{split}-{number:05d}-of-{of:05d}.arrow"


def write_index(path: Path, columns: Mapping[str, Any], about: Mapping[str, str] | None = None) -> None:
    """Writes the index of some objects, atomically.

    Args:
        columns: names (objects,), and arrays of one or two axes, of which the first is that of the objects.
        about: what `about_index` returns.
    """
    import pyarrow as pa  # imported late: it takes a fifth of a second

    def column(values: Any) -> pa.Array:
        if np.ndim(values) < 2:
            return pa.array(values)
        return pa.FixedSizeListArray.from_arrays(pa.array(np.ravel(values)), np.shape(values)[1])

    table = pa.table({name: column(values) for name, values in columns.items()}).replace_schema_metadata(about)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    write_bytes(path, sink.getvalue().to_pybytes())


def about_index(path: Path) -> dict[str, str]:
    """Returns what `write_index` was told about an index; empty if there is none that can be read."""
    import pyarrow as pa

    try:
        with pa.memory_map(str(path)) as file:
            found = pa.ipc.open_file(file).schema.metadata or {}
    except (OSError, pa.ArrowInvalid):
        return {}
    return {name.decode(): value.decode() for name, value in found.items()}


def read_index(folder: Path, split: str, *columns: str) -> dict[str, Any]:
    """Returns columns of the index of a split, in the order of the records; names as a list, others as arrays.

    Args:
        columns: such as `name`, `label`, `entropy` (objects, views) in bits, `extent` (objects, 3) and `radius` in the units of
            the file, and `points` (objects, views), the pixels that hit an object. The last two are not in all data sets of
            older versions.

    Raises:
        DataError: if there are no shards, or there is no index and they are damaged.
    """
    checked, again = checks_in(folder), f"{INDEX}/{split}.arrow"
    of_shards = sorted(name for name in checked if name.startswith(f"{INDEX}/{split}-"))
    names = [again] if again in checked else of_shards
    if names and (damage := damage_in(folder, names)) is None:
        return _read([folder / name for name in names], columns)
    if names:
        console.print(f"{damage}, so the index of {split} is made again from the records", markup=False)
    return _made_of_records(folder, split, columns)


def read_parts(paths: list[Path], *columns: str) -> dict[str, Any]:
    """Returns columns of the indices of some shards, joined."""
    return _read(paths, columns)


def _read(paths: list[Path], columns: tuple[str, ...]) -> dict[str, Any]:
    import pyarrow as pa

    tables = [pa.ipc.open_file(pa.memory_map(str(path))).read_all() for path in paths]
    table = pa.concat_tables(tables)

    def array(column: pa.ChunkedArray) -> Any:
        if pa.types.is_string(column.type):
            return column.to_pylist()
        if not pa.types.is_fixed_size_list(column.type):
            return column.to_numpy()
        return np.concatenate([part.flatten() for part in column.chunks]).reshape(-1, column.type.list_size)

    return {name: array(table[name]) for name in columns or table.column_names}


def _made_of_records(folder: Path, split: str, columns: tuple[str, ...]) -> dict[str, Any]:
    """Makes the index of a split from its records, and stores it where the folder may be written to."""
    found: dict[str, list[Any]] = {}
    for example in open_split(folder, split, _IN_RECORDS):
        for name, value in example.items():
            found.setdefault(name, []).append(value.decode() if name == "name" else value)
    made = {name: values if name == "name" else np.array(values) for name, values in found.items()}
    path = folder / INDEX / f"{split}.arrow"
    try:
        write_index(path, made)
        keep_checks(folder, {f"{INDEX}/{path.name}": check_of_file(path)})
    except (OSError, DataError) as error:  # the folder is another's, or the disk is full
        console.print(f"the index of {split} is not kept ({reason_of(error)})", markup=False)
    return {name: made[name] for name in columns}
