"""The array types that public functions accept, JAX's and NumPy's, and a search that XLA vectorises on CPU."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

AnyArray = jax.Array | np.ndarray
AnyVector = jax.Array | np.ndarray | Sequence[float]


def first_true(mask: Bool[jax.Array, " n"]) -> Int[jax.Array, ""]:
    """Index of the first entry that is true, or `n` if none is; faster on CPU than argmax, which XLA does not vectorise."""
    index = jnp.arange(mask.shape[0], dtype=jnp.int32)
    return jnp.min(jnp.where(mask, index, index.size))
