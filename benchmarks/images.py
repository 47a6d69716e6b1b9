"""ResNet-18 compared with PyTorch's, forward and training step: `make bench`, or `python benchmarks/images.py`.

64 images of 64×64 pixels and 16 of 224×224, in float32 and bfloat16, with the same weights. PyTorch computes in its default
layout and in channels-last, and the network's matrix products are timed alone: each convolution as one product of all patches
with its weights, and for a training step two more of that size. Results are compared before they are timed. Calls take
turns, so that other load on the machine affects all of them. Times are medians and quartiles; the relevant number is their
ratio. `--layers` lists the rate of every convolution and of its gradients beside the matrix product of its size.

The tables are written to `benchmarks/results/images.json` and `images.md`. With `--guard` nothing is written, and the exit
code is 1 if a ratio is below a third of the stored one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from benchmarks.comparing import (
    HEADER,
    Row,
    classification_loss,
    compare,
    end_by_guard,
    finished,
    forward_of,
    installed,
    machine_name,
    peer_device,
    row_cells,
    take_turns,
    training_step,
)
from data_pipeline.files import write_json, write_text
from mevs_jax import ResNet, resnet_from_torch
from mevs_jax.markdown import markdown_row, markdown_table
from mevs_jax.models.resnet import Convolution

RESULTS = Path(__file__).parent / "results" / "images.json"
BATCHES = {64: 64, 224: 16}
"""Images in a batch, by their size in pixels."""
LAYERS = ("layer", "products, GFLOP", "forward", "weights' gradient", "inputs' gradient", "product alone")


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
    of = [product_of(convolution, images, side) for _, convolution, side in convolutions(network, side)]
    different = sorted(set(of))
    arrays = [(jnp.ones((rows, inner), dtype), jnp.ones((inner, columns), dtype)) for rows, inner, columns in different]
    counts = [of.count(product) for product in different]

    @jax.jit
    def all_of(arrays: list[tuple[jax.Array, jax.Array]]) -> jax.Array:
        total = jnp.float32(0)
        for (x, kernel), count in zip(arrays, counts, strict=True):
            for number in range(count):
                out = x @ (kernel + number)
                total += out[-1, -1]
                if training:
                    total += (x.T @ (out + number))[-1, -1] + (out @ (kernel.T + number))[-1, -1]
        return total

    return lambda: all_of(arrays)


def rows_of(side: int, dtype: Any, torch_peer: Any, rounds: int) -> list[Row]:
    """Forward pass and training step for images of one size, in one type."""
    images, name = BATCHES[side], jnp.dtype(dtype).name
    random = np.random.default_rng(0)
    pixels = random.uniform(size=(images, side, side, 3)).astype(np.float32)
    labels = random.integers(0, 10, images)
    network = ResNet(rngs=nnx.Rngs(0), dtype=dtype)
    shown, peers = jnp.asarray(pixels), {}
    if torch_peer:
        peers = torch_peer.resnet18(pixels, labels, name, peer_device())
        resnet_from_torch(network, torch_peer.resnet18_weights())
    forward, step = jax.jit(forward_of(network)), training_step(network, classification_loss)
    wanted, what = jnp.asarray(labels), f"{images} images of {side}×{side}, {name}"
    rows: list[Row] = []
    for kind, ours in (
        ("forward", lambda: forward(shown)),
        ("training step", lambda: step(shown, wanted)),
    ):
        training = kind != "forward"
        calls: dict[str, Callable[[], Any]] = {peer: finished(both[training]) for peer, both in peers.items()}
        notes = {"its matrix products alone": "a floor, not a peer"}
        mine = np.asarray(ours())
        for peer, call in calls.items():
            expected = call().detach().float().cpu().numpy()
            apart = float(np.abs(mine - expected).max() / max(np.abs(expected).max(), 1))
            assert apart < (1e-4 if name == "float32" else 0.1), (what, peer, apart)
            notes[peer] = f"{'first loss' if training else 'outputs'} equal to {apart:.0e}"
        calls["its matrix products alone"] = products(network, images, side, dtype, training)
        rows += compare(f"ResNet-18 {kind}, {what}", ours, calls, rounds, notes)
    return rows


def layers_of(side: int, rounds: int) -> list[list[str]]:
    """GFLOP/s of every different convolution in float32 and of its gradients, beside the matrix product of its size."""
    images, random, found = BATCHES[side], np.random.default_rng(0), {}
    for name, convolution, extent in convolutions(ResNet(rngs=nnx.Rngs(0)), side):
        rows, inner, columns = product_of(convolution, images, extent)
        key = rows, inner, columns, convolution.stride
        if key in found:
            continue
        kernel = convolution.kernel[...]
        x = jnp.asarray(random.normal(size=(images, extent, extent, kernel.shape[2])), jnp.float32)
        structure = nnx.graphdef(convolution)

        def call(x, kernel, structure=structure):
            return nnx.merge(structure, nnx.State({"kernel": nnx.Param(kernel)}))(x)

        out = jax.jit(call)(x, kernel)
        of_kernel = jax.jit(lambda x, kernel, out, call=call: jax.vjp(lambda k: call(x, k), kernel)[1](out))
        of_x = jax.jit(lambda x, kernel, out, call=call: jax.vjp(lambda x: call(x, kernel), x)[1](out))
        alone = jax.jit(jnp.matmul)
        flat = jnp.asarray(random.normal(size=(rows, inner)), jnp.float32)
        calls: list[Callable[[], Any]] = [
            partial(jax.jit(call), x, kernel),
            partial(of_kernel, x, kernel, out),
            partial(of_x, x, kernel, out),
            partial(alone, flat, kernel.reshape(inner, columns)),
        ]
        work = 2e-9 * rows * inner * columns
        rates = 1e3 * work / np.median(take_turns(calls, rounds), axis=1)
        shape = f"{name}: {extent}×{extent}, {kernel.shape[2]} to {columns}, {kernel.shape[0]}×{kernel.shape[0]}"
        found[key] = [f"{shape}, stride {convolution.stride}", f"{work:.2f}", *(f"{rate:.0f}" for rate in rates)]
        print(markdown_row(found[key]), flush=True)
    return list(found.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--guard", action="store_true", help="compare ratios with the stored ones")
    parser.add_argument("--layers", action="store_true", help="rates of every layer, too")
    parser.add_argument("--sides", type=int, nargs="+", choices=list(BATCHES), default=list(BATCHES))
    given = parser.parse_args()
    rounds = 3 if given.guard else 11
    machine = machine_name()
    print(f"Measured on: {machine}. Milliseconds: median (quartiles).\n\n{markdown_table(HEADER, [])}")
    torch_peer: Any = None
    if installed("torch"):
        from benchmarks import torch_peer
    types = [jnp.float32] if given.guard else [jnp.float32, jnp.bfloat16]
    rows = [row for side in given.sides for dtype in types for row in rows_of(side, dtype, torch_peer, rounds)]
    if given.guard:
        end_by_guard(rows, RESULTS)
    layers = []
    if given.layers:
        print(f"\nGFLOP/s\n\n{markdown_table(LAYERS, [])}")
        layers = [layer for side in given.sides for layer in layers_of(side, rounds)]
    write_json(
        RESULTS,
        {
            "machine": machine,
            "device": peer_device() if torch_peer else "",
            "rows": [asdict(row) for row in rows],
            "layers": layers,
        },
    )
    text = (
        f"{machine}. Milliseconds: median (quartiles).\n\n{markdown_table(HEADER, [row_cells(row) for row in rows])}\n"
    )
    if layers:
        text += f"\nRates of the convolutions in float32, GFLOP/s:\n\n{markdown_table(LAYERS, layers)}\n"
    write_text(RESULTS.with_suffix(".md"), text)


if __name__ == "__main__":
    main()
