"""Applying a compiled program to many objects in chunks of one shape, which limits memory and compiles once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def in_chunks(function: Callable[[Any], Any], objects: Any, size: int) -> Any:
    """Returns `function(objects)` as arrays on the host, computed in chunks.

    Args:
        function: maps a tree of arrays with a leading axis of objects to another such tree, each object independently.
        objects: a tree of arrays with a leading axis of objects.
        size: objects in a chunk; the last chunk is filled up by repeating its objects.
    """
    count = len(jax.tree.leaves(objects)[0])
    size, done = min(size, count), []
    for first in range(0, count, size):
        index = np.resize(np.arange(first, min(first + size, count)), size)
        found = function(jax.tree.map(lambda leaf, index=index: leaf[index], objects))
        done.append(jax.device_get(found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *done)
