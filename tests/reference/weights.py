"""Weights made from names and shapes alone, so that PyTorch and JAX can be given the same without storing them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

Network = TypeVar("Network", bound=nnx.Module)


def untrained(make: Callable[[], Network]) -> Network:
    """A network whose weights are all 0.01, without compiling what would draw them."""
    network = nnx.eval_shape(make)
    weights = jax.tree.map(lambda like: jnp.asarray(np.full(like.shape, 0.01, like.dtype)), nnx.state(network))
    nnx.update(network, weights)
    return network


def made_up_weights(shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """A state dict of plausible numbers: kernels of unit gain, scales about 1, positive variances."""
    state = {}
    for name, shape in shapes.items():
        random = np.random.Generator(np.random.PCG64(zlib.crc32(name.encode())))
        if name.endswith("num_batches_tracked"):
            state[name] = np.array(0)
        elif name.endswith("running_var"):
            state[name] = random.uniform(0.5, 1.5, shape).astype(np.float32)
        elif name.endswith("running_mean"):
            state[name] = random.uniform(-0.1, 0.1, shape).astype(np.float32)
        elif name.endswith("bn2.weight"):  # small residual branches keep the logits of a deep network near one
            state[name] = random.uniform(0.1, 0.3, shape).astype(np.float32)
        elif len(shape) == 1 and name.endswith("weight"):
            state[name] = random.uniform(0.8, 1.2, shape).astype(np.float32)
        elif len(shape) == 1:
            state[name] = random.uniform(-0.1, 0.1, shape).astype(np.float32)
        else:
            spread = np.sqrt(3 * 2.0 / np.prod(shape[1:]))
            state[name] = random.uniform(-spread, spread, shape).astype(np.float32)
    return state


def made_up_inputs(kind: str) -> np.ndarray:
    """Images (4, 64, 64, 3), or clouds (3, 600, 3) in the unit sphere."""
    random = np.random.Generator(np.random.PCG64(7))
    if kind == "resnet":
        return random.uniform(-1, 1, (4, 64, 64, 3)).astype(np.float32)
    cloud = random.uniform(-1, 1, (3, 600, 3))
    return (cloud / np.maximum(np.linalg.norm(cloud, axis=2, keepdims=True), 1) * 0.9).astype(np.float32)


def small_state() -> dict[str, np.ndarray]:
    """Arrays of the kinds that a file of weights may hold; `bfloat16` is stored as that."""
    random = np.random.Generator(np.random.PCG64(3))
    return {
        "plain": random.normal(size=(2, 3)).astype(np.float32),
        "transposed": random.normal(size=(3, 2)).astype(np.float32),
        "part": random.normal(size=4).astype(np.float32),
        "parameter": random.normal(size=5).astype(np.float32),
        "half": random.normal(size=3).astype(np.float16),
        "double": random.normal(size=3),
        "bfloat16": np.array([1.5, -2.0, 0.25], np.float32),
        "count": np.array(7),
        "nothing": np.zeros((0, 3), np.float32),
    }
