"""PointNet++ of Vector Neurons (Deng et al., *Vector Neurons*, 2021): features are vectors, which turn as the cloud turns.

This is a compact form. Centres, neighbourhoods and levels are those of `PointNet2`. A layer mixes vectors, normalises their
lengths by the batch, and removes the part of each that points against a learned direction. Neighbours are averaged, as are
centres. A layer has a third of the channels that PointNet++ has, so as many numbers. The value of a view is a function of the
lengths of the last vectors and of their products with the view's direction, the same function for all views. So if the cloud and
the views are turned, nothing changes, and the network knows neither the upward direction nor how the objects of a class face.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models import Abstraction, BatchNorm
from mevs_jax.models.calling import TrainedByCall
from mevs_jax.models.neighbours import infer
from mevs_jax.models.pointnet2 import Perceptron
from mevs_jax.points.ops import ball_query, farthest_point_sample

_TINY = 1e-6
Momentum = float | Float[Array, ""]


def _length(vectors: Float[Array, "*batch 3 channels"]) -> Float[Array, "*batch channels"]:
    return jnp.sqrt(jnp.sum(jnp.square(vectors), axis=-2) + _TINY)


class VectorLayer(nnx.Module):
    """A linear layer over vectors (…, 3, channels), batch norm of their lengths, and the nonlinearity of Vector Neurons."""

    def __init__(self, inputs: int, outputs: int, *, rngs: nnx.Rngs):
        self.linear = nnx.Linear(inputs, outputs, use_bias=False, rngs=rngs)
        self.direction = nnx.Linear(outputs, outputs, use_bias=False, rngs=rngs)
        self.norm = BatchNorm(outputs)

    def __call__(
        self, vectors: Float[Array, "*batch 3 inputs"], *, train: bool, momentum: Momentum
    ) -> Float[Array, "*batch 3 outputs"]:
        mixed = self.linear(vectors)
        length = _length(mixed)
        mixed = mixed * (self.norm(length, train=train, momentum=momentum) / length)[..., None, :]
        towards = self.direction(mixed)
        along = jnp.sum(mixed * towards, axis=-2) / jnp.square(_length(towards))
        return mixed - jnp.minimum(along, 0.0)[..., None, :] * towards


def _layers(inputs: int, widths: Sequence[int], rngs: nnx.Rngs) -> nnx.List:
    sizes = [inputs, *(max(1, width // 3) for width in widths)]
    return nnx.List(VectorLayer(a, b, rngs=rngs) for a, b in pairwise(sizes))


class VectorPointNet2(TrainedByCall):
    """Predicts a value of each view, as `PointNet2`, from features that turn with the cloud.

    Args:
        viewpoints: directions of the views.
        abstractions, global_layers, head_layers, dropout, rngs: as of `PointNet2`.
    """

    def __init__(
        self,
        *,
        viewpoints: tuple[tuple[float, ...], ...],
        abstractions: Sequence[Abstraction],
        global_layers: Sequence[int],
        head_layers: Sequence[int],
        dropout: float,
        rngs: nnx.Rngs,
    ):
        self.viewpoints, self.levels, self.dropout = viewpoints, tuple(abstractions), dropout
        channels, levels = 1, []
        for level in self.levels:
            levels.append(_layers(3 + channels, level.layers, rngs))
            channels = max(1, level.layers[-1] // 3)
        self.local = nnx.List(levels)
        widths = (*global_layers, head_layers[-1])
        self.whole = _layers(1 + channels, widths[:-1], rngs)
        self.last = _layers(max(1, widths[-2] // 3), widths[-1:], rngs)
        self.head = Perceptron(2 * max(1, widths[-1] // 3), head_layers[-1:], rngs=rngs)
        self.out = nnx.Linear(head_layers[-1], 1, rngs=rngs)

    def __call__(
        self,
        points: Float[AnyArray, "clouds points columns"],
        *,
        train: bool = False,
        key: Array | None = None,
        momentum: Momentum = 0.1,
        dropout: Momentum | None = None,
    ) -> Float[Array, "clouds views"]:
        """Predicted value of every view; arguments as of `PointNet2`."""
        hidden = self.hidden(points, jnp.array(self.viewpoints), train=train, momentum=momentum)
        if train and key is not None:
            kept = 1 - (self.dropout if dropout is None else dropout)
            hidden = jnp.where(jax.random.bernoulli(key, kept, hidden.shape), hidden / kept, 0.0)
        return self.out(hidden)[..., 0]

    def hidden(
        self,
        points: Float[AnyArray, "clouds points columns"],
        directions: Float[Array, "views 3"],
        *,
        train: bool = False,
        momentum: Momentum = 0.1,
    ) -> Float[Array, "clouds views hidden"]:
        """What is known of some directions before the last layer; it stays when cloud and directions are turned together."""
        points = jnp.asarray(points)
        how = {"train": train, "momentum": momentum}
        coordinates, features = points[..., :3], points[..., 3:, None]
        if not features.shape[-2]:  # without directions to the camera
            features = jnp.zeros_like(coordinates)[..., None]
        for level, layers in zip(self.levels, self.local, strict=True):
            chosen = jax.vmap(partial(farthest_point_sample, k=level.centres))(coordinates)
            centres = jnp.take_along_axis(coordinates, chosen[..., None], axis=1)
            near = jax.vmap(partial(ball_query, radius=level.radius, k=level.samples))(coordinates, centres)
            taken, around = jax.vmap(lambda of, index: of[index])(features, near), centres[:, :, None]
            offset = jax.vmap(lambda of, index: of[index])(coordinates, near) - around
            frame = [offset, jnp.broadcast_to(around, offset.shape), jnp.cross(offset, around)]
            vectors = jnp.concatenate([jnp.stack(frame, axis=-1), taken], axis=-1)
            for layer in layers:
                vectors = layer(vectors, **how)
            features, coordinates = jnp.mean(vectors, axis=2), centres
        vectors = jnp.concatenate([coordinates[..., None], features], axis=-1)
        for layer in self.whole:
            vectors = layer(vectors, **how)
        vectors = self.last[0](jnp.mean(vectors, axis=1), **how)
        seen = jnp.einsum("vx,bxc->bvc", directions, vectors)
        lengths = jnp.broadcast_to(_length(vectors)[:, None], seen.shape)
        known = jnp.concatenate([seen, lengths], axis=-1)
        return self.head(known, momentum=momentum) if train else infer(self.head.layers(), known)
