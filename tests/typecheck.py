"""The type checker that the tests put around every function of the four packages (see `addopts` in pyproject.toml)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))  # a whole number is also a float

PYTREES = ("TrainState", "Results", "Features", "Choices", "Transitions")
"""Classes whose constructors are not checked: JAX and Orbax also fill these trees with shapes, shardings, NumPy arrays, None,
and with arrays that have one axis more or less."""


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which raises where an argument or its result is not what its annotation says."""
    return function if function.__qualname__.removesuffix(".__init__") in PYTREES else _checked(function)
