"""Metrics of the grid with intervals: accuracies, differences from random, area under the curve, views to reach an accuracy.

The bootstrap resamples objects with the same draws everywhere, so every difference is paired.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Shaped

from eval.numbers.metrics import Difference, Reach, Summary
from eval.walks.grid import Results
from mevs_jax.beliefs.metrics import bootstrap_interval, bootstrap_means

_KEY = 1
"""Seed of the bootstrap; every cell uses the same resampled objects."""
REFERENCE_VIEWS = (3, 5, 9)
"""Numbers of views after which the baseline's accuracy is the target in `views_to_reach`."""


@jax.jit
def _intervals(values: jax.Array) -> jax.Array:
    key = jax.random.key(_KEY)
    flat = values.reshape(-1, values.shape[-1])
    return jax.vmap(lambda cell: bootstrap_interval(key, cell))(flat).reshape(*values.shape[:-1], 2)


def interval_of(values: Shaped[np.ndarray, "*cells objects"]) -> Float[np.ndarray, "*cells 2"]:
    """95 % intervals of means over the objects."""
    return np.asarray(_intervals(jnp.asarray(values, jnp.float32)), float)


def intervals(values: np.ndarray) -> list:
    """As `interval_of`, in lists."""
    return interval_of(values).tolist()


def interval_of_both(values: Float[np.ndarray, "*cells trainings objects"]) -> Float[np.ndarray, "*cells 2"]:
    """95 % intervals of means for other objects *and* other trainings, of values of the same objects in every training.

    The variance of the mean has two parts: the variance of the objects' means over trainings, divided by the number of objects;
    and that of the trainings' means over objects, divided by the number of trainings. What is special to one object in one
    training counts in both, so that the interval is rather too wide than too narrow. It is a t interval with Satterthwaite's
    degrees of freedom. A bootstrap that resamples both is too narrow for a few trainings: three of them resampled have two thirds
    of their variance, and it does not know how uncertain a variance of three numbers is (a test compares both).

    Raises:
        ValueError: for fewer than two trainings or objects.
    """
    from scipy.special import stdtrit  # imported late: it takes a twentieth of a second

    *_, trainings, objects = values.shape
    if min(trainings, objects) < 2:
        raise ValueError(f"an interval over both needs two trainings and two objects, got {trainings} and {objects}")
    mean = values.mean(axis=(-2, -1))
    parts = (
        (values.mean(axis=-2).var(axis=-1, ddof=1) / objects, objects - 1),
        (values.mean(axis=-1).var(axis=-1, ddof=1) / trainings, trainings - 1),
    )
    variance = sum(part for part, _ in parts)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    half = np.where(variance > 0, stdtrit(np.nan_to_num(freedom, nan=1.0), 0.975), 0) * np.sqrt(variance)
    return np.stack([mean - half, mean + half], axis=-1)


def class_mean(right: np.ndarray, labels: np.ndarray) -> np.ndarray | np.floating:
    """Mean recall (…) over the classes that occur, from `right` (…, objects)."""
    return np.stack([right[..., labels == label].mean(axis=-1) for label in np.unique(labels)]).mean(axis=0)


def cells(results: Results) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`right`, `used`, `after` and `travelled` of the first backbone, each with the objects as the last axis."""
    arrays = results.right, results.used, results.after, results.travelled
    return tuple(np.moveaxis(np.asarray(array[0]), 0, -1) for array in arrays)  # type: ignore[return-value]


def summarise(results: Results, labels: np.ndarray) -> Summary:
    """Metrics of one policy with their intervals."""
    right, used, after, travelled = cells(results)
    return Summary(
        accuracy=right.mean(axis=-1),
        interval=interval_of(right),
        class_accuracy=np.asarray(class_mean(right, labels)),
        views_used=used.mean(axis=-1),
        after_views=after.mean(axis=-1),
        after_views_interval=interval_of(after),
        travelled=travelled.mean(axis=-1),
        area=float(after.mean()),
        area_interval=interval_of(after.mean(axis=0)),
    )


def difference(results: Results, base: Results) -> Difference:
    """Differences of one policy from another on the same objects and start views."""
    gain, gain_used, gain_after, _ = (mine - other for mine, other in zip(cells(results), cells(base), strict=True))
    return Difference(
        difference=gain.mean(axis=-1),
        interval=interval_of(gain),
        after_views_difference=gain_after.mean(axis=-1),
        after_views_interval=interval_of(gain_after),
        views_used_difference=gain_used.mean(axis=-1),
        area_difference=float(gain_after.mean()),
        area_interval=interval_of(gain_after.mean(axis=0)),
    )


def first_reaching(curve: np.ndarray, target: np.ndarray | np.floating) -> np.ndarray:
    """Interpolated number of views at which each curve (…, steps) first reaches its target (…); inf if it never does."""
    target = np.asarray(target)
    reached = curve >= target[..., None]
    at = reached.argmax(axis=-1)
    high = np.take_along_axis(curve, at[..., None], axis=-1)[..., 0]
    low = np.take_along_axis(curve, np.maximum(at - 1, 0)[..., None], axis=-1)[..., 0]
    part = np.where(at > 0, (target - low) / np.where(high > low, high - low, 1), 1)
    return np.where(reached.any(axis=-1), at + part, np.inf)


def views_to_reach(results: dict[str, Results], baseline: str = "random") -> dict[int, Reach]:
    """Number of views that each policy needs for the baseline's accuracy after 3, 5 and 9 views."""
    curves = {name: cells(result)[2] for name, result in results.items()}

    @jax.jit
    def resampled(after: jax.Array) -> jax.Array:
        return jax.vmap(lambda step: bootstrap_means(jax.random.key(_KEY), step))(after).T

    means = {name: after.mean(axis=-1) for name, after in curves.items()}
    drawn = {name: np.asarray(resampled(jnp.asarray(after))) for name, after in curves.items()}

    def known(views: np.ndarray | np.floating) -> float | None:
        return float(views) if np.isfinite(views) else None

    def reach(views: int) -> Reach:
        exactly, ends = {}, {}
        for name in curves:
            exactly[name] = known(first_reaching(means[name], means[baseline][views - 1]))
            resampled_views = first_reaching(drawn[name], drawn[baseline][:, views - 1])
            low, high = np.quantile(resampled_views, (0.025, 0.975), method="nearest")
            ends[name] = known(low), known(high)
        return Reach(float(means[baseline][views - 1]), exactly, ends)

    return {views: reach(views) for views in REFERENCE_VIEWS if views <= len(means[baseline])}
