"""What the grid says, with intervals: accuracies, differences from random, area under the curve, views to reach an accuracy.

Everything is resampled over objects with the same draws, so every difference is paired, whatever is compared.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eval.walks.grid import Results
from mevs_jax.metrics import bootstrap_interval, bootstrap_means

_KEY = 1
"""Of the bootstrap: the same objects are drawn for every cell."""
REFERENCE_VIEWS = (3, 5, 9)
"""How many random views the others are compared with in `views_to_reach`."""


@jax.jit
def _intervals(values: jax.Array) -> jax.Array:
    key = jax.random.key(_KEY)
    flat = values.reshape(-1, values.shape[-1])
    return jax.vmap(lambda cell: bootstrap_interval(key, cell))(flat).reshape(*values.shape[:-1], 2)


def intervals(values: np.ndarray) -> list:
    """95 % intervals of means over the last axis, objects; for a single cell, two numbers."""
    return np.asarray(_intervals(jnp.asarray(values, jnp.float32)), float).tolist()


def class_mean(right: np.ndarray, labels: np.ndarray) -> np.ndarray | np.floating:
    """Mean recall over the classes that occur, from (…, objects)."""
    return np.stack([right[..., labels == label].mean(axis=-1) for label in np.unique(labels)]).mean(axis=0)


def cells(results: Results) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`right`, `used`, `after`, `travelled` of the first backbone, each with the objects last."""
    arrays = results.right, results.used, results.after, results.travelled
    return tuple(np.moveaxis(np.asarray(array[0]), 0, -1) for array in arrays)  # type: ignore[return-value]


def summarise(results: Results, labels: np.ndarray) -> dict[str, Any]:
    """One policy's numbers, (MV, CT) or by number of views, and their intervals."""
    right, used, after, travelled = cells(results)
    return {
        "accuracy": right.mean(axis=-1).tolist(),
        "interval": intervals(right),
        "class_accuracy": class_mean(right, labels).tolist(),
        "views_used": used.mean(axis=-1).tolist(),
        "after_views": after.mean(axis=-1).tolist(),
        "after_views_interval": intervals(after),
        "travelled": travelled.mean(axis=-1).tolist(),
        "area": float(after.mean()),
        "area_interval": intervals(after.mean(axis=0)),
    }


def difference(results: Results, base: Results) -> dict[str, Any]:
    """One policy minus another on the same objects and starts."""
    (right, used, after, _), (base_right, base_used, base_after, _) = cells(results), cells(base)
    gain, gain_after, gain_used = right - base_right, after - base_after, used - base_used
    return {
        "difference": gain.mean(axis=-1).tolist(),
        "interval": intervals(gain),
        "after_views_difference": gain_after.mean(axis=-1).tolist(),
        "after_views_interval": intervals(gain_after),
        "views_used_difference": gain_used.mean(axis=-1).tolist(),
        "area_difference": float(gain_after.mean()),
        "area_interval": intervals(gain_after.mean(axis=0)),
    }


def first_reaching(curve: np.ndarray, target: np.ndarray | np.floating) -> np.ndarray:
    """Number of views, interpolated, at which each curve (…, steps) first reaches its target (…); inf where never."""
    target = np.asarray(target)
    reached = curve >= target[..., None]
    at = reached.argmax(axis=-1)
    high = np.take_along_axis(curve, at[..., None], axis=-1)[..., 0]
    low = np.take_along_axis(curve, np.maximum(at - 1, 0)[..., None], axis=-1)[..., 0]
    part = np.where(at > 0, (target - low) / np.where(high > low, high - low, 1), 1)
    return np.where(reached.any(axis=-1), at + part, np.inf)


def views_to_reach(results: dict[str, Results], baseline: str = "random") -> dict[str, Any]:
    """How many views each policy needs to be as accurate as the baseline after 3, 5 and 9; None where it never is."""
    curves = {name: cells(result)[2] for name, result in results.items()}

    @jax.jit
    def resampled(after: jax.Array) -> jax.Array:
        return jax.vmap(lambda step: bootstrap_means(jax.random.key(_KEY), step))(after).T

    means = {name: after.mean(axis=-1) for name, after in curves.items()}
    drawn = {name: np.asarray(resampled(jnp.asarray(after))) for name, after in curves.items()}
    out: dict[str, Any] = {}
    for views in REFERENCE_VIEWS:
        if views > len(means[baseline]):
            continue
        out[str(views)] = {"accuracy": float(means[baseline][views - 1]), "views": {}, "interval": {}}
        for name in curves:
            exactly = first_reaching(means[name], means[baseline][views - 1])
            ends = np.quantile(
                first_reaching(drawn[name], drawn[baseline][:, views - 1]), (0.025, 0.975), method="nearest"
            )
            out[str(views)]["views"][name] = float(exactly) if np.isfinite(exactly) else None
            out[str(views)]["interval"][name] = [float(end) if np.isfinite(end) else None for end in ends]
    return out
