"""What callers pass, checked: one sentence with the argument's name where it cannot be.

What is traced has no numbers yet, so nothing is said of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def numbers(value: Any) -> np.ndarray:
    """The value in float64; one NaN for what holds no numbers, which no check of numbers lets pass."""
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.array(np.nan)


def number(value: Any, rule: str, fits: Callable[[float], bool] = math.isfinite) -> float:
    """The value as a number that `fits`.

    Raises:
        ValueError: for any other; the message is the rule and the value.
    """
    array = numbers(value)
    if array.size != 1 or not fits(one := float(array.reshape(()))):
        raise ValueError(f"{rule}, got {value!r:.80}")
    return one


def whole(value: Any, rule: str, low: int, high: int) -> int:
    """The value as a whole number from `low` to `high`, as `number`."""
    return int(number(value, rule, lambda one: low <= one <= high and one == int(one)))


def index(value: Any, name: str, count: int) -> int:
    """The value as an index of one of `count` things, as `number`."""
    return whole(value, f"{name} must be an index from 0 to {count - 1}", 0, count - 1)


def known(value: Any) -> np.ndarray | None:
    """The numbers of an array in float64, as `numbers`; None while it is traced, or if another process holds a part of it."""
    if isinstance(value, jax.core.Tracer) or (isinstance(value, jax.Array) and not value.is_fully_addressable):
        return None
    return numbers(value)


def check(value: Any, rule: str, fits: Callable[[np.ndarray], Any]) -> None:
    """Checks the numbers of an array where they are known.

    Args:
        value: an array, or a number.
        rule: the message, to which the first number that does not fit is added.
        fits: of an array in float64, whether its numbers are right; False for NaN, as all comparisons are.

    Raises:
        ValueError: if a number does not fit.
    """
    if (array := known(value)) is None:
        return
    right = np.broadcast_to(fits(array), array.shape)
    if not right.all():
        wrong = array[~right].reshape(-1)[0]
        raise ValueError(f"{rule}, got {f'{value!r:.80}' if np.isnan(wrong) and not array.ndim else f'{wrong:g}'}")


def check_indices(value: Any, name: str, count: int) -> None:
    """Checks that an array, where it is known, holds indices of `count` things, as `check`."""
    rule = f"{name} must be from 0 to {count - 1}"
    check(value, rule, lambda array: (array >= 0) & (array < count) & (array == np.floor(array)))


def check_directions(value: Any, name: str) -> None:
    """Checks that the last axis of an array, where it is known, holds finite vectors that are not zero, as `check`."""
    if (array := known(value)) is None:
        return
    if not array.ndim or not (np.isfinite(array).all() and (np.linalg.norm(array, axis=-1) > 0).all()):
        raise ValueError(f"{name} must be finite and not zero, got {array.tolist()!r:.80}")
