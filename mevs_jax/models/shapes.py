"""Shapes of networks: all that is needed, besides its weights, to make a network again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

from flax import nnx

from mevs_jax.models import efficientnet, vision_transformer
from mevs_jax.models.image_encoder import ImageEncoder
from mevs_jax.models.pointnet2 import Abstraction, PointNet2
from mevs_jax.models.pose import PoseHead
from mevs_jax.models.resnet import ResNet
from mevs_jax.models.set_fusion import SetFusion
from mevs_jax.models.view_policy import ViewPolicyShape

__all__ = [
    "ENCODERS",
    "EncoderShape",
    "PointNet2Shape",
    "PoseShape",
    "ResNetShape",
    "SetFusionShape",
    "ViewPolicyShape",
]

EncoderName = Literal["efficientnet_lite0", "vit_tiny_patch8", "vit_tiny_patch16"]
ENCODERS: tuple[str, ...] = get_args(EncoderName)
"""Names of networks that can take the ResNet's place."""


@dataclass(frozen=True)
class ResNetShape:
    """Arguments of `ResNet`."""

    depth: Literal[10, 18, 34]
    width: int
    channels: int
    standardise: bool
    stem: Literal["convolution", "patches"]

    def network(self, classes: int, rngs: nnx.Rngs) -> ResNet:
        """Returns a network of this shape with random weights."""
        return ResNet(classes=classes, rngs=rngs, **vars(self))

    @property
    def features(self) -> int:
        """Length of the feature vector."""
        return 8 * self.width

    def outputs(self, resolution: int) -> int:
        """An upper bound on the outputs of a layer for one image, for the most part."""
        return resolution**2 * self.width


@dataclass(frozen=True)
class EncoderShape:
    """A network of another kind than ResNet. Its images are square, have three channels and are standardised by the network.

    Attributes:
        name: of the network.
        resolution: of the images in pixels.
    """

    name: EncoderName
    resolution: int
    channels: ClassVar[int] = 3

    @property
    def patch(self) -> int:
        """Side of a vision transformer's patches in pixels; 0 for another network."""
        return int(self.name.removeprefix("vit_tiny_patch")) if self.name.startswith("vit") else 0

    def network(self, classes: int, rngs: nnx.Rngs) -> ImageEncoder:
        """Returns a network of this shape with random weights."""
        if not self.patch:
            return efficientnet.EfficientNetLite0(classes=classes, rngs=rngs)
        return vision_transformer.VisionTransformer(
            resolution=self.resolution, patch=self.patch, classes=classes, rngs=rngs
        )

    @property
    def features(self) -> int:
        """Length of the feature vector."""
        return vision_transformer.WIDTH if self.patch else efficientnet.FEATURES

    def outputs(self, resolution: int) -> int:
        """An upper bound on the outputs of a layer for one image."""
        if self.patch:
            return vision_transformer.HEADS * ((resolution // self.patch) ** 2 + 1) ** 2
        return resolution**2 * efficientnet.PER_PIXEL


@dataclass(frozen=True)
class PointNet2Shape:
    """Arguments of `PointNet2`."""

    abstractions: tuple[Abstraction, ...]
    global_layers: tuple[int, ...]
    head_layers: tuple[int, ...]

    def network(self, views: int, rngs: nnx.Rngs) -> PointNet2:
        """Returns a network of this shape with random weights, without dropout."""
        return PointNet2(views=views, dropout=0.0, rngs=rngs, **vars(self))


@dataclass(frozen=True)
class SetFusionShape:
    """Arguments of `SetFusion`."""

    width: int
    heads: int
    blocks: int

    def network(self, features: int, classes: int, rngs: nnx.Rngs) -> SetFusion:
        """Returns a network of this shape with random weights, without dropout."""
        return SetFusion(features, classes, dropout=0.0, rngs=rngs, **vars(self))


@dataclass(frozen=True)
class PoseShape:
    """Arguments of `PoseHead`."""

    poses: int
    width: int

    def network(self, features: int, classes: int, rngs: nnx.Rngs) -> PoseHead:
        """Returns a network of this shape with random weights, without dropout."""
        return PoseHead(features, classes, dropout=0.0, rngs=rngs, **vars(self))
