"""Objects shared out to all devices: each runs the same program on its part, and none waits for another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec


def over_objects(function: Callable[[Any], Any], arguments: Any, multiple: int = 1) -> Any:
    """`function(arguments)`, where every array on both sides has a leading axis of objects; for use under jit.

    Args:
        function: treats objects one by one, so that it may be given some of them.
        arguments: a tree of arrays.
        multiple: each device is given a multiple of so many objects; the first is repeated to make up the number.
    """
    devices = jax.devices()
    objects = jax.tree.leaves(arguments)[0].shape[0]
    padding = -objects % (multiple * len(devices))
    padded = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[:1].repeat(padding, 0)]), arguments)
    if len(devices) > 1:
        over = PartitionSpec("objects")
        mesh = Mesh(np.array(devices), "objects")
        function = jax.shard_map(function, mesh=mesh, in_specs=(over,), out_specs=over, check_vma=False)
    return jax.tree.map(lambda leaf: leaf[:objects], function(padded))
