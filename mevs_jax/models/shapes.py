"""Shapes of networks: all that is needed, besides its weights, to make a network again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from flax import nnx

from mevs_jax.models.pointnet2 import Abstraction, PointNet2
from mevs_jax.models.pose import PoseHead
from mevs_jax.models.resnet import ResNet
from mevs_jax.models.set_fusion import SetFusion
from mevs_jax.models.view_policy import Utility, ViewPolicy


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
        return ResNet(
            depth=self.depth,
            classes=classes,
            channels=self.channels,
            width=self.width,
            standardise=self.standardise,
            stem=self.stem,
            rngs=rngs,
        )


@dataclass(frozen=True)
class PointNet2Shape:
    """Arguments of `PointNet2`."""

    abstractions: tuple[Abstraction, ...]
    global_layers: tuple[int, ...]
    head_layers: tuple[int, ...]

    def network(self, views: int, rngs: nnx.Rngs) -> PointNet2:
        """Returns a network of this shape with random weights, without dropout."""
        return PointNet2(
            views=views,
            abstractions=self.abstractions,
            global_layers=self.global_layers,
            head_layers=self.head_layers,
            dropout=0.0,
            rngs=rngs,
        )


@dataclass(frozen=True)
class SetFusionShape:
    """Arguments of `SetFusion`."""

    width: int
    heads: int
    blocks: int

    def network(self, features: int, classes: int, rngs: nnx.Rngs) -> SetFusion:
        """Returns a network of this shape with random weights, without dropout."""
        shape = {"width": self.width, "heads": self.heads, "blocks": self.blocks}
        return SetFusion(features, classes, **shape, dropout=0.0, rngs=rngs)


@dataclass(frozen=True)
class PoseShape:
    """Arguments of `PoseHead`."""

    poses: int
    width: int

    def network(self, features: int, classes: int, rngs: nnx.Rngs) -> PoseHead:
        """Returns a network of this shape with random weights, without dropout."""
        return PoseHead(features, classes, poses=self.poses, width=self.width, dropout=0.0, rngs=rngs)


@dataclass(frozen=True)
class ViewPolicyShape:
    """Arguments of `ViewPolicy`, without embeddings of clouds."""

    width: int
    heads: int
    blocks: int
    posed: bool
    utility: Utility
    floor: float

    def network(self, classes: int, rngs: nnx.Rngs) -> ViewPolicy:
        """Returns a network of this shape with random weights."""
        return ViewPolicy(
            classes,
            width=self.width,
            heads=self.heads,
            blocks=self.blocks,
            posed=self.posed,
            utility=self.utility,
            floor=self.floor,
            rngs=rngs,
        )
