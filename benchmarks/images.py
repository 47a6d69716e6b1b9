"""ResNet-18 compared with PyTorch's, forward and training step: `make bench`, or `python benchmarks/images.py`.

64 images of 64×64 pixels and 16 of 224×224, in float32 and bfloat16, with the same weights. PyTorch computes in its default
layout and in channels-last, and the network's matrix products are timed alone: each convolution as one product of all patches
with its weights, and for a training step two more of that size. Results are compared before they are timed, in turns. The
relevant number is the ratio of the times. `--layers` lists the rates of every convolution and its gradients.

The tables are written to `benchmarks/results/images.json` and `images.md`. With `--guard` nothing is written, and the exit
code is 1 if a ratio is below a third of the stored one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx

from benchmarks.comparing import (
    COMPARED,
    FLOOR,
    UNITS,
    TrainingStep,
    classification_loss,
    compare,
    end_by_guard,
    forward_of,
    take_turns,
    torch_peers,
)
from benchmarks.reporting import RESULTS, Row, Table, keep, machine_name
from mevs_jax import ResNet, resnet_from_torch
from mevs_jax.models.resnet import Convolution

PATH = RESULTS / "images.json"
BATCHES = {64: 64, 224: 16}
"""Images in a batch, by their size in pixels."""
RATES = ("forward", "weights' gradient", "inputs' gradient", "product alone")
LAYERS = Table(
    " | ".join(("layer", "products, GFLOP", *RATES)),
    " | ".join(("{layer}", "{work:.2f}", *(f"{{{name}:.0f}}" for name in RATES))),
)


def convolutions(network: ResNet, side: int) -> Iterator[tuple[str, Convolution, int]]:
    """The convolutions of a network, each with the side of its input for images of `side` pixels."""
    assert isinstance(network.convolution, Convolution)
    yield "stem", network.convolution, side
    side //= 4
    for number, block in enumerate(network.blocks):
        yield f"block {number}, first", block.convolution1, side
        if block.projects:
            yield f"block {number}, shortcut", block.shortcut, side
        side //= block.convolution1.stride
        yield f"block {number}, second", block.convolution2, side


def product_of(convolution: Convolution, images: int, side: int) -> tuple[int, int, int]:
    """Rows, inner size and columns of the matrix product that a convolution is."""
    size, _, inputs, outputs = convolution.kernel.shape
    return images * (side // convolution.stride) ** 2, size * size * inputs, outputs


def products(network: ResNet, images: int, side: int, dtype: Any, training: bool) -> Callable[[], jax.Array]:
    """The matrix products of the convolutions of a forward pass or training step alone."""
    sizes = Counter(product_of(convolution, images, side) for _, convolution, side in convolutions(network, side))
    arrays = [(jnp.ones((rows, inner), dtype), jnp.ones((inner, columns), dtype)) for rows, inner, columns in sizes]

    @jax.jit
    def all_of(arrays: list[tuple[jax.Array, jax.Array]]) -> jax.Array:
        total = jnp.float32(0)
        for (x, kernel), count in zip(arrays, sizes.values(), strict=True):
            for number in range(count):
                out = x @ (kernel + number)
                total += out[-1, -1]
                if training:
                    total += (x.T @ (out + number))[-1, -1] + (out @ (kernel.T + number))[-1, -1]
        return total

    return lambda: all_of(arrays)


def compared(side: int, dtype: Any, torch_peer: Any, rounds: int) -> Iterator[Row]:
    """Forward pass and training step for images of one size, in one type."""
    images, name = BATCHES[side], jnp.dtype(dtype).name
    random = np.random.default_rng(0)
    pixels = random.uniform(size=(images, side, side, 3)).astype(np.float32)
    labels = random.integers(0, 10, images)
    network, peers = ResNet(rngs=nnx.Rngs(0), dtype=dtype), {}
    if torch_peer:
        weights, peers = torch_peer.resnet18(pixels, labels, name)
        resnet_from_torch(network, weights)
    shown, wanted = jnp.asarray(pixels), jnp.asarray(labels)
    forward = partial(jax.jit(forward_of(network)), shown)
    step = partial(TrainingStep(network, classification_loss), shown, wanted)
    what = f"{images} images of {side}×{side}, {name}"
    for training, kind, ours in ((False, "forward", forward), (True, "training step", step)):
        calls: dict[str, Callable[[], Any]] = {peer: both[training] for peer, both in peers.items()}
        mine, notes = np.asarray(ours()), dict[str, str]()
        for peer, call in calls.items():
            expected = torch_peer.array(call())
            apart = float(np.abs(mine - expected).max() / max(np.abs(expected).max(), 1))
            assert apart < (1e-4 if name == "float32" else 0.1), (what, peer, apart)
            notes[peer] = f"{'first loss' if training else 'outputs'} equal to {apart:.0e}"
        calls[FLOOR] = products(network, images, side, dtype, training)
        yield from compare(f"ResNet-18 {kind}, {what}", ours, calls, rounds, notes)


def layers_of(side: int, rounds: int) -> Iterator[Row]:
    """GFLOP/s of every different convolution in float32 and of its gradients, beside the matrix product of its size."""
    images, random, done = BATCHES[side], np.random.default_rng(0), set()
    for name, convolution, extent in convolutions(ResNet(rngs=nnx.Rngs(0)), side):
        rows, inner, columns = product_of(convolution, images, extent)
        key = rows, inner, columns, convolution.stride
        if key in done:
            continue
        done.add(key)
        kernel = convolution.kernel[...]
        x = jnp.asarray(random.normal(size=(images, extent, extent, kernel.shape[2])), jnp.float32)
        structure = nnx.graphdef(convolution)

        def call(x, kernel, structure=structure):
            return nnx.merge(structure, nnx.State({"kernel": nnx.Param(kernel)}))(x)

        out = jax.jit(call)(x, kernel)
        flat = jnp.asarray(random.normal(size=(rows, inner)), jnp.float32)
        calls: list[Callable[[], Any]] = [
            partial(jax.jit(call), x, kernel),
            partial(
                jax.jit(lambda x, kernel, out, call=call: jax.vjp(partial(call, x), kernel)[1](out)), x, kernel, out
            ),
            partial(
                jax.jit(lambda x, kernel, out, call=call: jax.vjp(lambda x: call(x, kernel), x)[1](out)), x, kernel, out
            ),
            partial(jax.jit(jnp.matmul), flat, kernel.reshape(inner, columns)),
        ]
        work = 2e-9 * rows * inner * columns
        rates = (1e3 * work / np.median(take_turns(calls, rounds), axis=1)).tolist()
        size = kernel.shape[0]
        shape = f"{name}: {extent}×{extent}, {kernel.shape[2]} to {columns}, {size}×{size}, stride {convolution.stride}"
        yield {"layer": shape, "work": work} | dict(zip(RATES, rates, strict=True))


def main(guard: bool = False, layers: bool = False, sides: tuple[Literal[64, 224], ...] = (64, 224)) -> None:
    """Measures, shows and keeps.

    Args:
        guard: compare ratios with the stored ones.
        layers: rates of every layer, too.
        sides: sizes of images in pixels.
    """
    rounds, types = (3, [jnp.float32]) if guard else (11, [jnp.float32, jnp.bfloat16])
    print(f"Measured on: {machine_name()}. {UNITS}")
    torch_peer = torch_peers()
    rows = COMPARED.show(row for side in sides for dtype in types for row in compared(side, dtype, torch_peer, rounds))
    if guard:
        end_by_guard(rows, PATH)
    measured, parts = [], [UNITS, COMPARED.markdown(rows)]
    if layers:
        measured = LAYERS.show(layer for side in sides for layer in layers_of(side, rounds))
        parts += ["Rates of the convolutions in float32, GFLOP/s:", LAYERS.markdown(measured)]
    device = torch_peer.device() if torch_peer else ""
    keep(PATH, {"device": device, "rows": rows, "layers": [LAYERS.cells(layer) for layer in measured]}, *parts)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
