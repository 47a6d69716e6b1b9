"""Training of the view policy on the exact gain of each candidate view.

For objects whose features are known from all candidate views, the belief after a set of views and one more view is one call of
the fusion. So in a state (a set of views seen), the label of a candidate is its gain: by how much it raises the log-probability
of the true class. Encoder and fusion are certain of objects that they were trained on from any view, so those objects would
teach little; labels are of objects that they were not trained on. Later rounds add the states that the policy itself reaches
(DAgger; Ross et al. 2011).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Literal, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from data_pipeline.progress import console
from mevs_jax.beliefs.calibration import class_weights
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.models.view_policy import Utility, ViewPolicy, expected_gain, utility_of
from mevs_jax.policies.base import Policy
from mevs_jax.policies.learned import learned, looking_ahead
from mevs_jax.policies.uninformed import random_view
from mevs_jax.selection.loop import ViewTable, by_attention, select_from_table
from train.choosing.averaged import AveragedConfig, Fitting, fit_together, mean_losses
from train.choosing.chunks import in_chunks
from train.choosing.features import Features

Tree = TypeVar("Tree")
Seen = tuple[CalibratedFusion, Features]
"""Features of some objects, and the fusion of the recogniser that computed them."""
Trained = tuple[ViewPolicy, list[list[dict[str, float]]]]
"""A policy, and the losses of its training by round and epoch."""


@dataclass(frozen=True)
class PolicyConfig(AveragedConfig):
    """Architecture of the view policy, and settings of its training."""

    epochs: int = 8
    """passes over the states, in every round"""
    batch_size: int = 256
    """states in a batch"""
    width: int = 96
    """width of queries and tokens"""
    heads: int = 4
    """heads of attention"""
    blocks: int = 2
    """blocks of attention and feed-forward layers"""
    most_seen: int = 6
    """maximal number of views seen in a state"""
    walks: int = 3
    """walks on each object in a round, each with a state of every size from 1 to most_seen views"""
    candidates: int = 12
    """views not seen yet whose gain is a training label, for each state"""
    rounds: int = 2
    """rounds of training; walks of the first are random, those of later rounds follow the policy of the round before (DAgger)"""
    differences: float = 30.0
    """weight of the errors of differences between candidates, which decide the choice, against errors of the gains themselves"""
    utility: Utility = "log"
    """utility of a belief: the probability of the true class, or its logarithm"""
    floor: float = 0.01
    """added to probabilities before the logarithm, so that one object that is always misjudged does not outweigh all others"""


@flax.struct.dataclass
class Choices:
    """States of walks, and the gain of some candidates in each.

    Attributes:
        belief: log-probabilities of the classes after the views seen.
        views: log-probabilities of the classes by each seen view alone.
        directions: directions of the views seen.
        present: which entries of `views` and `directions` are seen; others are padding.
        candidates: directions of some views not seen.
        gain: gain in utility by each candidate.
        label: true class.
        weight: weight of the state in the loss.
        clouds: embeddings of the partial clouds of the views seen, if used.
    """

    belief: Float[Array, "states classes"]
    views: Float[Array, "states seen classes"]
    directions: Float[Array, "states seen 3"]
    present: Bool[Array, "states seen"]
    candidates: Float[Array, "states candidates 3"]
    gain: Float[Array, "states candidates"]
    label: Int[Array, " states"]
    weight: Float[Array, " states"]
    clouds: Float[Array, "states seen embedding"] | None = None


def graph_of(directions: Float[Array, "views 3"]) -> ViewGraph:
    """Returns a view graph of the directions without neighbours, which learned policies do not use."""
    views = directions.shape[0]
    distances = jnp.arccos(jnp.clip(directions @ directions.T, -1.0, 1.0))
    return ViewGraph(directions, jnp.zeros((views, views), bool), distances)


@partial(jax.jit, static_argnames=("policy_of", "most", "walks"))
def _walk_some(
    some: tuple[Array, Features],
    fusion: CalibratedFusion,
    policy_of: Callable[..., Policy],
    parameters: Any,
    most: int,
    walks: int,
) -> Int[Array, "objects walks most"]:
    policy = policy_of(parameters)

    def of_object(key: Array, one: Features) -> Array:
        graph = graph_of(one.directions)
        table = ViewTable(one.logits, None, None, one.labels, features=one.features, clouds=one.clouds)
        starts, keys = jax.random.split(key)
        start = jax.random.randint(starts, (walks,), 0, one.directions.shape[0])

        def run(key: Array, start: Array) -> Array:
            scene, fuse = table.scene(graph), by_attention(fusion)
            return select_from_table(key, table, scene, policy, start, max_views=most, fuse=fuse).views

        return jax.vmap(run)(jax.random.split(keys, walks), start)

    return jax.vmap(of_object)(*some)


def walk(
    key: Array,
    fusion: CalibratedFusion,
    data: Features,
    policy_of: Callable[..., Policy],
    parameters: Any,
    most: int,
    walks: int,
) -> Int[np.ndarray, "objects walks most"]:
    """Returns the views of walks from random starts.

    Args:
        policy_of: `policy_of(parameters)` is the policy that chooses the views; a static argument of the compiled walk.
        most: views of a walk.
        walks: walks for each object.
    """
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(data.labels)))
    rest = fusion, policy_of, parameters, most, walks
    return in_chunks(lambda some: _walk_some(some, *rest), (keys, data), 64)


@partial(jax.jit, static_argnames="config")
def _choices_of_some(fusion: CalibratedFusion, some: tuple[Features, Array, Array], config: PolicyConfig) -> Choices:
    most, by = some[1].shape[-1], (config.utility, config.floor)

    def of_object(one: Features, walks: Array, candidates: Array) -> Choices:
        single = jax.nn.log_softmax(one.logits / fusion.single, axis=-1)

        def of_state(order: Array, count: Array, candidates: Array) -> Choices:
            present = jnp.arange(most) < count
            features, directions = one.features[order], one.directions[order]
            belief = fusion(features, directions, present)

            def with_one_more(view: Array) -> Array:
                return fusion(
                    jnp.concatenate([features, one.features[view][None]]),
                    jnp.concatenate([directions, one.directions[view][None]]),
                    jnp.concatenate([present, jnp.array([True])]),
                )

            after = jax.vmap(with_one_more)(candidates)
            gain = utility_of(after[:, one.labels], *by) - utility_of(belief[one.labels], *by)
            known = belief, single[order], directions, present, one.directions[candidates]
            clouds = None if one.clouds is None else one.clouds[order]
            return Choices(*known, gain, one.labels, jnp.float32(1), clouds)

        of_walk = jax.vmap(of_state, (None, 0, 0))
        return jax.vmap(of_walk, (0, None, 0))(walks, jnp.arange(1, most + 1), candidates)

    return jax.vmap(of_object)(*some)


def unseen(
    walks: Int[np.ndarray, "objects walks most"], views: int, candidates: int, seed: int
) -> Int[np.ndarray, "objects walks most candidates"]:
    """Returns random views not seen yet for every state of some walks.

    The number of views is `candidates`, or what the longest walk leaves unseen if that is less.
    """
    most = walks.shape[-1]
    drawn = np.random.default_rng(seed).random((*walks.shape, views))
    seen = (walks[..., None, :, None] == np.arange(views)) & np.tri(most, dtype=bool)[:, :, None]
    drawn[seen.any(axis=-2)] = 2
    return np.argsort(drawn, axis=-1)[..., : min(candidates, views - most)].astype(np.int32)


def choices_along(
    fusion: CalibratedFusion,
    data: Features,
    walks: Int[np.ndarray, "objects walks most"],
    candidates: Int[np.ndarray, "objects walks most candidates"],
    config: PolicyConfig,
) -> Choices:
    """Returns every state of some walks with the gain of its candidates, as arrays on the host."""
    same = replace(config, seed=0)  # one program for all seeds
    found = in_chunks(partial(_choices_of_some, fusion, config=same), (data, walks, candidates), 16)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), found)


def policy_loss(network: ViewPolicy, some: Choices, differences: float) -> dict[str, Array]:
    """Returns the terms of the loss, which are to be added: squared errors, averaged over candidates.

    * `gain`: of the predicted gain.
    * `gain_if`: of the predicted gain given the true class.
    * `differences`: of the gain minus the candidates' mean gain, both for the prediction given the true class and for its mean
      over the belief; multiplied by `differences`.

    Errors are squared because the mean of a gain is to be predicted: an informative view changes the belief little in most cases
    and much in some. Most of the variance of a gain is how hard the object is, the same for all next views; without the term of
    differences, a network learns that first.
    """
    gain, gain_if = network(some.belief, some.views, some.directions, some.present, some.candidates, some.clouds)
    own = jnp.take_along_axis(gain_if, some.label[:, None, None], axis=2)[:, :, 0]
    weight = some.weight[:, None] / jnp.sum(some.weight)

    def error(found: Array, true: Array) -> Array:
        return jnp.mean(jnp.sum(weight * (found - true) ** 2, axis=0))

    def beside_the_mean(gain: Array) -> Array:
        return gain - jnp.mean(gain, axis=1, keepdims=True)

    true = beside_the_mean(some.gain)
    compared = [error(beside_the_mean(found), true) for found in (own, expected_gain(some.belief, gain_if))]
    return {
        "gain": error(gain, some.gain),
        "gain_if": error(own, some.gain),
        "differences": differences * (compared[0] + compared[1]),
    }


By = Literal["belief", "state", "table", "ahead"]
"""How a view policy scores candidates: the options of `mevs_jax.policies.learned.learned`, or "ahead" for `looking_ahead`."""


def learned_policy(given: tuple[nnx.State, Array], structure: nnx.GraphDef, by: By = "belief") -> Policy:
    """Returns the policy `learned` or `looking_ahead` of a network.

    Args:
        given: weights and temperature of single views, which may be arguments of a compiled program.
        structure: graph definition of the network.
        by: how candidates are scored.
    """
    network, temperature = nnx.merge(structure, given[0]), given[1]
    return looking_ahead(network, temperature) if by == "ahead" else learned(network, temperature, by=by)


def new_policy(config: PolicyConfig, classes: int, posed: bool = True, cloud: int = 0) -> ViewPolicy:
    """Returns a view policy with random weights; `posed` and `cloud` as of `ViewPolicy`."""
    return ViewPolicy(
        classes,
        width=config.width,
        heads=config.heads,
        blocks=config.blocks,
        cloud=cloud,
        posed=posed,
        utility=config.utility,
        floor=config.floor,
        rngs=nnx.Rngs(config.seed),
    )


def train_policy(
    config: PolicyConfig,
    parts: Sequence[Seen],
    validation: Seen | None = None,
    name: str = "view policy",
) -> Trained:
    """Returns the policy after all rounds, and the losses by round and epoch.

    Args:
        parts: objects to learn from, each part with features and fusion of a recogniser that was trained without it.
        validation: other objects, which decide which epoch is best; if None, the last epoch is taken.
        name: name of the policy, for messages.

    Raises:
        Diverged: if a loss or a weight is infinite or NaN.
    """
    return train_policies(config, [Lesson(config.seed, parts, validation, name)])[0]


@dataclass(frozen=True)
class Lesson:
    """What one of several policies that are trained together learns from.

    Attributes:
        seed: of its weights, walks and batches.
        parts, validation, name: as of `train_policy`.
    """

    seed: int
    parts: Sequence[Seen]
    validation: Seen | None
    name: str


def train_policies(config: PolicyConfig, lessons: Sequence[Lesson]) -> list[Trained]:
    """Returns for each lesson what `train_policy` returns; the policies are trained together (`fit_together`).

    Args:
        config: of all policies; each lesson has a seed of its own.
        lessons: all with as many objects, views and parts.
    """
    configs = [replace(config, seed=lesson.seed) for lesson in lessons]
    policies: list[ViewPolicy | None] = [None] * len(lessons)
    gathered: list[list[Choices]] = [[] for _ in lessons]
    gathered_for_check: list[list[Choices]] = [[] for _ in lessons]
    histories: list[list[list[dict[str, float]]]] = [[] for _ in lessons]
    for number in range(config.rounds):
        each = []
        for index, (own, lesson) in enumerate(zip(configs, lessons, strict=True)):
            guide, parts = policies[index], lesson.parts
            gathered[index] += [_gather(seen, guide, own, (number, part)) for part, seen in enumerate(parts)]
            if lesson.validation is not None:
                gathered_for_check[index].append(_gather(lesson.validation, guide, own, (number, len(parts))))
            train, check = _balanced(joined(gathered[index])), gathered_for_check[index]
            each.append((own, lesson, train, _balanced(joined(check)) if check else None))
        fitted = _fit(config, each, f"round {number + 1} of {config.rounds}")
        for index, (policy, history) in enumerate(fitted):
            policies[index] = policy
            histories[index].append(history)
            last = ", ".join(f"{name} {value:.4f}" for name, value in history[-1].items())
            console.print(
                f"{lessons[index].name}, round {number + 1} of {config.rounds}, {len(each[index][2].label)} states: {last}"
            )
    trained = zip(configs, lessons, policies, histories, strict=True)
    return [(policy or _untrained(own, lesson), history) for own, lesson, policy, history in trained]


def _untrained(config: PolicyConfig, lesson: Lesson) -> ViewPolicy:
    fusion, data = lesson.parts[0]
    cloud = 0 if data.clouds is None else data.clouds.shape[-1]
    return new_policy(config, data.logits.shape[-1], fusion.posed, cloud)


def _fit(
    config: PolicyConfig,
    each: Sequence[tuple[PolicyConfig, Lesson, Choices, Choices | None]],
    when: str,
) -> list[tuple[ViewPolicy, list[dict[str, float]]]]:
    """Returns trained networks of their best epoch, or of the last without validation states, and their losses by epoch.

    Args:
        each: for each policy its settings, lesson, states to learn from and validation states.
        when: the round, for messages.
    """
    networks = [_untrained(own, lesson) for own, lesson, _, _ in each]
    structure = nnx.graphdef(networks[0])

    def loss_of(parameters: nnx.State, some: Choices, key: Array) -> Array:
        del key
        errors = policy_loss(nnx.merge(structure, parameters), some, config.differences)
        return sum(errors.values(), jnp.float32(0))

    @jax.jit
    def check(mean: nnx.State, some: Choices) -> dict[str, Array]:
        return policy_loss(nnx.merge(structure, mean), some, config.differences)

    fittings = [
        Fitting(
            own.seed,
            nnx.state(network),
            train,
            None if validation is None else mean_losses(check, validation, 1024),
            f"{lesson.name}, {when},",
        )
        for network, (own, lesson, train, validation) in zip(networks, each, strict=True)
    ]
    fitted = fit_together(config, loss_of, fittings, "--learned.policy.learning-rate")
    return [(nnx.merge(structure, best), history) for best, history in fitted]


def _gather(seen: Seen, guide: ViewPolicy | None, config: PolicyConfig, number: tuple[int, int]) -> Choices:
    """Returns every state of new walks on some objects, with the gain of random candidates.

    Args:
        guide: the policy that chooses the views of the walks; random views if None.
        number: numbers of the round and the part, which seed the walks and candidates.
    """
    (fusion, data), (round_number, part) = seen, number
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), round_number), part)
    policy_of: Callable[..., Policy] = _at_random if guide is None else _guided(nnx.graphdef(guide))
    given = (None if guide is None else nnx.state(guide)), fusion.single
    views = walk(key, fusion, data, policy_of, given, config.most_seen, config.walks)
    candidates = unseen(views, data.features.shape[1], config.candidates, config.seed + 100 * round_number + part)
    return choices_along(fusion, data, views, candidates, config)


def _at_random(_: Any) -> Policy:
    return random_view


@cache
def _guided(structure: nnx.GraphDef) -> Callable[..., Policy]:
    """Returns the same function for the same structure: walks are compiled once per function, not once per set of weights."""
    return partial(learned_policy, structure=structure)


def _balanced(choices: Choices) -> Choices:
    """Returns the states with weights that give every class the same total weight."""
    return replace(choices, weight=class_weights(choices.label, choices.belief.shape[-1]))


def joined(parts: Sequence[Tree]) -> Tree:
    """Returns trees of arrays on the host, concatenated along the first axis."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
