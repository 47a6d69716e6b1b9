"""The machine that computes: what it is, how long a call takes on it, and how much memory a program needs."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

NO_ACCELERATOR = "none but the CPU"
WARM_UP = 3
"""Calls before the first that is measured."""


@dataclass(frozen=True)
class Machine:
    """A machine, as Table 1 of the thesis describes one."""

    operating_system: str
    cpu: str
    cores: int | None
    device: str
    memory_gib: float | None
    python: str
    jax: str


def machine() -> Machine:
    """Returns the machine that this program runs on."""
    device = jax.devices()[0]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30 if hasattr(os, "sysconf") else None
    return Machine(
        operating_system=f"{platform.system()} {platform.release()}",
        cpu=_processor(),
        cores=os.cpu_count(),
        device=NO_ACCELERATOR if device.platform == "cpu" else f"{len(jax.devices())} × {device.device_kind}",
        memory_gib=memory,
        python=platform.python_version(),
        jax=jax.__version__,
    )


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()


def milliseconds(call: Callable[[Any], Any], inputs: Sequence[Any]) -> np.ndarray:
    """Time in milliseconds of a call with each of the inputs, until its result is ready, (inputs,)."""
    for _ in range(WARM_UP):
        jax.block_until_ready(call(inputs[0]))
    times = np.empty(len(inputs))
    for run, given in enumerate(inputs):
        started = time.perf_counter()
        jax.block_until_ready(call(given))
        times[run] = 1000 * (time.perf_counter() - started)
    return times


def planned_memory(compiled: Any) -> float | None:
    """Megabytes that XLA plans for a program: arguments, results and temporaries; None if unknown."""
    plan = compiled.memory_analysis()
    parts = ("argument_size_in_bytes", "output_size_in_bytes", "temp_size_in_bytes")
    return sum(getattr(plan, part) for part in parts) / 1e6 if plan else None
