"""Comparisons of policies on the same objects: paired differences, shares of the oracle's gain, means over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from eval.numbers.comparison import interval_of, interval_of_both
from mevs_jax.beliefs.metrics import bootstrap_means

BASELINES = ("random", "farthest", "fixed_order")
"""The policies with which learned policies are compared."""
_ORACLES = ("belief_oracle", "label_oracle")
_GAP = 3
"""Numbers of views, from 2 on, at which the gap between random and the label-free oracle is computed."""


@dataclass(frozen=True)
class ByObject:
    """Results of a policy on each test object, as means over its walks.

    Attributes:
        right: (steps, objects) share of the walks with the right prediction after 1, 2, … views.
        likelihood: (steps, objects) log-probability of the true class.
        from_some: (steps, objects) `right` of the walks from the start views that the oracles use.
    """

    right: Float[np.ndarray, "steps objects"]
    likelihood: Float[np.ndarray, "steps objects"]
    from_some: Float[np.ndarray, "steps objects"]


def compared(each: Mapping[str, ByObject], method: str) -> dict[str, Any]:
    """Paired differences of every policy from the baselines and from the method, and the share of the gap that each closes.

    The gap is the gain of the label-free oracle over random.
    """
    against = {
        base: {
            name: difference(mine.right, each[base].right)
            | {"likelihood": difference(mine.likelihood, each[base].likelihood)}
            for name, mine in each.items()
            if name not in (base, *_ORACLES)  # which walk from some start views only
        }
        for base in (*BASELINES, method)
        if base in each
    }
    closed: dict[str, list[tuple[float | None, list[float] | None]]] = {}
    if "belief_oracle" in each:
        random, oracle = each["random"].from_some, each["belief_oracle"].from_some
        steps = slice(1, min(len(oracle), 1 + _GAP))
        gap = oracle[steps] - random[steps]
        for name, mine in each.items():
            if name not in ("random", *_ORACLES):
                closed[name] = list(map(_share, mine.from_some[steps] - random[steps], gap))
    return {
        "against": against,
        "gap_closed": {name: [share for share, _ in steps] for name, steps in closed.items()},
        "gap_closed_interval": {name: [interval for _, interval in steps] for name, steps in closed.items()},
    }


def seeds_together(
    found: Sequence[dict[str, Any]], seeds: Sequence[Mapping[str, ByObject]], method: str
) -> dict[str, Any]:
    """Means over several seeds; each object is averaged first, since all seeds have the same objects.

    Intervals are over objects, these trainings given; `over_both` are those over objects and trainings.

    Args:
        found: the metrics that `study` returned for each seed.
        seeds: the results of each policy by object, for each seed.
    """
    policies, each, first = {}, {}, found[0]
    for name, policy in first["policies"].items():
        values = [vars(seed[name]) for seed in seeds]
        each[name] = ByObject(**{key: np.mean([value[key] for value in values], axis=0) for key in values[0]})
        errors = [one["policies"][name]["calibration_error"] for one in found]
        policies[name] = {key: policy[key] for key in ("title", "knows")} | {
            "after_views": each[name].right.mean(axis=1),
            "interval": interval_of(each[name].right),
            "calibration_error": np.mean(errors, axis=0),
        }
    same = {key: first[key] for key in ("views", "trying_starts")} | {"policies": policies} | compared(each, method)
    if len(seeds) < 2:  # one training says nothing of others
        return same
    every = {name: np.stack([seed[name].right for seed in seeds], axis=1) for name in policies}
    for name, policy in policies.items():
        policy["over_both"] = interval_of_both(every[name])
    same["against_over_both"] = {
        base: {
            name: interval_of_both(right - every[base])
            for name, right in every.items()
            if name != base and right.shape == every[base].shape
        }
        for base in BASELINES
        if base in every
    }
    return same


def gains_of_seeds(seeds: Sequence[Mapping[str, Float[np.ndarray, "steps objects"]]]) -> dict[str, Any]:
    """Gains of policies over random selection: means over seeds, with intervals over objects, and over objects and trainings."""
    gains = {
        name: np.stack([one[name] - one["random"] for one in seeds], axis=1) for name in seeds[0] if name != "random"
    }
    return {
        name: {
            "difference": gain.mean(axis=(1, 2)),
            "interval": interval_of(gain.mean(axis=1)),
            **({"over_both": interval_of_both(gain)} if len(seeds) > 1 else {}),
        }
        for name, gain in gains.items()
    }


def difference(mine: np.ndarray, base: np.ndarray) -> dict[str, Any]:
    """Mean differences of two policies by number of views, with intervals, from their (steps, objects) results."""
    steps = min(len(mine), len(base))
    return gain_of(mine[:steps] - base[:steps])


def gain_of(gain: Float[np.ndarray, "*steps objects"]) -> dict[str, Any]:
    """Mean of differences by object, with intervals."""
    return {"difference": gain.mean(axis=-1), "interval": interval_of(gain)}


def _share(
    gain: Float[np.ndarray, " objects"], gap: Float[np.ndarray, " objects"]
) -> tuple[float | None, list[float] | None]:
    """A gain over random as a share of the oracle's gain, and its 95 % interval by a bootstrap over objects.

    The share is None where the oracle has no gain, and the interval where its gain is not clearly positive.
    """
    share = float(gain.mean() / gap.mean()) if gap.mean() > 0 else None
    gains, gaps = (np.asarray(_resampled(values)) for values in (gain, gap))
    if np.quantile(gaps, 0.025) <= 0:
        return share, None
    shares = gains[gaps > 0] / gaps[gaps > 0]
    return share, np.quantile(shares, (0.025, 0.975)).tolist()


@jax.jit
def _resampled(values: Array) -> Array:
    return bootstrap_means(jax.random.key(1), values)
