"""Many objects through a compiled program, some at a time: one shape for all of them, and memory for some."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def in_chunks(function: Callable[[Any], Any], objects: Any, size: int) -> Any:
    """`function(objects)`, as arrays of the host, where both are trees of arrays with a leading axis of objects.

    Args:
        function: treats objects one by one, so that it may be given `size` of them; the last chunk is filled up with its first.
    """
    count = len(jax.tree.leaves(objects)[0])
    size, done = min(size, count), []
    for first in range(0, count, size):
        index = np.resize(np.arange(first, min(first + size, count)), size)
        found = function(jax.tree.map(lambda leaf, index=index: leaf[index], objects))
        done.append(jax.device_get(found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *done)
