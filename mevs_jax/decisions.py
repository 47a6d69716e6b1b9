"""Cloud in, next view out: the thesis's decision (§4.3.3) as a robot asks for it, one cloud of any size after another.

Compiled programs have fixed shapes, and a camera's clouds have not. A cloud is filled up to the next of a few sizes with copies
of its first point, which change nothing: farthest-point sampling never takes a copy of a point it has, and where a ball query
finds the copies it found the point itself before, so that no maximum over neighbours is another. There are as many programs
as sizes, and whoever cannot wait for the compiler calls `warm_up` first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.models import PointNet2
from mevs_jax.policies.base import maxima_first
from mevs_jax.viewpoints import ViewGraph


@dataclass(frozen=True)
class Decision:
    """Where to look next.

    Attributes:
        view: index of the next view.
        entropies: (views,) predicted, in units of the training split's largest.
    """

    view: int
    entropies: Float[np.ndarray, " views"]


class NextView:
    """Chooses the next view from one partial cloud.

    Args:
        network: predicts the entropy of every view of `graph`.
        graph: the candidate views.
        sizes: that clouds are filled up to, rising; of larger ones as many points as the last are drawn at random.

    Raises:
        ValueError: for a network of another number of views, or sizes that do not rise.
    """

    def __init__(self, network: PointNet2, graph: ViewGraph, *, sizes: Sequence[int] = (512, 1024, 2048, 4096)):
        if network.views != len(graph.points):
            raise ValueError(f"the network predicts {network.views} views, the graph has {len(graph.points)}")
        if not sizes or any(b <= a for a, b in zip((0, *sizes), sizes, strict=False)):
            raise ValueError(f"sizes must rise from at least 1, got {tuple(sizes)}")
        self.sizes, self.views = tuple(sizes), network.views
        structure, self._state = nnx.split(network)

        def decide(state: nnx.State, clouds: Array, available: Array) -> tuple[Array, Array]:
            entropies = nnx.merge(structure, state)(clouds)
            scores = jax.vmap(maxima_first, in_axes=(0, 0, None))(entropies, available, graph.neighbours)
            return jnp.argmax(jnp.where(available, scores, -jnp.inf), axis=-1), entropies

        self._decide = jax.jit(decide)

    def __call__(
        self, cloud: Float[np.ndarray, "points columns"], available: Bool[np.ndarray, " views"] | None = None
    ) -> Decision:
        """The available view with the most promising entropy: the best local maximum, or the best of all where there is none.

        Args:
            cloud: (points, 3) or (points, 6), as `PointNet2` takes them, in any order: they are shuffled, the same way each
                time, as training clouds are, since a ball query takes neighbours as they come.
            available: views that may be chosen, say those not attempted yet; all of them unless given.

        Raises:
            ValueError: for a cloud without points or with numbers that are not finite, or where no view is available.
        """
        return self.of_many([cloud], None if available is None else np.asarray(available)[None])[0]

    def of_many(
        self,
        clouds: Sequence[Float[np.ndarray, "_ columns"]],
        available: Bool[np.ndarray, "clouds views"] | None = None,
    ) -> list[Decision]:
        """Decisions on several clouds in one call. They share the size that the largest needs; their number is filled up too."""
        if not clouds:
            return []
        if available is None:
            available = np.ones((len(clouds), self.views), bool)
        if available.shape != (len(clouds), self.views) or not available.any(axis=1).all():
            raise ValueError(
                f"a decision among {self.views} views needs one that is available, got a mask of shape {available.shape[1:]}"
                f" with {available.sum(axis=-1).min()} of them"
            )
        size = self._size(max(map(len, clouds)))
        batch = np.minimum(np.arange(1 << (len(clouds) - 1).bit_length()), len(clouds) - 1)
        filled = np.stack([self.fill(cloud, size) for cloud in clouds])
        views, entropies = map(np.asarray, self._decide(self._state, filled[batch], available[batch]))
        return [Decision(int(views[i]), entropies[i]) for i in range(len(clouds))]

    def warm_up(self, columns: int = 3) -> None:
        """Compiles the programs of all sizes for one cloud, of 3 or 6 columns, so that no decision waits for it."""
        for size in self.sizes:
            self(np.ones((size, columns), np.float32))

    def fill(
        self, cloud: Float[np.ndarray, "points columns"], size: int | None = None
    ) -> Float[np.ndarray, "size columns"]:
        """The cloud in random order, in one of the sizes: filled up with copies of one point, or thinned out at random."""
        cloud = np.asarray(cloud, np.float32)
        if cloud.ndim != 2 or len(cloud) == 0 or not np.isfinite(cloud).all():
            raise ValueError(
                f"a decision needs a cloud (points, 3 or 6) of finite numbers with at least one point, got shape {cloud.shape}"
            )
        size = size or self._size(len(cloud))
        order = np.random.default_rng(0).permutation(len(cloud))[:size]
        return cloud[np.concatenate([order, np.full(size - len(order), order[0])])]

    def _size(self, points: int) -> int:
        return next((size for size in self.sizes if size >= points), self.sizes[-1])
