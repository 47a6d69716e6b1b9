"""Applying a compiled program to many objects in chunks of one shape, which limits memory and compiles once.

Several processes share the chunks. Each chunk is computed as one process alone would compute it, so the results are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from data_pipeline.distributed import from_all, own_share


def in_chunks(function: Callable[[Any], Any], objects: Any, size: int) -> Any:
    """Returns `function(objects)` as arrays on the host, computed in chunks; each process returns all of it.

    Args:
        function: maps a tree of arrays with a leading axis of objects to another such tree, each object independently.
        objects: a tree of arrays with a leading axis of objects.
        size: objects in a chunk; the last chunk is filled up by repeating its objects.
    """
    count = len(jax.tree.leaves(objects)[0])
    size, done = min(size, count), []
    firsts = range(0, count, size)
    own = own_share(len(firsts))
    for first in [firsts[number] for number in own] or [0]:  # a process without a chunk still needs shapes
        index = np.resize(np.arange(first, min(first + size, count)), size)
        found = function(jax.tree.map(lambda leaf, index=index: leaf[index], objects))
        done.append(jax.device_get(found))

    def joined(*leaves: np.ndarray) -> np.ndarray:
        every = from_all(np.stack(leaves)[: len(own)], len(firsts))
        return every.reshape(-1, *every.shape[2:])[:count]

    return jax.tree.map(joined, *done)
