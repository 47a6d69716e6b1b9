"""ResNet-18 and ResNet-34 (He et al., 2016), and a ResNet-10 with half the blocks: logits from the image of one view.

Arithmetic, padding and order of layers are torchvision's, so its weights carry over (`mevs_jax.models.pretrained`). The layout is
channels-last. `width` scales all stages, for data sets and machines smaller than the thesis's.
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.batch_norm import BatchNorm
from mevs_jax.models.calling import TrainedByCall
from mevs_jax.models.convolution import Convolution, pool

_BLOCKS = {10: (1, 1, 1, 1), 18: (2, 2, 2, 2), 34: (3, 4, 6, 3)}
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def _normalised(convolution: Convolution, norm: BatchNorm, x: Array, *, train: bool, momentum: float | Array) -> Array:
    """A convolution and its batch norm; in inference, the norm is folded into the weights and a bias."""
    if train:
        return norm(convolution(x), train=True, momentum=momentum)
    factor, bias = norm.folded()
    return convolution(x, factor) + bias.astype(x.dtype)


class BasicBlock(nnx.Module):
    """Two 3×3 convolutions with a residual connection."""

    def __init__(self, inputs: int, outputs: int, stride: int, *, rngs: nnx.Rngs):
        self.convolution1 = Convolution(inputs, outputs, 3, stride, rngs=rngs)
        self.norm1 = BatchNorm(outputs)
        self.convolution2 = Convolution(outputs, outputs, 3, 1, rngs=rngs)
        self.norm2 = BatchNorm(outputs)
        self.projects = stride != 1 or inputs != outputs
        if self.projects:
            self.shortcut = Convolution(inputs, outputs, 1, stride, rngs=rngs)
            self.shortcut_norm = BatchNorm(outputs)

    def __call__(self, x: Array, *, train: bool, momentum: float | Array) -> Array:
        normalised = partial(_normalised, train=train, momentum=momentum)
        out = jax.nn.relu(normalised(self.convolution1, self.norm1, x))
        out = normalised(self.convolution2, self.norm2, out)
        if self.projects:
            x = normalised(self.shortcut, self.shortcut_norm, x)
        return jax.nn.relu(out + x)


class PatchStem(nnx.Module):
    """One linear layer on patches of 4×4 pixels, as in ConvNeXt (Liu et al. 2022).

    It replaces ResNet's first convolution and pooling: the output has the same size, for a twentieth of the work.
    """

    def __init__(self, inputs: int, outputs: int, *, rngs: nnx.Rngs):
        initial = nnx.initializers.he_normal()
        self.layer = nnx.Linear(16 * inputs, outputs, use_bias=False, kernel_init=initial, rngs=rngs)

    def __call__(self, x: Float[Array, "batch height width inputs"]) -> Float[Array, "batch rows columns outputs"]:
        batch, height, width, channels = x.shape
        if height % 4 or width % 4:
            raise ValueError(
                f"patches of 4×4 pixels do not fill an image of {height}×{width}: choose a height and width divisible by 4"
            )
        patches = x.reshape(batch, height // 4, 4, width // 4, 4, channels).swapaxes(2, 3)
        return patches.reshape(batch, height // 4, width // 4, -1) @ self.layer.kernel[...].astype(x.dtype)


class ResNet(TrainedByCall):
    """ResNet of basic blocks.

    Args:
        depth: 18 or 34 as in the paper, or 10 with one block per stage.
        classes: number of logits.
        channels: of the image; the thesis replicates depth to 3.
        width: channels of the first stage, doubled in each of the three later stages; 64 in the paper.
        standardise: whether to subtract ImageNet's mean and divide by its standard deviation, as torchvision's weights expect
            of images in [0, 1].
        stem: `convolution`, 7×7 and pooling as in the paper; or `patches` (`PatchStem`), for small images on small machines.
        rngs: source of the initial weights.
        dtype: type in which the convolutions compute; that of the images by default. Weights, batch-norm statistics and the
            last layer keep their own types.

    Raises:
        ValueError: for another depth, or `standardise` with other than three channels.
    """

    def __init__(
        self,
        *,
        depth: int = 18,
        classes: int = 10,
        channels: int = 3,
        width: int = 64,
        standardise: bool = False,
        stem: Literal["convolution", "patches"] = "convolution",
        rngs: nnx.Rngs,
        dtype: jnp.dtype | None = None,
    ):
        if depth not in _BLOCKS:
            raise ValueError(f"ResNet needs depth 10, 18 or 34, got {depth}")
        if standardise and channels != 3:
            raise ValueError(f"ResNet can standardise images of 3 channels only, got {channels}")
        self.depth, self.classes, self.channels, self.width = depth, classes, channels, width
        self.standardise, self.dtype = standardise, dtype
        self.stages = _BLOCKS[depth]
        self.convolution: Convolution | PatchStem
        if stem == "convolution":
            self.convolution = Convolution(channels, width, 7, 2, rngs=rngs)
        else:
            self.convolution = PatchStem(channels, width, rngs=rngs)
        self.norm = BatchNorm(width)
        blocks = []
        inputs = width
        for stage, repeats in enumerate(_BLOCKS[depth]):
            outputs = width * 2**stage
            for repeat in range(repeats):
                blocks.append(BasicBlock(inputs, outputs, 2 if stage and not repeat else 1, rngs=rngs))
                inputs = outputs
        self.blocks = nnx.List(blocks)
        self.head = nnx.Linear(inputs, classes, rngs=rngs)

    def features(
        self,
        images: Float[AnyArray, "*batch height width channels"],
        *,
        train: bool = False,
        momentum: float | Array = 0.1,
    ) -> Float[Array, "*batch features"]:
        """The feature vector before the last layer, of length `8 * width`.

        Raises:
            ValueError: for images of integers.
        """
        images = jnp.asarray(images)
        if not jnp.issubdtype(images.dtype, jnp.floating):
            raise ValueError(
                f"ResNet needs floating-point images in [0, 1], got {images.dtype}: divide 8-bit images by 255"
            )
        batch = images.shape[:-3]
        x = images.reshape(-1, *images.shape[-3:])
        if self.standardise:
            x = (x - jnp.array(_IMAGENET_MEAN)) / jnp.array(_IMAGENET_STD)
        exact, x = x.dtype, x.astype(self.dtype or x.dtype)
        if isinstance(self.convolution, PatchStem):
            x = jax.nn.relu(self.norm(self.convolution(x), train=train, momentum=momentum))
        else:
            x = jax.nn.relu(_normalised(self.convolution, self.norm, x, train=train, momentum=momentum))
            x = pool(x)
        for block in self.blocks:
            x = block(x, train=train, momentum=momentum)
        return jnp.mean(x, axis=(1, 2), dtype=exact).reshape(*batch, -1)

    def __call__(
        self,
        images: Float[AnyArray, "*batch height width channels"],
        *,
        train: bool = False,
        momentum: float | Array = 0.1,
    ) -> Float[Array, "*batch classes"]:
        """Logits of one image (height, width, channels) or of a batch.

        Args:
            images: the images, of any number of batch axes.
            train: whether to normalise by the batch and update the running statistics.
            momentum: weight of the new batch in the running statistics, in [0, 1].
        """
        return self.head(self.features(images, train=train, momentum=momentum))
