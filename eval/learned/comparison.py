"""Comparisons of policies on the same objects: paired differences, shares of the oracle's gain, means over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from eval.numbers.comparison import interval_of_both, intervals
from mevs_jax.beliefs.metrics import bootstrap_means

BASELINES = ("random", "farthest", "fixed_order")
"""The policies with which learned policies are compared."""
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
    from_some = {name: policy.from_some.mean(axis=1) for name, policy in each.items()}
    against = {
        base: {
            name: difference(mine.right, each[base].right)
            | {"likelihood": difference(mine.likelihood, each[base].likelihood)}
            for name, mine in each.items()
            if name not in (base, "belief_oracle", "label_oracle")  # the oracles walk from some start views only
        }
        for base in (*BASELINES, method)
        if base in each
    }
    gap_closed = {
        name: _gap_closed(mine, from_some["random"], from_some["belief_oracle"])
        for name, mine in from_some.items()
        if "belief_oracle" in each and name not in ("random", "belief_oracle", "label_oracle")
    }
    walked = {name: policy.from_some for name, policy in each.items()}
    intervals_of_gap = {
        name: _interval_of_gap(walked[name], walked["random"], walked["belief_oracle"]) for name in gap_closed
    }
    return {"against": against, "gap_closed": gap_closed, "gap_closed_interval": intervals_of_gap}


def seeds_together(
    found: Sequence[dict[str, Any]], seeds: Sequence[Mapping[str, ByObject]], method: str
) -> dict[str, Any]:
    """Means over several seeds; each object is averaged first, since all seeds have the same objects.

    Intervals are over objects, these trainings given; `over_both` are those over objects and trainings.

    Args:
        found: the metrics that `study` returned for each seed.
        seeds: the results of each policy by object, for each seed.
    """

    def mean(name: str) -> ByObject:
        values = [vars(seed[name]) for seed in seeds]
        return ByObject(**{key: np.mean([value[key] for value in values], axis=0) for key in values[0]})

    each, first = {name: mean(name) for name in found[0]["policies"]}, found[0]
    policies = {
        name: {key: policy[key] for key in ("title", "knows")}
        | {
            "after_views": each[name].right.mean(axis=1).tolist(),
            "interval": intervals(each[name].right),
            "calibration_error": np.mean(
                [one["policies"][name]["calibration_error"] for one in found], axis=0
            ).tolist(),
        }
        for name, policy in first["policies"].items()
    }
    same = {key: first[key] for key in ("views", "trying_starts")}
    if len(seeds) < 2:  # one training says nothing of others
        return same | {"policies": policies} | compared(each, method)
    every = {name: np.stack([seed[name].right for seed in seeds], axis=1) for name in policies}
    for name, policy in policies.items():
        policy["over_both"] = interval_of_both(every[name]).tolist()
    over_both = {
        base: {
            name: interval_of_both(right - every[base]).tolist()
            for name, right in every.items()
            if name != base and right.shape == every[base].shape
        }
        for base in BASELINES
        if base in every
    }
    return same | {"against_over_both": over_both} | {"policies": policies} | compared(each, method)


def gains_of_seeds(seeds: Sequence[Mapping[str, Float[np.ndarray, "steps objects"]]]) -> dict[str, Any]:
    """Gains of policies over random selection: means over seeds, with intervals over objects, and over objects and trainings."""
    gains = {
        name: np.stack([one[name] - one["random"] for one in seeds], axis=1) for name in seeds[0] if name != "random"
    }
    return {
        name: {
            "difference": gain.mean(axis=(1, 2)).tolist(),
            "interval": intervals(gain.mean(axis=1)),
            **({"over_both": interval_of_both(gain).tolist()} if len(seeds) > 1 else {}),
        }
        for name, gain in gains.items()
    }


def difference(mine: np.ndarray, base: np.ndarray) -> dict[str, Any]:
    """Mean differences of two policies by number of views, with intervals, from their (steps, objects) results."""
    steps = min(len(mine), len(base))
    gain = mine[:steps] - base[:steps]
    return {"difference": gain.mean(axis=1).tolist(), "interval": intervals(gain)}


def _interval_of_gap(mine: np.ndarray, random: np.ndarray, oracle: np.ndarray) -> list[list[float] | None]:
    """95 % intervals of `_gap_closed` by a bootstrap over objects; None where the oracle's gain is not clearly positive.

    Args:
        mine, random, oracle: (steps, objects) results by object.
    """
    found: list[list[float] | None] = []
    for step in range(1, min(len(oracle), 1 + _GAP)):
        gain, gap = (np.asarray(_resampled(one[step] - random[step])) for one in (mine, oracle))
        clear = np.quantile(gap, 0.025) > 0
        shares = gain[gap > 0] / gap[gap > 0]
        found.append(np.quantile(shares, (0.025, 0.975)).tolist() if clear else None)
    return found


@jax.jit
def _resampled(values: Array) -> Array:
    return bootstrap_means(jax.random.key(1), values)


def _gap_closed(mine: np.ndarray, random: np.ndarray, oracle: np.ndarray) -> list[float | None]:
    """Gain over random as a share of the oracle's gain, from 2 views on; None where the oracle has no gain."""
    steps = slice(1, min(len(oracle), 1 + _GAP))
    gains = zip(mine[steps] - random[steps], oracle[steps] - random[steps], strict=True)
    return [float(gain / gap) if gap > 0 else None for gain, gap in gains]
