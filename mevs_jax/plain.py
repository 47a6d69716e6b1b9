"""Typed values from what JSON keeps of them, and what JSON keeps of typed values."""

from __future__ import annotations

import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import AbstractArray


def named(key: str = "", *, omitted: bool = False, **rest: Any) -> Any:
    """A field of a dataclass whose name in JSON is another.

    Args:
        key: its name in JSON; that of the field by default.
        omitted: whether JSON has no entry for None.
        rest: further arguments of `dataclasses.field`.
    """
    if omitted:
        rest.setdefault("default", None)
    return field(metadata={"key": key, "omitted": omitted}, **rest)


def _key(one: Field) -> str:
    return one.metadata.get("key") or one.name


def as_plain(value: Any) -> Any:
    """Values that JSON can hold: dataclasses become objects, arrays and tuples lists, paths text, and all keys text."""
    if is_dataclass(value) and not isinstance(value, type):
        entries = ((one, getattr(value, one.name)) for one in fields(value))
        return {
            _key(one): as_plain(entry) for one, entry in entries if not (entry is None and one.metadata.get("omitted"))
        }
    if isinstance(value, Mapping):
        return {str(name): as_plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [as_plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    return np.asarray(value).tolist() if hasattr(value, "dtype") else value


def from_plain(kind: Any, content: Any, where: str) -> Any:
    """A value of a type made of dataclasses, tuples, lists, dictionaries, arrays and plain values, from what JSON keeps of it.

    Args:
        kind: the type; arrays are annotated as `Float[np.ndarray, "views 3"]`, and get 64 bits.
        content: what `json.loads` returned.
        where: name of the place, for messages.

    Raises:
        TypeError, ValueError: for content of another form; the message names the place.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        return _dataclass(kind, content, where)
    if isinstance(kind, type) and issubclass(kind, AbstractArray):
        return _array(kind, content, where)
    if origin in (tuple, list):
        if not isinstance(content, list):
            raise TypeError(f"{where} is no list")
        same = origin is list or arguments[1:] == (...,)
        kinds = [arguments[0]] * len(content) if same else list(arguments)
        if len(kinds) != len(content):
            raise ValueError(f"{where} has {len(content)} entries, not {len(kinds)}")
        return origin(
            from_plain(one, item, f"{where}[{i}]") for i, (one, item) in enumerate(zip(kinds, content, strict=True))
        )
    if origin is dict:
        if not isinstance(content, dict):
            raise TypeError(f"{where} is no object")
        key = arguments[0] if arguments[0] is int else str
        return {key(name): from_plain(arguments[1], value, f"{where}.{name}") for name, value in content.items()}
    if origin in (Union, types.UnionType):
        if content is None and type(None) in arguments:
            return None
        *others, last = [argument for argument in arguments if argument is not type(None)]
        return from_plain(next((one for one in others if _has_all(one, content)), last), content, where)
    if origin is Literal:
        if not any(type(content) is type(argument) and content == argument for argument in arguments):
            raise ValueError(f"{where} is {content!r:.40}, not one of {', '.join(map(str, arguments))}")
        return content
    if kind is Path:
        return Path(content)
    if kind is float:
        if type(content) not in (int, float) or not math.isfinite(content):
            raise TypeError(f"{where} is {content!r:.40}, not a finite number")
        return float(content)
    if kind is not Any and type(content) is not kind:
        raise TypeError(f"{where} is {content!r:.40}, not of type {kind.__name__}")
    return content


def _has_all(kind: type, content: Any) -> bool:
    """Whether a dataclass has all entries of an object."""
    return isinstance(content, dict) and set(content) <= {_key(one) for one in fields(kind)}


def _array(kind: Any, content: Any, where: str) -> np.ndarray:
    try:
        array = np.asarray(content)
    except ValueError as error:
        raise ValueError(f"{where} is no array of numbers: its rows have different lengths") from error
    if not array.size or (array.dtype.kind == "i" and "float64" in kind.dtypes):
        array = array.astype(kind.dtypes[-1])
    if array.size and not isinstance(array, kind):
        raise TypeError(f"{where} is no array of type {kind.__name__}")
    if not np.isfinite(array).all():
        raise TypeError(f"{where} has numbers that are not finite")
    return array


def _dataclass(kind: type, content: Any, where: str) -> Any:
    if not isinstance(content, dict):
        raise TypeError(f"{where} is no object")
    hints, known = get_type_hints(kind), {_key(one): one for one in fields(kind)}
    if unknown := set(content) - set(known):
        raise ValueError(f"{where} has no setting {min(unknown)!r:.40}")
    for key, one in known.items():
        if key not in content and one.default is MISSING and one.default_factory is MISSING:
            raise ValueError(f"{where} lacks {key!r}")
    return kind(
        **{
            known[key].name: from_plain(hints[known[key].name], value, f"{where}.{key}")
            for key, value in content.items()
        }
    )
