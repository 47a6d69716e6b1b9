"""Batches of views from shards, read by a Grain pipeline with random access.

An epoch contains every training object once, with `views_per_object` views drawn anew. Batch `i` is a function of (seed, i)
alone, so a resumed run reads the same batches and needs to store only the step. With several processes, each reads its own
part of every batch.

Validation is by object. The thesis's published code holds out views instead, so that the same objects are used for training
and validation. The option `ViewBatches.validation_by` reproduces this, to show its effect.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.index import read_index
from data_pipeline.processes import end_with_parent, usable_cpus


@dataclass(frozen=True)
class ViewBatches:
    """How training views are drawn.

    Attributes:
        batch_size: number of views in a batch, over all processes; a multiple of `views_per_object`.
        views_per_object: number of distinct views of each object in an epoch.
        points: number of points in a cloud; 0 for no clouds.
        images: `depth` or `image`, or None for neither.
        seed: seed of the order, the views and the points.
        fold: (k, n) to train without part k of n of the training objects; None to train on all of them.
        validation_by: `object`, without leakage; or `view`, to train also on views of the validation objects, except for a share
            of every object's views (`views_aside`).
        balanced: repeat the objects of rarer classes in an epoch, so that all classes have the same weight.
        workers: number of processes that read; 0 for threads of this process. Batches are the same.
        target: name of values of the views that are learned in place of their entropies (`target_path`); empty for entropies.
    """

    batch_size: int
    views_per_object: int
    points: int = 0
    images: str | None = None
    seed: int = 0
    fold: tuple[int, int] | None = None
    validation_by: Literal["object", "view"] = "object"
    balanced: bool = False
    workers: int = 0
    target: str = ""

    def __post_init__(self) -> None:
        if self.fold is not None and self.validation_by == "view":
            why = "with validation by view, an object of each part is trained on"
            raise ValueError(f"folds are parts of the objects; {why}")


VIEWS_ASIDE = 0.2
"""Share of each object's views that is held out if validation is by view (thesis §5.2)."""


def views_aside(views: int, index: int, seed: int) -> np.ndarray:
    """Returns the sorted views of training object `index` that are held out if validation is by view; at least one."""
    random = np.random.default_rng([seed, index, views])
    return np.sort(random.permutation(views)[: max(1, round(VIEWS_ASIDE * views))])


def sample_pixels(depth: np.ndarray, points: int, random: np.random.Generator) -> np.ndarray:
    """Returns flat indices (points,) int32 of random pixels that hit the object, repeated only if there are too few.

    For a view in which nothing is hit, all indices are 0; with a depth of 0, they become the camera's centre.
    """
    hit = np.flatnonzero(depth)
    if len(hit) == 0:
        return np.zeros(points, np.int32)
    if len(hit) >= points:
        return random.choice(hit, points, replace=False).astype(np.int32)
    return np.resize(random.permutation(hit), points).astype(np.int32)


def _keys_read(points: int, images: str | None) -> tuple[str, ...]:
    """Keys of an object that `views_of_example` reads: pixels that are not needed are not decoded."""
    return ("label", "pose", "entropy", "radius", *([images] if images else []), *(["depth"] if points else []))


def views_of_example(
    example: dict[str, Any], views: np.ndarray, *, points: int, images: str | None, random: np.random.Generator
) -> dict[str, np.ndarray]:
    """Returns the given views of one object as arrays with a leading axis of views.

    The keys are `label`, `view`, `pose`, `entropy` (of all views of the object), `radius` (of the object, in the units of its
    file; NaN in data sets that lack it), `depth` or `image` as `images` says, and, if `points` is not 0, `pixels` and
    `pixel_depth`.
    """
    out = {
        "label": np.full(len(views), example["label"], np.int32),
        "view": views.astype(np.int32),
        "pose": example["pose"][views],
        "entropy": np.repeat(example["entropy"][None], len(views), axis=0),
        "radius": np.full(len(views), example.get("radius", np.nan), np.float32),
    }
    if images:
        out[images] = example[images][views]
    if points:
        pixels = np.stack([sample_pixels(example["depth"][view], points, random) for view in views])
        flat = example["depth"][views].reshape(len(views), -1)
        out |= {"pixels": pixels, "pixel_depth": np.take_along_axis(flat, pixels, axis=1)}
    return out


def _draw_views(element: dict[str, Any], rng: np.random.Generator, config: ViewBatches) -> dict[str, np.ndarray]:
    """Draws `views_per_object` of the views of an object that may be used for training."""
    views = rng.choice(element["trainable"], config.views_per_object, replace=False)
    return views_of_example(element, views, points=config.points, images=config.images, random=rng)


def fold_of(objects: int, folds: int) -> np.ndarray:
    """Returns the fold (0 to folds − 1) of each training object, in the order of the shards, which is random."""
    return np.arange(objects) % folds


def objects_kept(objects: int, config: ViewBatches) -> np.ndarray:
    """Returns the indices of the training objects outside of the fold left out, of `objects` in all."""
    if config.fold is None:
        return np.arange(objects)
    part, folds = config.fold
    return np.flatnonzero(fold_of(objects, folds) != part)


def equally_often(objects: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Returns the objects, with those of rarer classes repeated so that all classes have the same number."""
    _, members = np.unique(labels, return_inverse=True)
    largest = int(np.bincount(members).max())
    return np.concatenate([np.resize(objects[members == one], largest) for one in range(members.max() + 1)])


def target_path(folder: Path, target: str, split: str) -> Path:
    """Returns the file of the values of all views of a split, `array` (objects, views), in the order of the shards."""
    return folder / "targets" / f"{target}_{split}.npz"


class _Valued:
    """Objects of a split with other values in place of their entropies."""

    def __init__(self, objects: Any, path: Path):
        with np.load(path) as stored:
            self._objects, self._values = objects, stored["array"]

    def __len__(self) -> int:
        return len(self._objects)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self._objects[index] | {"entropy": self._values[index]}


def _objects_of(folder: Path, split: str, config: ViewBatches) -> Any:
    """Returns the objects of a split, with what views hold and what is learned of them."""
    objects = open_split(folder, split, _keys_read(config.points, config.images))
    return _Valued(objects, target_path(folder, config.target, split)) if config.target else objects


class _TrainingObjects:
    """The objects of all training splits, concatenated; the key `trainable` lists the views that may be used for training."""

    def __init__(self, folder: Path, config: ViewBatches):
        splits = training_splits(config)
        self._sources, self._config = [_objects_of(folder, split, config) for split in splits], config
        self._kept = objects_kept(sum(map(len, self._sources)), config)
        if config.balanced:
            labels = np.concatenate([read_index(folder, split, "label")["label"] for split in splits])
            self._kept = equally_often(self._kept, labels[self._kept])

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, index: int) -> dict[str, Any]:
        index = int(self._kept[index])
        source, position = self._sources[0], index
        for source in self._sources:
            if position < len(source):
                break
            position -= len(source)
        example = source[position]
        views = np.arange(len(example["entropy"]))
        if self._config.validation_by == "view":
            views = np.setdiff1d(views, views_aside(len(views), index, self._config.seed))
        return example | {"trainable": views}


def training_splits(config: ViewBatches) -> tuple[str, ...]:
    """Returns the splits used for training."""
    return ("train",) if config.validation_by == "object" else ("train", "val")


def validation_splits(config: ViewBatches) -> tuple[str, ...]:
    """Returns the splits used for validation."""
    return ("val",) if config.validation_by == "object" else training_splits(config)


def validation_batches(
    folder: Path, config: ViewBatches, views: int, part: slice = slice(None)
) -> Iterator[dict[str, np.ndarray]]:
    """Returns an iterator over the validation views, one object per batch.

    If validation is by object, different objects contribute different views, so that every view of the lattice is used. If it
    is by view, an object contributes views that are held out.

    Args:
        views: number of views of each object (by view: their held-out share); 0 for all of them.
        part: which of the objects; all by default.
    """
    by_object = config.validation_by == "object"
    objects = _objects_of(folder, "val", config) if by_object else _TrainingObjects(folder, config)
    positions = range(len(objects))[part]
    return _read(
        _mapped(positions, partial(_validation_views, objects=objects, config=config, views=views)), config.workers
    )


def _validation_views(index: int, objects: Any, config: ViewBatches, views: int) -> dict[str, np.ndarray]:
    """Returns the validation views of the object at a position."""
    example = objects[index]
    count = len(example["entropy"])
    if config.validation_by == "object":
        wanted = min(views or count, count)
        keep = (np.arange(wanted) * count // wanted + index) % count if views else np.arange(count)
    else:
        aside = views_aside(count, index, config.seed)
        keep = aside[: max(1, round(VIEWS_ASIDE * views))] if views else aside
    random = np.random.default_rng([config.seed, index])
    return views_of_example(example, keep, points=config.points, images=config.images, random=random)


def _mapped(positions: Sequence[int], function: Callable[[int], dict[str, np.ndarray]]) -> Any:
    """Returns a Grain data set of a function of positions."""
    import grain  # imported late: it takes a sixth of a second

    return grain.MapDataset.source(positions).map(function)


def _begin_worker(index: int, count: int) -> None:
    """Prepares a reading process: it leaves signals to the training process, and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    end_with_parent()


def _read(stream: Any, workers: int) -> Iterator[dict[str, np.ndarray]]:
    """Returns an iterator over a Grain data set, which is read ahead by threads, or by so many processes."""
    import grain

    threads = 1 if workers else min(16, max(1, usable_cpus() // 2))
    read = stream.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=16))
    if workers:
        from absl import flags

        if not flags.FLAGS.is_parsed():  # of the command line, which has none of Abseil's; Grain asks for some
            flags.FLAGS.mark_as_parsed()
        options = grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=4)
        read = read.mp_prefetch(options, worker_init_fn=_begin_worker)
    return iter(read)


def _join(elements: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {key: np.concatenate([element[key] for element in elements]) for key in elements[0]}


def objects_per_batch(config: ViewBatches) -> int:
    """Returns the number of objects in a batch, over all processes.

    Raises:
        ValueError: if the batch size is not a multiple of the views per object.
    """
    if config.batch_size % config.views_per_object:
        views = f"{config.views_per_object} views per object"
        raise ValueError(f"batch size {config.batch_size} is not a multiple of {views}; change either")
    return config.batch_size // config.views_per_object


def steps_per_epoch(objects: int, config: ViewBatches) -> int:
    """Returns the number of batches in an epoch of `objects` objects; the last batch is filled from the next epoch."""
    return -(-objects // objects_per_batch(config))


def train_batches(
    folder: Path, config: ViewBatches, *, first_step: int = 0, whole: bool = False
) -> Iterator[dict[str, np.ndarray]]:
    """Returns an endless iterator over this process's part of each batch from step `first_step` on, read ahead.

    Args:
        whole: whether this process's part is all of a batch, as where processes train networks of their own.

    Raises:
        ValueError: if the objects of a batch cannot be divided equally among the processes.
    """
    index, processes = (0, 1) if whole else (jax.process_index(), jax.process_count())
    per_batch = objects_per_batch(config)
    if per_batch % processes:
        share = f"{per_batch} objects per batch cannot be shared by {processes} processes"
        raise ValueError(f"{share}; choose another batch size")
    import grain

    # The order is drawn anew for every epoch, and a batch may contain objects of two successive epochs.
    objects = _TrainingObjects(folder, config)
    stream = (
        grain.MapDataset.source(objects)
        .seed(config.seed)
        .shuffle()
        .repeat()
        .random_map(partial(_draw_views, config=config))
    )
    # The parts of all processes, concatenated, are the batch that a single process would read.
    parts = stream.batch(per_batch // processes, batch_fn=_join)[index::processes]
    return _read(parts[first_step:], config.workers)


def evaluation_batches(
    folder: Path,
    split: str,
    *,
    points: int = 0,
    images: str | None = None,
    seed: int = 0,
    chosen: np.ndarray | None = None,
    workers: int = 0,
) -> Iterator[dict[str, np.ndarray]]:
    """Returns an iterator over all views of the objects of a split, always the same: one object per batch, as in the shards.

    Batches are those of `views_of_example`, with the key `position`: the position of the object in the split, for each view.

    Args:
        chosen: positions of the objects; all by default.
        workers: number of processes that read; 0 for threads of this process.
    """
    source = open_split(folder, split, _keys_read(points, images))
    positions = range(len(source)) if chosen is None else [int(position) for position in chosen]
    views = partial(_all_views, source=source, points=points, images=images, seed=seed)
    return _read(_mapped(positions, views), workers)


def _all_views(index: int, source: Any, points: int, images: str | None, seed: int) -> dict[str, np.ndarray]:
    """Returns all views of the object at a position."""
    example = source[index]
    views, random = np.arange(len(example["entropy"])), np.random.default_rng([seed, index])
    batch = views_of_example(example, views, points=points, images=images, random=random)
    return batch | {"position": np.full(len(views), index, np.int32)}
