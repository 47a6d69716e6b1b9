"""The array types that public functions accept: JAX's and NumPy's."""

from __future__ import annotations

import jax
import numpy as np

AnyArray = jax.Array | np.ndarray
