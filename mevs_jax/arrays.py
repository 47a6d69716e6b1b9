"""The kind of array that public functions take: JAX's own or NumPy's."""

from __future__ import annotations

import jax
import numpy as np

AnyArray = jax.Array | np.ndarray
