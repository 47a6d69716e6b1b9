"""One function of one object, applied to many objects: shared by processes, devices and cores, in chunks of bounded memory.

On CPUs every chunk is computed as one core alone would compute it. So the results do not depend on how many processes, devices
and cores share them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from data_pipeline.distributed import from_all, own_share
from data_pipeline.processes import usable_cpus

_MOST_AT_ONCE = 16
"""The most programs side by side, because each needs memory of its own."""
_CHUNKS_IN_PROGRAM = 8
"""The most chunks in one call of a program, whose objects and results are on the device together."""


def programs_at_once() -> int:
    """Returns how many threads should run programs side by side: one for each core where the only device is a CPU, else one.

    Programs that one thread starts run one after the other, and XLA runs a loop on one core. Those of several threads run side by
    side.
    """
    device, *others = jax.local_devices()
    return 1 if others or device.platform != "cpu" else min(usable_cpus(), _MOST_AT_ONCE)


def over_objects(
    function: Callable[..., Any], objects: Any, *shared: Any, at_once: int, by_all: bool = False, **static: Any
) -> Any:
    """Returns `function(one, *shared, **static)` of every object, as arrays on the host with a leading axis of objects.

    Args:
        function: of one object. A program is compiled for it once, so it must be the same function in every call.
        objects: a tree of arrays with a leading axis of objects.
        shared: trees of arrays that all objects share.
        at_once: the most objects that a core or device computes side by side.
        by_all: whether every process calls this, so that they share the objects; each returns all results.
        static: arguments by name that the program is compiled for; they must be hashable.
    """
    every = jax.device_get(jax.tree.leaves(objects))  # parts may belong on other devices than those that they are on
    count = len(every[0])
    devices, threads = jax.local_device_count(), programs_at_once()
    workers_of_any = _MOST_AT_ONCE if jax.default_backend() == "cpu" else devices  # chunks are those of one core
    at_once = max(1, min(at_once, -(-count // workers_of_any)))
    chunks, workers = -(-count // at_once), devices * threads * (jax.process_count() if by_all else 1)
    calls = -(-chunks // (workers * _CHUNKS_IN_PROGRAM))
    size = -(-chunks // (workers * calls)) * at_once * devices
    firsts = range(0, count, size)
    own = own_share(len(firsts)) if by_all else np.arange(len(firsts))

    if devices > 1:
        shared = jax.device_put(shared, NamedSharding(_mesh(), PartitionSpec()))

    def given(first: int) -> list[Any]:
        index = np.minimum(np.arange(first, first + size), count - 1)  # the last object fills up the last part
        return [*(leaf[index] for leaf in every), *jax.tree.leaves(shared)]

    program = function, jax.tree.structure((objects, shared)), tuple(static.items()), at_once
    run: Callable[[list[Any]], Any] = partial(_run, *program)
    parts = [firsts[number] for number in own] or [0]  # a process without a part still needs shapes
    if min(threads, len(parts)) > 1:
        run = _run.lower(*program, given(parts[0])).compile()  # once, not by every thread
    leaves: list[np.ndarray] = []
    with ThreadPoolExecutor(threads) as pool:
        for place, part in enumerate(pool.map(lambda first: jax.device_get(run(given(first))), parts)):
            some, structure = jax.tree.flatten(part)
            leaves = leaves or [np.empty((len(parts), *leaf.shape), leaf.dtype) for leaf in some]
            for leaf, values in zip(leaves, some, strict=True):  # each part is freed once it has its place
                leaf[place] = values
    if by_all:
        leaves = [from_all(leaf[: len(own)], len(firsts)) for leaf in leaves]
    return jax.tree.unflatten(structure, [leaf.reshape(-1, *leaf.shape[2:])[:count] for leaf in leaves])


def _mesh() -> Mesh:
    return Mesh(np.array(jax.local_devices()), "objects")


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _run(
    function: Callable[..., Any], structure: Any, static: tuple[tuple[str, Any], ...], at_once: int, leaves: list[Array]
) -> Any:
    """The results of some objects, on all devices of this process.

    The arguments are a flat list, because lowering also rebuilds them with descriptions in place of arrays, which the type checks
    of the tests refuse.
    """

    def of_some(objects: Any, shared: tuple[Any, ...]) -> Any:
        return jax.lax.map(lambda one: function(one, *shared, **dict(static)), objects, batch_size=at_once)

    if jax.local_device_count() > 1:
        over = PartitionSpec("objects")
        of_some = jax.shard_map(
            of_some, mesh=_mesh(), in_specs=(over, PartitionSpec()), out_specs=over, check_vma=False
        )
    return of_some(*structure.unflatten(leaves))
