"""A data set whose test objects are others has the same statistics, objects and batches for training and validation."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from data_pipeline.dataset.batches import ViewBatches, evaluation_batches, train_batches, validation_batches
from data_pipeline.dataset.builder import open_split, split_objects
from data_pipeline.dataset.statistics import SPLITS, load_statistics
from data_pipeline.objects.sources import furniture10
from tests.reference.leaks import check_fitted, check_tested, other_labels

BATCHES = ViewBatches(batch_size=12, views_per_object=3, points=20, images="depth", seed=4)
OF_TEST_OBJECTS = {"counts": "test", "entropy_histograms": "test"}
"""Entries of the statistics that are about test objects."""


def test_test_objects_are_others(data, otherwise_tested):
    """Otherwise the tests below would say nothing."""
    one, other = (list(evaluation_batches(folder, "test", images="depth")) for folder in (data, otherwise_tested))
    assert (len(one), len(other)) == (10, 10)
    images = [{image.tobytes() for batch in batches for image in batch["depth"]} for batches in (one, other)]
    assert min(map(len, images)) > 50
    assert not images[0] & images[1]
    counts = [load_statistics(folder).counts["test"] for folder in (data, otherwise_tested)]
    assert all(counts[0][name] != counts[1][name] for name in counts[0])


def test_statistics_are_of_training_objects(data, otherwise_tested):
    """The largest entropy, which the entropy predictor's targets are divided by; the mean maps; numbers of objects."""
    one, other = (load_statistics(folder).content() for folder in (data, otherwise_tested))
    for name, split in OF_TEST_OBJECTS.items():
        check_tested({name: repr(one[name].pop(split))}, {name: repr(other[name].pop(split))})
    check_fitted(one, other)


def test_objects_for_validation_are_chosen_among_those_for_training():
    """Whatever the labels of test objects, how many there are and where they are listed."""
    entries = furniture10(6, 3).entries
    tested = [entry for entry in entries if entry.split == "test"]
    others = [replace(entry, label=int(other_labels(np.array(entry.label), 10))) for entry in tested[5:]]
    one = split_objects(entries, 0.3, 0)
    other = split_objects([*others, *(entry for entry in entries if entry.split != "test")], 0.3, 0)
    assert len(one["val"]) == 20
    assert other["test"] == others
    for split in ("train", "val"):
        assert one[split] == other[split]
        assert {entry.split for entry in one[split]} == {"train"}


@pytest.mark.parametrize("split", [split for split in SPLITS if split != "test"])
def test_objects_of_other_splits_are_the_same(split, data, otherwise_tested):
    one, other = (list(open_split(folder, split)) for folder in (data, otherwise_tested))
    check_fitted(one, other)


@pytest.mark.parametrize(
    "changes",
    [{}, {"validation_by": "view"}, {"balanced": True}, {"fold": (0, 2)}, {"images": "image", "points": 0}],
    ids=["by_object", "by_view", "balanced", "part", "images"],
)
def test_batches_are_the_same(changes, data, otherwise_tested):
    config, folders = replace(BATCHES, **changes), (data, otherwise_tested)
    check_fitted(*(list(islice(train_batches(folder, config), 12)) for folder in folders))
    for views in (0, 2):
        check_fitted(*(list(validation_batches(folder, config, views)) for folder in folders))
