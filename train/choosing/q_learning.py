"""The learned baseline: Q-learning of the next view, as in MVSelect (Hou et al., CVPR 2024).

`train.choosing.policy` learns from the gain of many candidates in each state. Here only walks are known: the view taken, and by
how much the belief in the true class rose. Values are bootstrapped from the next state's values (DQN; Mnih et al. 2015). The
network is that of the view policy, so that only the method of learning differs. Walks are ε-greedy. A round walks with the last
round's network, which is also the target network, and trains on the walks of all rounds (the replay).

Differences to MVSelect: fusion is by attention instead of the maximum, beliefs are of recognisers that were not trained on the
object, and there is a reward at every step instead of only the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int

from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models.view_policy import ViewPolicy, utility_of
from mevs_jax.policies.base import Policy, Scene, SelectionState, as_tree
from mevs_jax.policies.learned import of_network
from mevs_jax.policies.uninformed import random_view
from train.choosing.averaged import Fitting, fit_together, mean_losses
from train.choosing.features import Features
from train.choosing.policy import Lesson, PolicyConfig, Round, Seen, Trained, in_rounds, round_key, walk
from train.running.over_objects import over_objects


@dataclass(frozen=True)
class QLearningConfig(PolicyConfig):
    """Settings of the view policy's training by Q-learning."""

    epochs: int = 3
    """passes over the walks, in every round"""
    batch_size: int = 64
    """walks in a batch"""
    rounds: int = 6
    """rounds of walking and training; the first walks at random"""
    discount: float = 0.9
    """discount factor for the gain of one view later"""
    exploration: float = 0.2
    """ε: share of views that are chosen at random, in rounds after the first"""


@flax.struct.dataclass
class Transitions:
    """Walks, and the gain by each of their views.

    Attributes:
        beliefs: log-probabilities of the classes after each view.
        views: log-probabilities of the classes by each view alone.
        order: indices of the views.
        candidates: directions of all views of the object.
        reward: gain in utility by view t + 1, at index t.
    """

    beliefs: Float[Array, "walks steps classes"]
    views: Float[Array, "walks steps classes"]
    order: Int[Array, "walks steps"]
    candidates: Float[Array, "walks candidates 3"]
    reward: Float[Array, "walks transitions"]


def _transitions_of(
    one: tuple[Features, Int[Array, "walks steps"]], fusion: CalibratedFusion, *, config: QLearningConfig
) -> Transitions:
    data, walks = one
    steps, single = walks.shape[-1], jax.nn.log_softmax(data.logits / fusion.single, axis=-1)

    def of_walk(order: Array) -> Transitions:
        seen = data.features[order], data.directions[order]
        beliefs = jax.vmap(lambda count: fusion(*seen, jnp.arange(steps) < count))(jnp.arange(1, steps + 1))
        reward = jnp.diff(utility_of(beliefs[:, data.labels], config.utility, config.floor))
        return Transitions(beliefs, single[order], order, data.directions, reward)

    return jax.vmap(of_walk)(walks)


def transitions_along(
    fusion: CalibratedFusion,
    data: Features,
    walks: Int[np.ndarray, "objects walks steps"],
    config: QLearningConfig,
) -> Transitions:
    """Returns beliefs and rewards along some walks, as arrays on the host."""
    same = replace(config, seed=0)  # one program for all seeds
    found = over_objects(_transitions_of, (data, walks), fusion, at_once=64, by_all=True, config=same)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def values(network: ViewPolicy, some: Transitions) -> Float[Array, "walks transitions candidates"]:
    """Returns the value of every candidate after every view but the last; −inf for candidates already seen."""
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
    """Returns the value of each view taken minus its reward and the target's discounted value of the next state.

    The last view ends the walk: nothing is added to its reward.
    """
    taken = jnp.take_along_axis(values(network, some), some.order[:, 1:, None], axis=2)[:, :, 0]
    ahead = jnp.max(values(target, some), axis=2)[:, 1:]
    ahead = jnp.pad(ahead, ((0, 0), (0, 1)))
    return taken - (some.reward + discount * ahead)


def exploring(policy: Policy, share: float) -> Policy:
    """Returns the ε-greedy form of a policy: random scores with probability `share`, else its own."""
    return Partial(_exploring, as_tree(policy), share)


def _exploring(
    greedy: Policy, share: Float[Array, ""] | float, key: Array, state: SelectionState, scene: Scene
) -> Float[Array, " views"]:
    whether, drawn = jax.random.split(key)
    any_view = jax.random.uniform(drawn, (len(scene.graph.points),))
    return jnp.where(jax.random.bernoulli(whether, share), any_view, greedy(key, state, scene))


def train_by_q_learning(
    config: QLearningConfig, lessons: Sequence[Lesson], folder: Path | None = None
) -> list[Trained]:
    """Returns a network for each lesson, as `train_policies` does, for use with `by="state"`."""
    return in_rounds(config, lessons, folder, _gather, _fit)


def _gather(seen: Seen, guide: ViewPolicy | None, config: QLearningConfig, number: tuple[int, int]) -> Transitions:
    """Returns what new walks on some objects tell; the first are random."""
    fusion, data = seen
    policy: Policy = random_view
    if guide is not None:
        policy = exploring(of_network(guide, fusion.single, "state"), config.exploration)
    walks = walk(round_key(config, number), fusion, data, policy, config.most_seen + 1, config.walks)
    return transitions_along(fusion, data, walks, config)


def _fit(
    config: QLearningConfig, rounds: Sequence[Round[Transitions]], kept: Path | None
) -> list[tuple[ViewPolicy, list[dict[str, float]]]]:
    """Trains networks from the weights of their targets, those of the round before.

    In the first round, where the target is untrained, the value of the next state does not count.
    """
    structure, discount = nnx.graphdef(rounds[0].untrained), config.discount if rounds[0].before else 0.0

    def loss_of(parameters: nnx.State, some: Transitions, key: Array | None, target: nnx.State) -> Array:
        del key
        network, old = (nnx.merge(structure, weights) for weights in (parameters, target))
        return jnp.mean(temporal_difference(network, old, some, discount) ** 2)

    @jax.jit
    def error(mean: nnx.State, some: Transitions, target: nnx.State) -> dict[str, Array]:
        return {"error": loss_of(mean, some, None, target)}

    fittings = []
    for one in rounds:
        target = nnx.state(one.before or one.untrained)
        validate = None if one.check is None else mean_losses(partial(error, target=target), one.check, 256)
        fittings.append(Fitting(one.config.seed, target, one.train, validate, one.name, (target,)))
    fitted = fit_together(config, loss_of, fittings, "--learned.q-learning.learning-rate", kept)
    return [(nnx.merge(structure, best), history) for best, history in fitted]
