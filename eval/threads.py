"""Calls side by side, by threads: on a CPU, XLA runs a loop on one core."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from train.running.over_objects import programs_at_once

Item = TypeVar("Item")
Result = TypeVar("Result")


def by_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Returns `function` of each item, in order.

    The first is computed alone, because it compiles; the others `programs_at_once` at a time.
    """
    found = [function(item) for item in items[:1]]
    with ThreadPoolExecutor(programs_at_once()) as pool:
        return found + list(pool.map(function, items[1:]))
