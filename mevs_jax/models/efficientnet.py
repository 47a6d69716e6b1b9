"""EfficientNet-Lite0 (Tan and Le, 2019): logits from the image of one view, by 4.7 million weights.

Arithmetic, padding and order of layers are those of TensorFlow's implementation, so ImageNet's weights carry over
(`mevs_jax.models.pretrained`). There is no dropout. The layout is channels-last.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from mevs_jax.models.batch_norm import BatchNorm
from mevs_jax.models.convolution import Convolution
from mevs_jax.models.image_encoder import ImageEncoder, normalised

_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
"""Blocks, kernel size, stride of the first block, expansion and output channels of each stage."""
_STEM, FEATURES, PER_PIXEL = 32, 1280, 96 // 4
"""Channels after the first and after the last convolution, and the most outputs of a layer by pixel of the image."""
_EPSILON = 1e-3


def _padding(extent: int, size: int, stride: int) -> tuple[int, int]:
    """TensorFlow's padding, of which the smaller half comes first."""
    total = max((-(-extent // stride) - 1) * stride + size - extent, 0)
    return total // 2, total - total // 2


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def depthwise(
    x: Float[Array, "batch height width channels"], kernel: Float[Array, "size size 1 channels"], stride: int
) -> Float[Array, "batch rows columns channels"]:
    """Convolution of each channel by a kernel of its own, as a sum over the kernel's taps, which XLA makes one loop of."""
    (size, *_), (rows, columns) = kernel.shape, (-(-extent // stride) for extent in x.shape[1:3])
    return sum(tap * kernel[i, j, 0] for (i, j), tap in _taps(x, size, stride, rows, columns))


def _taps(x: Array, size: int, stride: int, rows: int, columns: int):
    """For each tap of the kernel, the inputs that it reads."""
    x = jnp.pad(x, [(0, 0), *(_padding(extent, size, stride) for extent in x.shape[1:3]), (0, 0)])
    for i in range(size):
        for j in range(size):
            down, right = (slice(at, at + (n - 1) * stride + 1, stride) for at, n in ((i, rows), (j, columns)))
            yield (i, j), x[:, down, right]


def _depthwise_backwards(stride: int, residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, kernel = residuals
    size, counts, spread = len(kernel), cotangent.shape[1:3], [(0, 0, 0)]

    def of_taps(x: Array, cotangent: Array) -> Float[Array, "taps channels"]:
        taps = _taps(x, size, stride, *counts)
        return jnp.stack([jnp.sum(tap * cotangent, axis=(0, 1, 2)) for _, tap in taps])

    def by_image(x: Array, cotangent: Array) -> Float[Array, "taps channels"]:
        """An image at a time stays in a CPU's cache: four times as fast as all at once."""
        nothing = jnp.zeros((size**2, x.shape[-1]), x.dtype)
        pairs = x[:, None], cotangent[:, None]
        return jax.lax.scan(lambda total, pair: (total + of_taps(*pair), None), nothing, pairs)[0]

    of_kernel = jax.lax.platform_dependent(x, cotangent, cpu=by_image, default=of_taps).reshape(kernel.shape)
    for extent, count in zip(x.shape[1:3], counts, strict=True):  # to the places that the kernel's centre reads
        before = size // 2 - _padding(extent, size, stride)[0]
        spread.append((before, extent - before - (count - 1) * stride - 1, stride - 1))
    placed = jax.lax.pad(cotangent, jnp.zeros((), x.dtype), [*spread, (0, 0, 0)])
    return depthwise(placed, kernel[::-1, ::-1], 1), of_kernel


depthwise.defvjp(
    lambda x, kernel, stride: (depthwise(x, kernel, stride), (x, kernel)),
    _depthwise_backwards,
)


class Depthwise(nnx.Module):
    """A layer of `depthwise`, padded as in TensorFlow."""

    def __init__(self, channels: int, size: int, stride: int, *, rngs: nnx.Rngs):
        initial = nnx.initializers.normal((2 / size**2) ** 0.5)
        self.kernel = nnx.Param(initial(rngs.params(), (size, size, 1, channels)))
        self.stride = stride

    def __call__(self, x: Array, factor: Array | None = None) -> Array:
        kernel = self.kernel[...]
        return depthwise(x, kernel if factor is None else kernel * factor, self.stride)


class _Stem(Convolution):
    """The first convolution, padded as in TensorFlow."""

    def __call__(self, x: Array, factor: Array | None = None) -> Array:
        kernel = self.kernel[...] if factor is None else self.kernel[...] * factor
        return jax.lax.conv_general_dilated(x, kernel, (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


class InvertedBottleneck(nnx.Module):
    """A 1×1 convolution to more channels, a convolution of each of them, and a 1×1 convolution to fewer; with a residual."""

    def __init__(self, inputs: int, outputs: int, size: int, stride: int, expansion: int, *, rngs: nnx.Rngs):
        wide = inputs * expansion
        self.expands, self.adds = expansion > 1, stride == 1 and inputs == outputs
        if self.expands:
            self.expand, self.expand_norm = (
                Convolution(inputs, wide, 1, 1, rngs=rngs),
                BatchNorm(wide, epsilon=_EPSILON),
            )
        self.depthwise, self.depthwise_norm = (
            Depthwise(wide, size, stride, rngs=rngs),
            BatchNorm(wide, epsilon=_EPSILON),
        )
        self.project, self.project_norm = (
            Convolution(wide, outputs, 1, 1, rngs=rngs),
            BatchNorm(outputs, epsilon=_EPSILON),
        )

    def __call__(self, x: Array, *, train: bool, momentum: float | Array) -> Array:
        after, out = partial(normalised, train=train, momentum=momentum), x
        if self.expands:
            out = jax.nn.relu6(after(self.expand, self.expand_norm, out))
        out = jax.nn.relu6(after(self.depthwise, self.depthwise_norm, out))
        out = after(self.project, self.project_norm, out)
        return out + x if self.adds else out


class EfficientNetLite0(ImageEncoder):
    """EfficientNet-Lite0.

    Args:
        classes: number of logits.
        channels: of the image.
        standardise: whether to standardise images in [0, 1] as ImageNet's weights expect.
        rngs: source of the initial weights.
    """

    STATISTICS = (127 / 255,) * 3, (128 / 255,) * 3

    def __init__(self, *, classes: int = 10, channels: int = 3, standardise: bool = True, rngs: nnx.Rngs):
        super().__init__(channels, standardise)
        self.stem, self.stem_norm = _Stem(channels, _STEM, 3, 2, rngs=rngs), BatchNorm(_STEM, epsilon=_EPSILON)
        blocks, inputs = [], _STEM
        for repeats, size, stride, expansion, outputs in _STAGES:
            for repeat in range(repeats):
                step = 1 if repeat else stride
                blocks.append(InvertedBottleneck(inputs, outputs, size, step, expansion, rngs=rngs))
                inputs = outputs
        self.blocks = nnx.List(blocks)
        self.last, self.last_norm = (
            Convolution(inputs, FEATURES, 1, 1, rngs=rngs),
            BatchNorm(FEATURES, epsilon=_EPSILON),
        )
        self.head = nnx.Linear(FEATURES, classes, rngs=rngs)

    def _features(self, x: Array, train: bool, momentum: float | Array) -> Float[Array, "batch features"]:
        x = jax.nn.relu6(normalised(self.stem, self.stem_norm, x, train=train, momentum=momentum))
        for block in self.blocks:
            x = block(x, train=train, momentum=momentum)
        x = jax.nn.relu6(normalised(self.last, self.last_norm, x, train=train, momentum=momentum))
        return jnp.mean(x, axis=(1, 2))
