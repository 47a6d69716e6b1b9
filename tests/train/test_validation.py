"""Validation views are the same, whether they are kept in memory or read again after every epoch."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import train.validation
from data_pipeline.dataset.statistics import load_statistics
from eval.runs import tasks
from eval.settings import TINY
from tests.reference.quick import quick_tasks
from train.loop import fit
from train.tasks.recogniser import RecogniserTask
from train.validation import ValidationSet


@pytest.mark.parametrize("name", ["classifier", "entropy", "recogniser"])
def test_batches_read_again_are_those_that_are_kept(name, request):
    data = request.getfixturevalue("turned" if name == "recogniser" else "data")
    statistics = load_statistics(data)
    if name == "recogniser":
        task = RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera)
    else:
        task = tasks(TINY, statistics)[("classifier", "entropy").index(name)]
    task = replace(task, optimiser=replace(task.optimiser, validation_views=3))
    kept, read = (ValidationSet(task, data, statistics, 4, most_kept=most) for most in (1 << 30, 0))
    assert len(kept) == len(list(kept)) == len(list(read))
    for _ in range(2):
        for mine, theirs in zip(kept, read, strict=True):
            jax.tree.map(np.testing.assert_array_equal, mine, theirs)
    weights = np.concatenate([weights for _, weights in kept])
    objects = statistics.objects_of(["val"])
    assert (weights > 0).sum() == 3 * objects
    labels = np.concatenate([batch["label"] for batch, _ in kept])[weights > 0]
    counts = np.bincount(labels, minlength=len(statistics.classes))
    assert counts.tolist() == [3 * statistics.counts["val"][name] for name in statistics.classes]


def test_many_processes_have_equally_many_batches(data, monkeypatch):
    """Also where some have an object less than others, or none; all views count once."""
    statistics = load_statistics(data)
    task = replace(tasks(TINY, statistics)[0])
    task = replace(task, optimiser=replace(task.optimiser, validation_views=0))
    for processes in (3, 4, 16):
        monkeypatch.setattr(jax, "process_count", lambda count=processes: count)
        seen, lengths = [], set()
        for index in range(processes):
            monkeypatch.setattr(jax, "process_index", lambda number=index: number)
            batches = list(ValidationSet(task, data, statistics, 2 * processes))
            lengths.add((len(batches), *(len(weights) for _, weights in batches)))
            seen += [int((weights > 0).sum()) for _, weights in batches]
        assert len(lengths) == 1
        assert sum(seen) == statistics.objects_of(["val"]) * statistics.views


def test_training_is_the_same_with_views_that_are_read_again(data, tmp_path, monkeypatch):
    statistics = load_statistics(data)
    task = quick_tasks(statistics, epochs=1)[1]
    kept = fit(task, data, statistics, tmp_path / "kept")
    monkeypatch.setattr(train.validation.ValidationSet.__init__, "__defaults__", (0,))
    read = fit(task, data, statistics, tmp_path / "read")
    assert read["best"] == kept["best"]
