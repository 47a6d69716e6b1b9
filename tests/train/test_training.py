"""Training learns, stops early, and goes on exactly where it was stopped."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

import train.loop
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError, Diverged
from eval.runs import tasks
from eval.settings import TINY
from tests.reference.quick import lines, quick_tasks
from train.loop import content_on, fit, load_best, steps_of_an_epoch
from train.optimiser import OptimiserConfig
from train.results.identity import config_of, content_of
from train.running.checkpoints import Checkpoints
from train.running.preemption import Preempted
from train.step import abstract_state
from train.weights.starting import weights_from_network


@pytest.fixture(scope="module")
def quick(data):
    """Trainings of the quick classifier on the data set, by the changes of its optimiser: the task, and a function that fits."""
    statistics = load_statistics(data)

    def of(**changed):
        task = quick_tasks(statistics, **changed)[0]
        return task, lambda folder, task=task, **options: fit(task, data, statistics, folder, **options)

    return of


@pytest.fixture(scope="module")
def whole(quick, tmp_path_factory) -> Path:
    """A whole run of the quick classifier, never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    quick()[1](folder)
    return folder


def test_training_learns(data, tmp_path):
    """Both networks of `tiny`."""
    statistics = load_statistics(data)
    of_a_classifier = OptimiserConfig(
        epochs=6, batch_size=16, views_per_object=2, epoch_views=6, learning_rate=3e-3, schedule="cosine"
    )
    classify, predict = tasks(TINY, statistics)
    classify = replace(classify, optimiser=of_a_classifier)
    predict = replace(predict, network_config=replace(predict.network_config, dropout=0.1))
    predict = replace(predict, optimiser=replace(of_a_classifier, epochs=3, schedule="constant", learning_rate=1e-2))
    for task, name in ((classify, "classifier"), (predict, "entropy")):
        fit(task, data, statistics, tmp_path / name)
    history = lines(tmp_path / "classifier")
    assert [entry["epoch"] for entry in history] == [1, 2, 3, 4, 5, 6]
    assert history[-1]["train/loss"] < 0.8 * history[0]["train/loss"]
    assert history[-1]["train/accuracy"] > 0.2  # chance is 0.1
    entropy = lines(tmp_path / "entropy")
    assert entropy[-1]["train/loss"] < 0.7 * entropy[0]["train/loss"]
    assert list((tmp_path / "classifier" / "tensorboard").iterdir())


def test_a_run_killed_within_epochs_repeats_few_steps(quick, whole, tmp_path, monkeypatch, random):
    """At random places; weights and log are those of a run that was never stopped."""

    class Killed(BaseException):
        pass

    task, train_in = quick(checkpoint_steps=2)
    real, done = train.loop._Training.take_step, list[int]()

    def killed(self, batch):
        if kills and random.random() < 0.3:
            raise kills.pop()
        done.append(self.step)
        return real(self, batch)

    monkeypatch.setattr(train.loop._Training, "take_step", killed)
    kills, times = [Killed() for _ in range(8)], 0
    while True:
        try:
            train_in(tmp_path)
            break
        except Killed:
            times += 1
    assert times >= 4
    with Checkpoints(tmp_path) as checkpoints:
        assert len(done) <= checkpoints.latest_step("latest") + times * task.optimiser.checkpoint_steps
    assert content_of(task) == content_of(quick()[0])  # not part of what a training is
    for mine, theirs in zip(lines(tmp_path), lines(whole), strict=True):
        assert mine | {"seconds": 0} == theirs | {"seconds": 0}
    states = [nnx.state(load_best(task, folder)) for folder in (tmp_path, whole)]
    for mine, theirs in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_stopped_run_ends_as_if_it_had_not_been(quick, whole, tmp_path, monkeypatch):
    task, train_in = quick()

    class Stopped(Exception):
        pass

    real_validate, calls = train.loop.validate, itertools.count(1)

    def stop_in_the_second_epoch(*args):
        if next(calls) == 2:
            raise Stopped
        return real_validate(*args)

    monkeypatch.setattr(train.loop, "validate", stop_in_the_second_epoch)
    with pytest.raises(Stopped):
        train_in(tmp_path)
    monkeypatch.undo()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 99999, "half a line')  # killed while writing
    validated = []
    monkeypatch.setattr(train.loop, "validate", lambda *given: validated.append(1) or real_validate(*given))
    summary = train_in(tmp_path)
    assert len(validated) == summary["epoch"] - 1  # the first epoch is not trained again

    expected = json.loads((whole / "summary.json").read_text())
    assert summary | {"seconds": 0} == expected | {"seconds": 0}
    a, b = nnx.state(load_best(task, tmp_path)), nnx.state(load_best(task, whole))
    for mine, theirs in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    timeless, as_a_whole = ([line | {"seconds": 0} for line in lines(folder)] for folder in (tmp_path, whole))
    assert timeless == as_a_whole


def test_training_goes_on_from_other_weights(quick, whole, tmp_path):
    """The first epoch begins where the other network ended, and the run knows where it began."""
    task, train_in = quick(epochs=1, learning_rate=1e-6)
    summary = train_in(tmp_path, start=weights_from_network(load_best(task, whole), "the one before"))
    before = json.loads((whole / "summary.json").read_text())
    assert (summary["start"], before["start"]) == ("the one before", "random weights")
    assert summary["best"]["loss"] == pytest.approx(before["best"]["loss"], rel=0.1)
    assert lines(tmp_path)[0]["train/loss"] < lines(whole)[0]["train/loss"]
    with pytest.raises(DataError, match="other settings"):
        train_in(tmp_path)


def test_all_views_are_counted_by_the_end(quick, data, tmp_path, monkeypatch):
    shown, bar = [], train.loop.progress_bar("views")
    monkeypatch.setattr(bar, "advance", lambda line, views: shown.append(views))
    monkeypatch.setattr(train.loop, "progress_bar", lambda unit: bar)
    task, train_in = quick(epochs=2)
    train_in(tmp_path)
    assert sum(shown) == 2 * steps_of_an_epoch(task, load_statistics(data)) * task.optimiser.batch_size


def test_a_finished_run_is_not_repeated_nor_mixed(quick, whole):
    before = (whole / "metrics.jsonl").stat().st_mtime_ns
    assert quick()[1](whole)["epoch"] == 3
    assert (whole / "metrics.jsonl").stat().st_mtime_ns == before
    with pytest.raises(DataError, match="other settings"):
        quick(learning_rate=1e-4)[1](whole)


def test_a_finished_run_may_be_lengthened(quick, tmp_path, capsys):
    """More epochs at a constant rate, where more patience is needed too; the result is that of one long run."""
    quick(epochs=1)[1](tmp_path / "lengthened")
    task, train_in = quick(epochs=2, patience=9)
    summary = train_in(tmp_path / "lengthened")
    said = " ".join(capsys.readouterr().err.split())
    assert "(task.optimiser.epochs 1, not 2; task.optimiser.patience" in said
    assert "resuming after epoch 1" in said
    expected = train_in(tmp_path / "whole")
    for key in ("epoch", "steps", "best_epoch", "best"):
        assert summary[key] == expected[key], key
    assert config_of(tmp_path / "lengthened") == config_of(tmp_path / "whole")
    assert train_in(tmp_path / "lengthened") == summary
    for change in (
        {"epochs": 1},
        {"patience": 3},
        {"patience": 0},
        {"parts": 2},
        {"compute": "bfloat16"},
        {"epochs": 3, "seed": 1},
        {"schedule": "cosine"},
    ):
        other = replace(task, optimiser=replace(task.optimiser, **change))
        with pytest.raises(DataError, match="other settings"):
            train_in(tmp_path / "lengthened", task=other)


def test_an_interrupted_run_may_go_on_in_parts_and_half_precision(quick, tmp_path, monkeypatch, capsys):
    """What is there stays as it was until an epoch was trained so."""
    real, calls = train.loop.validate, itertools.count(1)

    def interrupted(*given, **options):
        if next(calls) in (2, 3):
            raise KeyboardInterrupt
        return real(*given, **options)

    monkeypatch.setattr(train.loop, "validate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        quick(epochs=2)[1](tmp_path)
    assert config_of(tmp_path)["task"]["optimiser"]["parts"] == 1
    smaller = quick(epochs=2, parts=2, compute="bfloat16")[1]
    monkeypatch.setattr(train.loop, "train_batches", interrupted)
    with pytest.raises(KeyboardInterrupt):  # before the end of an epoch
        smaller(tmp_path)
    assert config_of(tmp_path)["task"]["optimiser"]["parts"] == 1
    monkeypatch.undo()
    capsys.readouterr()
    assert smaller(tmp_path)["epoch"] == 2
    assert "resuming after epoch 1" in " ".join(capsys.readouterr().err.split())
    assert config_of(tmp_path)["task"]["optimiser"]["parts"] == 2


@pytest.mark.parametrize(("patience", "epoch", "best"), [(2, 4, 2), (0, 5, 5)])
def test_training_stops_when_validation_gets_no_better(quick, tmp_path, monkeypatch, patience, epoch, best):
    """Or does all epochs without patience, and ends with its last weights."""
    losses = iter([1.0, 0.9, 0.95, 0.92, 0.91])
    monkeypatch.setattr(train.loop, "validate", lambda *_: {"loss": next(losses)})
    task, train_in = quick(epochs=5, patience=patience)
    summary = train_in(tmp_path)
    assert (summary["epoch"], summary["best_epoch"]) == (epoch, best)
    assert summary["stopped_early"] == (epoch < 5)
    kept, last = (Checkpoints(tmp_path).latest_step(name) for name in ("best", "latest"))
    assert (kept == last) == (best == epoch)
    load_best(task, tmp_path)
    if not patience:  # its weights are not the best, which more patience would have to keep
        with pytest.raises(DataError, match="other settings"):
            quick(epochs=5, patience=7)[1](tmp_path)


def test_few_objects_are_seen_often_enough(quick, data):
    """An epoch has a least number of steps, which is part of what a training is where it matters, and only there."""
    statistics, task = load_statistics(data), quick()[0]
    steps, plain = steps_of_an_epoch(task, statistics), content_on(task, statistics)
    for least, expected, content in ((steps, steps, None), (3 * steps, 3 * steps, 3 * steps)):
        longer = replace(task, optimiser=replace(task.optimiser, epoch_steps=least))
        assert steps_of_an_epoch(longer, statistics) == expected
        found = content_on(longer, statistics)
        assert found["optimiser"].pop("epoch_steps", None) == content
        assert found == plain


def test_networks_of_another_size_are_described(quick, whole, data, tmp_path):
    statistics = load_statistics(data)
    classify, predict = quick_tasks(statistics, epochs=1)
    fit(predict, data, statistics, tmp_path)
    with pytest.raises(DataError, match="trained for 6 views, the data set has 40"):
        load_best(replace(predict, views=40), tmp_path)
    with pytest.raises(DataError, match="trained for 10 classes, the data set has 4"):
        load_best(replace(classify, classes=4), whole)
    with pytest.raises(DataError, match="other layers"):
        load_best(replace(classify, network_config=replace(classify.network_config, width=16)), whole)
    with pytest.raises(DataError, match="no trained classifier in"):
        load_best(classify, tmp_path / "nothing")


def test_a_loss_that_is_no_number_stops_the_run(quick, tmp_path):
    with pytest.raises(
        Diverged, match=r"diverged in epoch 1, by step .* not finite; no epoch was saved; to train again, lower"
    ):
        quick(learning_rate=1e38, epochs=1)[1](tmp_path)
    assert not list((tmp_path / "best").iterdir())
    assert not list((tmp_path / "latest").iterdir())


@pytest.mark.parametrize("what", ["validation accuracy", "weights"])
def test_what_is_not_finite_is_not_saved(what, quick, tmp_path, monkeypatch):
    """Also where the loss is finite; and the way out that the message names works."""
    task, train_in = quick()
    found = iter([{"loss": 1.0, "accuracy": 0.5}, {"loss": 0.5, "accuracy": 0.5 if what == "weights" else math.nan}])
    finite = iter([True, what != "weights"])
    monkeypatch.setattr(train.loop, "validate", lambda *_: next(found))
    monkeypatch.setattr(train.loop._Training, "_has_finite_weights", lambda _: next(finite))
    here = re.escape(str(tmp_path))
    said = (
        rf"the classifier diverged in epoch 2, by step \d+: its {what} \w+ not finite; the checkpoint after epoch 1 is kept in "
        rf"{here}; to train again, lower --the.rate \(0.003 in this run\), and delete {here} or choose another --out"
    )
    with pytest.raises(Diverged, match=said):
        train_in(tmp_path, rate_option="--the.rate")
    monkeypatch.undo()
    assert [entry["epoch"] for entry in lines(tmp_path)] == [1]
    with Checkpoints(tmp_path) as checkpoints:
        for slot in ("best", "latest"):
            _, progress = checkpoints.restore(slot, abstract_state(task)[1])
            assert (progress["epoch"], progress["best_loss"]) == (1, 1.0)
    lower = quick(learning_rate=1e-3, epochs=1)[1]
    with pytest.raises(DataError, match="other settings"):
        lower(tmp_path)
    shutil.rmtree(tmp_path)
    assert lower(tmp_path)["epoch"] == 1


def test_a_best_epoch_of_an_older_version_without_a_loss_is_replaced(quick, tmp_path, monkeypatch):
    task, train_in = quick(epochs=4, patience=2)
    losses = iter([3.0, 2.0, Preempted("stopped")])

    def validated(*_):
        if isinstance(loss := next(losses), Preempted):
            raise loss
        return {"loss": loss}

    monkeypatch.setattr(train.loop, "validate", validated)
    with pytest.raises(Preempted):
        train_in(tmp_path)
    monkeypatch.undo()
    shutil.copytree(tmp_path, tmp_path / "weights")
    with Checkpoints(tmp_path) as checkpoints:
        state, progress = checkpoints.restore("latest", abstract_state(task)[1])
        shutil.rmtree(tmp_path / "latest")
    older = progress | {
        "best_loss": math.nan,
        "best_epoch": 1,
        "best": {"loss": math.nan},
    }  # it would stop by its patience
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save("latest", int(state.step), state, older | {"epoch": 2})
    summary = train_in(tmp_path)
    assert summary["best_epoch"] in (3, 4)
    assert np.isfinite(summary["best_loss"])
    assert np.isfinite(nnx.state(load_best(task, tmp_path), nnx.Param)["head"]["bias"][...]).all()

    folder = tmp_path / "weights"
    shutil.rmtree(folder / "latest")
    nowhere = jax.tree.map(lambda leaf: leaf * np.nan, state.parameters)
    with Checkpoints(folder) as checkpoints:
        checkpoints.save("latest", int(state.step), replace(state, parameters=nowhere), older)
    with pytest.raises(Diverged, match=r"after epoch 2 in .* has weights that are not finite; to train again"):
        train_in(folder)


def test_an_end_within_an_epoch_saves_nothing_that_is_not_finite(quick, tmp_path, monkeypatch):
    steps = itertools.count(1)
    monkeypatch.setattr(train.loop.Preemption, "after_step", lambda _: next(steps) == 3)
    with pytest.raises(Diverged, match="diverged in epoch 1, by step 3"):
        quick(learning_rate=1e38)[1](tmp_path)
    assert not list((tmp_path / "latest").iterdir())
