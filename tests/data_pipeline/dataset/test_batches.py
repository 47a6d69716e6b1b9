"""Batches: a function of seed and step, every object once an epoch, and validation apart from training."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace
from itertools import islice

import jax
import numpy as np
import pytest

from data_pipeline.dataset.batches import (
    ViewBatches,
    evaluation_batches,
    sample_pixels,
    steps_per_epoch,
    train_batches,
    validation_batches,
)
from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.statistics import load_statistics

BATCHES = ViewBatches(batch_size=12, views_per_object=3, points=50, images="depth", seed=4)


def equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def test_batches_depend_on_seed_and_step_alone(data):
    first = list(islice(train_batches(data, BATCHES), 12))
    again = list(islice(train_batches(data, BATCHES, first_step=9), 3))
    for a, b in zip(first[9:], again, strict=True):
        assert equal(a, b)
    other = next(train_batches(data, replace(BATCHES, seed=5)))
    assert not equal(first[0], other)
    assert first[0]["depth"].shape == (12, 32, 32)
    assert first[0]["pixels"].shape == (12, 50)


def test_an_epoch_shows_every_object_once(data):
    assert steps_per_epoch(40, BATCHES) == 10
    source = open_split(data, "train")
    known = {source[i]["entropy"].tobytes() for i in range(40)}
    for epoch in range(2):
        batches = list(islice(train_batches(data, BATCHES, first_step=10 * epoch), 10))
        seen = [row.tobytes() for batch in batches for row in batch["entropy"][::3]]
        assert set(seen) == known
        assert len(seen) == 40
        for batch in batches:  # distinct views of each object
            assert all(len(set(views)) == 3 for views in batch["view"].reshape(-1, 3))


def test_processes_share_every_batch(data, monkeypatch):
    whole = next(train_batches(data, BATCHES, first_step=2))
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    parts = []
    for process in range(2):
        monkeypatch.setattr(jax, "process_index", lambda p=process: p)
        parts.append(next(train_batches(data, BATCHES, first_step=2)))
    rows = [row.tobytes() for part in parts for row in part["depth"]]
    assert rows == [row.tobytes() for row in whole["depth"]]  # one after the other, as one process reads them
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    with pytest.raises(ValueError, match="cannot be shared by 3"):
        next(train_batches(data, BATCHES))


def test_validation_by_view_keeps_a_share_of_every_objects_views_apart(data):
    """The thesis's published code: an object is on both sides, a view never is."""
    by_view = replace(BATCHES, validation_by="view", batch_size=9)
    statistics = load_statistics(data)
    objects = sum(sum(statistics.counts[split].values()) for split in ("train", "val"))
    aside: dict[bytes, set[int]] = {}
    for batch in validation_batches(data, by_view, 0):
        key = batch["entropy"][0].tobytes()
        aside[key] = set(batch["view"].tolist())
    assert len(aside) == objects
    assert {len(views) for views in aside.values()} == {max(1, round(0.2 * statistics.views))}
    seen: dict[bytes, set[int]] = {}
    for batch in islice(train_batches(data, by_view), objects):
        for entropy, view in zip(batch["entropy"], batch["view"], strict=True):
            seen.setdefault(entropy.tobytes(), set()).add(int(view))
    assert seen.keys() == aside.keys()
    for key, views in seen.items():
        assert not views & aside[key]


def test_validation_views_take_turns_over_the_objects(data):
    """Evenly spaced views, one place further on for each object, so that every view of the lattice is validated on."""
    batches = list(validation_batches(data, BATCHES, 2))
    assert [batch["view"].tolist() for batch in batches] == [[index % 8, (index + 4) % 8] for index in range(10)]
    seen = [batch["view"].tolist() for batch in validation_batches(data, BATCHES, 3)]
    assert seen[:3] == [[0, 2, 5], [1, 3, 6], [2, 4, 7]]
    assert {view for views in seen for view in views} == set(range(8))
    assert [batch["view"].tolist() for batch in validation_batches(data, BATCHES, 0)] == [list(range(8))] * 10


def test_pixels_are_drawn_without_repetition_and_repeated_to_fill(random):
    depth = np.zeros((10, 10), np.uint16)
    depth[2:5, 3:7] = 9
    few = sample_pixels(depth, 8, random)
    assert len(set(few.tolist())) == 8
    many = sample_pixels(depth, 30, random)
    assert set(many.tolist()) == set(np.flatnonzero(depth).tolist())
    assert np.bincount(many).max() == 3
    np.testing.assert_array_equal(sample_pixels(np.zeros((4, 4)), 5, random), 0)


def test_evaluation_batches_hold_every_view_and_never_change(data):
    a = list(evaluation_batches(data, "test", points=20, images="image"))
    b = list(evaluation_batches(data, "test", points=20, images="image"))
    assert len(a) == 10
    assert all(equal(x, y) for x, y in zip(a, b, strict=True))
    np.testing.assert_array_equal(a[0]["view"], np.arange(8))


@pytest.mark.slow
def test_processes_that_read_give_the_same_batches(data):
    """For training from a later step, for validation of a part, and for evaluation; SIGTERM to all of them stops no reading."""
    by_processes = replace(BATCHES, workers=2)
    streams = [train_batches(data, config, first_step=3) for config in (BATCHES, by_processes)]
    for number in range(8):
        assert equal(*(next(stream) for stream in streams))
        if number == 1:
            children = multiprocessing.active_children()
            assert len(children) == 2
            for child in children:
                os.kill(child.pid, signal.SIGTERM)
    parts = [list(validation_batches(data, config, 3, slice(1, None, 2))) for config in (BATCHES, by_processes)]
    assert len(parts[0]) == 5
    assert all(map(equal, *parts))
    tests = [list(evaluation_batches(data, "test", points=20, workers=workers)) for workers in (0, 2)]
    assert len(tests[1]) == 10
    assert all(map(equal, *tests))
    streams[1].close()
    assert all(not child.is_alive() for child in children)
