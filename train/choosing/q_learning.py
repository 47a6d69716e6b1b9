"""The learned baseline: Q-learning of the next view, as in MVSelect (Hou et al., CVPR 2024).

`train.choosing.policy` learns from the gain of many candidates in each state. Here only walks are known: the view taken, and by
how much the belief in the true class rose. Values are bootstrapped from the next state's values (DQN; Mnih et al. 2015). The
network is that of the view policy, so that only the method of learning differs. Walks are ε-greedy. A round walks with the last
round's network, which is also the target network, and trains on the walks of all rounds (the replay).

Differences to MVSelect: fusion is by attention instead of the maximum, beliefs are of recognisers that were not trained on the
object, and there is a reward at every step instead of only the last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int

from data_pipeline.progress import console
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models.view_policy import ViewPolicy, utility_of
from mevs_jax.policies.base import Policy
from train.choosing.averaged import Fitted, Fitting, fit_together, mean_losses
from train.choosing.chunks import in_chunks
from train.choosing.features import Features
from train.choosing.policy import Lesson, PolicyConfig, Seen, Trained, joined, learned_policy, new_policy, walk


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
    """Returns beliefs and rewards along some walks, as arrays on the host."""
    same = replace(config, seed=0)  # one program for all seeds
    found = in_chunks(partial(_transitions_of_some, fusion, config=same), (data, walks), 64)
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


def exploring(given: tuple[nnx.State, Array], structure: nnx.GraphDef, share: float) -> Policy:
    """Returns the ε-greedy policy: random scores with probability `share`, else the network's values.

    Args:
        given: weights and temperature of single views.
    """
    greedy = learned_policy(given, structure, by="state")

    def scores(key: Array, state: Any, scene: Any) -> Array:
        whether, drawn = jax.random.split(key)
        any_view = jax.random.uniform(drawn, (scene.graph.points.shape[0],))
        return jnp.where(jax.random.bernoulli(whether, share), any_view, greedy(key, state, scene))

    return scores


@cache
def _exploring(structure: nnx.GraphDef, share: float) -> Callable[..., Policy]:
    """Returns the same function for the same arguments: walks are compiled once for each function."""
    return partial(exploring, structure=structure, share=share)


def train_by_q_learning(
    config: QLearningConfig,
    parts: Sequence[Seen],
    validation: Seen | None = None,
    name: str = "view policy",
) -> Trained:
    """Returns the network after all rounds, for use with `by="state"`, and the losses by round and epoch.

    Arguments are those of `train_policy`.
    """
    return train_all_by_q_learning(config, [Lesson(config.seed, parts, validation, name)])[0]


def train_all_by_q_learning(config: QLearningConfig, lessons: Sequence[Lesson]) -> list[Trained]:
    """Returns for each lesson what `train_by_q_learning` returns; the networks are trained together, as by `train_policies`."""
    networks = [
        new_policy(replace(config, seed=lesson.seed), lesson.parts[0][1].logits.shape[-1], lesson.parts[0][0].posed)
        for lesson in lessons
    ]
    structure, weights = nnx.graphdef(networks[0]), [nnx.state(network) for network in networks]
    replays: list[list[Transitions]] = [[] for _ in lessons]
    replays_for_check: list[list[Transitions]] = [[] for _ in lessons]
    histories: list[list[list[dict[str, float]]]] = [[] for _ in lessons]
    for number in range(config.rounds):
        share = config.exploration if number else 1.0
        policy_of = _exploring(structure, share)
        fittings = []
        for index, lesson in enumerate(lessons):
            key = jax.random.fold_in(jax.random.key(lesson.seed), number)
            new, new_for_check = _walked(config, lesson, weights[index], policy_of, key)
            replays[index] += new
            replays_for_check[index] += new_for_check
            train, check = joined(replays[index]), replays_for_check[index]
            named = f"{lesson.name}, round {number + 1} of {config.rounds},"
            fittings.append((lesson.seed, weights[index], train, joined(check) if check else None, named))
        for index, (found, history) in enumerate(_fit(config, structure, number > 0, fittings)):
            weights[index] = found
            histories[index].append(history)
            console.print(f"{fittings[index][-1]} {len(fittings[index][2].order)} walks: {history[-1]}")
    return [(nnx.merge(structure, own), history) for own, history in zip(weights, histories, strict=True)]


def _walked(
    config: QLearningConfig, lesson: Lesson, weights: nnx.State, policy_of: Callable[..., Policy], key: Array
) -> tuple[list[Transitions], list[Transitions]]:
    """Returns what new walks on a lesson's objects tell, by part, and on its validation objects."""
    found, parts = [], [*lesson.parts] if lesson.validation is None else [*lesson.parts, lesson.validation]
    for part, (fusion, data) in enumerate(parts):
        given, own = (weights, fusion.single), jax.random.fold_in(key, part)
        walks = walk(own, fusion, data, policy_of, given, config.most_seen + 1, config.walks)
        found.append(transitions_along(fusion, data, walks, config))
    return found[: len(lesson.parts)], found[len(lesson.parts) :]


def _fit(
    config: QLearningConfig,
    structure: nnx.GraphDef,
    ahead: bool,
    each: Sequence[tuple[int, nnx.State, Transitions, Transitions | None, str]],
) -> list[Fitted]:
    """Trains networks from their targets' weights; returns new weights and the losses by epoch.

    Args:
        ahead: whether the next state's value counts; not in the first round, where the target is untrained.
        each: for each network its seed, its target's weights, transitions to learn from and for validation, and its name.
    """
    discount = config.discount if ahead else 0.0

    def loss_of(parameters: nnx.State, some: Transitions, key: Array | None, target: nnx.State) -> Array:
        del key
        network, old = (nnx.merge(structure, weights) for weights in (parameters, target))
        return jnp.mean(temporal_difference(network, old, some, discount) ** 2)

    @jax.jit
    def error(mean: nnx.State, some: Transitions, target: nnx.State) -> dict[str, Array]:
        return {"error": loss_of(mean, some, None, target)}

    fittings = []
    for seed, target, train, check, name in each:
        validate = None if check is None else mean_losses(partial(error, target=target), check, 256)
        fittings.append(Fitting(seed, target, train, validate, name, (target,)))
    return fit_together(config, loss_of, fittings, "--learned.q-learning.learning-rate")
