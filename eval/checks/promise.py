"""What "sure" is worth: how often answers of agents that stop are wrong, and what they say of objects of unknown classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from eval.checks.walks import Walks
from eval.numbers.comparison import intervals
from eval.numbers.confidence import stops_at


@dataclass(frozen=True)
class PromiseRow:
    """Walks that end as an agent's do, at a probability or when their views are spent.

    Attributes:
        stop: the calibrated probability at which they stop.
        views: the largest number of views.
        wrong: share of wrong answers among walks around known objects that end sure; None if none does.
        excess: 95 % interval, over objects, of the share of walks that end sure and are wrong, less what `stop` allows.
        sure, refused: shares of the walks around known objects that end sure, and as an unknown object; None without any.
        strangers_sure, strangers_refused: the same around objects of unknown classes.
        interval: of `strangers_sure`, 95 % over objects.
    """

    stop: float
    views: int
    wrong: float | None
    excess: list[float] | None
    sure: float | None
    refused: float | None
    strangers_sure: float | None
    strangers_refused: float | None
    interval: list[float] | None


@dataclass(frozen=True)
class StrangerRow:
    """How well objects of unknown classes are separated from the others after some random views.

    Attributes:
        auroc: area under the ROC curve (½ is chance, 1 perfect) of one walk of each object, averaged over walks.
        unknown_found, known_refused: shares of unknown and of known objects that are said to be unknown.
    """

    views: int
    auroc: float
    unknown_found: float
    known_refused: float


@dataclass(frozen=True)
class Strangers:
    """Number of objects of unknown classes, and how well they are distinguished from the others."""

    objects: int
    after: list[StrangerRow]


def promises(
    walks: Walks, known: Bool[np.ndarray, " objects"], stops: Sequence[float], budgets: Sequence[int]
) -> list[PromiseRow]:
    """What walks around known and unknown objects end with, for each probability and number of views."""
    rows = []
    for stop in stops:
        for views in (count for count in budgets if count <= walks.right.shape[-1]):
            stopped = walks.confidence[..., :views] >= stop
            at = stops_at(stopped)[..., None]
            right, unknown = (
                np.take_along_axis(values, at, axis=-1)[..., 0] for values in (walks.right, walks.unknown)
            )
            sure = stopped.any(axis=-1) & ~unknown
            by_object = [values.mean(axis=1) for values in (sure & ~right, sure, unknown)]
            (wrong, of_known, refused), (_, of_strangers, found) = (
                [values[some] for values in by_object] for some in (known, ~known)
            )
            rows.append(
                PromiseRow(
                    stop=stop,
                    views=views,
                    wrong=float(wrong.mean() / of_known.mean()) if of_known.any() else None,
                    excess=intervals(wrong - (1 - stop) * of_known) if len(wrong) else None,
                    sure=_mean(of_known),
                    refused=_mean(refused),
                    strangers_sure=_mean(of_strangers),
                    strangers_refused=_mean(found),
                    interval=intervals(of_strangers) if len(of_strangers) else None,
                )
            )
    return rows


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


def strangers(walks: Walks, known: Bool[np.ndarray, " objects"], views: Sequence[int] = (1, 2, 4)) -> Strangers | None:
    """How well unknown objects are separated from the others on walks; None if one kind is missing or no score exists."""
    if known.all() or not known.any() or np.isnan(walks.strange).any():
        return None
    rows = []
    for count in (count for count in views if count <= walks.right.shape[-1]):
        scores, said = walks.strange[..., count - 1], walks.unknown[..., count - 1]
        area = np.mean([auroc(one, ~known) for one in scores.T])
        rows.append(StrangerRow(count, float(area), float(said[~known].mean()), float(said[known].mean())))
    return Strangers(int((~known).sum()), rows)


def auroc(scores: np.ndarray, positive: np.ndarray) -> float:
    """Probability that a positive has a higher score than a negative; equal scores count half."""
    from scipy.stats import rankdata  # late, since it takes a quarter of a second

    ranks, count = rankdata(scores), int(positive.sum())
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * (len(scores) - count)))
