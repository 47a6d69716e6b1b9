"""What differs between two configurations, for messages that refuse one of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

_MISSING = object()
_MOST = 4
"""Largest number of differences that a message names."""


def differences(was: Any, now: Any, place: str = "", shared: bool = False) -> dict[str, tuple[Any, Any]]:
    """Returns the values that differ between two nested configurations, by place, such as `{"capture.views": (40, 10)}`.

    Args:
        was, now: contents as JSON has them.
        place: of both, which is put before the names of their entries.
        shared: whether entries that only one of them has are left out, as those that a later version added.
    """
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        names = [name for name in (*was, *(set(now) - set(was))) if not shared or (name in was and name in now)]
        found: dict[str, tuple[Any, Any]] = {}
        for name in names:
            where = f"{place}.{name}" if place else str(name)
            found |= differences(was.get(name, _MISSING), now.get(name, _MISSING), where, shared)
        return found
    return {} if was == now else {place: (was, now)}


def in_words(found: Mapping[str, tuple[Any, Any]]) -> str:
    """Returns the differences as a part of a sentence: "seed 0, not 1; capture.views 40, not 10"."""
    parts = [f"{place} {_shown(was)}, not {_shown(now)}" for place, (was, now) in found.items()]
    more = f"; {len(parts) - _MOST} more" if len(parts) > _MOST else ""
    return "; ".join(parts[:_MOST]) + more


def _shown(value: Any) -> str:
    if value is _MISSING:
        return "nothing"
    text = value if isinstance(value, str) and value else json.dumps(value, default=str)
    return text if len(text) <= 60 else f"{text[:57]}…"
