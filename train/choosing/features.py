"""Training of the set fusion on cached features: random subsets of an object's views, of every size, to its class.

Features of all objects fit into memory (`train.averaged`).
"""

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
    """Shape of the set fusion."""

    width: int = 128
    """of the tokens"""
    heads: int = 4
    """of attention"""
    blocks: int = 2
    """of attention and layers"""
    dropout: float = 0.2
    """within blocks, and of features"""


@flax.struct.dataclass
class Features:
    """What the encoder says of every view of some objects.

    Attributes:
        features: (objects, views, features).
        logits: (objects, views, classes) of the single views.
        labels: (objects,).
        directions: (objects, views, 3) unit vectors to the cameras.
        clouds: (objects, views, embedding) of the partial clouds, where they are used.
    """

    features: Float[Array, "objects views features"]
    logits: Float[Array, "objects views classes"]
    labels: Int[Array, " objects"]
    directions: Float[Array, "objects views 3"]
    clouds: Float[Array, "objects views embedding"] | None = None

    def some(self, chosen: Int[np.ndarray, " some"]) -> Features:
        """Those of some objects."""
        return jax.tree.map(lambda leaf: leaf[chosen], self)

    def without(self, classes: tuple[int, ...]) -> Features:
        """Those of objects of other classes; all of them where none is given."""
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
    """For each object a random set of 1 to `largest` views; small ones more often: one view as often as 2 and 3 together, about,
    and as 4 to 7, since much changes with each of the first views and little with each of the last."""
    sizes, order = jax.random.split(key)
    logarithm = jax.random.uniform(sizes, (objects, 1), maxval=math.log(min(largest, views) + 1))
    count = jnp.clip(jnp.floor(jnp.exp(logarithm)), 1, min(largest, views))
    ranks = jnp.argsort(jnp.argsort(jax.random.uniform(order, (objects, views)), axis=1), axis=1)
    return ranks < count


def sets_of_size(objects: int, views: int, size: int, draws: int, seed: int = 0) -> Bool[Array, "draws objects views"]:
    """Random sets of so many views, the same at every call."""
    drawn = jax.random.uniform(jax.random.key(seed), (draws, objects, views))
    return jnp.argsort(jnp.argsort(drawn, axis=-1), axis=-1) < size
