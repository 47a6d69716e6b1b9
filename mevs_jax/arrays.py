"""The array types that public functions accept, JAX's and NumPy's; equality of records that hold arrays; and a search that XLA
vectorises on CPU."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

AnyArray = jax.Array | np.ndarray
AnyVector = jax.Array | np.ndarray | Sequence[float]


class ByContent:
    """Equality and hash of a dataclass that holds arrays (made with `eq=False`): numbers in arrays and sequences are compared,
    and NaN is equal to NaN."""

    def __eq__(self, other: object) -> bool:
        return _content(self) == _content(other) if type(other) is type(self) else NotImplemented

    def __hash__(self) -> int:
        return hash(_content(self))


def _content(value: Any) -> Hashable:
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), *(_content(getattr(value, one.name)) for one in fields(value) if one.compare)
    if isinstance(value, Mapping):
        return frozenset((key, _content(entry)) for key, entry in value.items())
    if isinstance(value, float | AnyArray) or (
        isinstance(value, tuple | list) and all(isinstance(one, float | int) for one in value)
    ):
        array = np.asarray(value, np.float64) + 0.0  # of the two zeros, the positive one
        return array.shape, array.tobytes()
    return tuple(map(_content, value)) if isinstance(value, tuple | list) else value


def first_true(mask: Bool[jax.Array, " n"]) -> Int[jax.Array, ""]:
    """Index of the first entry that is true, or `n` if none is; faster on CPU than argmax, which XLA does not vectorise."""
    index = jnp.arange(mask.shape[0], dtype=jnp.int32)
    return jnp.min(jnp.where(mask, index, index.size))
