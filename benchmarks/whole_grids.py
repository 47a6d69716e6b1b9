"""Accuracy of a network on whole voxel grids: `python benchmarks/whole_grids.py ARCHIVE`.

A control for `ceiling.py`: VoxNet (Maturana and Scherer 2015) receives every cell of an object, including the inside
and the back, in a known pose, while a camera sees only surfaces. Objects that it misclassifies can hardly be
recognised from views. Nothing is selected: the number of epochs is fixed, the last weights are used, and predictions
are means over eight rotations and mirror images of each test object. All classes have the same weight in training.

The result is written to `benchmarks/results/whole_grids.json`.
"""

from __future__ import annotations

import time
from itertools import product
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import nnx
from jax import Array

from benchmarks.comparing import TrainingStep, forward_of
from benchmarks.reporting import RESULTS
from data_pipeline.files import write_json
from eval.machine import machine
from eval.numbers.comparison import intervals


class _Convolution(nnx.Module):
    """A three-dimensional convolution as one matrix product, because XLA's own is slow on CPUs."""

    def __init__(self, channels: int, filters: int, size: int, stride: int, *, rngs: nnx.Rngs):
        self.size, self.stride = size, stride
        self.linear = nnx.Linear(channels * size**3, filters, kernel_init=nnx.initializers.he_normal(), rngs=rngs)

    def __call__(self, x: Array) -> Array:
        last = x.shape[1] - self.size + 1
        slices = [slice(start, start + last, self.stride) for start in range(self.size)]
        return self.linear(jnp.concatenate([x[:, i, j, k] for i, j, k in product(slices, repeat=3)], axis=-1))


class VoxNet(nnx.Module):
    """VoxNet: two convolutions, one pooling, two linear layers."""

    def __init__(self, classes: int, *, rngs: nnx.Rngs):
        self.first, self.second = (
            _Convolution(1, 32, 5, 2, rngs=rngs),
            _Convolution(32, 32, 3, 1, rngs=rngs),
        )
        self.hidden, self.head = nnx.Linear(32 * 6**3, 128, rngs=rngs), nnx.Linear(128, classes, rngs=rngs)

    def __call__(self, grids: Array, key: Array | None = None) -> Array:
        """Logits of grids (batch, 32, 32, 32); dropout is applied if a key is given."""
        keys = (None,) * 3 if key is None else jax.random.split(key, 3)
        x = _dropped(keys[0], 0.2, nnx.leaky_relu(self.first(grids[..., None]), 0.1))
        x = nnx.max_pool(nnx.leaky_relu(self.second(x), 0.1), (2, 2, 2), (2, 2, 2))
        x = _dropped(keys[1], 0.3, x.reshape(len(x), -1))
        return self.head(_dropped(keys[2], 0.4, nnx.relu(self.hidden(x))))


def _dropped(key: Array | None, rate: float, x: Array) -> Array:
    return x if key is None else jnp.where(jax.random.bernoulli(key, 1 - rate, x.shape), x / (1 - rate), 0.0)


def changed(grids: np.ndarray, turns: int, mirror: bool) -> np.ndarray:
    """Grids rotated about the vertical (the last axis) by `turns` right angles, and mirrored if `mirror`."""
    grids = np.rot90(grids, turns, (1, 2))
    return grids[:, ::-1] if mirror else grids


def drawn(random: np.random.Generator, grids: np.ndarray) -> np.ndarray:
    """Training grids with augmentation: each is rotated, mirrored and shifted by up to two cells at random."""
    found = np.empty(grids.shape, np.float32)
    for index, grid in enumerate(grids):
        one = changed(grid[None], int(random.integers(4)), bool(random.integers(2)))[0]
        x, y, z = random.integers(0, 5, 3)
        found[index] = np.pad(one, 2)[x : x + 32, y : y + 32, z : z + 32]
    return found


def objects_of(archive: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, int]]:
    """Grids and labels of each split, and how many empty grids were left out."""
    grids, labels, left_out = {}, {}, {}
    with np.load(archive) as arrays:
        for split in ("train", "test"):
            every = arrays[f"X_{split}"] > 0
            there = every.any(axis=(1, 2, 3))
            grids[split], labels[split] = every[there], arrays[f"y_{split}"].astype(np.int32)[there]
            left_out[split] = int((~there).sum())
    return grids, labels, left_out


def probabilities(network: VoxNet, grids: np.ndarray) -> np.ndarray:
    """Sums over rotations and mirror images, (objects, classes)."""
    judge = jax.jit(lambda grids: jax.nn.softmax(forward_of(network)(grids)))
    every = [changed(grids.astype(np.float32), turns, mirror) for turns in range(4) for mirror in (False, True)]
    parts = [sum(judge(one[i : i + 100]) for one in every) for i in range(0, len(grids), 100)]
    return np.concatenate(parts)


def trained(
    grids: np.ndarray, labels: np.ndarray, epochs: int, batch_size: int, learning_rate: float, seed: int
) -> VoxNet:
    """All classes are drawn equally often; the learning rate falls by a cosine schedule."""
    counts = np.bincount(labels)
    chance, steps = 1 / counts[labels], len(labels) // batch_size
    schedule = optax.cosine_decay_schedule(learning_rate, steps * epochs)

    def loss_of(network: VoxNet, grids: Array, labels: Array, key: Array) -> Array:
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(network(grids, key), labels))

    network = VoxNet(len(counts), rngs=nnx.Rngs(seed))
    step, random = TrainingStep(network, loss_of, optax.adamw(schedule, weight_decay=1e-4)), np.random.default_rng(seed)
    for epoch in range(epochs):
        total = 0.0
        for chosen in random.choice(len(chance), (steps, batch_size), p=chance / chance.sum()):
            key = jax.random.key(int(random.integers(2**31)))
            total += float(step(drawn(random, grids[chosen]), labels[chosen], key))
        print(f"epoch {epoch + 1}/{epochs}: loss {total / steps:.4f}", flush=True)
    return step.network()


def main(
    archive: Annotated[Path, tyro.conf.Positional],
    epochs: int = 40,
    batch_size: int = 64,
    learning_rate: float = 1e-3,
    seed: int = 0,
) -> None:
    """Measures, shows and keeps.

    Args:
        archive: an .npz of 32×32×32 voxel grids.
        epochs: each draws as many objects as the training split has.
        batch_size: number of grids in a batch.
        learning_rate: of AdamW, initially.
        seed: of weights and batches.
    """
    grids, labels, left_out = objects_of(archive)
    started = time.perf_counter()
    network = trained(grids["train"], labels["train"], epochs, batch_size, learning_rate, seed)
    right = probabilities(network, grids["test"]).argmax(axis=-1) == labels["test"]
    result = {
        "accuracy": float(right.mean()),
        "interval": intervals(right),
        "objects": len(right),
        "left_out": left_out,
        "epochs": epochs,
        "seconds": time.perf_counter() - started,
        "machine": vars(machine()),
    }
    write_json(RESULTS / "whole_grids.json", result)
    print(result)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
