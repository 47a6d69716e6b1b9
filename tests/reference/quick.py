"""Networks that are compiled in a moment, for tests of what is done with any network; and what a training logs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.runs import tasks
from eval.settings import TINY
from mevs_jax.models import PointNet2
from train.optimiser import OptimiserConfig
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask

BRIEF = OptimiserConfig(epochs=3, batch_size=16, views_per_object=2, epoch_views=4, learning_rate=3e-3)
"""A few steps at a constant rate, so that trainings of all lengths are one compiled program."""


class QuickClassifier(nnx.Module):
    """One layer after batch norm, on images in 8×8 blocks."""

    def __init__(self, classes: int, rngs: nnx.Rngs):
        self.norm, self.head = nnx.BatchNorm(64, rngs=rngs), nnx.Linear(64, classes, rngs=rngs)

    def __call__(self, images: jax.Array, train: bool = False) -> jax.Array:
        views, side, _, _ = images.shape
        blocks = images.reshape(views, 8, side // 8, 8, -1).mean(axis=(2, 4)).reshape(views, 64)
        return self.head(self.norm(blocks, use_running_average=not train))


class QuickPredictor(PointNet2):
    """One layer after batch norm and dropout, on the box around a cloud."""

    def __init__(self, views: int, rngs: nnx.Rngs):
        self.norm, self.head = nnx.BatchNorm(6, rngs=rngs), nnx.Linear(6, views, rngs=rngs)

    def __call__(
        self, clouds: jax.Array, train: bool = False, key: Any = None, momentum: Any = 0.1, dropout: Any = 0.0
    ) -> jax.Array:
        box = jnp.concatenate([clouds[..., :3].min(axis=1), clouds[..., :3].max(axis=1)], axis=-1)
        box = self.norm(box, use_running_average=not train)
        if train:
            box = jnp.where(jax.random.bernoulli(key, 1 - dropout, box.shape), box / (1 - dropout), 0.0)
        return self.head(box)


class QuickClassifierTask(ClassifierTask):
    def network(self, rngs: nnx.Rngs) -> QuickClassifier:
        return QuickClassifier(self.classes, rngs)


class QuickEntropyTask(EntropyTask):
    def network(self, rngs: nnx.Rngs) -> QuickPredictor:
        return QuickPredictor(self.views, rngs)


def quick_tasks(statistics: DatasetStatistics, **changed: Any) -> tuple[QuickClassifierTask, QuickEntropyTask]:
    """The tasks of `tiny` with quick networks and brief trainings, in which some settings of the optimiser are changed."""
    classify, predict = (replace(task, optimiser=replace(BRIEF, **changed)) for task in tasks(TINY, statistics))
    return QuickClassifierTask(**vars(classify)), QuickEntropyTask(**vars(predict))


def lines(folder: Path) -> list[dict[str, Any]]:
    """The entries of a training's log."""
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
