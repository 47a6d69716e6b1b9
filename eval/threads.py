"""Programs side by side: on a CPU, XLA runs a loop on one core."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from data_pipeline.processes import usable_cpus

Item = TypeVar("Item")
Result = TypeVar("Result")

_MOST_AT_ONCE = 16
"""The most programs side by side, because each needs memory of its own."""


def programs_at_once() -> int:
    """Returns how many threads should run programs side by side: one for each core where the only device is a CPU, else one.

    Programs that one thread starts run one after the other. Those of several threads run side by side.
    """
    device, *others = jax.local_devices()
    return 1 if others or device.platform != "cpu" else min(usable_cpus(), _MOST_AT_ONCE)


def by_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Returns `function` of each item, in order.

    The first is computed alone, because it compiles; the others `programs_at_once` at a time.
    """
    found = [function(item) for item in items[:1]]
    with ThreadPoolExecutor(programs_at_once()) as pool:
        return found + list(pool.map(function, items[1:]))
