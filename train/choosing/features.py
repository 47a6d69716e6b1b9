"""Training of the set fusion on cached features: random subsets of an object's views, of every size, to its class.

Features of all objects fit into memory (`train.averaged`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.models.set_fusion import SetFusion
from train.choosing.averaged import AveragedConfig, fit_averaged


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


@dataclass(frozen=True)
class FusionConfig(AveragedConfig):
    """The set fusion's training on features that are there."""

    epochs: int = 60
    """looks at each object's views"""
    weight_decay: float = 0.05
    """decoupled"""
    network: SetFusionConfig = SetFusionConfig()
    largest_set: int = 12
    """views in a training set at most"""


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


def fusion_loss(
    network: SetFusion, chosen: Features, present: Array, key: Array | None = None
) -> Float[Array, " objects"]:
    """Cross-entropy of each set, in nats; with a key, dropping out."""
    logits = network(chosen.features, chosen.directions, present, key=key)
    return optax.softmax_cross_entropy_with_integer_labels(logits, chosen.labels)


def train_fusion(
    config: FusionConfig, train: Features, validation: Features, start: SetFusion | None = None
) -> tuple[SetFusion, dict[str, Any]]:
    """The network of the best epoch, and what happened: losses by epoch. It begins as `start`, or with random weights."""
    if start is None:
        start = new_fusion(config.network, train.features.shape[-1], train.logits.shape[-1], nnx.Rngs(config.seed))
    structure, parameters = nnx.split(start)
    views, largest = train.features.shape[1], config.largest_set

    def loss_of(parameters: nnx.State, some: Features, key: Array) -> Array:
        sets, drop = jax.random.split(key)
        present = random_sets(sets, len(some.labels), views, largest)
        return jnp.mean(fusion_loss(nnx.merge(structure, parameters), some, present, drop))

    @jax.jit
    def check(mean: nnx.State, validation: Features) -> Array:
        network = nnx.merge(structure, mean)
        keys = jax.random.split(jax.random.key(1), 4)  # the same sets after every epoch
        sets = [random_sets(key, len(validation.labels), views, largest) for key in keys]
        return jnp.mean(jnp.stack([fusion_loss(network, validation, present) for present in sets]))

    def validate(mean: nnx.State) -> dict[str, float]:
        return {"validation": float(check(mean, validation))}

    best, history = fit_averaged(config, loss_of, parameters, train, validate)
    best_loss = min((epoch["validation"] for epoch in history), default=None)
    return nnx.merge(structure, best), {"best_loss": best_loss, "epochs": history}
