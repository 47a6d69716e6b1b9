"""Accuracy of a network on whole voxel grids: `python benchmarks/whole_grids.py ARCHIVE`.

A control for `ceiling.py`: VoxNet (Maturana and Scherer 2015) receives every cell of an object, including the inside
and the back, in a known pose, while a camera sees only surfaces. Objects that it misclassifies can hardly be
recognised from views. Nothing is selected: the number of epochs is fixed, the last weights are used, and predictions
are means over eight rotations and mirror images of each test object. All classes have the same weight in training.

The result is written to `benchmarks/results/whole_grids.json`.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import nnx
from jax import Array

from data_pipeline.files import write_json
from eval.machine import machine
from eval.numbers.comparison import intervals

RESULT = Path(__file__).parent / "results" / "whole_grids.json"


@dataclass(frozen=True)
class Options:
    archive: Annotated[Path, tyro.conf.Positional]
    """an .npz of 32×32×32 voxel grids"""
    epochs: int = 40
    """epochs; each draws as many objects as the training split has, with all classes equally often"""
    batch_size: int = 64
    """number of grids in a batch"""
    learning_rate: float = 1e-3
    """initial learning rate of AdamW, with a cosine schedule"""
    seed: int = 0
    """seed of weights and batches"""


class _Convolution(nnx.Module):
    """A three-dimensional convolution as one matrix product, because XLA's own is slow on CPUs."""

    def __init__(self, channels: int, filters: int, size: int, stride: int, *, rngs: nnx.Rngs):
        self.size, self.stride = size, stride
        self.linear = nnx.Linear(channels * size**3, filters, kernel_init=nnx.initializers.he_normal(), rngs=rngs)

    def __call__(self, x: Array) -> Array:
        places = [(side - self.size) // self.stride + 1 for side in x.shape[1:4]]
        offsets = np.ndindex((self.size,) * 3)

        def at(offset: tuple[int, ...]) -> Array:
            i, j, k = (
                slice(o, o + self.stride * (n - 1) + 1, self.stride) for o, n in zip(offset, places, strict=True)
            )
            return x[:, i, j, k]

        return self.linear(jnp.concatenate([at(offset) for offset in offsets], axis=-1))


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


def main(options: Options) -> None:
    with np.load(options.archive) as archive:
        grids = {split: archive[f"X_{split}"] > 0 for split in ("train", "test")}
        labels = {split: archive[f"y_{split}"].astype(np.int32) for split in ("train", "test")}
    there = {split: grids[split].any(axis=(1, 2, 3)) for split in grids}
    left_out = {split: int((~there[split]).sum()) for split in grids}
    grids, labels = ({split: values[split][there[split]] for split in values} for values in (grids, labels))
    counts = np.bincount(labels["train"])
    chance = 1 / counts[labels["train"]]
    steps = len(labels["train"]) // options.batch_size
    structure, weights = nnx.split(VoxNet(len(counts), rngs=nnx.Rngs(options.seed)))
    optimiser = optax.adamw(
        optax.cosine_decay_schedule(options.learning_rate, steps * options.epochs), weight_decay=1e-4
    )

    @jax.jit
    def step(weights, state, grids, labels, key):
        def loss_of(weights):
            logits = nnx.merge(structure, weights)(grids, key)
            return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, labels))

        loss, gradient = jax.value_and_grad(loss_of)(weights)
        updates, state = optimiser.update(gradient, state, weights)
        return optax.apply_updates(weights, updates), state, loss

    @jax.jit
    def judge(weights, grids):
        return jax.nn.softmax(nnx.merge(structure, weights)(grids))

    def accuracy() -> np.ndarray:
        """Whether each test object is classified correctly."""
        some = grids["test"].astype(np.float32)
        every = [changed(some, turns, mirror) for turns in range(4) for mirror in (False, True)]
        parts = [sum(judge(weights, one[i : i + 100]) for one in every) for i in range(0, len(some), 100)]
        return np.concatenate(parts).argmax(axis=-1) == labels["test"]

    random, state, started = np.random.default_rng(options.seed), optimiser.init(weights), time.perf_counter()
    for epoch in range(options.epochs):
        total = 0.0
        for chosen in random.choice(len(chance), (steps, options.batch_size), p=chance / chance.sum()):
            key = jax.random.key(int(random.integers(2**31)))
            batch = drawn(random, grids["train"][chosen]), labels["train"][chosen]
            weights, state, loss = step(weights, state, *batch, key)
            total += float(loss)
        print(f"epoch {epoch + 1}/{options.epochs}: loss {total / steps:.4f}", flush=True)
    right = accuracy()
    found = {
        "accuracy": float(right.mean()),
        "interval": intervals(right),
        "objects": len(right),
        "left_out": left_out,
        "epochs": options.epochs,
        "seconds": time.perf_counter() - started,
        "machine": machine(),
    }
    write_json(RESULT, found)
    print(found)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__.splitlines()[0]))
