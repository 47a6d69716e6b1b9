"""Fits what a recogniser is expected to say of each class from every direction, on the objects that it was trained on.

A recogniser knows these objects, so it is surer of them than of others. Which views separate which classes can be read from them
all the same (see the ablations in the documentation), and no object of any other split is needed.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mevs_jax.models.expected_views import ExpectedViews, harmonics

DEGREE = 6
"""Largest degree of the harmonics: 49 terms, which vary over about 30°."""
_RIDGE = 1.0
"""Weight of the squared coefficients, in views; it matters only for a class with hardly any."""
FITTED_AS = f"degree {DEGREE}, ridge {_RIDGE}"
"""Names the way of fitting, for the identity of what is stored."""


def fit_expected_views(
    directions: Float[np.ndarray, "samples 3"],
    log_probabilities: Float[np.ndarray, "samples classes"],
    labels: Int[np.ndarray, " samples"],
    degree: int = DEGREE,
) -> ExpectedViews:
    """Returns the least-squares fit for each class; all zeros, which is no evidence, for a class without views.

    Args:
        directions: unit vectors from the object to the camera of each view, in the object's frame.
        log_probabilities: of the classes after each single view.
        labels: true class of each view.
        degree: largest degree of the harmonics.
    """
    penalty = _RIDGE / (4 * np.pi) * np.eye((degree + 1) ** 2)

    def of_class(label: int) -> np.ndarray:
        own = labels == label
        terms = np.asarray(harmonics(np.asarray(directions[own], np.float32), degree), np.float64)
        return np.linalg.solve(terms.T @ terms + penalty, terms.T @ log_probabilities[own])

    return ExpectedViews(jnp.asarray(np.stack([of_class(y) for y in range(log_probabilities.shape[1])]), jnp.float32))
