"""Training of the set fusion on cached features: random subsets of an object's views, of every size, to its class.

Features of all objects fit into memory, so an epoch is one program. The weights that are kept are running means (Polyak),
those of the epoch that is best on the validation objects.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.fusion import SetFusion


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
class FusionConfig:
    """The set fusion's training on features that are there."""

    network: SetFusionConfig = SetFusionConfig()
    largest_set: int = 12
    """views in a training set at most"""
    epochs: int = 60
    """looks at each object's views"""
    batch_size: int = 128
    """sets in a batch"""
    learning_rate: float = 1e-3
    """of AdamW, at its highest"""
    weight_decay: float = 0.05
    """decoupled"""
    averaging: float = 0.995
    """share of the running mean of the weights that a step keeps"""
    seed: int = 0
    """of weights, sets and dropout"""


@flax.struct.dataclass
class Features:
    """What the encoder says of every view of some objects.

    Attributes:
        features: (objects, views, features).
        logits: (objects, views, classes) of the single views.
        labels: (objects,).
        directions: (objects, views, 3) unit vectors to the cameras.
    """

    features: Float[Array, "objects views features"]
    logits: Float[Array, "objects views classes"]
    labels: Int[Array, "objects"]
    directions: Float[Array, "objects views 3"]


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
    """For each object a random set of 1 to `largest` views, every size as likely."""
    sizes, order = jax.random.split(key)
    count = jax.random.randint(sizes, (objects, 1), 1, min(largest, views) + 1)
    ranks = jnp.argsort(jnp.argsort(jax.random.uniform(order, (objects, views)), axis=1), axis=1)
    return ranks < count


def sets_of_size(objects: int, views: int, size: int, draws: int, seed: int = 0) -> Bool[Array, "draws objects views"]:
    """Random sets of so many views, the same at every call."""
    drawn = jax.random.uniform(jax.random.key(seed), (draws, objects, views))
    return jnp.argsort(jnp.argsort(drawn, axis=-1), axis=-1) < size


def fusion_loss(
    network: SetFusion, chosen: Features, present: Array, key: Array | None = None
) -> Float[Array, "objects"]:
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
    objects, views = train.features.shape[:2]
    batch = min(config.batch_size, objects)
    steps = objects // batch
    total = steps * config.epochs
    rate = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, max(1, total // 20), max(2, total))
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(rate, b2=0.98, weight_decay=config.weight_decay)
    )

    Carry = tuple[Any, Any, Any, Array]  # weights, moments, mean of weights, steps

    def step(carry: Carry, given: tuple[Array, Array]) -> tuple[Carry, Array]:
        parameters, moments, mean, taken = carry
        index, key = given
        sets, noise = jax.random.split(key)
        present = random_sets(sets, batch, views, config.largest_set)

        def loss_of(parameters: nnx.State) -> Array:
            some = jax.tree.map(lambda leaf: leaf[index], train)
            return jnp.mean(fusion_loss(nnx.merge(structure, parameters), some, present, noise))

        loss, gradient = jax.value_and_grad(loss_of)(parameters)
        update, moments = optimiser.update(gradient, moments, parameters)
        parameters = optax.apply_updates(parameters, update)
        keep = jnp.minimum(config.averaging, (taken + 1) / (taken + 10))
        mean = jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, mean, parameters)
        return (parameters, moments, mean, taken + 1), loss

    @jax.jit
    def epoch(carry: Carry, key: Array) -> tuple[Carry, Array]:
        order, keys = jax.random.split(key)
        index = jax.random.permutation(order, objects)[: steps * batch].reshape(steps, batch)
        carry, losses = jax.lax.scan(step, carry, (index, jax.random.split(keys, steps)))
        return carry, jnp.mean(losses)

    @partial(jax.jit, static_argnames="draws")
    def validate(mean: nnx.State, draws: int = 4) -> Array:
        network = nnx.merge(structure, mean)
        keys = jax.random.split(jax.random.key(1), draws)  # the same sets after every epoch
        sets = [random_sets(key, len(validation.labels), views, config.largest_set) for key in keys]
        return jnp.mean(jnp.stack([fusion_loss(network, validation, present) for present in sets]))

    carry = parameters, optimiser.init(parameters), parameters, jnp.float32(0)
    best, best_loss, history = parameters, float("inf"), []
    for number in range(config.epochs):
        carry, train_loss = epoch(carry, jax.random.fold_in(jax.random.key(config.seed), number))
        loss = float(validate(carry[2]))
        history.append({"train": float(train_loss), "validation": loss})
        if loss < best_loss:
            best, best_loss = carry[2], loss
    return nnx.merge(structure, best), {"best_loss": best_loss, "epochs": history}
