"""What all networks of single views share: features of an image, and logits by a last layer on them."""

from __future__ import annotations

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.batch_norm import BatchNorm
from mevs_jax.models.calling import TrainedByCall

IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's channels, by which torchvision's networks standardise images."""


class ImageEncoder(TrainedByCall):
    """A network from images to features, with a linear layer `head` from these to logits.

    A subclass has `_features` for a batch (batch, height, width, channels).

    Args:
        channels: of the images; the thesis replicates depth to 3.
        standardise: whether to subtract `STATISTICS[0]` and divide by `STATISTICS[1]`, as pretrained weights expect of images
            in [0, 1].

    Raises:
        ValueError: for `standardise` with other than three channels.
    """

    STATISTICS = IMAGENET
    head: nnx.Linear

    def __init__(self, channels: int, standardise: bool):
        if standardise and channels != 3:
            raise ValueError(f"{type(self).__name__} can standardise images of 3 channels only, got {channels}")
        self.channels, self.standardise = channels, standardise

    def _features(self, x: Array, train: bool, momentum: float | Array) -> Float[Array, "batch features"]:
        raise NotImplementedError

    def features(
        self,
        images: Float[AnyArray, "*batch height width channels"],
        *,
        train: bool = False,
        momentum: float | Array = 0.1,
    ) -> Float[Array, "*batch features"]:
        """The feature vector before the last layer.

        Raises:
            ValueError: for images of integers.
        """
        images = jnp.asarray(images)
        if not jnp.issubdtype(images.dtype, jnp.floating):
            raise ValueError(
                f"{type(self).__name__} needs floating-point images in [0, 1], got {images.dtype}: divide 8-bit images by 255"
            )
        x = images.reshape(-1, *images.shape[-3:])
        if self.standardise:
            x = (x - jnp.array(self.STATISTICS[0])) / jnp.array(self.STATISTICS[1])
        return self._features(x, train, momentum).reshape(*images.shape[:-3], -1)

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


def normalised(convolution: nnx.Module, norm: BatchNorm, x: Array, *, train: bool, momentum: float | Array) -> Array:
    """A convolution and its batch norm; in inference, the norm is folded into the weights and a bias."""
    if train:
        return norm(convolution(x), train=True, momentum=momentum)
    factor, bias = norm.folded()
    return convolution(x, factor) + bias.astype(x.dtype)
