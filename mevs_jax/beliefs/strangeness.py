"""How unlike the known objects an object is, from the logits of its views.

The energy of a view is −log Σ exp(logits), low where a network has seen such views in training (Liu et al., *Energy-based
Out-of-distribution Detection*, 2020). That of several views is the mean of theirs. It is compared with the energies of validation
objects after as many views.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mevs_jax.arguments import whole
from mevs_jax.arrays import AnyArray

STRANGE = 0.95
"""An object that is stranger than this share of the known objects is unknown, unless another share is asked for."""
LEVELS = 201
"""Number of quantiles of the energies of known objects that are kept for each number of views."""


@flax.struct.dataclass
class Strangeness:
    """Quantiles of the energies of known objects.

    Attributes:
        quantiles: (most, levels) after 1, 2, … views, at equal steps from 0 to 1.
    """

    quantiles: Float[Array, "most levels"]

    def of(self, logits: Float[AnyArray, "most classes"], present: Bool[AnyArray, " most"]) -> Float[Array, ""]:
        """Share of the known objects that are less strange after as many views, in [0, 1].

        Args:
            logits: of the views seen.
            present: True for the views seen; the others are padding.
        """
        energy = jnp.where(present, -jax.nn.logsumexp(jnp.asarray(logits), axis=-1), 0.0)
        count = jnp.maximum(jnp.sum(present), 1)
        known = self.quantiles[jnp.minimum(count, len(self.quantiles)) - 1]
        return jnp.mean(known < jnp.sum(energy) / count)


def fit_strangeness(
    logits: Float[AnyArray, "objects views classes"], most: int, *, draws: int = 8, seed: int = 0
) -> Strangeness:
    """Measures the energies of known objects, on random walks.

    Args:
        logits: of every view of objects that the network was not trained on.
        most: largest number of views of a walk.
        draws: random walks of each object.
        seed: of the walks.
    """
    most = whole(most, f"most must be from 1 to {logits.shape[1]} views", 1, logits.shape[1])
    draws = whole(draws, "draws must be at least 1", 1, 2**20)
    energy = np.asarray(-jax.nn.logsumexp(jnp.asarray(logits), axis=-1))
    views = np.broadcast_to(np.arange(energy.shape[1]), (draws, *energy.shape))
    walks = np.random.default_rng(seed).permuted(views, axis=-1)[..., :most]
    along = np.take_along_axis(np.broadcast_to(energy, views.shape), walks, axis=-1)
    means = np.cumsum(along, axis=-1) / np.arange(1, along.shape[-1] + 1)
    levels = np.quantile(means.reshape(-1, means.shape[-1]), np.linspace(0, 1, LEVELS), axis=0).T
    return Strangeness(jnp.asarray(levels, jnp.float32))
