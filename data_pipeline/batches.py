"""Shards become batches: a Grain pipeline of random access, and what turns a stored view into a network's input.

An epoch shows every training object once, through `views_per_object` views drawn anew. Batch number `i` is a function of
(seed, i) alone, so a run that stops and goes on sees the same batches, and nothing but the step needs to be remembered.
With several processes each reads its own share of every batch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grain
import jax
import numpy as np

from data_pipeline.builder import open_split


@dataclass(frozen=True)
class ViewBatches:
    """How views are drawn.

    Attributes:
        batch_size: views in a batch, over all processes; a multiple of `views_per_object`.
        views_per_object: distinct views of each object in an epoch.
        points: size of the clouds; 0 for no clouds.
        images: `depth` or `image`, or None for neither.
        seed: of order, views and points.
    """

    batch_size: int
    views_per_object: int
    points: int = 0
    images: str | None = None
    seed: int = 0


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
        `label`, `view`, `entropy` (of *all* views) and, as asked for, `depth` or `image`, and `pixels`, `pixel_depth`, `pose`.
    """
    out = {
        "label": np.full(len(views), example["label"], np.int32),
        "view": views.astype(np.int32),
        "entropy": np.repeat(example["entropy"][None], len(views), axis=0),
    }
    if images:
        out[images] = example[images][views]
    if points:
        pixels = np.stack([sample_pixels(example["depth"][view], points, random) for view in views])
        flat = example["depth"][views].reshape(len(views), -1)
        out |= {
            "pixels": pixels,
            "pixel_depth": np.take_along_axis(flat, pixels, axis=1),
            "pose": example["pose"][views],
        }
    return out


class _DrawViews(grain.transforms.RandomMap):
    def __init__(self, config: ViewBatches):
        self.config = config

    def random_map(self, element: dict[str, Any], rng: np.random.Generator) -> dict[str, np.ndarray]:
        config = self.config
        views = rng.choice(len(element["entropy"]), config.views_per_object, replace=False)
        return select_views(element, views, points=config.points, images=config.images, random=rng)


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
    """Endless batches from step `first_step` on, this process's share of each, read ahead by a thread."""
    processes = jax.process_count()
    per_batch = objects_per_batch(config)
    if per_batch % processes:
        raise ValueError(f"{per_batch} objects a batch cannot be shared by {processes} processes")
    # Repeated first: then every pass has its own order, and batches may cross from one pass to the next.
    stream = grain.MapDataset.source(open_split(folder, "train")).seed(config.seed).shuffle().repeat()
    stream = stream.random_map(_DrawViews(config))[jax.process_index() :: processes]
    batches = stream.batch(per_batch // processes, batch_fn=_join)[first_step:]
    return iter(batches.to_iter_dataset(grain.ReadOptions(num_threads=1, prefetch_buffer_size=16)))


def evaluation_batches(
    folder: Path, split: str, *, points: int = 0, images: str | None = None, seed: int = 0, objects: int | None = None
) -> Iterator[dict[str, np.ndarray]]:
    """Every view of every object of a split, one object a batch, in the order of the shards; the same at every call."""
    source = open_split(folder, split)
    for index in range(len(source) if objects is None else min(objects, len(source))):
        example = source[index]
        views = np.arange(len(example["entropy"]))
        random = np.random.default_rng([seed, index])
        yield select_views(example, views, points=points, images=images, random=random)
