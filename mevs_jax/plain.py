"""Typed values from what JSON keeps of them."""

from __future__ import annotations

import math
import types
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints


def from_plain(kind: Any, content: Any, where: str) -> Any:
    """A value of a type made of dataclasses, tuples, dictionaries and plain values, from what JSON keeps of it.

    Args:
        kind: the type.
        content: what `json.loads` returned.
        where: name of the place, for messages.

    Raises:
        TypeError, ValueError: for content of another form; the message names the place.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        return _dataclass(kind, content, where)
    if origin is tuple:
        if not isinstance(content, list):
            raise TypeError(f"{where} is no list")
        kinds = [arguments[0]] * len(content) if arguments[1:] == (...,) else list(arguments)
        if len(kinds) != len(content):
            raise ValueError(f"{where} has {len(content)} entries, not {len(kinds)}")
        return tuple(
            from_plain(one, item, f"{where}[{i}]") for i, (one, item) in enumerate(zip(kinds, content, strict=True))
        )
    if origin is dict:
        if not isinstance(content, dict):
            raise TypeError(f"{where} is no object")
        return {name: from_plain(arguments[1], value, f"{where}.{name}") for name, value in content.items()}
    if origin in (Union, types.UnionType):
        if content is None and type(None) in arguments:
            return None
        (one,) = [argument for argument in arguments if argument is not type(None)]
        return from_plain(one, content, where)
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


def _dataclass(kind: type, content: Any, where: str) -> Any:
    if not isinstance(content, dict):
        raise TypeError(f"{where} is no object")
    hints, known = get_type_hints(kind), {field.name: field for field in fields(kind)}
    if unknown := set(content) - set(known):
        raise ValueError(f"{where} has no setting {min(unknown)!r:.40}")
    for name, field in known.items():
        if name not in content and field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{where} lacks {name!r}")
    return kind(**{name: from_plain(hints[name], value, f"{where}.{name}") for name, value in content.items()})
