"""The array types that public functions accept: JAX's and NumPy's."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

AnyArray = jax.Array | np.ndarray
AnyVector = jax.Array | np.ndarray | Sequence[float]
