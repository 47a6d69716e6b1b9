"""mevs_jax: where should a camera look next?

Everything takes *one* object, cloud or view; put `jax.vmap` on for many. No files, no printing, no globals.
"""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

__version__ = "0.3.0"

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOMES = {name: module for module, name in re.findall(r"^from (\S+) import \S+ as (\S+)$", _STUB, re.MULTILINE)}
"""The module of each public name, from the stub for type checkers. It is imported when one of its names is first used (PEP 562),
so that importing the package takes a moment and needs no JAX. Modules and folders of the package are reached the same way."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    elif not name.startswith("_") and find_spec(f"mevs_jax.{name}"):
        value = import_module(f"mevs_jax.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
