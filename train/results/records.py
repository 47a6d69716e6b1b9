"""Results with a type: frozen dataclasses with arrays, as JSON and as CSV.

A record is written as `as_json` has it, and read by `from_json`. A field whose name in JSON is another is made by `named`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from data_pipeline.errors import DataError
from mevs_jax.plain import as_plain, from_plain, named

__all__ = ["as_json", "csv_of", "ends", "from_json", "named", "numbered"]

Record = TypeVar("Record")

as_json = as_plain


def from_json(kind: type[Record], content: Any, what: str) -> Record:
    """Returns a record from what `as_json` made of it.

    Args:
        kind: the class of the record.
        content: what JSON kept.
        what: names the content in messages, such as a path.

    Raises:
        DataError: if the content has another form; the sentence names the first place.
    """
    try:
        return from_plain(kind, content, "content")
    except (TypeError, ValueError) as error:
        raise DataError(f"{what} has another form than results of this version: {error}") from error


def csv_of(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Returns a CSV file with the columns of the first row. Numbers have the digits that tell float32 apart, and no more."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _shown(value) for name, value in row.items()} for row in rows)
    return text.getvalue().encode()


def _shown(value: Any) -> Any:
    return np.float32(value) if isinstance(value, float) else value


def ends(name: str, interval: Sequence[float] | np.ndarray) -> dict[str, float]:
    """The columns of an interval in a row of a CSV file: `name_low` and `name_high`."""
    low, high = interval
    return {f"{name}_low": float(low), f"{name}_high": float(high)}


def numbered(name: str, values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """The columns of several numbers in a row of a CSV file: `name_0`, `name_1`, …"""
    return {f"{name}_{number}": float(value) for number, value in enumerate(values)}
