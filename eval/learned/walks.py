"""The policies of the study of learned view selection, and their walks from every start view with the same fusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from eval.learned.poses import UnknownPose
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.models import ViewPolicy
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.policies.base import Knowledge, Policy, as_tree
from mevs_jax.policies.informed import expected_views
from mevs_jax.policies.learned import By, of_network
from mevs_jax.policies.oracles import fused_oracle
from mevs_jax.policies.registry import Need, PolicyRecord, policy_record
from mevs_jax.selection.loop import ViewTable, by_attention, sum_of_logits
from mevs_jax.selection.walks import every_walk, walks_around
from mevs_jax.trained.system import EXPECTED_VIEWS
from train.choosing.features import Features
from train.running.over_objects import over_objects

_WALKS_AT_ONCE = 2**11
_SCORES_AT_ONCE = 2**26
"""Hypotheses of class and pose × views × walks: about one gigabyte of temporary arrays."""
_TRYING_STARTS = 8
"""Approximate number of start views, spread over the lattice, for oracles and for walks with a movement cost."""


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

    def graph(self) -> ViewGraph:
        """The candidate views of the first object; the angles between views are the same for all objects."""
        return ViewGraph.from_points(np.asarray(self.features.directions[0], np.float64), self.neighbours)

    def table(self, needs: frozenset[Need]) -> ViewTable:
        """View tables with what a policy needs, and nothing else: programs are shared by lattices that differ in the rest."""
        data = self.features
        return ViewTable(
            data.logits,
            jnp.asarray(self.predicted_entropy) if "predicted_entropy" in needs else None,
            jnp.asarray(self.entropy) if "entropy" in needs else None,
            data.labels,
            features=data.features if "belief" in needs else None,
            clouds=data.clouds if "clouds" in needs else None,
        )


@dataclass(frozen=True)
class Walking:
    """How the study walks.

    Attributes:
        max_views: length of a walk.
        draws: walks of random policies from each start view.
        oracle_views: length of the oracles' walks.
        every_nth: oracles, and walks with a movement cost, begin at every n-th view.
        fitting_starts: temperatures are fitted on walks from every n-th view.
        seed: of random policies.
        promising: whether temperatures are those of `keep_promise`.
    """

    max_views: int
    draws: int
    oracle_views: int = 4
    every_nth: int = 1
    fitting_starts: int = 1
    seed: int = 0
    promising: bool = False

    def on(self, views: int) -> Walking:
        """The same on a lattice of so many views: no walk is longer, and oracles begin at about `_TRYING_STARTS` of them."""
        most = min(self.max_views, views)
        every = max(1, views // _TRYING_STARTS)
        return replace(self, max_views=most, oracle_views=min(self.oracle_views, most), every_nth=every)


RANDOM = policy_record("random")
BY_EXPECTED_VIEWS = PolicyRecord(
    EXPECTED_VIEWS,
    expected_views,
    "information gain by expected views",
    "others",
    frozenset({"belief", "expected_views"}),
)
"""Information gain by what the recogniser is expected to say; over class and pose if the pose of objects is unknown."""


def by_network(name: str, title: str, network: ViewPolicy, fusion: CalibratedFusion, by: By = "belief") -> PolicyRecord:
    """Returns the policy of a trained network, for beliefs of a fusion."""
    needs: set[Need] = {"belief"}
    needs |= {"clouds"} if network.cloud is not None else set()
    needs |= {"expected_views"} if by in ("table", "ahead") else set()
    return PolicyRecord(name, of_network(network, fusion.single, by), title, "learned", frozenset(needs))


def compared(
    learned: Sequence[PolicyRecord], fusion: CalibratedFusion, given: frozenset[Need]
) -> tuple[PolicyRecord, ...]:
    """Returns all policies of the study that can be used, in the order of the tables.

    Args:
        learned: the trained policies.
        fusion: that of the study, which the oracles try every view with.
        given: what policies can be given.
    """
    belief, label = (
        replace(
            policy_record(f"{by}_oracle"), score=fused_oracle(fusion, by=by), needs=frozenset({"belief", "features"})
        )
        for by in ("belief", "label")
    )
    before = map(policy_record, ("random", "farthest", "predicted_entropy", "fixed_order"))
    every = (*before, BY_EXPECTED_VIEWS, *learned, policy_record("oracle_entropy"), belief, label)
    return tuple(policy for policy in every if policy.can_use(given))


Known = Knowledge | ExpectedViews | UnknownPose | None
"""What policies know about other objects."""


def _at(known: Known, directions: Float[Array, "views 3"]) -> Knowledge | None:
    """What is known about the views of one object."""
    if isinstance(known, ExpectedViews):
        return Knowledge(expected_logits=known.at(directions))
    return known.knowledge if isinstance(known, UnknownPose) else known


def _walks_of(
    one: tuple[Int[Array, ""], ViewTable, Float[Array, "views 3"]],
    key: Array,
    policy: Policy,
    fusion: CalibratedFusion,
    graph: ViewGraph,
    knowledge: Known,
    walks: tuple[Array, Array],
    *,
    max_views: int,
) -> Int[Array, "walks steps"]:
    """The views of walks around an object, whose number, table and directions are given."""
    number, table, directions = one
    fuse = sum_of_logits if table.features is None else by_attention(fusion)
    if isinstance(knowledge, UnknownPose) and table.features is not None:
        table = replace(table, pose_evidence=knowledge.evidence(table.features, directions))
    scene = table.scene(replace(graph, points=directions), _at(knowledge, directions))
    return walks_around(key, table.observe, scene, policy, (number, *walks), max_views=max_views, fuse=fuse).views


def _most_at_once(policy: PolicyRecord, knowledge: Known, views: int) -> int:
    """How many walks are computed together. Networks are faster on a CPU if what they compute of all of them fits its cache."""
    most = _WALKS_AT_ONCE
    if "belief" in policy.needs and jax.default_backend() == "cpu":
        most //= 32 if policy.knows == "truth" else 8  # oracles fuse the views once for each candidate
    if isinstance(knowledge, UnknownPose):  # each walk scores every view under every hypothesis
        most = min(most, max(1, _SCORES_AT_ONCE // knowledge.hypotheses // views))
    return most


def walk_all(
    key: Array,
    policy: PolicyRecord,
    fusion: CalibratedFusion,
    lattice: OnLattice,
    knowledge: Known,
    *,
    max_views: int,
    draws: int = 1,
    every: int = 1,
) -> Int[np.ndarray, "objects walks steps"]:
    """The views of walks around every object.

    Args:
        fusion: of the beliefs; a policy that does not need them walks without.
        knowledge: about other objects; `ExpectedViews` are evaluated at the directions of each object.
        draws: walks of a random policy from each start view.
        every: walks begin at every n-th view.
    """
    views, table, graph = lattice.features.logits.shape[1], lattice.table(policy.needs), lattice.graph()
    walks = every_walk(jnp.arange(0, views, every), policy.draws(draws))
    if not policy.needs & {"order", "expected_views"}:
        knowledge = None
    objects = np.arange(len(table.label)), table, lattice.features.directions
    shared = key, as_tree(policy.score), fusion, graph, knowledge, walks
    at_once = _most_at_once(policy, knowledge, views) // len(walks[0])
    return over_objects(_walks_of, objects, *shared, at_once=at_once, by_all=True, max_views=max_views)


def _beliefs_of_one(
    one: tuple[Features, Int[Array, "walks steps"]], fusion: CalibratedFusion
) -> Float[Array, "walks steps classes"]:
    data, walks = one

    def after(views: Array) -> Array:
        return fusion(data.features[views], data.directions[views], jnp.ones(views.shape, bool))

    return jnp.stack([after(walks[:, :count]) for count in range(1, walks.shape[1] + 1)], axis=1)


def beliefs_of(
    fusion: CalibratedFusion, data: Features, views: Int[np.ndarray, "objects walks steps"]
) -> Float[np.ndarray, "objects walks steps classes"]:
    """Log-probabilities after each view of each walk."""
    return over_objects(_beliefs_of_one, (data, views), fusion, at_once=1024 // views.shape[1], by_all=True)


def right_along(
    fusion: CalibratedFusion, data: Features, views: Int[AnyArray, "objects walks steps"]
) -> Float[np.ndarray, "steps objects"]:
    """Share of the walks around each object with the right prediction after 1, 2, … views."""
    right = beliefs_of(fusion, data, np.asarray(views)).argmax(axis=-1) == np.asarray(data.labels)[:, None, None]
    return right.mean(axis=1).T
