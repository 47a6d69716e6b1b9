"""The policies of the study of learned view selection, and their walks from every start view with the same fusion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int

from eval.learned.poses import UnknownPose
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.models import ViewPolicy
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.policies.base import Knowledge, Policy
from mevs_jax.policies.informed import expected_views
from mevs_jax.policies.oracles import fused_oracle
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection.loop import ViewTable, by_attention, select_from_table, sum_of_logits
from mevs_jax.trained.system import EXPECTED_VIEWS
from train.choosing.chunks import in_chunks
from train.choosing.features import Features
from train.choosing.policy import By, learned_policy

_WALKS_AT_ONCE = 2**11
_SCORES_AT_ONCE = 2**26
"""Hypotheses of class and pose × views × walks: about one gigabyte of temporary arrays."""


@dataclass(frozen=True)
class OnLattice:
    """Objects of a split on one lattice of candidate views.

    Attributes:
        features: of every view.
        predicted_entropy: (objects, views, views) predicted normalised entropies, if known; row i after seeing view i.
        entropy: (objects, views) true normalised entropies, if known.
        neighbours: pairs of neighbouring views, if the viewpoints have neighbours of their own (`ViewGraph.from_points`).
    """

    features: Features
    predicted_entropy: np.ndarray | None = None
    entropy: np.ndarray | None = None
    neighbours: list[list[int]] | None = None

    def table(self) -> ViewTable:
        predicted_entropy, entropy = (
            None if known is None else jnp.asarray(known) for known in (self.predicted_entropy, self.entropy)
        )
        data = self.features
        return ViewTable(
            data.logits, predicted_entropy, entropy, data.labels, features=data.features, clouds=data.clouds
        )


Used = Literal["predicted_entropy", "entropy", "clouds", "knowledge"]


@dataclass(frozen=True)
class Contender:
    """A policy in the study.

    Attributes:
        name: its name in `metrics.json`.
        title: its name in the report.
        knows: a key of `eval.walks.ladder.KNOWS`.
        policy_of: function from parameters to the policy.
        believes: whether it uses the belief; a policy that does not walks without fusion.
        draws: walks from each start view.
        max_views: length of its walks; 0 for that of the study.
        every: it walks from every n-th start view.
        uses: what it is given besides the views seen, and the truth. Programs are shared by data sets that differ in the rest.
    """

    name: str
    title: str
    knows: str
    policy_of: Callable[[Any], Policy]
    believes: bool = True
    draws: int = 1
    max_views: int = 0
    every: int = 1
    uses: tuple[Used, ...] = ()


@dataclass(frozen=True)
class Learner:
    """A trained view policy in the study; `name` and `title` are as in `Contender`."""

    name: str
    title: str
    network: ViewPolicy
    by: By = "belief"
    made_as: str = ""
    """name of the variant under which the network was trained"""
    fusion: CalibratedFusion | None = None
    """its own fusion, if it differs from that of the study"""


def _named(_: Any, name: str) -> Policy:
    return POLICIES[name]


# Walks are compiled once for each `policy_of`: it has to be the same object for all seeds, splits and data sets.


@cache
def _policy_named(name: str) -> Callable[[Any], Policy]:
    return partial(_named, name=name)


@cache
def _policy_learned(structure: nnx.GraphDef, by: By) -> Callable[[Any], Policy]:
    return partial(learned_policy, structure=structure, by=by)


@cache
def _policy_of_truth(by: str) -> Callable[[Any], Policy]:
    return partial(_oracle, by=by)


def _by_name(name: str, title: str, knows: str, *uses: Used) -> Contender:
    """A registered policy that does not use the belief."""
    return Contender(name, title, knows, _policy_named(name), believes=False, uses=uses)


def random_walker(draws: int) -> Contender:
    return replace(_by_name("random", "random", "nothing"), draws=draws)


def walker(learner: Learner) -> Contender:
    """The contender of a learner; its parameters are those of `policy_parameters`."""
    policy_of = _policy_learned(nnx.graphdef(learner.network), learner.by)
    uses: tuple[Used, ...] = ("clouds", "knowledge") if learner.by in ("table", "ahead") else ("clouds",)
    return Contender(learner.name, learner.title, "learned", policy_of, uses=uses)


def policy_parameters(learner: Learner, fusion: CalibratedFusion) -> tuple[nnx.State, Array]:
    """The parameters of the learner's policy: the network's weights and the temperature of single views."""
    return nnx.state(learner.network, nnx.Param), fusion.single


def _oracle(fusion: CalibratedFusion, by: Any) -> Policy:
    return fused_oracle(fusion, by=by)


Known = Knowledge | ExpectedViews | UnknownPose | None
"""What policies know about other objects."""


def _at(known: Known, directions: Float[Array, "views 3"]) -> Knowledge | None:
    """What is known about the views of one object."""
    if isinstance(known, ExpectedViews):
        return Knowledge(expected_logits=known.at(directions))
    return known.knowledge if isinstance(known, UnknownPose) else known


@partial(jax.jit, static_argnames=("contender", "max_views"))
def _walk_some(
    some: tuple[Array, ViewTable, Array],
    contender: Contender,
    parameters: Any,
    fusion: CalibratedFusion,
    graph: ViewGraph,
    knowledge: Known,
    max_views: int,
) -> Int[Array, "objects walks steps"]:
    starts = jnp.arange(0, graph.points.shape[0], contender.every)
    policy, fuse = contender.policy_of(parameters), by_attention(fusion) if contender.believes else sum_of_logits

    def of_object(key: Array, table: ViewTable, directions: Array) -> Array:
        if isinstance(knowledge, UnknownPose) and table.features is not None:
            table = replace(table, pose_evidence=knowledge.evidence(table.features, directions))
        scene = table.scene(replace(graph, points=directions), _at(knowledge, directions))

        def run(key: Array, start: Array) -> Array:
            return select_from_table(key, table, scene, policy, start, max_views=max_views, fuse=fuse).views

        keys = jax.random.split(key, len(starts) * contender.draws)
        return jax.vmap(run)(keys, starts.repeat(contender.draws))

    return jax.vmap(of_object)(*some)


def _most_at_once(contender: Contender) -> int:
    """How many walks are computed together. Networks are faster on a CPU if what they compute of all of them fits its cache."""
    if not contender.believes or jax.default_backend() != "cpu":
        return _WALKS_AT_ONCE
    return _WALKS_AT_ONCE // (32 if contender.knows == "truth" else 8)  # oracles fuse the views once for each candidate


def walk_all(
    key: Array,
    contender: Contender,
    parameters: Any,
    fusion: CalibratedFusion,
    tables: ViewTable,
    directions: Float[AnyArray, "objects views 3"],
    knowledge: Known,
    max_views: int,
    neighbours: list[list[int]] | None = None,
) -> Int[np.ndarray, "objects walks steps"]:
    """The views of walks, `contender.draws` from each of its start views.

    Args:
        directions: unit vectors to the views; the angles between views must be the same for all objects.
        knowledge: about other objects; `ExpectedViews` are evaluated at the directions of each object.
        neighbours: pairs of neighbouring views; those of the Delaunay graph if None.
    """
    graph = ViewGraph.from_points(np.asarray(directions[0], np.float64), neighbours)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(tables.label)))
    optional: tuple[Used, ...] = "predicted_entropy", "entropy", "clouds"
    unused: dict[str, Any] = {name: None for name in optional if name not in contender.uses}
    tables = replace(tables, features=tables.features if contender.believes else None, **unused)
    knowledge = knowledge if "knowledge" in contender.uses else None
    unnamed = replace(contender, name="", title="", knows="", max_views=0, uses=())  # what a program depends on
    rest = unnamed, parameters, fusion, graph, knowledge, max_views
    most = _most_at_once(contender)
    if isinstance(knowledge, UnknownPose):  # each walk scores every view under every hypothesis
        most = min(most, max(1, _SCORES_AT_ONCE // knowledge.hypotheses // len(graph.points)))
    at_once = max(1, most * contender.every // (len(graph.points) * contender.draws))
    return in_chunks(lambda some: _walk_some(some, *rest), (keys, tables, directions), at_once)


@jax.jit
def _beliefs_of_some(fusion: CalibratedFusion, some: tuple[Features, Array]) -> Array:
    def of_object(one: Features, walks: Array) -> Array:
        def after(views: Array) -> Array:
            return fusion(one.features[views], one.directions[views], jnp.ones(views.shape, bool))

        return jnp.stack([after(walks[:, :count]) for count in range(1, walks.shape[1] + 1)], axis=1)

    return jax.vmap(of_object)(*some)


def beliefs_of(
    fusion: CalibratedFusion, data: Features, views: Int[np.ndarray, "objects walks steps"]
) -> Float[np.ndarray, "objects walks steps classes"]:
    """Log-probabilities after each view of each walk."""
    return in_chunks(partial(_beliefs_of_some, fusion), (data, views), max(1, 1024 // views.shape[1]))


def _by_expected_views(_: Any) -> Policy:
    return expected_views


def by_expected_views() -> Contender:
    """Information gain by what the recogniser is expected to say; over class and pose if the pose of objects is unknown."""
    title = "information gain by expected views"
    return Contender(EXPECTED_VIEWS, title, "others", _by_expected_views, uses=("knowledge",))


def contenders(
    learners: Sequence[Learner],
    draws: int,
    oracle_views: int,
    oracle_starts: int,
    *,
    entropies: bool,
    shared: bool,
    expected: bool,
) -> list[Contender]:
    """All policies of the study, in the order of the tables.

    Args:
        learners: the trained policies.
        draws: walks of random policies from each start view.
        oracle_views, oracle_starts: oracles take this many views, from every n-th start view.
        entropies: whether predicted and true depth entropies are known.
        shared: whether all objects have the same candidate views in a known pose; only then is there a fixed order of views.
        expected: whether it is known what the recogniser is expected to say of each class, from every direction.
    """
    found = [random_walker(draws), _by_name("farthest", "farthest from those seen", "nothing")]
    if entropies:
        found.append(_by_name("predicted_entropy", "PointNet++ entropy (thesis)", "networks", "predicted_entropy"))
    if shared:
        found.append(_by_name("fixed_order", "best fixed order", "others", "knowledge"))
    if expected:
        found.append(by_expected_views())
    found += map(walker, learners)
    if entropies:
        found.append(_by_name("oracle_entropy", "entropy oracle (thesis)", "truth", "entropy"))
    for by, title in (("belief", "label-free oracle"), ("label", "greedy label oracle")):
        policy_of, name = _policy_of_truth(by), f"{by}_oracle"
        found.append(Contender(name, title, "truth", policy_of, True, 1, oracle_views, oracle_starts))
    return found
