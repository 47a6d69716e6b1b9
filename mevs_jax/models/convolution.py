"""Square convolutions and the pooling of ResNet, on CPU as matrix products where those are faster than XLA's own operations.

The layout is channels-last, padding is half the kernel's size, and all ways compute the same sums in different orders.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

_TINY_MAP, _SMALL_MAP = 4, 64
"""Numbers of outputs of a tiny and of a small map."""
_MUCH = 5e8
"""Operations from which another way on CPU saves more time than it takes to compile, in some hundred training steps."""
_TILED_CHANNELS = 64
"""Number of channels from which 3×3 kernels are computed by Winograd's algorithm on CPU."""
_CACHED = 1 << 21
"""Bytes of patches, or of images in tiles, from which a gradient of weights is computed at a time on CPU, for the cache."""


class Convolution(nnx.Module):
    """Square convolution without bias, padded by half its size, with torchvision's initial weights."""

    def __init__(self, inputs: int, outputs: int, size: int, stride: int, *, rngs: nnx.Rngs):
        initial = nnx.initializers.variance_scaling(2.0, "fan_out", "normal")
        self.kernel = nnx.Param(initial(rngs.params(), (size, size, inputs, outputs)))
        self.size, self.stride = size, stride

    def __call__(
        self, x: Float[Array, "batch height width inputs"], factor: Float[Array, " outputs"] | None = None
    ) -> Float[Array, "batch rows columns outputs"]:
        """The convolution of `x`; each output channel is multiplied by its `factor`, if given, by scaling the weights."""
        kernel = self.kernel[...]
        return convolve(x, (kernel if factor is None else kernel * factor).astype(x.dtype), self.stride)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def convolve(
    x: Float[Array, "batch height width inputs"], kernel: Float[Array, "size size inputs outputs"], stride: int
) -> Float[Array, "batch rows columns outputs"]:
    """Convolution, padded by half the kernel's size, in the way of the platform that a program is compiled for."""
    on_cpu = partial(_best_on_cpu(x, kernel, stride).forwards, stride=stride)
    return jax.lax.platform_dependent(x, kernel, cpu=on_cpu, default=partial(_convolve, stride=stride))


def _backwards(stride: int, residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    on_cpu = partial(_best_on_cpu(*residuals, stride).backwards, stride=stride)
    elsewhere = partial(_gradient_of(_convolve), stride=stride)
    return jax.lax.platform_dependent(*residuals, cotangent, cpu=on_cpu, default=elsewhere)


convolve.defvjp(lambda x, kernel, stride: (convolve(x, kernel, stride), (x, kernel)), _backwards)


class _Way(NamedTuple):
    """A way to compute a convolution.

    Attributes:
        forwards: a function of images, kernel and stride.
        backwards: a function of images, kernel, cotangent and stride; returns the cotangents of images and kernel.
    """

    forwards: Callable[..., Array]
    backwards: Callable[..., tuple[Array, Array]]


def _gradient_of(forwards: Callable[..., Array]) -> Callable[..., tuple[Array, Array]]:
    return lambda x, kernel, cotangent, stride: jax.vjp(partial(forwards, stride=stride), x, kernel)[1](cotangent)


def _best_on_cpu(x: Array, kernel: Array, stride: int) -> _Way:
    """The way on CPU, which depends on the shapes.

    XLA's convolution of small maps is slow (64 maps of 2×2 by 512 channels: 357 ms; tap by tap 1.5), and so are its gradients of
    weights (256 maps of 16×16 by 32: 15 ms; from patches that stay in the cache 8).
    """
    size, images = kernel.shape[0], x.shape[0]
    places = -(-x.shape[1] // stride) * -(-x.shape[2] // stride)
    # While a program is exported, the number of images is a symbol.
    if isinstance(images, int) and 2 * images * places * kernel.size >= _MUCH:
        wide = min(kernel.shape[2:]) >= _TILED_CHANNELS and x.dtype == jnp.float32
        if size == 3 and stride == 1 and places > _TINY_MAP and wide:
            return _Way(_tiled, _tiled_backwards)
        if size == 3 and (stride > 1 or places <= _SMALL_MAP):
            return _Way(_tap_by_tap, _tap_by_tap_backwards)
    elif places <= _SMALL_MAP or size == 1:
        return _Way(_product, _gradient_of(_product))
    return _Way(_convolve, _from_patches)


def _convolve(x: Array, kernel: Array, stride: int) -> Array:
    pad = kernel.shape[0] // 2
    return jax.lax.conv_general_dilated(
        x, kernel, (stride, stride), [(pad, pad)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def _product(x: Array, kernel: Array, stride: int) -> Array:
    """Convolution as one matrix product of all patches."""
    rows, columns = (-(-extent // stride) for extent in x.shape[1:3])
    flat = _patches(x, kernel.shape[0], stride)
    return (flat @ kernel.reshape(flat.shape[1], -1)).reshape(x.shape[0], rows, columns, -1)


def _reached(tap: int, pad: int, stride: int, extent: int, outputs: int) -> tuple[slice, tuple[int, int]]:
    """The inputs that a tap of the kernel reads along one axis, and the numbers of outputs before and after theirs."""
    first = max(0, -(-(pad - tap) // stride))
    last = min(outputs - 1, (extent - 1 + pad - tap) // stride)
    if last < first:
        return slice(0), (0, outputs)
    start = first * stride + tap - pad
    return slice(start, start + (last - first) * stride + 1, stride), (first, outputs - 1 - last)


def _taps(x: Array, size: int, stride: int) -> list[tuple[int, slice, slice, list[tuple[int, int]]]]:
    """The taps of a kernel that read any input: number, rows and columns that they read, outputs around theirs."""
    (height, width), pad, found = x.shape[1:3], size // 2, []
    for tap in range(size * size):
        down, above = _reached(tap // size, pad, stride, height, -(-height // stride))
        right, beside = _reached(tap % size, pad, stride, width, -(-width // stride))
        if down.stop and right.stop:
            found.append((tap, down, right, [(0, 0), above, beside, (0, 0)]))
    return found


def _tap_by_tap(x: Array, kernel: Array, stride: int) -> Array:
    """Convolution as one matrix product for each tap of the kernel, of those inputs alone that the tap reads.

    In a small map many places of the kernel lie in the padding: of a 2×2 map more than half.
    """
    size, out = kernel.shape[0], jnp.zeros((), x.dtype)
    for tap, down, right, around in _taps(x, size, stride):
        read = x[:, down, right]
        product = read.reshape(-1, x.shape[-1]) @ kernel[tap // size, tap % size]
        out = out + jnp.pad(product.reshape(*read.shape[:3], -1), around)
    return out


def _tap_by_tap_backwards(x: Array, kernel: Array, cotangent: Array, stride: int) -> tuple[Array, Array]:
    size, (_, height, width, inputs), (rows, columns) = kernel.shape[0], x.shape, cotangent.shape[1:3]
    of_x, of_taps = jnp.zeros((), x.dtype), [jnp.zeros(kernel.shape[2:], x.dtype)] * (size * size)
    for tap, down, right, (_, above, beside, _) in _taps(x, size, stride):
        some = cotangent[:, above[0] : rows - above[1], beside[0] : columns - beside[1]]
        flat = some.reshape(-1, some.shape[-1])
        of_taps[tap] = x[:, down, right].reshape(-1, inputs).T @ flat
        product = (flat @ kernel[tap // size, tap % size].T).reshape(*some.shape[:3], inputs)
        around = [(down.start, height - down.stop, stride - 1), (right.start, width - right.stop, stride - 1)]
        of_x = of_x + jax.lax.pad(product, jnp.zeros((), x.dtype), [(0, 0, 0), *around, (0, 0, 0)])
    return of_x, jnp.stack(of_taps).reshape(kernel.shape)


def _patches(x: Array, size: int, stride: int) -> Float[Array, "places patch"]:
    """The inputs of a square kernel at each of its places, one place per row."""
    shifted = _shifted(x, size, stride)
    return jnp.concatenate(shifted, axis=-1).reshape(shifted[0][..., 0].size, -1)


def _patches_by_tap(x: Array, size: int, stride: int) -> Float[Array, "patch places"]:
    """The transpose of `_patches`, which is quicker to gather where channels are few: each row is written at once."""
    each = [image[..., channel] for image in _shifted(x, size, stride) for channel in range(x.shape[-1])]
    return jnp.stack([image.reshape(-1) for image in each])


def _shifted(x: Array, size: int, stride: int) -> list[Array]:
    """For each tap of a square kernel, the inputs that it reads at all of its places."""
    pad = size // 2
    rows, columns = (-(-extent // stride) for extent in x.shape[1:3])
    x = jnp.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    return [
        x[:, i : i + (rows - 1) * stride + 1 : stride, j : j + (columns - 1) * stride + 1 : stride]
        for i in range(size)
        for j in range(size)
    ]


def _from_patches(x: Array, kernel: Array, cotangent: Array, stride: int) -> tuple[Array, Array]:
    """The gradient of `_convolve`, that of the weights as matrix products of patches, some images at a time."""
    (of_x,) = jax.vjp(lambda x: _convolve(x, kernel, stride), x)[1](cotangent)
    return of_x, _of_kernel(x, cotangent, kernel.shape[0], stride).astype(kernel.dtype)


def _of_kernel(x: Array, cotangent: Array, size: int, stride: int) -> Float[Array, "size size inputs outputs"]:
    inputs, outputs = x.shape[-1], cotangent.shape[-1]

    def of(images: Array, cotangents: Array) -> Array:
        exact = jnp.promote_types(x.dtype, jnp.float32)
        patches = _patches_by_tap(images, size, stride) if inputs < 8 else _patches(images, size, stride).T
        return jnp.matmul(patches, cotangents.reshape(-1, outputs), preferred_element_type=exact)

    total = _sum_over_parts(of, x, cotangent, cotangent[0, ..., 0].size * size * size * inputs * x.dtype.itemsize)
    return total.reshape(size, size, inputs, outputs)


def _sum_over_parts(of: Callable[[Array, Array], Any], x: Array, cotangent: Array, bytes_of_one: int) -> Any:
    """Sum of a function over parts of the batch, of as many images as the cache holds at `bytes_of_one` for each.

    The batch is one part where several devices share it, since each would wait for the images of the others.
    """
    if jax.device_count() > 1:
        return of(x, cotangent)
    fitting = min(max(1, _CACHED // bytes_of_one), len(x))
    count = next(count for count in range(fitting, 0, -1) if len(x) % count == 0)
    parts = tuple(array.reshape(-1, count, *array.shape[1:]) for array in (x, cotangent))
    if len(parts[0]) == 1:
        return of(x, cotangent)
    nothing = jax.tree.map(
        lambda shape: jnp.zeros(shape.shape, shape.dtype), jax.eval_shape(of, parts[0][0], parts[1][0])
    )
    return jax.lax.scan(lambda total, part: (jax.tree.map(jnp.add, total, of(*part)), None), nothing, parts)[0]


_OF_INPUTS = ((1, 0, -1, 0), (0, 1, 1, 0), (0, -1, 1, 0), (0, 1, 0, -1))
_OF_KERNEL = ((1, 0, 0), (0.5, 0.5, 0.5), (0.5, -0.5, 0.5), (0, 0, 1))
_OF_PRODUCTS = ((1, 1, 1, 0), (0, 1, -1, -1))
"""Winograd's transforms of F(2×2, 3×3), as in Lavin and Gray (2016)."""


def _combined(rows: tuple[tuple[float, ...], ...], arrays: list[Array]) -> list[Array]:
    """The sums of arrays, each times its factor; one sum for each row of factors."""
    terms = [[factor * array for factor, array in zip(row, arrays, strict=True) if factor] for row in rows]
    return [sum(row[1:], start=row[0]) for row in terms]


def _in_both(rows: tuple[tuple[float, ...], ...], arrays: list[list[Array]]) -> list[list[Array]]:
    """A transform of the columns, then of the rows, of a square of arrays."""
    across = [_combined(rows, row) for row in arrays]
    down = [_combined(rows, list(column)) for column in zip(*across, strict=True)]
    return [list(row) for row in zip(*down, strict=True)]


def _tiles(x: Array) -> list[list[Array]]:
    """The transformed 4×4 inputs of each tile of 2×2 outputs, each (tiles, inputs)."""
    rows, columns = (-(-extent // 2) for extent in x.shape[1:3])
    x = jnp.pad(x, ((0, 0), (1, 1 + x.shape[1] % 2), (1, 1 + x.shape[2] % 2), (0, 0)))
    parts = [[x[:, i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2] for j in range(4)] for i in range(4)]
    return [[part.reshape(-1, x.shape[-1]) for part in row] for row in _in_both(_OF_INPUTS, parts)]


def _from_tiles(x: Array, kernels: list[list[Array]], axis: int) -> Array:
    """The outputs of `_tiled`, from transformed kernels, whose `axis` (0 or 1) is that of the channels of `x`."""
    batch, height, width, _ = x.shape
    over = ((2,), (1 + axis,)), ((0,), (0,))
    products = [
        jax.lax.dot_general(jnp.stack(tiles), jnp.stack(row), over)
        for tiles, row in zip(_tiles(x), kernels, strict=True)
    ]
    outputs = _in_both(_OF_PRODUCTS, [list(row) for row in products])
    shape = batch, -(-height // 2), -(-width // 2), outputs[0][0].shape[-1]
    out = jnp.stack([jnp.stack([part.reshape(shape) for part in row], 3) for row in outputs], 2)
    return out.reshape(batch, 2 * shape[1], 2 * shape[2], -1)[:, :height, :width]


def _tiled(x: Array, kernel: Array, stride: int) -> Array:
    """Convolution with a 3×3 kernel and a `stride` of 1, by Winograd's algorithm, in 4/9 of the multiplications.

    Rounding errors are a few times those of the sum itself, some 1e-6 of the largest output.
    """
    return _from_tiles(x, _in_both(_OF_KERNEL, [[kernel[i, j] for j in range(3)] for i in range(3)]), 0)


def _tiled_backwards(x: Array, kernel: Array, cotangent: Array, stride: int) -> tuple[Array, Array]:
    flipped = _in_both(_OF_KERNEL, [[kernel[2 - i, 2 - j] for j in range(3)] for i in range(3)])
    of_x = _from_tiles(cotangent, flipped, 1)
    of_kernels = _sum_over_parts(_of_transformed, x, cotangent, x[0].size * x.dtype.itemsize)
    of_kernel = _in_both(tuple(zip(*_OF_KERNEL, strict=True)), [list(row) for row in of_kernels])
    return of_x, jnp.stack([jnp.stack(row) for row in of_kernel])


def _of_transformed(x: Array, cotangent: Array) -> list[Array]:
    """Gradient of the transformed kernels, by row."""
    _, height, width, outputs = cotangent.shape
    even = jnp.pad(cotangent, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)))
    parts = [[even[:, i::2, j::2].reshape(-1, outputs) for j in range(2)] for i in range(2)]
    of_products = _in_both(tuple(zip(*_OF_PRODUCTS, strict=True)), parts)
    rows = zip(_tiles(x), of_products, strict=True)
    return [jnp.matmul(jnp.stack(tiles).mT, jnp.stack(products)) for tiles, products in rows]


def pool(x: Float[Array, "batch height width channels"]) -> Float[Array, "batch rows columns channels"]:
    """Maxima of 3×3 at every second row and column, padded by one. Among equal values, the first in the order of rows and
    columns receives the gradient, as in PyTorch.
    """
    return jax.lax.platform_dependent(x, cpu=_pool_on_cpu, default=_pool)


def _pool(x: Array) -> Array:
    return nnx.max_pool(x, (3, 3), strides=(2, 2), padding=((1, 1), (1, 1)))


def _pool_on_cpu(x: Array) -> Array:
    """XLA takes 32 ms for 64 maps of 32×32 by 64 with their gradient, this way 5."""
    height, width = x.shape[1:3]
    x = jnp.pad(x, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), constant_values=-jnp.inf)
    return _pool_along(_pool_along(x, 2), 1)


def _moved(x: Array, axis: int, by: int, fill: float) -> Array:
    """`x` moved along an axis by 1, or back by −1."""
    fill_of = jnp.asarray(fill, x.dtype)
    return jax.lax.pad(x, fill_of, [(by, -by, 0) if place == axis else (0, 0, 0) for place in range(x.ndim)])


def _window(x: Array, axis: int) -> tuple[Array, Array, Array]:
    """The three values of each window along an axis: the one before a pair, and the pair."""
    pairs = x.reshape(*x.shape[:axis], -1, 2, *x.shape[axis + 1 :])
    first, second = (jax.lax.index_in_dim(pairs, which, axis + 1, keepdims=False) for which in (0, 1))
    return _moved(second, axis, 1, -jnp.inf), first, second


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def _pool_along(x: Array, axis: int) -> Array:
    """Maxima of three at every second place of an axis of even length."""
    before, first, second = _window(x, axis)
    return jnp.maximum(jnp.maximum(before, first), second)


def _pool_forwards(x: Array, axis: int) -> tuple[Array, tuple[Array, Array]]:
    out = _pool_along(x, axis)
    return out, (x, out)


def _pool_backwards(axis: int, residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array]:
    x, out = residuals
    before, first, second = _window(x, axis)
    of_first = jnp.where((before < out) & (first == out), cotangent, 0)
    of_second = jnp.where((before < out) & (first < out), cotangent, 0)
    of_second += jnp.where(second == _moved(out, axis, -1, jnp.inf), _moved(cotangent, axis, -1, 0), 0)
    return (jnp.stack([of_first, of_second], axis + 1).reshape(x.shape),)


_pool_along.defvjp(_pool_forwards, _pool_backwards)
