"""Results of checks as JSON holds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields, is_dataclass
from typing import Any

import numpy as np


def named(key: str = "", *, omitted: bool = False, **rest: Any) -> Any:
    """A field whose name in JSON is `key`, and that is left out where it is None if `omitted`."""
    if omitted:
        rest.setdefault("default", None)
    return field(metadata={"key": key, "omitted": omitted}, **rest)


def as_json(value: Any) -> Any:
    """Dataclasses become objects, arrays and tuples lists."""
    if is_dataclass(value) and not isinstance(value, type):
        entries = ((one, getattr(value, one.name)) for one in fields(value))
        return {
            one.metadata.get("key") or one.name: as_json(entry)
            for one, entry in entries
            if not (entry is None and one.metadata.get("omitted"))
        }
    if isinstance(value, Mapping):
        return {str(name): as_json(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    return np.asarray(value).tolist() if hasattr(value, "dtype") else value
