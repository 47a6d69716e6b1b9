"""Training learns, stops early, and goes on exactly where it was stopped."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from optax.contrib import muon

import train.loop
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError, Diverged
from eval.settings import TINY
from eval.stages import tasks
from train.loop import fit, load_best, steps_of_an_epoch
from train.optimiser import OptimiserConfig, _as_matrix, descent, learning_rate
from train.results.identity import config_of
from train.running.checkpoints import Checkpoints
from train.running.devices import Lead
from train.running.preemption import Preempted
from train.step import abstract_state, samples_before
from train.tasks.entropy import EntropyTask
from train.weights.starting import weights_from_network

SETTINGS = replace(
    TINY,
    classifier=replace(
        TINY.classifier,
        optimiser=OptimiserConfig(
            epochs=6, batch_size=16, views_per_object=2, epoch_views=6, learning_rate=3e-3, schedule="cosine"
        ),
    ),
    entropy=replace(
        TINY.entropy,
        network=replace(TINY.entropy.network, dropout=0.1),
        optimiser=OptimiserConfig(epochs=3, batch_size=16, views_per_object=2, epoch_views=6, learning_rate=1e-2),
    ),
)


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory) -> Path:
    """A whole run, never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    statistics = load_statistics(data)
    for task, name in zip(tasks(SETTINGS, statistics), ("classifier", "entropy"), strict=True):
        fit(task, data, statistics, folder / name)
    return folder


def test_muon_steps_are_as_long_in_all_directions_of_a_matrix(random):
    """Against the singular value decomposition, and Adam, with Nesterov's momentum, for what is no matrix."""
    shapes = {"kernel": (3, 3, 8, 32), "matrix": (40, 24), "head": (40, 10), "bias": (24,)}
    gradients = {name: jnp.asarray(random.normal(size=shape), jnp.float32) for name, shape in shapes.items()}
    weights = jax.tree.map(jnp.ones_like, gradients)
    of_muon, nadam = descent(OptimiserConfig(method="muon")), optax.scale_by_adam(nesterov=True)
    found, expected = (method.update(gradients, method.init(weights), weights)[0] for method in (of_muon, nadam))
    for name in ("head", "bias"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-5)
    for name, rows in (("kernel", 72), ("matrix", 40)):
        step, gradient = (np.asarray(tree[name]).reshape(rows, -1) for tree in (found, gradients))
        left, _, right = np.linalg.svd(gradient, full_matrices=False)
        along = left.T @ step @ right.T / (0.2 * np.sqrt(rows))
        assert (np.diag(along) > 0.6).all()  # Newton and Schulz's five steps come near 1, not closer
        assert (np.diag(along) < 1.3).all()
        np.testing.assert_allclose(along - np.diag(np.diag(along)), 0, atol=0.02)


def test_muon_steps_are_those_of_optax(random):
    """Also where a matrix is wide, and where its singular values are far apart."""
    shapes = {"tall": (3, 3, 8, 32), "wide": (40, 90), "bias": (24,)}
    weights = {name: jnp.zeros(shape) for name, shape in shapes.items()}
    ours = descent(OptimiserConfig(method="muon"))
    theirs = muon(-1.0, consistent_rms=0.2, muon_weight_dimension_numbers=lambda tree: jax.tree.map(_as_matrix, tree))
    states = ours.init(weights), theirs.init(weights)
    assert jax.tree.structure(states[0]) == jax.tree.structure(states[1])
    for _ in range(3):
        spread = np.logspace(0, -4, 24)
        gradients = {
            name: jnp.asarray(random.normal(size=shape) * np.resize(spread, shape[-1]), jnp.float32)
            for name, shape in shapes.items()
        }
        (found, mine), (expected, other) = (
            method.update(gradients, state, weights) for method, state in zip((ours, theirs), states, strict=True)
        )
        states = mine, other
        for name in shapes:
            np.testing.assert_allclose(found[name], expected[name], atol=1e-3)


def test_training_learns(trained):
    history = lines(trained / "classifier")
    assert [entry["epoch"] for entry in history] == [1, 2, 3, 4, 5, 6]
    assert history[-1]["train/loss"] < 0.8 * history[0]["train/loss"]
    assert history[-1]["train/accuracy"] > 0.2  # chance is 0.1
    entropy = lines(trained / "entropy")
    assert entropy[-1]["train/loss"] < 0.7 * entropy[0]["train/loss"]
    assert list((trained / "classifier" / "tensorboard").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["classifier", "entropy"])
def test_a_stopped_run_ends_as_if_it_had_not_been(name, trained, data, tmp_path, monkeypatch):
    statistics = load_statistics(data)
    task = dict(zip(("classifier", "entropy"), tasks(SETTINGS, statistics), strict=True))[name]

    class Stopped(Exception):
        pass

    real_validate, calls = train.loop.validate, 0

    def stop_in_the_second_epoch(*args):
        nonlocal calls
        calls += 1
        if calls == 2:
            raise Stopped
        return real_validate(*args)

    monkeypatch.setattr(train.loop, "validate", stop_in_the_second_epoch)
    with pytest.raises(Stopped):
        fit(task, data, statistics, tmp_path)
    monkeypatch.undo()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 99999, "half a line')  # killed while writing
    summary = fit(task, data, statistics, tmp_path)

    whole = json.loads((trained / name / "summary.json").read_text())
    for key in ("epoch", "best_epoch", "best_loss", "steps", "best"):
        assert summary[key] == whole[key], key
    a, b = nnx.state(load_best(task, tmp_path)), nnx.state(load_best(task, trained / name))
    for mine, theirs in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    timeless = [{key: value for key, value in entry.items() if key != "seconds"} for entry in lines(tmp_path)]
    assert timeless == [{k: v for k, v in entry.items() if k != "seconds"} for entry in lines(trained / name)]


def test_training_goes_on_from_other_weights(trained, data, tmp_path):
    """The first epoch begins where the other network ended, and the run knows where it began."""
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[0]
    once = replace(task, optimiser=replace(task.optimiser, epochs=1, learning_rate=1e-6))
    start = weights_from_network(load_best(task, trained / "classifier"), "the one before")
    summary = fit(once, data, statistics, tmp_path, start)
    assert summary["start"] == "the one before"
    assert json.loads((trained / "classifier" / "summary.json").read_text())["start"] == "random weights"
    before = json.loads((trained / "classifier" / "summary.json").read_text())
    assert summary["best"]["loss"] == pytest.approx(before["best"]["loss"], rel=0.2)
    assert lines(tmp_path)[0]["train/loss"] < 0.8 * lines(trained / "classifier")[0]["train/loss"]
    with pytest.raises(DataError, match="other settings"):
        fit(once, data, statistics, tmp_path)


def test_the_progress_shown_is_of_steps_that_have_ended(monkeypatch):
    lead, results, ended = Lead(steps=2), [jnp.int32(step) for step in range(5)], []
    monkeypatch.setattr(type(results[0]), "block_until_ready", lambda step: ended.append(int(step)))
    assert [lead.limit(step) for step in results] == [0, 0, 1, 1, 1]
    assert ended == [0, 1, 2]
    assert [lead.end(), lead.end()] == [2, 0]
    assert ended == [0, 1, 2, 3, 4]


def test_all_views_are_counted_by_the_end(data, tmp_path, monkeypatch):
    shown, bar, statistics = [], train.loop.progress_bar("views"), load_statistics(data)
    monkeypatch.setattr(bar, "advance", lambda line, views: shown.append(views))
    monkeypatch.setattr(train.loop, "progress_bar", lambda unit: bar)
    task = tasks(SETTINGS, statistics)[0]
    fit(task, data, statistics, tmp_path)
    assert sum(shown) == task.optimiser.epochs * steps_of_an_epoch(task, statistics) * task.optimiser.batch_size


def test_a_finished_run_is_not_repeated_nor_mixed(trained, data):
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[0]
    before = (trained / "classifier" / "metrics.jsonl").stat().st_mtime_ns
    assert fit(task, data, statistics, trained / "classifier")["epoch"] == 6
    assert (trained / "classifier" / "metrics.jsonl").stat().st_mtime_ns == before
    other = replace(task, optimiser=replace(task.optimiser, learning_rate=1e-4))
    with pytest.raises(DataError, match="other settings"):
        fit(other, data, statistics, trained / "classifier")


@pytest.mark.slow
def test_a_finished_run_may_be_lengthened(data, tmp_path, capsys):
    """More epochs at a constant rate, where more patience is needed too; the result is that of one long run."""
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[1]
    task = replace(task, optimiser=replace(task.optimiser, epochs=1, schedule="constant", epoch_views=2))
    fit(task, data, statistics, tmp_path / "lengthened")
    longer = replace(task, optimiser=replace(task.optimiser, epochs=2, patience=9))
    summary = fit(longer, data, statistics, tmp_path / "lengthened")
    assert "(task.optimiser.epochs 1, not 2; task.optimiser.patience" in " ".join(capsys.readouterr().err.split())
    whole = fit(longer, data, statistics, tmp_path / "whole")
    for key in ("epoch", "steps", "best_epoch", "best"):
        assert summary[key] == whole[key], key
    assert config_of(tmp_path / "lengthened") == config_of(tmp_path / "whole")
    assert fit(longer, data, statistics, tmp_path / "lengthened") == summary
    for change in ({"epochs": 1}, {"patience": 3}, {"parts": 2}, {"compute": "bfloat16"}, {"epochs": 3, "seed": 1}):
        other = replace(longer, optimiser=replace(longer.optimiser, **change))
        with pytest.raises(DataError, match="other settings"):
            fit(other, data, statistics, tmp_path / "lengthened")
    falling = replace(longer, optimiser=replace(longer.optimiser, schedule="cosine"))
    with pytest.raises(DataError, match="other settings"):
        fit(falling, data, statistics, tmp_path / "lengthened")


@pytest.mark.slow
def test_an_interrupted_run_may_go_on_in_parts_and_half_precision(data, tmp_path, monkeypatch):
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[1]
    task = replace(task, optimiser=replace(task.optimiser, epochs=2, epoch_views=2))
    real = train.loop.validate
    seen: list[int] = []

    def interrupted(*given):
        seen.append(1)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(train.loop, "validate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(task, data, statistics, tmp_path)
    monkeypatch.undo()
    smaller = replace(task, optimiser=replace(task.optimiser, parts=2, compute="bfloat16"))
    assert fit(smaller, data, statistics, tmp_path)["epoch"] == 2
    assert config_of(tmp_path)["task"]["optimiser"]["parts"] == 2


def test_training_stops_when_validation_gets_no_better(data, tmp_path, monkeypatch):
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[0]
    task = replace(task, optimiser=replace(task.optimiser, epochs=9, patience=2, epoch_views=2))
    losses = iter([1.0, 0.9, 0.95, 0.92, 0.1])
    monkeypatch.setattr(train.loop, "validate", lambda *_: {"loss": next(losses)})
    summary = fit(task, data, statistics, tmp_path)
    assert summary["epoch"] == 4
    assert summary["best_epoch"] == 2
    assert summary["stopped_early"]


def test_networks_of_another_size_are_described(trained, data):
    statistics = load_statistics(data)
    classify, predict = tasks(SETTINGS, statistics)
    with pytest.raises(DataError, match="trained for 6 views, the data set has 40"):
        load_best(replace(predict, views=40), trained / "entropy")
    with pytest.raises(DataError, match="trained for 10 classes, the data set has 4"):
        load_best(replace(classify, classes=4), trained / "classifier")
    with pytest.raises(DataError, match="other layers"):
        load_best(replace(classify, network_config=replace(classify.network_config, width=16)), trained / "classifier")
    with pytest.raises(DataError, match="no trained classifier in"):
        load_best(classify, trained / "nothing")


def test_schedules_end_where_they_are_beyond_two_thousand_million_samples():
    task = EntropyTask.of(TINY.entropy, 6, 5.0, TINY.dataset.capture)
    rate = learning_rate(OptimiserConfig(batch_size=64, schedule="steps"), 0)
    for step in (2**25, 2**26, 2**31 - 1):
        samples = samples_before(jnp.int32(step), 64)
        assert int(samples) == min(step * 64, (2**31 - 1) // 64 * 64)
        assert float(task.momentum(samples)) == pytest.approx(0.01)
        assert float(rate(jnp.int32(step), 1e-3)) == pytest.approx(1e-5)


def test_schedules():
    steps = learning_rate(OptimiserConfig(batch_size=32, schedule="steps"), 0)
    assert float(steps(jnp.int32(0), 1e-3)) == pytest.approx(1e-3)
    assert float(steps(jnp.int32(20_000 // 32 - 1), 1e-3)) == pytest.approx(1e-3)
    assert float(steps(jnp.int32(20_000 // 32 + 1), 1e-3)) == pytest.approx(0.7e-3)
    assert float(steps(jnp.int32(10**6), 1e-3)) == pytest.approx(1e-5)
    cosine = learning_rate(OptimiserConfig(schedule="cosine"), 1000)
    assert float(cosine(jnp.int32(1000), 1e-3)) == pytest.approx(0, abs=1e-9)
    assert float(cosine(jnp.int32(100), 1e-3)) == pytest.approx(1e-3)
    assert float(cosine(jnp.int32(100), 1e-2)) == pytest.approx(1e-2)
    assert float(learning_rate(OptimiserConfig(), 10)(jnp.int32(7), 1e-2)) == pytest.approx(1e-2)
    task = EntropyTask.of(SETTINGS.entropy, 6, 4.0, TINY.dataset.capture)
    assert float(task.momentum(jnp.int32(0))) == 0.5
    assert float(task.momentum(jnp.int32(45_000))) == 0.125
    assert float(task.momentum(jnp.int32(10**6))) == pytest.approx(0.01)


def test_a_loss_that_is_no_number_stops_the_run(data, tmp_path):
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[0]
    task = replace(task, optimiser=replace(task.optimiser, learning_rate=1e30, schedule="constant", epochs=1))
    with pytest.raises(
        Diverged, match=r"diverged in epoch 1, by step .* not finite; no epoch was saved; to train again, lower"
    ):
        fit(task, data, statistics, tmp_path)
    assert not list((tmp_path / "best").iterdir())
    assert not list((tmp_path / "latest").iterdir())


@pytest.mark.parametrize("what", ["validation accuracy", pytest.param("weights", marks=pytest.mark.slow)])
def test_what_is_not_finite_is_not_saved(what, data, tmp_path, monkeypatch):
    """Also where the loss is finite; and the way out that the message names works."""
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[0]
    task = replace(task, optimiser=replace(task.optimiser, epochs=3, epoch_views=2))
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
        fit(task, data, statistics, tmp_path, rate_option="--the.rate")
    monkeypatch.undo()
    assert [entry["epoch"] for entry in lines(tmp_path)] == [1]
    with Checkpoints(tmp_path) as checkpoints:
        for slot in ("best", "latest"):
            _, progress = checkpoints.restore(slot, abstract_state(task)[1])
            assert (progress["epoch"], progress["best_loss"]) == (1, 1.0)
    lower = replace(task, optimiser=replace(task.optimiser, learning_rate=1e-3, epochs=1))
    with pytest.raises(DataError, match="other settings"):
        fit(lower, data, statistics, tmp_path)
    shutil.rmtree(tmp_path)
    assert fit(lower, data, statistics, tmp_path)["epoch"] == 1


@pytest.mark.slow
def test_a_best_epoch_of_an_older_version_without_a_loss_is_replaced(data, tmp_path, monkeypatch):
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[0]
    task = replace(task, optimiser=replace(task.optimiser, epochs=4, epoch_views=2, patience=2))
    losses = iter([3.0, 2.0, Preempted("stopped")])

    def validated(*_):
        if isinstance(loss := next(losses), Preempted):
            raise loss
        return {"loss": loss}

    monkeypatch.setattr(train.loop, "validate", validated)
    with pytest.raises(Preempted):
        fit(task, data, statistics, tmp_path)
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
    summary = fit(task, data, statistics, tmp_path)
    assert summary["best_epoch"] in (3, 4)
    assert np.isfinite(summary["best_loss"])
    assert np.isfinite(nnx.state(load_best(task, tmp_path), nnx.Param)["head"]["bias"][...]).all()

    folder = tmp_path / "weights"
    shutil.rmtree(folder / "latest")
    nowhere = jax.tree.map(lambda leaf: leaf * np.nan, state.parameters)
    with Checkpoints(folder) as checkpoints:
        checkpoints.save("latest", int(state.step), replace(state, parameters=nowhere), older)
    with pytest.raises(Diverged, match=r"after epoch 2 in .* has weights that are not finite; to train again"):
        fit(task, data, statistics, folder)


def test_an_end_within_an_epoch_saves_nothing_that_is_not_finite(data, tmp_path, monkeypatch):
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[0]
    task = replace(task, optimiser=replace(task.optimiser, learning_rate=1e30, schedule="constant"))
    steps = itertools.count(1)
    monkeypatch.setattr(train.loop.Preemption, "after_step", lambda _: next(steps) == 3)
    with pytest.raises(Diverged, match="diverged in epoch 1, by step 3"):
        fit(task, data, statistics, tmp_path)
    assert not list((tmp_path / "latest").iterdir())


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Jobs in the background may have been started with interrupts ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_waits_for_the_checkpoint(tmp_path, monkeypatch):
    """One that falls into Orbax would leave its threads waiting for each other, and the program with them."""
    state = {"weights": jnp.arange(4.0)}
    with Checkpoints(tmp_path) as checkpoints:
        manager = checkpoints._slots["latest"]
        save = manager.save

        def interrupted(*arguments, **named):
            signal.raise_signal(signal.SIGINT)
            return save(*arguments, **named)

        monkeypatch.setattr(manager, "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            checkpoints.save("latest", 1, state, {"epoch": 1})
        restored = checkpoints.restore("latest", state)
        assert restored is not None
        assert restored[1] == {"epoch": 1}
        np.testing.assert_array_equal(restored[0]["weights"], state["weights"])
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
