"""Shapes of networks: all that is needed, besides its weights, to make a network again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from flax import nnx

from mevs_jax.models.pointnet2 import Abstraction, PointNet2
from mevs_jax.models.pose import PoseHead
from mevs_jax.models.resnet import ResNet
from mevs_jax.models.set_fusion import SetFusion
from mevs_jax.models.view_policy import ViewPolicyShape

__all__ = ["PointNet2Shape", "PoseShape", "ResNetShape", "SetFusionShape", "ViewPolicyShape"]


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
