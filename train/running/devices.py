"""The device mesh of a training and the placement of its arrays, from one CPU to a pod.

The mesh has two axes. Batches are split along `data`. Weights are copied along `data`; large ones are split along `model`, by
their last axis. The compiler derives the rest.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AbstractMesh, Mesh, NamedSharding, PartitionSpec

from data_pipeline.errors import DataError
from train.optimiser import OptimiserConfig

DATA, MODEL = "data", "model"
_SMALLEST_SPLIT = 2**12
"""Weights smaller than this are copied to every device."""


def local_mesh() -> Mesh:
    """Returns the mesh of this process's own devices, for work that processes share out by objects."""
    return Mesh(np.array(jax.local_devices()).reshape(-1, 1), (DATA, MODEL))


@dataclass(frozen=True)
class Layout:
    """How the devices of all processes share the work, as numbers: of a mesh, or of one that is not there yet.

    Attributes:
        processes: number of processes, which have equally many devices.
        data: number of parts into which a batch is split.
        model: number of devices that share one copy of the weights.
    """

    processes: int = 1
    data: int = 1
    model: int = 1

    @classmethod
    def of(cls, devices: int, processes: int = 1, model: int = 1) -> Layout:
        """Returns the layout of so many devices, of all processes together.

        Raises:
            DataError: if the processes cannot have equally many devices, or `model` does not divide the devices of a process.
        """
        if processes < 1 or devices < 1 or devices % processes:
            raise DataError(
                f"{devices} devices cannot be shared equally by {processes} processes; each process needs as many as the others"
            )
        local = devices // processes
        if model < 1 or local % model:
            raise DataError(
                f"--model-devices {model} does not divide the {local} devices of a process; use 1, or a divisor"
            )
        return cls(processes, devices // model, model)

    @classmethod
    def of_mesh(cls, mesh: Mesh) -> Layout:
        """Returns the layout of a mesh of devices."""
        return cls(jax.process_count(), mesh.shape[DATA], mesh.shape[MODEL])

    @property
    def devices(self) -> int:
        """Number of devices of all processes."""
        return self.data * self.model

    @property
    def abstract_mesh(self) -> AbstractMesh:
        """The mesh without its devices, which tells the shapes of shards."""
        return AbstractMesh((self.data, self.model), (DATA, MODEL))


def device_mesh(model: int = 1) -> Mesh:
    """Returns the mesh of all devices of all processes.

    A process's devices are adjacent along `data`, so that its part of a batch is contiguous.

    Args:
        model: number of devices that share one copy of the weights.

    Raises:
        DataError: if `model` does not divide the devices of a process.
    """
    devices = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
    layout = Layout.of(len(devices), jax.process_count(), model)
    return Mesh(np.array(devices).reshape(layout.data, layout.model), (DATA, MODEL))


def check_batch(name: str, config: OptimiserConfig, layout: Layout, group: int = 1) -> None:
    """Raises `DataError` if a batch cannot be split equally over the devices and the processes; it names a batch that can.

    Args:
        name: of the network.
        group: number of successive views that stay in one part.
    """
    for option in ("batch_size", "parts", "views_per_object"):
        if (value := getattr(config, option)) < 1:
            raise DataError(f"{name}: optimiser.{option.replace('_', '-')} must be at least 1, and is {value}")
    unit = math.lcm(layout.data * config.parts, config.parts * group, config.views_per_object * layout.processes)
    fits = f"such as {unit * -(-config.batch_size // unit)}"
    batch, parts = f"{name}: a batch of {config.batch_size} views", config.parts
    if config.batch_size % (layout.data * parts):
        raise DataError(
            f"{batch}{f' in {parts} parts' if parts != 1 else ''} cannot be shared equally by {layout.data} devices; choose "
            f"another optimiser.batch-size ({fits}) or optimiser.parts, or use fewer devices"
        )
    if config.batch_size % (parts * group):
        raise DataError(
            f"{batch}, {group} of an object, cannot be cut into {parts} parts of whole objects; choose another "
            f"optimiser.batch-size ({fits}), optimiser.parts or optimiser.views-per-object"
        )
    if config.batch_size % (config.views_per_object * layout.processes):
        raise DataError(
            f"{batch}, {config.views_per_object} of an object, cannot be read equally by {layout.processes} processes; "
            f"choose another optimiser.batch-size ({fits}) or optimiser.views-per-object"
        )


def parameter_sharding(mesh: Mesh | AbstractMesh, tree: Any) -> Any:
    """Returns the sharding of every array of a tree: large ones split along `model` by the last axis, others copied."""
    model = mesh.shape[MODEL]

    def of(leaf: jax.Array | jax.ShapeDtypeStruct) -> NamedSharding:
        splits = model > 1 and leaf.ndim > 1 and leaf.size >= _SMALLEST_SPLIT and leaf.shape[-1] % model == 0
        return NamedSharding(mesh, PartitionSpec(*[None] * (leaf.ndim - 1), MODEL) if splits else PartitionSpec())

    return jax.tree.map(of, tree)


def place(tree: Any, sharding: Any) -> Any:
    """Distributes arrays that every process holds completely; `sharding` is a tree like `tree`."""

    def put(leaf: jax.Array | np.ndarray, where: NamedSharding) -> jax.Array:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):  # of a network that draws its own dropout
            data = put(jax.random.key_data(leaf), NamedSharding(where.mesh, PartitionSpec()))
            return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, where, lambda index: whole[index])

    return jax.tree.map(put, tree, sharding)


def place_batch(mesh: Mesh, batch: Any) -> Any:
    """Returns a batch spread over all devices, assembled from the parts that the processes hold."""
    split = NamedSharding(mesh, PartitionSpec(DATA))
    return jax.tree.map(lambda part: jax.make_array_from_process_local_data(split, part), batch)


def on_host(tree: Any) -> Any:
    """Returns arrays that are spread over the devices of all processes, whole, on the host of each process."""

    def fetch(leaf: jax.Array) -> np.ndarray:
        if leaf.is_fully_addressable or leaf.is_fully_replicated:
            return np.asarray(leaf)
        return np.asarray(multihost_utils.process_allgather(leaf, tiled=True))

    return jax.tree.map(fetch, tree)


def place_on(mesh: Mesh, batch: Any) -> Any:
    """Returns a batch that this process holds, spread over its own devices, a `local_mesh`."""
    return jax.device_put(batch, NamedSharding(mesh, PartitionSpec(DATA)))


def summed_over(mesh: Mesh, function: Callable) -> Callable:
    """Returns `function(parameters, statistics, batch, weights)`, which sums over a batch, for a batch spread over all devices.

    Every device applies `function` to its own part; the results are added.
    """

    def own(*arguments: Any) -> Any:
        return jax.tree.map(lambda part: jax.lax.psum(part, DATA), function(*arguments))

    whole, split = PartitionSpec(), PartitionSpec(DATA)
    return jax.shard_map(own, mesh=mesh, in_specs=(whole, whole, split, split), out_specs=whole, check_vma=False)


class Lead:
    """Limits how many steps the host dispatches ahead of the devices.

    A few steps keep the devices busy; with more, errors would be reported late.
    """

    def __init__(self, steps: int = 4):
        self._steps, self._running = steps, deque[jax.Array]()

    def limit(self, result: jax.Array) -> int:
        """Takes a result of the newest step, and waits for that of `steps` steps earlier; returns how many steps have ended."""
        self._running.append(result)
        if len(self._running) <= self._steps:
            return 0
        self._running.popleft().block_until_ready()
        return 1

    def end(self) -> int:
        """Waits for all steps; returns how many have ended that were not counted yet."""
        ended = len(self._running)
        while self._running:
            self._running.popleft().block_until_ready()
        return ended
