"""Networks are trained and selected without test objects: with others in their place, they are the same to the last bit."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from flax import nnx

from data_pipeline.dataset.statistics import load_statistics
from eval.runs import tasks
from eval.settings import TINY
from tests.reference.leaks import check_fitted, check_tested
from tests.reference.quick import QuickClassifierTask, lines
from train.loop import fit, load_best, steps_of_an_epoch
from train.many.sweep import SweepConfig, sweep
from train.optimiser import OptimiserConfig
from train.results.outputs import network_outputs
from train.tasks.recogniser import RecogniserTask
from train.validation import ValidationSet, class_weights_of

BRIEF = OptimiserConfig(epochs=4, batch_size=16, views_per_object=2, learning_rate=3e-2, schedule="cosine")
SETTINGS = replace(TINY, classifier=replace(TINY.classifier, optimiser=BRIEF))


def every_task(folder) -> dict:
    """The trainings of a run and of the learned study, and a classifier validated by view."""
    statistics = load_statistics(folder)
    classify, predict = tasks(SETTINGS, statistics)
    recogniser = replace(TINY.learned.recogniser, balanced=True)
    return {
        "classifier": classify,
        "by_view": replace(classify, optimiser=replace(BRIEF, validation_by="view")),
        "entropy": predict,
        "recogniser": RecogniserTask.of(recogniser, 10, statistics.camera, (1, 2)),
    }


@pytest.mark.parametrize("name", ["classifier", "by_view", "entropy", "recogniser"])
def test_what_networks_are_validated_on_is_the_same(name, data, otherwise_tested):
    """Views, weights of the classes, and the number of steps between two validations."""
    found = []
    for folder in (data, otherwise_tested):
        task, statistics = every_task(folder)[name], load_statistics(folder)
        found.append(
            {
                "task": repr(task),
                "views": list(ValidationSet(task, folder, statistics, 1)),
                "classes": class_weights_of(task, statistics),
                "steps": steps_of_an_epoch(task, statistics),
            }
        )
    check_fitted(*found)


def test_a_training_ends_with_the_same_weights_and_best_epoch(data, otherwise_tested, tmp_path):
    fitted, tested = [], []
    for folder in (data, otherwise_tested):
        task, out = QuickClassifierTask(**vars(every_task(folder)["classifier"])), tmp_path / folder.name
        summary = fit(task, folder, load_statistics(folder), out)
        network = load_best(task, out)
        epochs = lines(out)
        for content in (summary, *epochs):
            del content["seconds"]
        fitted.append({"summary": summary, "epochs": epochs, "weights": nnx.state(network)})
        tested.append({"test outputs": network_outputs(folder, "test", task, network)})
    assert [line["epoch"] for line in fitted[0]["epochs"]] == [1, 2, 3, 4]
    check_fitted(*fitted)
    check_tested(*tested)


def test_a_sweep_finds_the_same_best_member(data, otherwise_tested, tmp_path):
    found = []
    for folder in (data, otherwise_tested):
        task, out = QuickClassifierTask(**vars(every_task(folder)["classifier"])), tmp_path / folder.name
        members = sweep(task, folder, load_statistics(folder), out, SweepConfig("classifier", members=3))
        best = load_best(replace(task, name="best of a sweep"), out / "network")
        found.append({"members": list(map(repr, members)), "best": nnx.state(best)})
    assert len(jax.tree.leaves(found[0]["best"])) == 6
    assert np.unique(found[0]["members"]).size == 3
    check_fitted(*found)
