"""The thesis's grid: objects × start views × draws × backbones × thresholds × limits on views, for each policy.

The views of a walk depend on neither the confidence threshold (CT) nor the limit on views (MV). So each object is
walked once from each start view up to the largest MV, and every cell is computed from that walk. The cells of a
policy share their random draws, all policies share their start views, and all differences are paired. Policies share a
program, which takes much less time to compile than one for each. With several backbones each policy has its own: one that
does not use the belief then walks once for all backbones. `vmap` does this by itself, because only the logits have an axis
of backbones.

Objects are processed in chunks, which bounds the memory; several devices, or the cores of a CPU, share them. The random
numbers of a walk depend only on the seed, the object's position, the start view and the draw (`walks_around`), so neither
chunks nor devices nor cores change a result.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.metrics import is_right
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Policy, Scene, SelectionState, as_tree
from mevs_jax.policies.registry import PolicyRecord
from mevs_jax.selection.loop import ViewTable
from mevs_jax.selection.walks import every_walk, walks_around
from train.running.over_objects import over_objects, programs_at_once

THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
FIRST_MV, LAST_MV = 2, 9
_WALKS_AT_ONCE = 2**12
_WALKS_IN_CACHE = 2**11
"""As many walks, with what 40 views and their neighbours need, stay in the cache of a CPU's core."""


@dataclass(frozen=True)
class GridConfig:
    """Settings of the evaluation."""

    max_views: int = LAST_MV
    """largest limit on views (MV); the grid starts at 2"""
    draws: int = 64
    """walks of a random policy from each start view of an object, which are averaged where the expectation is not exact"""
    lowest_elevation: float = -90.0
    """views below this elevation, in degrees, are unreachable"""
    seed: int = 0
    """seed of random policies and of the bootstrap"""


@flax.struct.dataclass
class Results:
    """Results of a policy on each object, averaged over start views and draws.

    Attributes:
        right: (backbones, objects, MV, CT) share of walks with the right final prediction.
        used: (backbones, objects, MV, CT) mean number of views used.
        after: (backbones, objects, steps) share with the right prediction after exactly 1, 2, … views, without stopping.
        travelled: (backbones, objects, steps) mean great-circle distance travelled, in radians.
        views: (backbones, objects, starts, draws, steps) views of the walks, −1 beyond their end; only the first draw.
    """

    right: Float[Array, "*batch MV CT"]
    used: Float[Array, "*batch MV CT"]
    after: Float[Array, "*batch steps"]
    travelled: Float[Array, "*batch steps"]
    views: Int[Array, "*walks steps"]


def read_object(
    logits: Float[Array, "views classes"],
    label: Int[Array, ""],
    distances: Float[Array, "views views"],
    views: Int[Array, "steps walks"],
    weights: Float[Array, " walks"],
) -> tuple[Float[Array, "MV CT"], Float[Array, "MV CT"], Float[Array, " steps"], Float[Array, " steps"]]:
    """Computes `right`, `used`, `after` and `travelled` of `Results` from full walks of one object.

    Walks are the last axis of all arrays, so that a CPU's vector instructions run along the walks and not along ten
    classes. Argmax and cumulative sums are avoided, because XLA is slow at them on CPUs.

    Args:
        weights: weights of the walks, with sum 1.
    """
    thresholds = jnp.array(THRESHOLDS)[:, None]
    none = jnp.zeros(views.shape[1])
    nothing = jnp.zeros((len(THRESHOLDS), views.shape[1]))

    Carry = tuple[Array, Array, Array, Array, Array]

    def step_of_walk(carry: Carry, step: tuple[Array, Array]) -> tuple[Carry, tuple[Array, ...]]:
        belief, distance, walking, settled, used = carry
        previous, view = step
        valid = view >= 0  # a walk ends early if no reachable view is left
        belief += jnp.where(valid, logits.T[:, view], 0.0)
        distance += jnp.where(valid, distances[previous, view], 0.0)
        used += walking * valid
        right = is_right(belief, label, axis=0)
        confidence = 1 / jnp.sum(jnp.exp(belief - jnp.max(belief, axis=0)), axis=0)
        seen = (settled + walking * right) @ weights, used @ weights, right @ weights, distance @ weights
        stops = walking * (confidence >= thresholds)
        return (belief, distance, walking - stops, settled + stops * right, used), seen

    start = jnp.zeros((logits.shape[1], views.shape[1])), none, nothing + 1, nothing, nothing
    previous = jnp.concatenate([views[:1], views[:-1]])
    right, used, after, travelled = jax.lax.scan(step_of_walk, start, (previous, views))[1]
    return right[FIRST_MV - 1 :], used[FIRST_MV - 1 :], after, travelled


def of_backbones(tables: ViewTable) -> ViewTable:
    """The tables of objects with an axis of backbones; of one backbone if they have none."""
    return tables if tables.logits.ndim == 4 else replace(tables, logits=tables.logits[:, None])


def run_grid(
    key: Array,
    tables: ViewTable,
    graph: ViewGraph,
    knowledge: Knowledge | None,
    policies: Sequence[PolicyRecord],
    *,
    max_views: int,
    draws: int = 1,
    reachable: Bool[AnyArray, " views"] | None = None,
) -> dict[str, Results]:
    """Walks every object from every start view by every policy and computes the whole grid.

    Args:
        key: for random policies.
        tables: view tables with a leading axis of objects; logits may have an axis of backbones after it. Predicted entropies may
            have that axis too: a backbone is then a whole system, such as one of several trainings.
        graph: the candidate views.
        knowledge: statistics of other objects, with a leading axis of backbones if logits have it; None if no policy needs them.
        policies: the policies, whose names differ.
        max_views: the largest MV.
        draws: walks of a random policy from each start view.
        reachable: the views that the camera can visit and start from; None for all.

    Returns:
        Results by policy. Unreachable start views have weight zero.
    """
    if tables.logits.ndim == 3:
        tables, knowledge = of_backbones(tables), jax.tree.map(lambda leaf: leaf[None], knowledge)
    objects, starts = (np.arange(len(tables.label)), tables), len(graph.points)
    most = _WALKS_IN_CACHE if jax.default_backend() == "cpu" else _WALKS_AT_ONCE

    programs: dict[tuple[int, str], list[PolicyRecord]] = {}
    for policy in policies:
        alone = policy.name if tables.logits.shape[1] > 1 else ""
        programs.setdefault((policy.draws(draws), alone), []).append(policy)

    def results(group: list[PolicyRecord]) -> dict[str, Results]:
        own, every = group[0].draws(draws), tuple(as_tree(policy.score) for policy in group)
        at_once, found = min(256, most // (starts * own)), {}
        for number, policy in enumerate(group):
            score = Partial(_one_of, jnp.int32(number), every) if len(every) > 1 else every[0]
            shared = key, score, graph, knowledge, reachable
            got = over_objects(results_of_object, objects, *shared, at_once=at_once, draws=own, max_views=max_views)
            leaves, structure = jax.tree.flatten(got)
            del got  # with many objects, results are large: each array is freed once it is on the device
            placed = [jnp.asarray(leaves.pop(0).swapaxes(0, 1)) for _ in range(len(leaves))]
            found[policy.name] = jax.tree.unflatten(structure, placed)
        return found

    with ThreadPoolExecutor(programs_at_once()) as pool:  # a program is compiled on one core
        found = {name: result for group in pool.map(results, programs.values()) for name, result in group.items()}
    return {policy.name: found[policy.name] for policy in policies}


def _one_of(
    number: Int[Array, ""], policies: tuple[Policy, ...], key: Array, state: SelectionState, scene: Scene
) -> Float[Array, " views"]:
    """The scores of one of several policies, which is known when the program runs."""
    branches = [lambda *given, policy=policy: jnp.asarray(policy(*given), jnp.float32) for policy in policies]
    return jax.lax.switch(number, branches, key, state, scene)


def results_of_object(
    one: tuple[Int[Array, ""], ViewTable],
    key: Array,
    policy: Policy,
    graph: ViewGraph,
    knowledge: Knowledge | None,
    reachable: Bool[Array, " views"] | None,
    *,
    draws: int,
    max_views: int,
) -> Results:
    """The results of a policy on one object, whose number and table are given."""
    (number, table), starts = one, len(graph.points)
    weight = jnp.ones(starts) if reachable is None else jnp.asarray(reachable, jnp.float32)
    weight = (weight / jnp.sum(weight)).repeat(draws) / draws

    def walks(logits: Array, entropies: Array | None, knowledge: Knowledge | None) -> Int[Array, "walks steps"]:
        own = replace(table, logits=logits, predicted_entropy=entropies)
        scene, every = own.scene(graph, knowledge, reachable), every_walk(jnp.arange(starts), draws)
        return walks_around(key, own.observe, scene, policy, (number, *every), max_views=max_views).views

    entropies = table.predicted_entropy
    each = 0 if entropies is not None and entropies.ndim == 3 else None
    views = jax.vmap(walks, (0, each, 0))(table.logits, entropies, knowledge)
    read = jax.vmap(read_object, (0, None, None, 0, None))
    found = read(table.logits, table.label, graph.distances, views.swapaxes(-1, -2), weight)
    shown = views.reshape(-1, starts, draws, max_views)[:, :, :1]
    return Results(*found, shown.astype(jnp.int8 if starts < 128 else jnp.int16))
