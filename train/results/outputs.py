"""Outputs of a trained network for every view of every object of a split."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import flax.nnx as nnx
import jax
import numpy as np

from data_pipeline.dataset.batches import evaluation_batches
from data_pipeline.dataset.builder import open_split
from data_pipeline.distributed import from_all, own_share
from data_pipeline.progress import COMPILING, progress_bar
from train.results.finite import check_outputs
from train.running.devices import local_mesh, parameter_sharding, place, place_on
from train.step import Batch, Task

Ask = Callable[[Any, Task, Batch], jax.Array]
"""A function of a network, its task and a batch that returns an output of each view, (views, numbers)."""


def _output(network: Any, task: Task, batch: Batch) -> jax.Array:
    return network(task.inputs(batch))


@partial(jax.jit, static_argnames=("task", "structure", "ask"))
def _outputs_of_batch(
    task: Task,
    structure: nnx.GraphDef,
    state: nnx.State,
    batch: Batch,
    ask: Ask,
) -> jax.Array:
    return ask(nnx.merge(structure, state), task, batch)


def network_outputs(
    data: Path,
    split: str,
    task: Task,
    network: nnx.Module,
    ask: Ask = _output,
    chosen: np.ndarray | None = None,
) -> np.ndarray:
    """Returns an output of a network for every view of every object of a split, (objects, views, numbers).

    Several processes share the objects, and each returns all.

    Args:
        data: folder of the data set.
        ask: computes the output of a batch; by default, what the network returns for the task's inputs.
        chosen: positions of objects in the split, in order; all if None.

    Raises:
        Diverged: if an output is infinite or NaN.
    """
    structure, state = nnx.split(network)
    mesh = local_mesh()
    state = place(state, parameter_sharding(mesh, state))
    chosen = np.arange(len(open_split(data, split))) if chosen is None else chosen
    own = chosen[own_share(len(chosen))]
    objects, given = len(own), own if len(own) else chosen[:1]
    of = task.batches
    batches = evaluation_batches(data, split, points=of.points, images=of.images, chosen=given, workers=of.workers)
    with progress_bar("objects") as bar:
        line = bar.add_task(f"Evaluating {task.name} on {split} objects", total=objects, note=COMPILING)
        out = []
        while chunk := list(islice(batches, mesh.size)):
            filled = [*chunk, *chunk[:1] * (mesh.size - len(chunk))]
            batch = {name: np.concatenate([one[name] for one in filled]) for name in filled[0]}
            # Fetched only after the loop, so that the next objects are read while the devices compute.
            out.append(_outputs_of_batch(task, structure, state, place_on(mesh, batch), ask))
            bar.advance(line, len(chunk))
    found = np.concatenate([np.asarray(part) for part in out])
    found = from_all(found.reshape(len(out) * mesh.size, -1, found.shape[-1])[:objects], len(chosen))
    return check_outputs(found, task.name, f"{split} objects")
