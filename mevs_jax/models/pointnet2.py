"""PointNet++ with single-scale grouping: one partial cloud to the depth entropy of every candidate view.

Source: Qi et al., *PointNet++*, 2017, and the thesis §4.3.2. The thesis's network reads six numbers a point, xyz and three
zeros in the place of normals; the place is kept so that its weights and its parameter count (1,471,509 for 10 views,
1,479,219 for 40) carry over. Where the camera's pose is known, the direction from each point to the camera can stand there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.batch_norm import BatchNorm
from mevs_jax.point_ops import ball_query, farthest_point_sample


@dataclass(frozen=True)
class Abstraction:
    """One set-abstraction level: how many centres, how far they look, at how many points, through which layers."""

    centres: int
    radius: float
    samples: int
    layers: tuple[int, ...]


THESIS_ABSTRACTIONS = (
    Abstraction(centres=512, radius=0.2, samples=64, layers=(64, 64, 128)),
    Abstraction(centres=128, radius=0.4, samples=64, layers=(128, 128, 256)),
)
THESIS_GLOBAL_LAYERS = (256, 512, 1024)
THESIS_HEAD_LAYERS = (512, 256)


class Perceptron(nnx.Module):
    """Linear layers without bias, each with batch norm and ReLU: the "shared MLP" of the paper."""

    def __init__(self, inputs: int, layers: Sequence[int], *, rngs: nnx.Rngs, dtype: jnp.dtype | None = None):
        sizes = [inputs, *layers]
        self.linear = nnx.List(
            nnx.Linear(a, b, use_bias=False, kernel_init=nnx.initializers.he_normal(), dtype=dtype, rngs=rngs)
            for a, b in pairwise(sizes)
        )
        self.norm = nnx.List(BatchNorm(size) for size in layers)

    def __call__(self, x: Array, *, train: bool, momentum: float | Array) -> Array:
        # One long matrix instead of many small ones: the gradient of the weights is then a single product.
        batch = x.shape[:-1]
        x = x.reshape(-1, x.shape[-1])
        for linear, norm in zip(self.linear, self.norm, strict=True):
            x = jax.nn.relu(norm(linear(x), train=train, momentum=momentum))
        return x.reshape(*batch, -1)


def group(
    points: Float[Array, "points 3"], features: Float[Array, "points channels"], level: Abstraction
) -> tuple[Float[Array, "centres 3"], Float[Array, "centres samples channels+3"]]:
    """Centres of one cloud, and for each the neighbours' offsets from it beside their features."""
    centres = points[farthest_point_sample(points, level.centres)]
    neighbours = ball_query(points, centres, level.radius, level.samples)
    offsets = points[neighbours] - centres[:, None, :]
    return centres, jnp.concatenate([offsets, features[neighbours]], axis=-1)


class PointNet2(nnx.Module):
    """PointNet++ SSG regressor.

    Args:
        views: number of candidate views, each of which gets one number.
        abstractions, global_layers, head_layers: sizes; the thesis's by default.
        dropout: rate before the last layer, in [0, 1).
        rngs: source of the initial weights.
        dtype: what the hidden layers calculate in, that of the clouds unless given; coordinates, weights, batch-norm statistics
            and the last layer keep their own.
    """

    def __init__(
        self,
        *,
        views: int,
        abstractions: Sequence[Abstraction] = THESIS_ABSTRACTIONS,
        global_layers: Sequence[int] = THESIS_GLOBAL_LAYERS,
        head_layers: Sequence[int] = THESIS_HEAD_LAYERS,
        dropout: float = 0.5,
        rngs: nnx.Rngs,
        dtype: jnp.dtype | None = None,
    ):
        if views < 2:
            raise ValueError(f"PointNet2 needs at least 2 candidate views, got {views}")
        self.views = views
        self.levels = tuple(abstractions)
        channels = 3  # the place of the normals
        perceptrons = []
        for level in self.levels:
            perceptrons.append(Perceptron(3 + channels, level.layers, rngs=rngs, dtype=dtype))
            channels = level.layers[-1]
        self.perceptrons = nnx.List(perceptrons)
        self.whole = Perceptron(3 + channels, global_layers, rngs=rngs, dtype=dtype)
        self.head = Perceptron(global_layers[-1], head_layers, rngs=rngs, dtype=dtype)
        self.dropout = dropout
        self.out = nnx.Linear(head_layers[-1], views, rngs=rngs)

    def __call__(
        self,
        points: Float[AnyArray, "*batch points columns"],
        *,
        train: bool = False,
        key: Array | None = None,
        momentum: float | Float[Array, ""] = 0.1,
        dropout: float | Float[Array, ""] | None = None,
    ) -> Float[Array, "*batch views"]:
        """Predicted entropy, in units of the training split's largest, of every view.

        Args:
            points: one cloud (points, 3) or a batch of them, in the unit sphere; or (points, 6), a direction beside each point.
            train: normalise over the batch, update running statistics, drop out.
            key: for dropout; needed where `train`.
            momentum: of the running statistics, in [0, 1].
            dropout: rate in the place of the network's own, in [0, 1).
        """
        if train and key is None:
            raise ValueError("PointNet2 in training needs a key for its dropout")
        points = jnp.asarray(points)
        if points.shape[-1] not in (3, 6):
            raise ValueError(f"PointNet2 reads clouds of 3 or 6 columns, got {points.shape[-1]}")
        batch = points.shape[:-2]
        clouds = points.reshape(-1, *points.shape[-2:])
        centres, features = clouds[..., :3], clouds[..., 3:]
        if not features.size:
            features = jnp.zeros_like(centres)
        for level, perceptron in zip(self.levels, self.perceptrons, strict=True):
            centres, grouped = jax.vmap(group, in_axes=(0, 0, None))(centres, features, level)
            features = jnp.max(perceptron(grouped, train=train, momentum=momentum), axis=2)
        everything = jnp.concatenate([centres, features], axis=-1)
        features = jnp.max(self.whole(everything, train=train, momentum=momentum), axis=1)
        hidden = self.head(features, train=train, momentum=momentum).astype(points.dtype)
        if train and key is not None:
            # Flax's own layer takes no rate that is traced.
            kept = 1 - (self.dropout if dropout is None else dropout)
            hidden = jnp.where(jax.random.bernoulli(key, kept, hidden.shape), hidden / kept, 0.0)
        return self.out(hidden).reshape(*batch, self.views)
