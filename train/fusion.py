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
class FusionConfig:
    """The set fusion and its training."""

    width: int = 128
    """of the tokens"""
    heads: int = 4
    """of attention"""
    blocks: int = 2
    """of attention and layers"""
    dropout: float = 0.2
    """within blocks, and of features"""
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
        directions: (views, 3) unit vectors to the cameras.
    """

    features: Float[Array, "objects views features"]
    logits: Float[Array, "objects views classes"]
    labels: Int[Array, "objects"]
    directions: Float[Array, "views 3"]


def new_fusion(config: FusionConfig, features: int, classes: int) -> SetFusion:
    return SetFusion(
        features,
        classes,
        width=config.width,
        heads=config.heads,
        blocks=config.blocks,
        dropout=config.dropout,
        rngs=nnx.Rngs(config.seed),
    )


def random_sets(key: Array, objects: int, views: int, largest: int) -> Bool[Array, "objects views"]:
    """For each object a random set of 1 to `largest` views, every size as likely."""
    sizes, order = jax.random.split(key)
    count = jax.random.randint(sizes, (objects, 1), 1, min(largest, views) + 1)
    ranks = jnp.argsort(jnp.argsort(jax.random.uniform(order, (objects, views)), axis=1), axis=1)
    return ranks < count


def fusion_loss(network: SetFusion, chosen: Features, present: Array, *, train: bool) -> Float[Array, "objects"]:
    """Cross-entropy of each set, in nats."""
    directions = jnp.broadcast_to(chosen.directions, (*present.shape, 3))
    logits = network(chosen.features, directions, present, train=train)
    return optax.softmax_cross_entropy_with_integer_labels(logits, chosen.labels)


def _some(data: Features, index: Array) -> Features:
    return Features(data.features[index], data.logits[index], data.labels[index], data.directions)


def train_fusion(config: FusionConfig, train: Features, validation: Features) -> tuple[SetFusion, dict[str, Any]]:
    """The network of the best epoch, and what happened: losses by epoch."""
    network = new_fusion(config, train.features.shape[-1], train.logits.shape[-1])
    structure, parameters, *others = nnx.split(network, nnx.Param, ...)
    rest = others[0]
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
            network = nnx.merge(structure, parameters, rest, copy=True)
            nnx.reseed(network, dropout=noise)
            return jnp.mean(fusion_loss(network, _some(train, index), present, train=True))

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
        network = nnx.merge(structure, mean, rest)
        keys = jax.random.split(jax.random.key(1), draws)  # the same sets after every epoch
        sets = [random_sets(key, len(validation.labels), views, config.largest_set) for key in keys]
        return jnp.mean(jnp.stack([fusion_loss(network, validation, present, train=False) for present in sets]))

    carry = parameters, optimiser.init(parameters), parameters, jnp.float32(0)
    best, best_loss, history = parameters, float("inf"), []
    for number in range(config.epochs):
        carry, train_loss = epoch(carry, jax.random.fold_in(jax.random.key(config.seed), number))
        loss = float(validate(carry[2]))
        history.append({"train": float(train_loss), "validation": loss})
        if loss < best_loss:
            best, best_loss = carry[2], loss
    return nnx.merge(structure, best, rest), {"best_loss": best_loss, "epochs": history}
