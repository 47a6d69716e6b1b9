"""Small networks with arbitrary weights, features without images, and a plain walk: what tests of learned choice share."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from mevs_jax import fibonacci_sphere
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models import ViewPolicy
from mevs_jax.models.set_fusion import SetFusion
from train.choosing.features import Features

VIEWS, CLASSES, SEEN = 6, 4, 3


def moved(network, scale: float = 0.3):
    """Weights that begin as zeros or ones would hide mistakes."""
    leaves, tree = jax.tree.flatten(nnx.state(network, nnx.Param))
    keys = jax.random.split(jax.random.key(3), len(leaves))
    nnx.update(
        network,
        jax.tree.unflatten(
            tree, [leaf + scale * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
        ),
    )
    return network


def fusion_of(features: int, classes: int) -> CalibratedFusion:
    network = moved(SetFusion(features, classes, width=8, heads=2, blocks=1, dropout=0.0, rngs=nnx.Rngs(0)))
    structure, weights = nnx.split(network)
    return CalibratedFusion(
        structure, weights, jnp.linspace(-1, 0, classes), jnp.array([1.5, 1.2, 0.9]), jnp.float32(1.3)
    )


def some_features(objects: int, seed: int = 0) -> Features:
    random = np.random.default_rng(seed)
    directions = np.stack([fibonacci_sphere(VIEWS)] * objects)
    return Features(
        jnp.asarray(random.normal(size=(objects, VIEWS, 5)), jnp.float32),
        jnp.asarray(random.normal(size=(objects, VIEWS, CLASSES)), jnp.float32),
        jnp.asarray(random.integers(0, CLASSES, objects), jnp.int32),
        jnp.asarray(directions, jnp.float32),
    )


@nnx.jit
def asked(policy: ViewPolicy, *arguments):
    return policy(*arguments)


@jax.jit
def fused(fusion, features, directions):
    return fusion(features, directions, jnp.ones(len(features), bool))


def plain_walk(fusion, data, index, scores, start, steps):
    """Look, fuse, score, go: in Python."""
    seen, beliefs = [start], []
    for _ in range(steps):
        order = np.array(seen)
        belief = fused(fusion, data.features[index, order], data.directions[index, order])
        beliefs.append(np.asarray(belief))
        found = np.array(scores(order, belief), np.float64)
        found[order] = -np.inf
        seen.append(int(found.argmax()))
    return seen[:steps], beliefs


def telling(objects: int, seed: int) -> Features:
    """One view identifies each class: at view 0 classes look alike in pairs, and another view separates each pair."""
    random = np.random.default_rng(seed)
    labels = random.integers(0, 4, objects)
    logits = random.normal(0, 0.3, (objects, VIEWS, 4))
    pair = labels // 2
    for index, label in enumerate(labels):
        logits[index, 0, 2 * pair[index] : 2 * pair[index] + 2] += 4
        logits[index, 2 + pair[index], label] += 4
    directions = np.stack([fibonacci_sphere(VIEWS)] * objects)
    return Features(
        *(jnp.asarray(logits, jnp.float32),) * 2, jnp.asarray(labels, jnp.int32), jnp.asarray(directions, jnp.float32)
    )


class Sum(nnx.Module):
    """The sum of what was seen, in the place of a fusion that is learned."""

    def __call__(self, features, directions, present, *, posed=True):
        del directions, posed
        return jnp.sum(jnp.where(present[..., None], features, 0.0), axis=-2)


def adding_fusion() -> CalibratedFusion:
    """The sum of what was seen as a fusion; its classes are those of `telling`."""
    structure, weights = nnx.split(Sum())
    return CalibratedFusion(structure, weights, jnp.zeros(4), jnp.ones(1), jnp.float32(1))


def some_policy() -> ViewPolicy:
    return moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=2, rngs=nnx.Rngs(1)), 0.1)
