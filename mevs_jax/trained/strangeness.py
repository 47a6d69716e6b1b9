"""How unlike the known objects an object is, from the encoder's features of its views.

The distance of a view is the smallest Mahalanobis distance of its features to the mean features of a class, with one covariance
for all classes (Lee et al., *A Simple Unified Framework for Detecting Out-of-Distribution Samples*, 2018). That of several views
is the mean of theirs. It is compared with the distances of validation objects after as many views.
"""

from __future__ import annotations

from dataclasses import replace

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arrays import AnyArray

LEVELS = 201
"""Number of quantiles of the distances of known objects that are kept for each number of views."""


@flax.struct.dataclass
class Strangeness:
    """Features of the known classes, and quantiles of the distances of known objects.

    Attributes:
        whitening: (features, rank) matrix that makes the covariance within classes the identity.
        means: (classes, rank) mean features of each class, whitened.
        quantiles: (most, levels) of the distances of known objects after 1, 2, … views, at equal steps from 0 to 1.
    """

    whitening: Float[Array, "features rank"]
    means: Float[Array, "classes rank"]
    quantiles: Float[Array, "most levels"]

    def distances(self, features: Float[AnyArray, "*batch features"]) -> Float[Array, "*batch"]:
        """Squared distance of single views to the nearest class, divided by the number of dimensions."""
        white = jnp.asarray(features) @ self.whitening
        apart = jnp.sum((white[..., None, :] - self.means) ** 2, axis=-1)
        return jnp.min(apart, axis=-1) / self.means.shape[-1]

    def of(self, features: Float[AnyArray, "most features"], present: Bool[AnyArray, " most"]) -> Float[Array, ""]:
        """Share of the known objects that are less strange after as many views, in [0, 1].

        Args:
            features: of the views seen.
            present: True for the views seen; the others are padding.
        """
        distances = jnp.where(present, self.distances(features), 0.0)
        count = jnp.maximum(jnp.sum(present), 1)
        known = self.quantiles[jnp.minimum(count, len(self.quantiles)) - 1]
        return jnp.mean(known < jnp.sum(distances) / count)


def fit_strangeness(
    features: Float[AnyArray, "objects views features"],
    labels: Int[AnyArray, " objects"],
    classes: int,
    most: int,
    *,
    draws: int = 8,
    seed: int = 0,
) -> Strangeness:
    """Fits the classes' features and the distances of known objects.

    Distances of objects would be too small if they had also been used to fit means and covariance. So each half of the objects
    gives the distances by the fit to the other half; the fit that is returned is to all.

    Args:
        features: of every view of objects that the encoder was not trained on.
        labels: their classes.
        classes: number of classes.
        most: largest number of views of a walk.
        draws: random walks of each object.
        seed: of the walks and of the halves.
    """
    features, labels = np.asarray(features, np.float64), np.asarray(labels)
    random = np.random.default_rng(seed)
    half = np.argsort(random.permutation(len(labels))) % 2
    distances = np.zeros(features.shape[:2])
    for part in range(2):
        held = half == part
        fitted = _fit(features[~held], labels[~held], classes)
        distances[held] = np.asarray(fitted.distances(features[held].astype(np.float32)))
    walks = np.stack(
        [
            random.permuted(np.broadcast_to(np.arange(features.shape[1]), features.shape[:2]), axis=1)
            for _ in range(draws)
        ]
    )
    along = np.take_along_axis(np.broadcast_to(distances, walks.shape), walks[..., :most], axis=-1)
    means = np.cumsum(along, axis=-1) / np.arange(1, along.shape[-1] + 1)
    levels = np.quantile(means.reshape(-1, means.shape[-1]), np.linspace(0, 1, LEVELS), axis=0).T
    return replace(_fit(features, labels, classes), quantiles=jnp.asarray(levels, jnp.float32))


def _fit(features: np.ndarray, labels: np.ndarray, classes: int, shrinkage: float = 0.05) -> Strangeness:
    """Class means and the whitening of the covariance within classes, shrunk towards a multiple of the identity."""
    count = np.bincount(labels, minlength=classes)
    overall = features.mean(axis=(0, 1))
    means = np.stack([features[labels == c].mean(axis=(0, 1)) if count[c] else overall for c in range(classes)])
    within = (features - means[labels][:, None]).reshape(-1, features.shape[-1])
    covariance = within.T @ within / len(within)
    size = len(covariance)
    covariance = (1 - shrinkage) * covariance + shrinkage * np.trace(covariance) / size * np.eye(size)
    values, vectors = np.linalg.eigh(covariance)
    whitening = vectors / np.sqrt(np.maximum(values, 1e-9 * max(values.max(), 1e-30)))
    return Strangeness(
        jnp.asarray(whitening, jnp.float32), jnp.asarray(means @ whitening, jnp.float32), jnp.zeros((1, LEVELS))
    )
