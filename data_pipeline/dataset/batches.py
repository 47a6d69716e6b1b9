"""Shards become batches: a Grain pipeline of random access, and what turns a stored view into a network's input.

An epoch shows every training object once, through `views_per_object` views drawn anew. Batch number `i` is a function of
(seed, i) alone, so a run that stops and goes on sees the same batches, and nothing but the step needs to be remembered.
With several processes each reads its own piece of every batch.

Validation is by object. The thesis's published code puts views aside instead, so that an object is on both sides; that is here
as a switch (`ViewBatches.validation_by`), to show what it does.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import grain
import jax
import numpy as np

from data_pipeline.dataset.builder import open_split


@dataclass(frozen=True)
class ViewBatches:
    """How views are drawn.

    Attributes:
        batch_size: views in a batch, over all processes; a multiple of `views_per_object`.
        views_per_object: distinct views of each object in an epoch.
        points: size of the clouds; 0 for no clouds.
        images: `depth` or `image`, or None for neither.
        seed: of order, views and points.
        fold: train without part k of n of the training objects, (k, n); all of them unless given.
        validation_by: `object`, the sound way; `view`: train on views of the validation objects too, except for a share
            of every object's views (`views_aside`).
        balanced: in a pass over the training objects those of rarer classes come more often, so that all classes weigh the same.
    """

    batch_size: int
    views_per_object: int
    points: int = 0
    images: str | None = None
    seed: int = 0
    fold: tuple[int, int] | None = None
    validation_by: Literal["object", "view"] = "object"
    balanced: bool = False


VIEWS_ASIDE = 0.2
"""The share of an object's views that are put aside where validation is by view (thesis §5.2)."""


def views_aside(views: int, index: int, seed: int) -> np.ndarray:
    """Which views of training object `index` are never trained on where validation is by view; at least one."""
    random = np.random.default_rng([seed, index, views])
    return np.sort(random.permutation(views)[: max(1, round(VIEWS_ASIDE * views))])


def sample_pixels(depth: np.ndarray, points: int, random: np.random.Generator) -> np.ndarray:
    """Flat indices (points,) int32 of pixels that hit the object: drawn without repetition, then repeated to fill.

    A view that sees nothing gives pixel 0 throughout, whose depth of 0 is the camera's own centre.
    """
    hit = np.flatnonzero(depth)
    if len(hit) == 0:
        return np.zeros(points, np.int32)
    if len(hit) >= points:
        return random.choice(hit, points, replace=False).astype(np.int32)
    return np.resize(random.permutation(hit), points).astype(np.int32)


def select_views(
    example: dict[str, Any], views: np.ndarray, *, points: int, images: str | None, random: np.random.Generator
) -> dict[str, np.ndarray]:
    """Some views of one object, as arrays with a leading axis of views.

    Returns:
        `label`, `view`, `pose`, `entropy` (of *all* views) and, as asked for, `depth` or `image`, and `pixels`, `pixel_depth`.
    """
    out = {
        "label": np.full(len(views), example["label"], np.int32),
        "view": views.astype(np.int32),
        "pose": example["pose"][views],
        "entropy": np.repeat(example["entropy"][None], len(views), axis=0),
    }
    if images:
        out[images] = example[images][views]
    if points:
        pixels = np.stack([sample_pixels(example["depth"][view], points, random) for view in views])
        flat = example["depth"][views].reshape(len(views), -1)
        out |= {"pixels": pixels, "pixel_depth": np.take_along_axis(flat, pixels, axis=1)}
    return out


class _DrawViews(grain.transforms.RandomMap):
    def __init__(self, config: ViewBatches):
        self.config = config

    def random_map(self, element: dict[str, Any], rng: np.random.Generator) -> dict[str, np.ndarray]:
        config = self.config
        views = rng.choice(element["trainable"], config.views_per_object, replace=False)
        return select_views(element, views, points=config.points, images=config.images, random=rng)


def fold_of(objects: int, folds: int) -> np.ndarray:
    """The part, 0 to folds − 1, of each training object, in the order of the shards (which is none)."""
    return np.arange(objects) % folds


def objects_kept(objects: int, config: ViewBatches) -> np.ndarray:
    """Which of so many training objects are trained on."""
    if config.fold is None:
        return np.arange(objects)
    part, folds = config.fold
    return np.flatnonzero(fold_of(objects, folds) != part)


def equally_often(objects: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The objects, those of rarer classes repeated until there are as many of each class."""
    _, members = np.unique(labels, return_inverse=True)
    largest = int(np.bincount(members).max())
    return np.concatenate([np.resize(objects[members == one], largest) for one in range(members.max() + 1)])


class _TrainingObjects:
    """The objects of some splits, one after the other, each with the views that may be trained on."""

    def __init__(self, sources: list[Any], config: ViewBatches):
        self._sources, self._config = sources, config
        self._kept = objects_kept(sum(map(len, sources)), config)
        if config.balanced:
            labels = [source[index]["label"] for source in sources for index in range(len(source))]
            self._kept = equally_often(self._kept, np.array(labels)[self._kept])

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
    """The splits whose objects are trained on."""
    return ("train",) if config.validation_by == "object" else ("train", "val")


def _training_objects(folder: Path, config: ViewBatches) -> _TrainingObjects:
    return _TrainingObjects([open_split(folder, split) for split in training_splits(config)], config)


def validation_splits(config: ViewBatches) -> tuple[str, ...]:
    """The splits whose objects training is validated on."""
    return ("val",) if config.validation_by == "object" else training_splits(config)


def validation_batches(
    folder: Path, config: ViewBatches, views: int, part: slice = slice(None)
) -> Iterator[dict[str, np.ndarray]]:
    """What training is validated on, one object a batch: `views` views of each object put aside, 0 for all of them.

    By object, every view of the lattice gets its turn. By view, an object gives its share of the views put aside. `part` of
    the objects, all unless given.
    """
    by_object = config.validation_by == "object"
    objects = open_split(folder, "val") if by_object else _training_objects(folder, config)
    for index in range(len(objects))[part]:
        example = objects[index]
        count = len(example["entropy"])
        if by_object:
            wanted = min(views or count, count)
            keep = (np.arange(wanted) * count // wanted + index) % count if views else np.arange(count)
        else:
            aside = views_aside(count, index, config.seed)
            keep = aside[: max(1, round(VIEWS_ASIDE * views))] if views else aside
        random = np.random.default_rng([config.seed, index])
        yield select_views(example, keep, points=config.points, images=config.images, random=random)


def _join(elements: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {key: np.concatenate([element[key] for element in elements]) for key in elements[0]}


def objects_per_batch(config: ViewBatches) -> int:
    if config.batch_size % config.views_per_object:
        raise ValueError(f"batch size {config.batch_size} is no multiple of {config.views_per_object} views per object")
    return config.batch_size // config.views_per_object


def steps_per_epoch(objects: int, config: ViewBatches) -> int:
    """Batches in an epoch of `objects` objects; the last is filled from the next epoch."""
    return -(-objects // objects_per_batch(config))


def train_batches(folder: Path, config: ViewBatches, *, first_step: int = 0) -> Iterator[dict[str, np.ndarray]]:
    """Endless batches from step `first_step` on, of each this process's piece, read ahead by threads."""
    processes = jax.process_count()
    per_batch = objects_per_batch(config)
    if per_batch % processes:
        raise ValueError(f"{per_batch} objects a batch cannot be shared by {processes} processes")
    # Repeated first: then every pass has its own order, and batches may cross from one pass to the next.
    objects = _training_objects(folder, config)
    stream = grain.MapDataset.source(objects).seed(config.seed).shuffle().repeat().random_map(_DrawViews(config))
    # Pieces one after the other make the batch that a single process would read.
    pieces = stream.batch(per_batch // processes, batch_fn=_join)[jax.process_index() :: processes]
    threads = min(16, max(1, (os.cpu_count() or 1) // 2))
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=16)
    return iter(pieces[first_step:].to_iter_dataset(options))


def evaluation_batches(
    folder: Path,
    split: str,
    *,
    points: int = 0,
    images: str | None = None,
    seed: int = 0,
    chosen: np.ndarray | None = None,
) -> Iterator[dict[str, np.ndarray]]:
    """Every view of every object of a split, or of those at the `chosen` positions, one object a batch, in the order of the
    shards; the same at every call. `position`, for each view, is that of its object in the split."""
    source = open_split(folder, split)
    for index in range(len(source)) if chosen is None else map(int, chosen):
        example = source[index]
        views = np.arange(len(example["entropy"]))
        random = np.random.default_rng([seed, index])
        batch = select_views(example, views, points=points, images=images, random=random)
        yield batch | {"position": np.full(len(views), index, np.int32)}
