"""Outputs of the thesis's networks that are made up, and what follows from them."""

from __future__ import annotations

import json

import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.objects.furniture import CLASSES
from eval.machine import machine
from eval.thesis.results import BackboneTraining, LatticeTables, ThesisResults, grids_of
from eval.thesis.timing import AscentTimes, LatticeTimes, MaximaTimes, Memory, MethodTimes, Timing
from eval.walks.grid import GridConfig
from mevs_jax.geometry.viewpoints import fibonacci_sphere
from train.many.thesis import BACKBONES, VIEWS
from train.results.records import as_json, from_json

OBJECTS = 10


def made_up_lattice(views: int, seed: int) -> LatticeTables:
    random = np.random.default_rng(seed)
    labels = (np.arange(OBJECTS) % len(CLASSES)).astype(np.int32)
    logits = {}
    for backbone in BACKBONES:
        noise = random.normal(size=(OBJECTS, views, len(CLASSES)))
        logits[backbone.name] = (noise + 1.5 * np.eye(len(CLASSES))[labels][:, None]).astype(np.float32)
    entropy = random.uniform(0.1, 0.9, (OBJECTS, views)).astype(np.float32)
    predicted_entropy = {
        frame: (entropy[:, None] + spread * random.normal(size=(OBJECTS, views, views))).astype(np.float32)
        for frame, spread in (("world", 0.05), ("camera", 0.2))
    }
    return LatticeTables([f"o{i}" for i in range(OBJECTS)], labels, entropy, logits, predicted_entropy)


def made_up_statistics(lattices: dict[int, LatticeTables]) -> dict[int, DatasetStatistics]:
    return {
        views: DatasetStatistics(
            classes=list(CLASSES),
            counts={split: dict.fromkeys(CLASSES, 8) for split in ("train", "val", "test")},
            left_out={"train": {}, "test": {}},
            entropy_max=4.0,
            entropy_mean=0.5,
            entropy_std=0.1,
            entropy_histograms={split: list(range(50)) for split in ("train", "val", "test")},
            mean_map=lattice.entropy.mean(axis=0).tolist(),
            class_mean_maps=[lattice.entropy[lattice.labels == c].mean(axis=0).tolist() for c in range(len(CLASSES))],
            points_mean=100.0,
            points_std=5.0,
            points_by_class=[[80.0, 90.0, 100.0, 110.0, 120.0]] * len(CLASSES),
            viewpoints=fibonacci_sphere(views).tolist(),
            capture={"resolution": 32, "views": views},
            source="made up",
        )
        for views, lattice in lattices.items()
    }


def made_up_results(lattices: dict[int, LatticeTables], statistics: dict[int, DatasetStatistics]) -> ThesisResults:
    validation = {views: made_up_lattice(views, 100 + views) for views in VIEWS}
    by_class = {name: (3.0, 0.5) for name in (*CLASSES, "all")}
    times = LatticeTimes(by_class, MaximaTimes(alone=0.1, batched=0.001))
    method = MethodTimes({name: (2.0, 0.25) for name in (*CLASSES, "all")}, Memory(5.0, None))
    found = ThesisResults(
        **vars(grids_of(lattices, validation, statistics, GridConfig(draws=2))),
        backbones={backbone.name: BackboneTraining(0.4, 0.5, 3, 2, "random weights") for backbone in BACKBONES},
        machine=machine(),
        timing=Timing(50, times, times),
        memory={"ResNet-18 + Random view selection": Memory(80.0, None)},
        ascent=AscentTimes(3, 8, 64, mesh=method, volume=method),
        training_seconds={},
        left_out={10: {}, 40: {}},
    )
    return from_json(ThesisResults, json.loads(json.dumps(as_json(found))), "made up")
