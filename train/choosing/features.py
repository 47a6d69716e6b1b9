"""Features of the recogniser for every view of some objects, and sets of views of one size."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


@flax.struct.dataclass
class Features:
    """Outputs of the encoder for every view of some objects.

    Attributes:
        features: features of each view.
        logits: logits of each single view.
        labels: true class of each object.
        directions: unit vectors from the object to the cameras.
        clouds: PointNet++'s embedding of the partial cloud of each view, if used.
    """

    features: Float[Array, "objects views features"]
    logits: Float[Array, "objects views classes"]
    labels: Int[Array, " objects"]
    directions: Float[Array, "objects views 3"]
    clouds: Float[Array, "objects views embedding"] | None = None

    def some(self, chosen: Int[np.ndarray, " some"]) -> Features:
        """Returns those of the chosen objects."""
        return jax.tree.map(lambda leaf: leaf[chosen], self)

    def and_of(self, others: Features) -> Features:
        """Returns these and those of further objects, or of the same objects in other images."""
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), self, others)

    def without(self, classes: tuple[int, ...]) -> Features:
        """Returns those of objects that belong to none of `classes`."""
        return self.some(np.flatnonzero(~np.isin(self.labels, classes))) if classes else self


def sets_of_size(objects: int, views: int, size: int, draws: int, seed: int = 0) -> Bool[Array, "draws objects views"]:
    """Returns random sets of `size` views; the same `seed` gives the same sets."""
    drawn = jax.random.uniform(jax.random.key(seed), (draws, objects, views))
    return jnp.argsort(jnp.argsort(drawn, axis=-1), axis=-1) < size
