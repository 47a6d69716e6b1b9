"""The validation views of a training, as batches of equal size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from data_pipeline.dataset.batches import validation_batches, validation_splits
from data_pipeline.dataset.statistics import DatasetStatistics
from train.step import Task

MOST_KEPT = 2 << 30
"""Bytes of validation views that a process keeps in memory. More are read again after every epoch."""

WeightedBatch = tuple[dict[str, np.ndarray], np.ndarray]
"""A batch, and the weight of every view."""


def class_weights_of(task: Task, statistics: DatasetStatistics) -> np.ndarray:
    """Returns the weight of a validation view of each class, (classes,).

    All are 1, unless training is `balanced`: then every class weighs the same in total.
    """
    objects = np.array(
        [
            sum(statistics.counts[split][name] for split in validation_splits(task.batches))
            for name in statistics.classes
        ]
    )
    if not task.batches.balanced:
        return np.ones(len(objects), np.float32)
    return (objects.sum() / (np.count_nonzero(objects) * np.maximum(objects, 1))).astype(np.float32)


class ValidationSet:
    """This process's part of the validation views, as batches of equal size with the weight of every view.

    Weights are those of `class_weights_of`, and 0 for views that only fill up a batch. With equal sizes, one compiled program
    serves all batches in all processes. It may be iterated over any number of times.

    Args:
        task: whose views they are.
        data: folder of the data set.
        statistics: those of the data set.
        devices: devices, of all processes together, that share a batch.
        whole: whether this process's part is all of the views, as where processes train networks of their own.
        most_kept: bytes that are kept in memory; if there are more, they are read again each time.
    """

    def __init__(
        self,
        task: Task,
        data: Path,
        statistics: DatasetStatistics,
        devices: int,
        most_kept: int = MOST_KEPT,
        *,
        whole: bool = False,
    ) -> None:
        index, processes = (0, 1) if whole else (jax.process_index(), jax.process_count())
        objects = statistics.objects_of(validation_splits(task.batches))
        self._task, self._data, self._counts = task, data, index < objects
        self._part = slice(index, None, processes) if self._counts else slice(1)
        self._class_weights = class_weights_of(task, statistics)
        first = next(self._read_objects(workers=0))
        of_an_object = len(first["label"])
        most = -(-objects // processes) * of_an_object  # of any process
        # Views of an object stay on a device where they belong together.
        together = (devices // processes) * (of_an_object if task.group > 1 else 1)
        self._size = -(-min(256, most) // together) * together
        self._count = -(-most // self._size)
        stored = most * sum(array.nbytes for array in first.values()) // of_an_object
        self._kept = list(self._read()) if stored <= most_kept else None

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[WeightedBatch]:
        return self._read() if self._kept is None else iter(self._kept)

    def _read_objects(self, **changed: Any) -> Iterator[dict[str, np.ndarray]]:
        batches, views = replace(self._task.batches, **changed), self._task.optimiser.validation_views
        return validation_batches(self._data, batches, views, self._part)

    def _read(self) -> Iterator[WeightedBatch]:
        waiting: list[dict[str, np.ndarray]] = []
        views = made = 0
        for example in self._read_objects():
            waiting.append(example)
            views += len(example["label"])
            while views >= self._size:
                whole = _joined(waiting)
                yield self._weighted({name: array[: self._size] for name, array in whole.items()}, self._size)
                waiting, views = [{name: array[self._size :] for name, array in whole.items()}], views - self._size
                made += 1
        last = _joined(waiting) if views else None
        for _ in range(made, self._count):  # processes have equally many batches
            filled = last or example
            yield self._weighted(
                {name: np.resize(array, (self._size, *array.shape[1:])) for name, array in filled.items()},
                views if last else 0,
            )
            last = None

    def _weighted(self, batch: dict[str, np.ndarray], real: int) -> WeightedBatch:
        weights = np.zeros(self._size, np.float32)
        if self._counts:
            weights[:real] = self._class_weights[batch["label"][:real]]
        return batch, weights


def _joined(examples: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([example[name] for example in examples]) for name in examples[0]}
