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
from pathlib import Path
from typing import Any, Generic, TypeVar

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
from mevs_jax.policies.base import Policy, as_tree
from mevs_jax.policies.learned import of_network
from mevs_jax.policies.uninformed import random_view
from mevs_jax.selection.loop import ViewTable, by_attention
from mevs_jax.selection.walks import walks_around
from train.choosing.averaged import AveragedConfig, Fitting, fit_together, mean_losses
from train.choosing.features import Features
from train.running.over_objects import over_objects

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


def _walks_of(
    one: tuple[Int[Array, ""], Features],
    key: Array,
    drawn: Array,
    fusion: CalibratedFusion,
    policy: Policy,
    *,
    most: int,
    walks: int,
) -> Int[Array, "walks most"]:
    number, data = one
    table = ViewTable(data.logits, None, None, data.labels, features=data.features, clouds=data.clouds)
    starts = jax.random.randint(jax.random.fold_in(drawn, number), (walks,), 0, len(data.directions))
    scene, each = table.scene(graph_of(data.directions)), (number, starts, jnp.arange(walks))
    return walks_around(key, table.observe, scene, policy, each, max_views=most, fuse=by_attention(fusion)).views


def walk(
    key: Array, fusion: CalibratedFusion, data: Features, policy: Policy, most: int, walks: int
) -> Int[np.ndarray, "objects walks most"]:
    """Returns the views of walks from random starts.

    Args:
        policy: chooses the views.
        most: views of a walk.
        walks: walks for each object.
    """
    objects, (key, drawn) = (np.arange(len(data.labels)), data), jax.random.split(key)
    shared = key, drawn, fusion, as_tree(policy)
    return over_objects(_walks_of, objects, *shared, at_once=64, by_all=True, most=most, walks=walks)


def _choices_of(
    one: tuple[Features, Int[Array, "walks most"], Int[Array, "walks most candidates"]],
    fusion: CalibratedFusion,
    *,
    config: PolicyConfig,
) -> Choices:
    (data, walks, candidates), by = one, (config.utility, config.floor)
    most, single = walks.shape[-1], jax.nn.log_softmax(data.logits / fusion.single, axis=-1)

    def of_state(order: Array, count: Array, candidates: Array) -> Choices:
        present = jnp.arange(most) < count
        features, directions = data.features[order], data.directions[order]
        belief = fusion(features, directions, present)

        def with_one_more(view: Array) -> Array:
            return fusion(
                jnp.concatenate([features, data.features[view][None]]),
                jnp.concatenate([directions, data.directions[view][None]]),
                jnp.concatenate([present, jnp.array([True])]),
            )

        after = jax.vmap(with_one_more)(candidates)
        gain = utility_of(after[:, data.labels], *by) - utility_of(belief[data.labels], *by)
        known = belief, single[order], directions, present, data.directions[candidates]
        clouds = None if data.clouds is None else data.clouds[order]
        return Choices(*known, gain, data.labels, jnp.float32(1), clouds)

    of_walk = jax.vmap(of_state, (None, 0, 0))
    return jax.vmap(of_walk, (0, None, 0))(walks, jnp.arange(1, most + 1), candidates)


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
    found = over_objects(_choices_of, (data, walks, candidates), fusion, at_once=16, by_all=True, config=same)
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


@dataclass(frozen=True)
class Lesson:
    """What one of several policies that are trained together learns from.

    Attributes:
        seed: of its weights, walks and batches.
        parts: objects to learn from, each part with features and fusion of a recogniser that was trained without it.
        validation: other objects, which decide which epoch is best; if None, the last epoch is taken.
        name: of the policy, for messages.
    """

    seed: int
    parts: Sequence[Seen]
    validation: Seen | None = None
    name: str = "view policy"


def train_policies(config: PolicyConfig, lessons: Sequence[Lesson], folder: Path | None = None) -> list[Trained]:
    """Returns for each lesson the policy after all rounds, and its losses by round and epoch.

    The policies are trained together (`fit_together`).

    Args:
        config: of all policies; each lesson has a seed of its own.
        lessons: all with as many objects, views and parts.
        folder: where the state is kept after every round and after SIGTERM, from which the training goes on; None for nowhere.

    Raises:
        Diverged: if a loss or a weight is infinite or NaN.
        Preempted: after SIGTERM, once the state is saved.
    """
    return in_rounds(config, lessons, folder, _gather, _fit)


Samples = TypeVar("Samples")


@dataclass(frozen=True)
class Round(Generic[Samples]):
    """What a policy learns from in one round of its training.

    Attributes:
        name: of the policy and the round, for messages.
        config: settings, with the seed of the policy.
        untrained: its network with random weights.
        before: its network after the round before; None in the first.
        train, check: samples to learn from, and those of validation objects, if there are any.
    """

    name: str
    config: Any
    untrained: ViewPolicy
    before: ViewPolicy | None
    train: Samples
    check: Samples | None


Gather = Callable[[Seen, ViewPolicy | None, Any, tuple[int, int]], Samples]
"""What new walks on some objects tell, by the network of the round before; the numbers of round and part seed them."""
Fit = Callable[[Any, Sequence[Round[Samples]], Path | None], list[tuple[ViewPolicy, list[dict[str, float]]]]]
"""Networks of the best epoch, or of the last without validation samples, and their losses by epoch; kept in a file if given."""


def in_rounds(
    config: Any, lessons: Sequence[Lesson], folder: Path | None, gather: Gather[Samples], fit: Fit[Samples]
) -> list[Trained]:
    """Returns for each lesson the network after all rounds. Every round gathers samples, and trains on those of all rounds."""
    configs = [replace(config, seed=lesson.seed) for lesson in lessons]
    untrained = [_untrained(own, lesson) for own, lesson in zip(configs, lessons, strict=True)]
    networks: list[ViewPolicy | None] = [None] * len(lessons)
    train: list[list[Samples]] = [[] for _ in lessons]
    check: list[list[Samples]] = [[] for _ in lessons]
    histories: list[list[list[dict[str, float]]]] = [[] for _ in lessons]
    for number in range(config.rounds):
        rounds = []
        for index, lesson in enumerate(lessons):
            guide, own, parts = networks[index], configs[index], lesson.parts
            train[index] += [gather(seen, guide, own, (number, part)) for part, seen in enumerate(parts)]
            if lesson.validation is not None:
                check[index].append(gather(lesson.validation, guide, own, (number, len(parts))))
            samples = joined(train[index]), joined(check[index]) if check[index] else None
            name = f"{lesson.name}, round {number + 1} of {config.rounds},"
            rounds.append(Round(name, own, untrained[index], guide, *samples))
        kept = None if folder is None else folder / f"round_{number + 1}.npz"
        for index, (network, history) in enumerate(fit(config, rounds, kept)):
            networks[index] = network
            histories[index].append(history)
            last = ", ".join(f"{name} {value:.4f}" for name, value in history[-1].items())
            console.print(f"{rounds[index].name} {len(jax.tree.leaves(rounds[index].train)[0])} samples: {last}")
    trained = zip(networks, untrained, histories, strict=True)
    return [(network or before, history) for network, before, history in trained]


def _untrained(config: PolicyConfig, lesson: Lesson) -> ViewPolicy:
    fusion, data = lesson.parts[0]
    cloud = 0 if data.clouds is None else data.clouds.shape[-1]
    return new_policy(config, data.logits.shape[-1], fusion.posed, cloud)


def _fit(
    config: PolicyConfig, rounds: Sequence[Round[Choices]], kept: Path | None
) -> list[tuple[ViewPolicy, list[dict[str, float]]]]:
    """Trains networks from the same random weights in every round."""
    structure = nnx.graphdef(rounds[0].untrained)

    def loss_of(parameters: nnx.State, some: Choices, key: Array) -> Array:
        del key
        errors = policy_loss(nnx.merge(structure, parameters), some, config.differences)
        return sum(errors.values(), jnp.float32(0))

    @jax.jit
    def check(mean: nnx.State, some: Choices) -> dict[str, Array]:
        return policy_loss(nnx.merge(structure, mean), some, config.differences)

    fittings = [
        Fitting(
            one.config.seed,
            nnx.state(one.untrained),
            _balanced(one.train),
            None if one.check is None else mean_losses(check, _balanced(one.check), 1024),
            one.name,
        )
        for one in rounds
    ]
    fitted = fit_together(config, loss_of, fittings, "--learned.policy.learning-rate", kept)
    return [(nnx.merge(structure, best), history) for best, history in fitted]


def _gather(seen: Seen, guide: ViewPolicy | None, config: PolicyConfig, number: tuple[int, int]) -> Choices:
    """Returns every state of new walks on some objects, with the gain of random candidates; the first walks are random."""
    (fusion, data), (round_number, part) = seen, number
    policy = random_view if guide is None else of_network(guide, fusion.single)
    views = walk(round_key(config, number), fusion, data, policy, config.most_seen, config.walks)
    candidates = unseen(views, data.features.shape[1], config.candidates, config.seed + 100 * round_number + part)
    return choices_along(fusion, data, views, candidates, config)


def round_key(config: PolicyConfig, number: tuple[int, int]) -> Array:
    """Returns the key of the walks of a round and part."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), number[0]), number[1])


def _balanced(choices: Choices) -> Choices:
    """Returns the states with weights that give every class the same total weight."""
    return replace(choices, weight=class_weights(choices.label, choices.belief.shape[-1]))


def joined(parts: Sequence[Tree]) -> Tree:
    """Returns trees of arrays on the host, concatenated along the first axis."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
