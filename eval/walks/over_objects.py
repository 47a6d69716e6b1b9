"""Distribution of objects over all devices, or cores; each runs the same program on its part, without communication."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Int

from eval.threads import programs_at_once


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


def on_all_cores(program: Any, arguments: Any, *rest: Any, **static: Any) -> Any:
    """Returns `program(arguments, *rest, **static)`, computed by one thread for each core where the only device is a CPU.

    Args:
        program: a jitted function that treats objects independently of each other; they are the second axis of its results.
        arguments: a tree of arrays with a leading axis of objects.
        rest: arguments that all objects share.
        static: arguments by name that the program is compiled for.
    """
    objects = len(jax.tree.leaves(arguments)[0])
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((arguments, rest)))
    if traced or (threads := min(programs_at_once(), objects)) < 2:
        return program(arguments, *rest, **static)
    size = -(-objects // threads)
    starts = [min(start, objects - size) for start in range(0, objects, size)]
    given, structure = jax.tree.flatten((arguments, rest))
    of_part = _of_part(program, structure, tuple(static.items()))
    compiled = of_part.lower(given, 0, size).compile()  # once, not by every thread
    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(lambda start: jax.block_until_ready(compiled(given, start)), starts))

    def together(*parts: Array) -> Array:
        whole = np.empty((len(parts[0]), objects, *parts[0].shape[2:]), parts[0].dtype)
        for start, part in zip(starts, parts, strict=True):
            whole[:, start : start + size] = part
        return jnp.asarray(whole)

    return jax.tree.map(together, *found)


@cache
def _of_part(program: Any, structure: Any, static: tuple[tuple[str, Any], ...]) -> Any:
    """The program for the objects from a number on.

    Its arguments are a flat list, because lowering also rebuilds them with descriptions in place of arrays, which the type checks
    of the tests refuse.
    """

    def of_part(given: list[Array], start: Int[Array, ""] | int, size: int) -> Any:
        arguments, rest = structure.unflatten(given)
        part = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, size), arguments)
        return program(part, *rest, **dict(static))

    return jax.jit(of_part, static_argnums=2)
