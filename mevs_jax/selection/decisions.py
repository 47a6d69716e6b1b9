"""The thesis's decision (§4.3.3) for a robot: chooses the next view from a partial cloud of any size.

Compiled programs have fixed shapes, but the clouds of a camera differ in size. A cloud is therefore padded to the next of a few
sizes with copies of its first point. The copies change nothing: farthest-point sampling never takes a copy of a point that it
has taken, and a ball query that finds the copies has already found the point itself, so the maxima over neighbours are the same.
There is one program per size; `warm_up` compiles them in advance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import ByContent
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.models import PointNet2
from mevs_jax.policies.base import maxima_first

_FARTHEST = 1.1
"""Largest distance of a point from the object's centre, in radii; above 1 since depth is measured with errors."""


@dataclass(frozen=True, eq=False)
class Decision(ByContent):
    """The next view, and the predictions it was chosen by.

    Attributes:
        view: index of the next view.
        entropies: (views,) predicted entropies, in units of the largest entropy of the training split.
    """

    view: int
    entropies: Float[np.ndarray, " views"]


class NextView:
    """Chooses the next view from one partial cloud.

    Args:
        network: predicts the entropy of every view of `graph`.
        graph: the candidate views.
        columns: of the clouds that the network was trained with: 3, or 6 with the unit vector to the camera beside each point.
        sizes: that clouds are padded to, increasing. Larger clouds are reduced to the last size by random sampling.

    Raises:
        ValueError: for a network with another number of views than `graph`, or sizes that do not increase.
    """

    def __init__(
        self, network: PointNet2, graph: ViewGraph, *, columns: int, sizes: Sequence[int] = (512, 1024, 2048, 4096)
    ):
        if network.views != len(graph.points):
            raise ValueError(f"the network predicts {network.views} views, the graph has {len(graph.points)}")
        if not sizes or any(b <= a for a, b in zip((0, *sizes), sizes, strict=False)):
            raise ValueError(f"sizes must increase from at least 1, got {tuple(sizes)}")
        if columns not in (3, 6):
            raise ValueError(f"a network reads clouds of 3 or 6 columns, not {columns}")
        self.sizes, self.views, self.columns = tuple(sizes), network.views, columns
        structure, self._state = nnx.split(network)

        def decide(state: nnx.State, clouds: Array, available: Array) -> tuple[Array, Array]:
            entropies = nnx.merge(structure, state)(clouds)
            scores = jax.vmap(maxima_first, in_axes=(0, 0, None))(entropies, available, graph.neighbours)
            return jnp.argmax(jnp.where(available, scores, -jnp.inf), axis=-1), entropies

        self._decide = jax.jit(decide)

    def __call__(
        self, cloud: Float[np.ndarray, "points columns"], available: Bool[np.ndarray, " views"] | None = None
    ) -> Decision:
        """Chooses the best available local maximum of the predicted entropies, or the best available view if there is none.

        Args:
            cloud: (points, columns) in any order, in the frame and unit of the training clouds: the object's sphere is the unit
                sphere. The points are shuffled, in the same way in every call, as in training, since a ball query depends on
                their order.
            available: True for the views that may be chosen, for example those not yet attempted; all views by default.

        Raises:
            ValueError: for a cloud of other columns, outside the unit sphere, without points or with numbers that are not
                finite, or if no view is available.
        """
        return self.of_many([cloud], None if available is None else np.asarray(available)[None])[0]

    def of_many(
        self,
        clouds: Sequence[Float[np.ndarray, "_ columns"]],
        available: Bool[np.ndarray, "clouds views"] | None = None,
    ) -> list[Decision]:
        """Decisions for several clouds in one call.

        All clouds are padded to the size that the largest needs, and their number to a power of two.

        Args:
            clouds: as for `__call__`.
            available: for each cloud, True for the views that may be chosen; all views by default.

        Raises:
            ValueError: as `__call__`.
        """
        if not clouds:
            return []
        if available is None:
            available = np.ones((len(clouds), self.views), bool)
        if available.shape != (len(clouds), self.views) or not available.any(axis=1).all():
            raise ValueError(
                f"a decision among {self.views} views needs one that is available, got a mask of shape {available.shape[1:]}"
                f" with {available.sum(axis=-1).min()} available views"
            )
        size = self._size(max(map(len, clouds)))
        batch = np.minimum(np.arange(1 << (len(clouds) - 1).bit_length()), len(clouds) - 1)
        padded = np.stack([self.fill(cloud, size) for cloud in clouds])
        views, entropies = map(np.asarray, self._decide(self._state, padded[batch], available[batch]))
        return [Decision(int(views[i]), entropies[i]) for i in range(len(clouds))]

    def warm_up(self) -> None:
        """Compiles the programs for one cloud of every size, so that no decision waits for the compiler."""
        for size in self.sizes:
            self(np.full((size, self.columns), 0.1, np.float32))

    def fill(
        self, cloud: Float[np.ndarray, "points columns"], size: int | None = None
    ) -> Float[np.ndarray, "size columns"]:
        """The cloud in random order, padded with copies of one point or reduced at random to `size` points.

        Args:
            cloud: as for `__call__`.
            size: number of points of the result; by default the smallest of `sizes` that holds the cloud, else the largest.

        Raises:
            ValueError: for a cloud of other columns, outside the unit sphere, without points or with numbers that are not
                finite.
        """
        cloud = np.asarray(cloud, np.float32)
        if cloud.ndim != 2 or cloud.shape[1] != self.columns or len(cloud) == 0 or not np.isfinite(cloud).all():
            raise ValueError(
                f"this network reads clouds (points, {self.columns}) of finite numbers with at least one point, got shape "
                f"{cloud.shape}"
            )
        if (farthest := float(np.linalg.norm(cloud[:, :3], axis=1).max())) > _FARTHEST:
            raise ValueError(
                f"the cloud reaches {farthest:.2f} from the origin; subtract the object's centre and divide by its radius"
            )
        size = size or self._size(len(cloud))
        order = np.random.default_rng(0).permutation(len(cloud))[:size]
        return cloud[np.concatenate([order, np.full(size - len(order), order[0])])]

    def _size(self, points: int) -> int:
        return next((size for size in self.sizes if size >= points), self.sizes[-1])
