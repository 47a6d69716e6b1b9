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

from mevs_jax.models.batch_norm import BatchNorm
from mevs_jax.models.convolution import Convolution, pool
from mevs_jax.models.image_encoder import ImageEncoder, normalised

_BLOCKS = {10: (1, 1, 1, 1), 18: (2, 2, 2, 2), 34: (3, 4, 6, 3)}


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
        after = partial(normalised, train=train, momentum=momentum)
        out = jax.nn.relu(after(self.convolution1, self.norm1, x))
        out = after(self.convolution2, self.norm2, out)
        if self.projects:
            x = after(self.shortcut, self.shortcut_norm, x)
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


class ResNet(ImageEncoder):
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
        super().__init__(channels, standardise)
        self.depth, self.classes, self.width, self.dtype = depth, classes, width, dtype
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

    def _features(self, x: Array, train: bool, momentum: float | Array) -> Float[Array, "batch features"]:
        """Of length `8 * width`."""
        exact, x = x.dtype, x.astype(self.dtype or x.dtype)
        if isinstance(self.convolution, PatchStem):
            x = jax.nn.relu(self.norm(self.convolution(x), train=train, momentum=momentum))
        else:
            x = jax.nn.relu(normalised(self.convolution, self.norm, x, train=train, momentum=momentum))
            x = pool(x)
        for block in self.blocks:
            x = block(x, train=train, momentum=momentum)
        return jnp.mean(x, axis=(1, 2), dtype=exact)
