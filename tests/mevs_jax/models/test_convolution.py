"""Every way in which a convolution is computed on CPU against XLA's own, and the pooling against XLA's and a plain loop."""

from __future__ import annotations

from functools import partial
from itertools import cycle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mevs_jax.models import convolution
from mevs_jax.models.convolution import Convolution, convolve, pool

WAYS = {
    "product": (convolution._product, convolution._gradient_of(convolution._product)),
    "taps": (convolution._tap_by_tap, convolution._tap_by_tap_backwards),
    "patches": (convolution._convolve, convolution._from_patches),
    "tiles": (convolution._tiled, convolution._tiled_backwards),
}
SHAPES = [(1, 1), (1, 2), (3, 1), (3, 2), (7, 2)]
"""Sizes and strides of kernels; tiles are of 3×3 kernels without stride."""
CASES = [
    pytest.param(way, *shape, marks=[pytest.mark.slow] * (shape == (7, 2) and way != "patches"))
    for way in WAYS
    for shape in SHAPES
    if way != "tiles" or shape == (3, 1)
]
MAPS = [(1, 1), (9, 8), (2, 2), (3, 5), (20, 24)]
some_maps = pytest.mark.parametrize(
    "maps", [MAPS[:2], pytest.param(MAPS[2:], marks=pytest.mark.slow)], ids=["few", "more"]
)


def weights_of(out):
    return jnp.asarray(np.random.default_rng(1).normal(size=out.shape), out.dtype)


def both(f, *arrays):
    """A result and the gradients of a sum that depends on each of its values differently."""
    out, of_inputs = jax.vjp(f, *arrays)
    return out, *of_inputs(weights_of(out))


@some_maps
@pytest.mark.parametrize(("way", "size", "stride"), CASES)
def test_every_way_is_the_convolution_of_xla(way, size, stride, maps, random, monkeypatch):
    monkeypatch.setattr(convolution, "_CACHED", 500)  # so that gradients are sums over parts of the batch
    few_and_many = cycle((3, 9))  # channels: patches of few are gathered otherwise
    for (height, width), channels in zip(maps, few_and_many, strict=False):
        x = jnp.asarray(random.normal(size=(6, height, width, channels)), jnp.float32)
        kernel = jnp.asarray(random.normal(size=(size, size, channels, 5)), jnp.float32)
        forwards, backwards = WAYS[way]
        out = forwards(x, kernel, stride)
        found = out, *backwards(x, kernel, weights_of(out), stride)
        expected = both(lambda x, kernel: convolution._convolve(x, kernel, stride), x, kernel)
        for mine, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("way", "batch", "side", "channels", "size", "stride"),
    [
        ("product", 4, 4, 8, 3, 1),
        ("product", 4, 16, 8, 1, 2),
        ("patches", 4, 16, 8, 3, 1),
        ("patches", 64, 64, 64, 7, 2),
        ("patches", 256, 16, 32, 3, 1),
        ("taps", 256, 2, 256, 3, 1),
        ("taps", 256, 16, 64, 3, 2),
        ("tiles", 256, 8, 64, 3, 1),
    ],
)
def test_the_way_depends_on_the_shapes(way, batch, side, channels, size, stride):
    x = jax.ShapeDtypeStruct((batch, side, side, channels), jnp.float32)
    kernel = jax.ShapeDtypeStruct((size, size, channels, channels), jnp.float32)
    chosen = []
    jax.eval_shape(lambda *given: chosen.append(convolution._best_on_cpu(*given, stride)), x, kernel)
    assert chosen[0].forwards is WAYS[way][0]


@pytest.mark.parametrize(("size", "stride"), SHAPES)
def test_a_layer_is_the_same_on_an_accelerator(size, stride):
    layer = Convolution(5, 6, size, stride, rngs=nnx.Rngs(0))
    x, kernel = jax.random.normal(jax.random.key(1), (2, 7, 7, 5)), layer.kernel[...]
    np.testing.assert_allclose(layer(x), convolution._convolve(x, kernel, stride), atol=1e-5)
    here, there = (both(partial(way, stride=stride), x, kernel) for way in (convolve, convolution._convolve))
    for mine, theirs in zip(here, there, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-4)


@some_maps
@pytest.mark.parametrize("equal", [False, True])
def test_pooling_gives_its_gradient_to_the_first_maximum(equal, maps, random):
    for height, width in [*maps, (5, 8), (8, 7)]:
        x = random.normal(size=(2, height, width, 3)).astype(np.float32)
        x = np.round(x) if equal else x
        found, expected = (both(way, jnp.asarray(x)) for way in (pool, convolution._pool))
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_allclose(found[1], expected[1], atol=1e-5)
        np.testing.assert_allclose(found[1], first_of_each_window(x, found[0].shape), atol=1e-5)


def first_of_each_window(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The gradient of `both`, window by window."""
    weights = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=-np.inf)
    gradient = np.zeros_like(padded)
    for image, row, column, channel in np.ndindex(shape):
        window = padded[image, 2 * row : 2 * row + 3, 2 * column : 2 * column + 3, channel]
        down, right = divmod(int(np.argmax(window)), window.shape[1])
        gradient[image, 2 * row + down, 2 * column + right, channel] += weights[image, row, column, channel]
    return gradient[:, 1:-1, 1:-1]
