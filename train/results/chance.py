"""Whether a classifier learned anything: its accuracy compared with that of always naming the most frequent class."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from data_pipeline.dataset.batches import validation_splits
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.progress import console
from train.step import Task

_QUANTILE = 1.959964
"""97.5 % quantile of the normal distribution, for two-sided 95 % intervals."""


def wilson_interval(share: float, count: float) -> tuple[float, float]:
    """Returns the 95 % interval of a probability by Wilson's score, given the share of successes in `count` trials.

    Unlike the normal approximation, it is usable for few trials and for shares near 0 and 1.
    """
    squared = _QUANTILE**2
    centre = (share + squared / (2 * count)) / (1 + squared / count)
    half = _QUANTILE * math.sqrt(share * (1 - share) / count + squared / (4 * count**2)) / (1 + squared / count)
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True)
class Chance:
    """The accuracy of a classifier beside that of always naming the most frequent class.

    Attributes:
        accuracy: mean accuracy on single views.
        objects: number of objects whose views these are.
        classes: number of classes.
        most_frequent: share of the most frequent class, which is the accuracy of always naming it.
        balanced: whether every class weighs the same in `accuracy`, so that naming any one class is as good.
    """

    accuracy: float
    objects: int
    classes: int
    most_frequent: float
    balanced: bool = False

    @classmethod
    def of(
        cls, accuracy: float, statistics: DatasetStatistics, splits: Sequence[str], balanced: bool = False
    ) -> Chance:
        """Returns the comparison for the objects of some splits of a data set.

        Args:
            accuracy: mean accuracy on single views.
            balanced: whether every class weighs the same in `accuracy`.
        """
        counts = [sum(statistics.counts[split][name] for split in splits) for name in statistics.classes]
        present = sum(count > 0 for count in counts)
        share = 1 / present if balanced else max(counts) / sum(counts)
        return cls(accuracy, sum(counts), len(counts), share, balanced)

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the accuracy.

        The number of trials is that of the objects, not of the views: views of one object are not independent. If they were,
        the interval would be narrower.
        """
        return wilson_interval(self.accuracy, self.objects)

    @property
    def stayed(self) -> bool:
        """Whether the accuracy cannot be told from chance: its interval does not lie above `most_frequent`."""
        return self.interval[0] <= self.most_frequent

    def warning(self, network: str, views: str) -> str | None:
        """Returns a sentence if the classifier stayed at chance, else None.

        Args:
            network: its name.
            views: which views the accuracy is of: "validation" or "test".
        """
        if not self.stayed:
            return None
        verdict = "stayed at" if self.accuracy <= self.most_frequent else "cannot be told from"
        low, high = self.interval
        always = "always the same class" if self.balanced else "always the most frequent class"
        return (
            f"the {network} {verdict} chance: {views} accuracy {100 * self.accuracy:.1f} % on {self.objects} objects of "
            f"{self.classes} classes, 95 % interval {100 * low:.1f} to {100 * high:.1f} % ({always}: "
            f"{100 * self.most_frequent:.1f} %); comparisons of policies mean nothing until it learns: train it for more epochs, "
            f"on more objects, or with another learning rate"
        )


def warn_of_chance(task: Task, summary: dict[str, Any], statistics: DatasetStatistics) -> None:
    """Prints a warning if a classifier's validation accuracy in its best epoch is not above chance.

    Args:
        task: its training; nothing is printed if it has no metric `accuracy`.
        summary: of the training, as `train.loop.fit` returns it.
        statistics: those of the data set.
    """
    if "accuracy" not in task.metrics:
        return
    accuracy, batches = summary["best"]["accuracy"], task.batches
    chance = Chance.of(accuracy, statistics, validation_splits(batches), batches.balanced)
    if (warning := chance.warning(task.name, "validation")) is not None:
        console.print(f"Warning: {warning}", style="yellow", markup=False)
