"""The machine that computes results."""

from __future__ import annotations

import os
import platform
from typing import Any

import jax

NO_ACCELERATOR = "none but the CPU"


def machine() -> dict[str, Any]:
    """The machine that computed the results (Table 1)."""
    device = jax.devices()[0]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30 if hasattr(os, "sysconf") else None
    return {
        "operating_system": f"{platform.system()} {platform.release()}",
        "cpu": _processor(),
        "cores": os.cpu_count(),
        "device": NO_ACCELERATOR if device.platform == "cpu" else f"{len(jax.devices())} × {device.device_kind}",
        "memory_gib": memory,
        "python": platform.python_version(),
        "jax": jax.__version__,
    }


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()
