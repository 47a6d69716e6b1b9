"""Features of the recogniser for every view of some objects, the shape of the set fusion, and random sets of views."""

from __future__ import annotations

import math
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.models.set_fusion import SetFusion


@dataclass(frozen=True)
class SetFusionConfig:
    """Architecture of the set fusion."""

    width: int = 128
    """width of the tokens"""
    heads: int = 4
    """heads of attention"""
    blocks: int = 2
    """blocks of attention and feed-forward layers"""
    dropout: float = 0.2
    """dropout rate within the blocks and of the features"""


@flax.struct.dataclass
class Features:
    """Outputs of the encoder for every view of some objects.

    Attributes:
        features: features of each view.
        logits: logits of each single view.
        labels: true class of each object.
        directions: unit vectors from the object to the cameras.
        clouds: PointNet++'s embedding of the partial cloud of each view, if used.
    """

    features: Float[Array, "objects views features"]
    logits: Float[Array, "objects views classes"]
    labels: Int[Array, " objects"]
    directions: Float[Array, "objects views 3"]
    clouds: Float[Array, "objects views embedding"] | None = None

    def some(self, chosen: Int[np.ndarray, " some"]) -> Features:
        """Returns those of the chosen objects."""
        return jax.tree.map(lambda leaf: leaf[chosen], self)

    def without(self, classes: tuple[int, ...]) -> Features:
        """Returns those of objects that belong to none of `classes`."""
        return self.some(np.flatnonzero(~np.isin(self.labels, classes))) if classes else self


def new_fusion(shape: SetFusionConfig, features: int, classes: int, rngs: nnx.Rngs) -> SetFusion:
    return SetFusion(
        features,
        classes,
        width=shape.width,
        heads=shape.heads,
        blocks=shape.blocks,
        dropout=shape.dropout,
        rngs=rngs,
    )


def random_sets(key: Array, objects: int, views: int, largest: int) -> Bool[Array, "objects views"]:
    """Returns for each object a random set of 1 to `largest` views.

    Small sets are drawn more often, since the first views change a belief much and later ones little: about as many sets have 1
    view as have 2 or 3 views, and as have 4 to 7.
    """
    sizes, order = jax.random.split(key)
    logarithm = jax.random.uniform(sizes, (objects, 1), maxval=math.log(min(largest, views) + 1))
    count = jnp.clip(jnp.floor(jnp.exp(logarithm)), 1, min(largest, views))
    ranks = jnp.argsort(jnp.argsort(jax.random.uniform(order, (objects, views)), axis=1), axis=1)
    return ranks < count


def sets_of_size(objects: int, views: int, size: int, draws: int, seed: int = 0) -> Bool[Array, "draws objects views"]:
    """Returns random sets of `size` views; the same `seed` gives the same sets."""
    drawn = jax.random.uniform(jax.random.key(seed), (draws, objects, views))
    return jnp.argsort(jnp.argsort(drawn, axis=-1), axis=-1) < size
