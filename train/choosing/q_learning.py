"""The learned baseline: Q-learning of the views to look at, as MVSelect does (Hou et al., CVPR 2024).

Where `train.policy` asks of every candidate how much it gained, here the walk alone is known: which view was taken, and by how
much the belief in the true class rose. Values follow by bootstrapping from the next state's (DQN; Mnih et al. 2015), with a
network that is the view policy's, so that nothing but the way of learning differs. Walks are ε-greedy; a round walks with the
network of the round before, which is also the target, and trains on the walks of all rounds (the replay).

What differs from MVSelect: a fusion by attention rather than the maximum, beliefs of recognisers that never saw the object,
and rewards at every step rather than the last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int

from data_pipeline.progress import console
from mevs_jax.beliefs import CalibratedFusion
from mevs_jax.models.view_policy import ViewPolicy, utility_of
from mevs_jax.policies.base import Policy
from train.choosing.averaged import fit_averaged, mean_losses
from train.choosing.chunks import in_chunks
from train.choosing.features import Features
from train.choosing.policy import PolicyConfig, Seen, joined, learned_policy, new_policy, walk


@dataclass(frozen=True)
class QLearningConfig(PolicyConfig):
    """Q-learning of the view policy."""

    epochs: int = 3
    """looks at each walk, in every round"""
    batch_size: int = 64
    """walks in a batch"""
    rounds: int = 6
    """of walking and learning; the first walks at random"""
    discount: float = 0.9
    """what a gain one view later counts"""
    exploration: float = 0.2
    """share of the views of later rounds that are drawn"""


@flax.struct.dataclass
class Transitions:
    """Walks, and what each of their views brought.

    Attributes:
        beliefs: log-probabilities after each view.
        views: those of each view alone.
        order: which views.
        candidates: directions of all views of the object.
        reward: [t]: rise in utility by view t + 1.
    """

    beliefs: Float[Array, "walks steps classes"]
    views: Float[Array, "walks steps classes"]
    order: Int[Array, "walks steps"]
    candidates: Float[Array, "walks candidates 3"]
    reward: Float[Array, "walks transitions"]


@partial(jax.jit, static_argnames="config")
def _transitions_of_some(
    fusion: CalibratedFusion, some: tuple[Features, Array], config: QLearningConfig
) -> Transitions:
    steps = some[1].shape[-1]

    def of_object(one: Features, walks: Array) -> Transitions:
        single = jax.nn.log_softmax(one.logits / fusion.single, axis=-1)

        def of_walk(order: Array) -> Transitions:
            seen = one.features[order], one.directions[order]
            beliefs = jax.vmap(lambda count: fusion(*seen, jnp.arange(steps) < count))(jnp.arange(1, steps + 1))
            reward = jnp.diff(utility_of(beliefs[:, one.labels], config.utility, config.floor))
            return Transitions(beliefs, single[order], order, one.directions, reward)

        return jax.vmap(of_walk)(walks)

    return jax.vmap(of_object)(*some)


def transitions_along(
    fusion: CalibratedFusion,
    data: Features,
    walks: Int[np.ndarray, "objects walks steps"],
    config: QLearningConfig,
) -> Transitions:
    """What happened along some walks; arrays of the host."""
    found = in_chunks(partial(_transitions_of_some, fusion, config=config), (data, walks), 64)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def values(network: ViewPolicy, some: Transitions) -> Float[Array, "walks transitions candidates"]:
    """What `network` expects of every candidate after every view but the last; −inf for those seen."""
    steps = some.order.shape[-1]

    def of_walk(beliefs: Array, views: Array, order: Array, candidates: Array) -> Array:
        def after(count: Array) -> Array:
            present = jnp.arange(steps) < count
            value = network(beliefs[count - 1], views, candidates[order], present, candidates)[0]
            seen = jnp.zeros(len(candidates), bool).at[order].max(present)
            return jnp.where(seen, -jnp.inf, value)

        return jax.vmap(after)(jnp.arange(1, steps))

    return jax.vmap(of_walk)(some.beliefs, some.views, some.order, some.candidates)


def temporal_difference(
    network: ViewPolicy, target: ViewPolicy, some: Transitions, discount: float
) -> Float[Array, "walks transitions"]:
    """How far each value of a view taken is from its reward and what the target expects from there on; the last ends the walk."""
    taken = jnp.take_along_axis(values(network, some), some.order[:, 1:, None], axis=2)[:, :, 0]
    ahead = jnp.max(values(target, some), axis=2)[:, 1:]
    ahead = jnp.pad(ahead, ((0, 0), (0, 1)))
    return taken - (some.reward + discount * ahead)


def exploring(given: tuple[nnx.State, Array], structure: nnx.GraphDef, share: float) -> Policy:
    """Now and then any view, otherwise that of the highest value."""
    greedy = learned_policy(given, structure, by="state")

    def scores(key: Array, state: Any, scene: Any) -> Array:
        whether, drawn = jax.random.split(key)
        any_view = jax.random.uniform(drawn, (scene.graph.points.shape[0],))
        return jnp.where(jax.random.bernoulli(whether, share), any_view, greedy(key, state, scene))

    return scores


def train_by_q_learning(
    config: QLearningConfig,
    parts: Sequence[Seen],
    validation: Seen | None = None,
) -> tuple[ViewPolicy, list[list[dict[str, float]]]]:
    """The network after all rounds, to be asked `by="state"`, and losses by round and epoch; arguments as of `train_policy`."""
    network = new_policy(config, parts[0][1].logits.shape[-1], parts[0][0].posed)
    structure, weights = nnx.split(network)
    replay: list[Transitions] = []
    replay_for_check: list[Transitions] = []
    histories = []
    for number in range(config.rounds):
        share = config.exploration if number else 1.0
        policy_of: Callable[..., Policy] = partial(exploring, structure=structure, share=share)
        for part, (fusion, data) in enumerate(parts if validation is None else [*parts, validation]):
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), number), part)
            given = weights, fusion.single
            walks = walk(key, fusion, data, policy_of, given, config.most_seen + 1, config.walks)
            to = replay if part < len(parts) else replay_for_check
            to.append(transitions_along(fusion, data, walks, config))
        train, check = joined(replay), joined(replay_for_check) if replay_for_check else None
        weights, history = _fit(config, structure, weights, number > 0, train, check)
        histories.append(history)
        console.print(f"Round {number + 1} of {config.rounds}, {len(train.order)} walks: {history[-1]}")
    return nnx.merge(structure, weights), histories


def _fit(
    config: QLearningConfig,
    structure: nnx.GraphDef,
    target: nnx.State,
    ahead: bool,
    train: Transitions,
    check: Transitions | None,
) -> tuple[nnx.State, list[dict[str, float]]]:
    """From the target's weights on; the first round looks no further than the next view, since its target knows nothing."""
    discount = config.discount if ahead else 0.0

    def loss_of(parameters: nnx.State, some: Transitions, key: Array | None = None) -> Array:
        del key
        network, old = (nnx.merge(structure, weights) for weights in (parameters, target))
        return jnp.mean(temporal_difference(network, old, some, discount) ** 2)

    @jax.jit
    def error(mean: nnx.State, some: Transitions) -> dict[str, Array]:
        return {"error": loss_of(mean, some)}

    validate = None if check is None else mean_losses(error, check, 256)
    return fit_averaged(config, loss_of, target, train, validate)
