"""Exact expectation of random selection without repetition, over all start views and all draws.

The belief of such a walk after k views depends on *which* views it has seen, not on their order. So the walk is a
Markov chain on subsets: P(S) = Σ_{v ∈ S} P(S \\ v, not stopped) / (views left). With 10 views this covers every
subset; with 40 it covers those of up to three views (10,700 subsets). Larger limits on views are estimated from
draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import combinations
from math import comb

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mevs_jax.beliefs.metrics import is_right

LARGEST = 12_000
"""Largest number of subsets, over all sizes, to evaluate for an object."""


@dataclass(frozen=True)
class Subsets:
    """All subsets of one size of the reachable views.

    Attributes:
        members: (subsets, size) views.
        without: (subsets, size) index, in the list of the next smaller size, of the subset without its i-th member.
    """

    members: np.ndarray
    without: np.ndarray


def all_subsets(views: np.ndarray, largest: int) -> list[Subsets]:
    """The subsets of `views` by size, from 1 up to `largest`, or fewer if `LARGEST` is exceeded."""
    found: list[Subsets] = []
    below: dict[tuple[int, ...], int] = {(): 0}
    total = 0
    for size in range(1, min(largest, len(views)) + 1):
        total += comb(len(views), size)
        if total > LARGEST:
            break
        subsets = list(combinations(views.tolist(), size))
        without = [[below[s[:i] + s[i + 1 :]] for i in range(size)] for s in subsets]
        found.append(Subsets(np.array(subsets), np.array(without)))
        below = {subset: index for index, subset in enumerate(subsets)}
    return found


def expected_of_object(
    logits: Float[Array, "views classes"],
    label: Int[Array, ""],
    sizes: list[Subsets],
    candidates: int,
    thresholds: tuple[float, ...],
) -> tuple[Float[Array, "sizes CT"], Float[Array, "sizes CT"], Float[Array, " sizes"]]:
    """Expected results of random selection on one object.

    Returns:
        The probability of a right final prediction and the number of views used, by limit on views and threshold; and the
        probability of a right prediction after each number of views.
    """
    levels = jnp.array(thresholds)
    belief = jnp.zeros((1, logits.shape[1]))
    walking = jnp.ones((1, len(thresholds)))  # probability that a walk has reached this subset and continues
    settled, used = jnp.zeros(len(thresholds)), jnp.zeros(len(thresholds))
    cells, used_cells, after = [], [], []
    for size, subsets in enumerate(sizes, start=1):
        reached = jnp.sum(walking[subsets.without], axis=1) / (candidates - size + 1)
        belief = belief[subsets.without[:, -1]] + logits[subsets.members[:, -1]]
        right = is_right(belief, label, axis=1).astype(jnp.float32)
        stops = jnp.max(jax.nn.softmax(belief), axis=1)[:, None] >= levels
        used += jnp.sum(reached, axis=0)
        cells.append(settled + right @ reached)
        used_cells.append(used)
        after.append(jnp.mean(right))
        settled += right @ (reached * stops)
        walking = reached * ~stops
    return jnp.stack(cells), jnp.stack(used_cells), jnp.stack(after)


def expected_random(
    logits: Float[Array, "objects backbones views classes"],
    labels: Int[Array, " objects"],
    reachable: np.ndarray,
    thresholds: tuple[float, ...],
    max_views: int,
) -> tuple[
    Float[Array, "backbones objects sizes CT"],
    Float[Array, "backbones objects sizes CT"],
    Float[Array, "backbones objects sizes"],
]:
    """Expected results of random selection on every object, for the sizes of `all_subsets`.

    Returns:
        `right` and `used` (backbones, objects, sizes, CT), and `after` (backbones, objects, sizes).
    """
    views = np.flatnonzero(reachable)
    sizes = all_subsets(views, max_views)
    one = partial(expected_of_object, sizes=sizes, candidates=len(views), thresholds=thresholds)

    @jax.jit
    def every(logits: Array, labels: Array):
        over_backbones = jax.vmap(one, (0, None))
        return jax.lax.map(lambda item: over_backbones(*item), (logits, labels), batch_size=4)

    right, used, after = (jnp.moveaxis(values, 0, 1) for values in every(logits, labels))
    return right, used, after
