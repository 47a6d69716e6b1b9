"""Distribution of objects over all devices of this process; each runs the same program on its part, without communication."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec


def over_objects(function: Callable[[Any], Any], arguments: Any, multiple: int = 1) -> Any:
    """Returns `function(arguments)`, with the objects split between all devices; for use under jit.

    Every array of the arguments and of the result has a leading axis of objects.

    Args:
        function: a function that treats objects independently of each other.
        arguments: a tree of arrays.
        multiple: each device receives a multiple of this number of objects; the first object is repeated as padding.
    """
    devices = jax.local_devices()
    objects = jax.tree.leaves(arguments)[0].shape[0]
    padding = -objects % (multiple * len(devices))
    padded = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[:1].repeat(padding, 0)]), arguments)
    if len(devices) > 1:
        over = PartitionSpec("objects")
        mesh = Mesh(np.array(devices), "objects")
        function = jax.shard_map(function, mesh=mesh, in_specs=(over,), out_specs=over, check_vma=False)
    return jax.tree.map(lambda leaf: leaf[:objects], function(padded))
