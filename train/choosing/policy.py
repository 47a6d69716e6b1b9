"""Training of the view policy on what looking was worth: exact, and free, since every view of a training object is at hand.

For objects whose features are known from all candidate views, the belief after any set of views and one more is one call of
the fusion. So for a state (a set seen) each candidate's label is by how much it raises the true class's log-probability. Encoder
and fusion that trained on an object are sure of it from any view, and there would be little to learn: labels are of objects that
they were not trained on. Later rounds add the states to which the policy itself leads (DAgger; Ross et al. 2011).
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
from mevs_jax.beliefs import CalibratedFusion
from mevs_jax.calibration import class_weights
from mevs_jax.models.view_policy import Utility, ViewPolicy, expected_gain, utility_of
from mevs_jax.policies.base import Policy
from mevs_jax.policies.learned import learned, looking_ahead
from mevs_jax.policies.uninformed import random_view
from mevs_jax.selection import ViewTable, by_attention, select_from_table
from mevs_jax.viewpoints import ViewGraph
from train.choosing.averaged import AveragedConfig, fit_averaged, mean_losses
from train.choosing.chunks import in_chunks
from train.choosing.features import Features

Tree = TypeVar("Tree")
Seen = tuple[CalibratedFusion, Features]
"""Objects, as a recogniser sees and fuses them."""


@dataclass(frozen=True)
class PolicyConfig(AveragedConfig):
    """The view policy and its training."""

    epochs: int = 8
    """looks at each state, in every round"""
    batch_size: int = 256
    """states in a batch"""
    width: int = 96
    """of queries and tokens"""
    heads: int = 4
    """of attention"""
    blocks: int = 2
    """of attention and layers"""
    most_seen: int = 6
    """views in a state at most"""
    walks: int = 3
    """walks on each object in a round, each through states of 1 to most_seen views"""
    candidates: int = 12
    """views not seen yet that a state is asked about"""
    rounds: int = 2
    """the first walks at random, the others as the policy of the round before says (DAgger)"""
    differences: float = 30.0
    """how much errors of differences between candidates count, on which the choice depends, beside those of what each brings"""
    utility: Utility = "log"
    """what a belief is worth: the true class's probability, or its logarithm"""
    floor: float = 0.01
    """added to probabilities in logarithms: one object that all are wrong about must not outweigh all others"""


@flax.struct.dataclass
class Choices:
    """States, and what each candidate would bring there.

    Attributes:
        belief: log-probabilities of what was seen.
        views: log-probabilities of each view seen alone.
        directions: of the views seen.
        present: which of them there are.
        candidates: directions of some views that were not seen.
        gain: in utility that each brings.
        label: the true class.
        weight: how much the state counts.
        clouds: embeddings of the partial clouds of the views seen, where they are used.
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
    """Candidates without neighbours, which policies that learn do not ask for."""
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
    """Views along walks from starts drawn at random, by `policy_of(parameters)`."""
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(data.labels)))
    rest = fusion, policy_of, parameters, most, walks
    return in_chunks(lambda some: _walk_some(some, *rest), (keys, data), 64)


@partial(jax.jit, static_argnames="config")
def _choices_of_some(fusion: CalibratedFusion, some: tuple[Features, Array, Array], config: PolicyConfig) -> Choices:
    most, by = some[1].shape[-1], (config.utility, config.floor)

    def of_object(one: Features, walks: Array, asked: Array) -> Choices:
        single = jax.nn.log_softmax(one.logits / fusion.single, axis=-1)

        def of_state(order: Array, count: Array, asked: Array) -> Choices:
            present = jnp.arange(most) < count
            features, directions = one.features[order], one.directions[order]
            belief = fusion(features, directions, present)

            def with_one_more(view: Array) -> Array:
                return fusion(
                    jnp.concatenate([features, one.features[view][None]]),
                    jnp.concatenate([directions, one.directions[view][None]]),
                    jnp.concatenate([present, jnp.array([True])]),
                )

            after = jax.vmap(with_one_more)(asked)
            gain = utility_of(after[:, one.labels], *by) - utility_of(belief[one.labels], *by)
            known = belief, single[order], directions, present, one.directions[asked]
            clouds = None if one.clouds is None else one.clouds[order]
            return Choices(*known, gain, one.labels, jnp.float32(1), clouds)

        of_walk = jax.vmap(of_state, (None, 0, 0))
        return jax.vmap(of_walk, (0, None, 0))(walks, jnp.arange(1, most + 1), asked)

    return jax.vmap(of_object)(*some)


def unseen(
    walks: Int[np.ndarray, "objects walks most"], views: int, candidates: int, seed: int
) -> Int[np.ndarray, "objects walks most candidates"]:
    """For every state along some walks a random choice of the views that were not seen yet, fewer where there are fewer."""
    most = walks.shape[-1]
    drawn = np.random.default_rng(seed).random((*walks.shape, views))
    seen = (walks[..., None, :, None] == np.arange(views)) & np.tri(most, dtype=bool)[:, :, None]
    drawn[seen.any(axis=-2)] = 2
    return np.argsort(drawn, axis=-1)[..., : min(candidates, views - most)].astype(np.int32)


def choices_along(
    fusion: CalibratedFusion,
    data: Features,
    walks: Int[np.ndarray, "objects walks most"],
    asked: Int[np.ndarray, "objects walks most candidates"],
    config: PolicyConfig,
) -> Choices:
    """Every state along some walks, with what each candidate `asked` about would bring there; arrays of the host."""
    found = in_chunks(partial(_choices_of_some, fusion, config=config), (data, walks, asked), 16)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), found)


def policy_loss(network: ViewPolicy, some: Choices, differences: float) -> dict[str, Array]:
    """The parts of the loss, to be added: means over candidates of squared errors.

    Of the gain that is expected, without and with knowing the true class; and, so many times, of how much more each candidate
    brings than all do on average, with knowing it and by the belief. Squared, because the mean is wanted: a telling view changes
    little most of the time and much now and then. Most of a gain's variance is how hard the object is, whichever view comes next:
    without the differences that is what a network learns first.
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
"""How a view policy is asked: as `learned` has it, or two views ahead."""


def learned_policy(given: tuple[nnx.State, Array], structure: nnx.GraphDef, by: By = "belief") -> Policy:
    """`learned` or `looking_ahead` of a network's weights and the temperature of single views, which a compiled program takes as
    arguments."""
    network, temperature = nnx.merge(structure, given[0]), given[1]
    return looking_ahead(network, temperature) if by == "ahead" else learned(network, temperature, by=by)


def new_policy(config: PolicyConfig, classes: int, posed: bool = True, cloud: int = 0) -> ViewPolicy:
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


def _fit(
    config: PolicyConfig, network: ViewPolicy, train: Choices, validation: Choices | None
) -> tuple[ViewPolicy, list]:
    """The weights of the best epoch, or of the last where there are no validation states."""
    structure, parameters = nnx.split(network)

    def loss_of(parameters: nnx.State, some: Choices, key: Array) -> Array:
        del key
        errors = policy_loss(nnx.merge(structure, parameters), some, config.differences)
        return sum(errors.values(), jnp.float32(0))

    @jax.jit
    def check(mean: nnx.State, some: Choices) -> dict[str, Array]:
        return policy_loss(nnx.merge(structure, mean), some, config.differences)

    validate = None if validation is None else mean_losses(check, validation, 1024)
    best, history = fit_averaged(config, loss_of, parameters, train, validate)
    return nnx.merge(structure, best), history


def train_policy(
    config: PolicyConfig,
    parts: Sequence[Seen],
    validation: Seen | None = None,
) -> tuple[ViewPolicy, list[list[dict[str, float]]]]:
    """The policy after all rounds, and losses by round and epoch.

    Args:
        parts: objects to learn from, each part as seen and fused by a recogniser that was trained without it.
        validation: other objects, that say which epoch is best; without, the last is.
    """
    fusion, data = parts[0]
    cloud = 0 if data.clouds is None else data.clouds.shape[-1]
    untrained = partial(new_policy, config, data.logits.shape[-1], fusion.posed, cloud)
    policy, histories = untrained(), []
    gathered: list[Choices] = []
    gathered_for_check: list[Choices] = []
    for number in range(config.rounds):
        guide = policy if number else None
        gathered += [_gather(seen, guide, config, (number, part)) for part, seen in enumerate(parts)]
        if validation is not None:
            gathered_for_check.append(_gather(validation, guide, config, (number, len(parts))))
        train = _balanced(joined(gathered))
        check = _balanced(joined(gathered_for_check)) if gathered_for_check else None
        policy, history = _fit(config, untrained(), train, check)
        histories.append(history)
        last = ", ".join(f"{name} {value:.4f}" for name, value in history[-1].items())
        console.print(f"Round {number + 1} of {config.rounds}, {len(train.label)} states: {last}")
    return policy, histories


def _gather(seen: Seen, guide: ViewPolicy | None, config: PolicyConfig, number: tuple[int, int]) -> Choices:
    """Every state along walks on some objects, as a policy says or at random, and what candidates would bring there.

    Args:
        number: of the round and the part, so that others draw other walks and candidates.
    """
    (fusion, data), (turn, part) = seen, number
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), turn), part)
    policy_of: Callable[..., Policy] = _at_random if guide is None else _guided(nnx.graphdef(guide))
    given = (None if guide is None else nnx.state(guide)), fusion.single
    views = walk(key, fusion, data, policy_of, given, config.most_seen, config.walks)
    asked = unseen(views, data.features.shape[1], config.candidates, config.seed + 100 * turn + part)
    return choices_along(fusion, data, views, asked, config)


def _at_random(_: Any) -> Policy:
    return random_view


@cache
def _guided(structure: nnx.GraphDef) -> Callable[..., Policy]:
    """One function for all weights: walks are compiled for each."""
    return partial(learned_policy, structure=structure)


def _balanced(choices: Choices) -> Choices:
    """Weighted so that every class counts the same."""
    return replace(choices, weight=class_weights(choices.label, choices.belief.shape[-1]))


def joined(parts: Sequence[Tree]) -> Tree:
    """Trees of arrays of the host, one behind the other."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
