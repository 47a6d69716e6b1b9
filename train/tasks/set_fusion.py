"""The set fusion that is trained with the recogniser, and the random sets of views on which it is trained."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool

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


def new_fusion(config: SetFusionConfig, features: int, classes: int, rngs: nnx.Rngs) -> SetFusion:
    return SetFusion(features, classes, **asdict(config), rngs=rngs)


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
