"""Memory and arithmetic of a training step, counted from shapes: nothing is compiled, and no array of that size is made.

Memory of a device is that of the state, gradients, the views of a batch, and what the forward pass keeps for the backward pass.
The plan is 0.9 to 1.2 times what XLA's compiler needs for an H100 (tested). Other compilers need other amounts: that for TPUs
fills tiles and fuses products, and that for CPUs spends memory to compute more at once (docs/scaling.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import jax
import numpy as np
from flax import nnx
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxprs_in_params

from data_pipeline.dataset.batches import views_of_example
from data_pipeline.dataset.statistics import DatasetStatistics
from train.running.devices import Layout, parameter_sharding
from train.step import Batch, Hyperparameters, Task, TrainState, abstract_state, train_step_of


def views_like(task: Task, statistics: DatasetStatistics, views: int) -> dict[str, jax.ShapeDtypeStruct]:
    """Returns the arrays of a batch of so many views, as shapes."""
    side, batches = statistics.camera.resolution, task.batches
    image = np.zeros((1, side, side))
    example = {
        "label": 0,
        "depth": image.astype(np.uint16),
        "image": image.astype(np.uint8),
        "pose": np.zeros((1, 4, 4), np.float32),
        "entropy": np.zeros(statistics.views, np.float32),
    }
    random = np.random.default_rng(0)
    one = views_of_example(example, np.zeros(1, int), points=batches.points, images=batches.images, random=random)
    return {name: jax.ShapeDtypeStruct((views, *array.shape[1:]), array.dtype) for name, array in one.items()}


_ALONE = Layout()


def bytes_of(tree: Any, layout: Layout = _ALONE) -> int:
    """Returns the bytes of one device's share of a tree of arrays or shapes, placed as weights are; by default of all of it."""
    where = parameter_sharding(layout.abstract_mesh, tree)
    shares = jax.tree.map(lambda leaf, at: math.prod(at.shard_shape(leaf.shape)) * leaf.dtype.itemsize, tree, where)
    return sum(jax.tree.leaves(shares))


def memory_of(task: Task, statistics: DatasetStatistics, layout: Layout) -> dict[str, int]:
    """Returns the bytes of a device by what they hold, by the names of `NetworkPlan`.

    Where the weights are split, activations are counted as if they were not: an upper bound.
    """
    config, (structure, state) = task.optimiser, abstract_state(task)
    weights, views = bytes_of(state.parameters, layout), config.batch_size // layout.data
    of_a_view = activations_of_a_view(task, statistics, structure, state)
    return {
        "weights_bytes": weights,
        "state_bytes": bytes_of(state, layout),
        "gradients_bytes": weights * min(2, config.parts),
        "inputs_bytes": bytes_of(views_like(task, statistics, views)),
        "activations_bytes": of_a_view * (views // config.parts),
        "view_activations_bytes": of_a_view,
    }


def activations_of_a_view(task: Task, statistics: DatasetStatistics, structure: nnx.GraphDef, state: TrainState) -> int:
    """Returns the bytes that a view adds to what a step keeps: what two more groups of views add, by half.

    A compiler that fuses operations keeps what products and convolutions read and write, each once, and computes all else again.
    The backward pass gives these up from the last to the first, and has the gradient of one of them.
    """

    def kept(groups: int) -> int:
        def loss_of(state: TrainState, batch: Batch, key: jax.Array, hyper: Hyperparameters) -> jax.Array:
            network = nnx.merge(structure, state.parameters, state.statistics, copy=True)
            return task.loss(network, batch, key, state.step, hyper)[0]

        batch = views_like(task, statistics, groups * task.group)
        key = jax.eval_shape(lambda: jax.random.key(0))
        found = _multiplied(jax.make_jaxpr(loss_of)(state, batch, key, task.hyperparameters))
        return max(until + size for until, size in zip(accumulate(found), found, strict=True))

    return (kept(4) - kept(2)) // (2 * task.group)


_PRODUCTS = {"dot_general", "conv_general_dilated", "cond"}
"""Operations that a compiler does not fuse into others; `cond` chooses the form of one for a platform."""
_COPIES = {"reshape", "transpose", "squeeze", "convert_element_type", "copy", "optimization_barrier"}


def _multiplied(program: ClosedJaxpr) -> list[int]:
    """Bytes of the arrays that the products of a program read and write, each once, in the narrowest type that it has."""
    found: dict[object, int] = {}

    def walk(jaxpr: Jaxpr, given: Sequence[object]) -> list[object]:
        names: dict[Any, object] = dict(zip(jaxpr.invars, given, strict=True))

        def name(variable: Any) -> object:
            return object() if isinstance(variable, Literal) else names.setdefault(variable, object())

        def keep(variable: Any, array: object) -> None:
            size = variable.aval.size * variable.aval.dtype.itemsize
            found[array] = min(size, found.get(array, size))

        for equation in jaxpr.eqns:
            read, written = equation.invars, equation.outvars
            if equation.primitive.name in _PRODUCTS:
                for variable in (*read, *written):
                    keep(variable, name(variable))
            elif equation.primitive.name in _COPIES:
                names[written[0]] = array = name(read[0])
                if array in found:
                    keep(written[0], array)
            elif (inner := next(jaxprs_in_params(equation.params), None)) and len(inner.invars) == len(read):
                names |= dict(zip(written, walk(inner, [name(variable) for variable in read]), strict=True))
        return [name(variable) for variable in jaxpr.outvars]

    walk(program.jaxpr, [object() for _ in program.jaxpr.invars])
    return list(found.values())


def flop_of(task: Task, statistics: DatasetStatistics, views: int) -> float:
    """Returns the floating-point operations of a step on so many views, as XLA counts them before it compiles; 0 if it does not.

    The body of a loop counts once: the search for spread points in PointNet++, which is small beside its layers.
    """
    task = replace(task, optimiser=replace(task.optimiser, batch_size=views, parts=1))  # type: ignore[type-var]
    structure, state = abstract_state(task)
    step = jax.jit(train_step_of(task, structure, 1))
    lowered = step.lower(state, views_like(task, statistics, views), task.hyperparameters)
    return float((lowered.cost_analysis() or {}).get("flops", 0.0))
