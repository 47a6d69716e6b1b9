"""A sweep is many runs at once: each member ends as it would have ended alone."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

import train.many.sweep
import train.many.training
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError, Diverged
from eval.report.sweep import sweep_table
from eval.runs import tasks
from eval.settings import TINY
from eval.sweeping import adopt, train_sweep
from tests.reference.quick import quick_tasks
from tests.train.running.scaling_worker import SETTINGS
from train.choosing.stages import Stages
from train.loop import fit, load_best, steps_of_an_epoch, validate
from train.many.members import Member, Together, by_configurations, task_of
from train.many.sweep import SweepConfig, best_of, draw_members, sweep
from train.results.identity import summary_of
from train.running.checkpoints import Checkpoints
from train.running.devices import device_mesh
from train.running.preemption import Preempted
from train.step import TrainState, evaluate_step_of, initial_state
from train.validation import ValidationSet

SWEEP = SweepConfig(members=4, learning_rate=(1e-4, 1e-2))


@pytest.fixture(scope="module")
def out(tmp_path_factory, data) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "data").symlink_to(data)
    return folder


def task_named(name: str, out: Path, **changed):
    """A quick task; `epochs` are three."""
    return quick_tasks(load_statistics(out / "data"), **changed)[("classifier", "entropy").index(name)]


@pytest.fixture(scope="module")
def whole(out) -> tuple[Path, list[Member]]:
    """A sweep that was never stopped."""
    members = sweep(task_named("entropy", out), out / "data", load_statistics(out / "data"), out / "whole", SWEEP)
    return out / "whole", members


def test_members_end_as_separate_runs_do(out, tmp_path):
    """Some stop early, and are left alone while others continue."""
    statistics, task = load_statistics(out / "data"), task_named("entropy", out, patience=1)
    # The last member multiplies its weights by −1.5 in every step, and so gets worse by each epoch.
    config = SweepConfig(grid=("learning-rate=1e-4,1e-3", "weight-decay=0,2500"))
    members = sweep(task, out / "data", statistics, tmp_path / "sweep", config)
    for index, member in enumerate(members):
        alone = fit(task_of(task, member), out / "data", statistics, tmp_path / str(index))
        assert (alone["epoch"], alone["best_epoch"]) == (member.epochs, member.best_epoch)
        for metric, value in alone["best"].items():
            assert member.best[metric] == pytest.approx(value, rel=1e-4), metric
    assert min(member.epochs for member in members) < max(member.epochs for member in members) == task.optimiser.epochs
    assert len({member.best["loss"] for member in members}) == 4

    best = min(members, key=lambda member: member.loss)
    network = load_best(task, tmp_path / "sweep" / "network")
    structure, state = initial_state(task, 0)
    _, parameters, rest = nnx.split(network, nnx.Param, ...)
    state = TrainState(state.step, parameters, rest, state.moments, state.sums)
    mesh = device_mesh()
    validation = ValidationSet(task, out / "data", statistics, mesh.shape["data"])
    found = validate(jax.jit(evaluate_step_of(task, structure)), state, validation, mesh)
    assert found["loss"] == pytest.approx(best.loss, rel=1e-5)
    summary = fit(task_of(task, best), out / "data", statistics, tmp_path / "sweep" / "network")  # a finished run
    assert summary["best_loss"] == best.loss


def metrics_of(folder: Path) -> list[dict[str, str]]:
    """All metrics of all epochs of a sweep."""
    return list(csv.DictReader((folder / "epochs.csv").open()))


def test_a_sweep_of_version_0_1_goes_on_after_its_last_epoch(out, whole, tmp_path, monkeypatch, capsys):
    """It kept the number of epochs alone."""
    statistics, task = load_statistics(out / "data"), task_named("entropy", out)
    real_save = Checkpoints.save

    def stopped(self, slot, step, state, progress):
        real_save(self, slot, step, state, {name: value for name, value in progress.items() if name != "step"})
        raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoints, "save", stopped)
    with pytest.raises(KeyboardInterrupt):
        sweep(task, out / "data", statistics, tmp_path / "before", SWEEP)
    monkeypatch.undo()
    capsys.readouterr()
    assert sweep(task, out / "data", statistics, tmp_path / "before", SWEEP) == whole[1]
    assert "resuming after epoch 1" in " ".join(capsys.readouterr().err.split())
    assert metrics_of(tmp_path / "before") == metrics_of(whole[0])


def test_a_stopped_sweep_ends_as_if_it_had_not_been(out, whole, tmp_path, monkeypatch, capsys):
    """Told to end within an epoch."""
    statistics, task = load_statistics(out / "data"), task_named("entropy", out)
    epoch = steps_of_an_epoch(task, statistics)
    assert epoch > 1
    after = epoch + 1
    real = train.many.training.train_batches

    def told_to_end(*arguments, **options):
        for number, batch in enumerate(real(*arguments, **options)):
            if number + 1 == after:
                os.kill(os.getpid(), signal.SIGTERM)
            yield batch

    monkeypatch.setattr(train.many.training, "train_batches", told_to_end)
    with pytest.raises(Preempted, match=f"after step {after}$"):
        sweep(task, out / "data", statistics, tmp_path / "stopped", SWEEP)
    monkeypatch.undo()
    assert not (tmp_path / "stopped" / "members.json").exists()
    assert (tmp_path / "stopped" / "latest" / str(after)).exists()
    capsys.readouterr()
    assert sweep(task, out / "data", statistics, tmp_path / "stopped", SWEEP) == whole[1]
    assert f"resuming after epoch 1, step {after}" in " ".join(capsys.readouterr().err.split())
    assert metrics_of(tmp_path / "stopped") == metrics_of(whole[0])
    assert sweep(task, out / "data", statistics, tmp_path / "stopped", SWEEP) == whole[1]  # not trained again
    with pytest.raises(DataError, match="other settings"):
        sweep(task, out / "data", statistics, tmp_path / "stopped", replace(SWEEP, members=2))


def test_a_member_whose_loss_is_no_number_leaves_the_others_alone(out, tmp_path, monkeypatch):
    statistics, task = load_statistics(out / "data"), task_named("classifier", out, epochs=1)
    chosen = [Member(rate, 1e-3, 0.0, 1.0, 7) for rate in (1e-4, 1e38)]
    monkeypatch.setattr(train.many.sweep, "draw_members", lambda *_: chosen)
    members = sweep(task, out / "data", statistics, tmp_path / "sweep", SWEEP)
    assert [member.diverged for member in members] == [False, True]
    assert "diverged" in sweep_table(members)
    alone = fit(task_of(task, members[0]), out / "data", statistics, tmp_path / "alone")
    assert members[0].loss == pytest.approx(alone["best_loss"], rel=1e-4)

    chosen[0] = chosen[1]
    for _ in range(2):  # the second time from its checkpoint
        with pytest.raises(
            Diverged, match=r"every member .* diverged, with learning rates from 1e.38 to 1e.38, .* delete"
        ):
            sweep(task, out / "data", statistics, tmp_path / "none", SWEEP)
    assert not (tmp_path / "none" / "members.json").exists()
    assert not (tmp_path / "none" / "network").exists()


def test_members_that_diverge_late_are_never_the_best():
    members = [
        Member(1e-3, 1e-3, 0.0, 1.0, seed, 1, {"loss": loss}, 1) for seed, loss in enumerate((0.1, 0.2, 0.3, 0.4))
    ]
    means = {"loss": np.ones(4), "accuracy": np.array([1, np.nan, 1, 1])}
    checked = {"loss": np.array([0.01, 0.01, np.inf, 0.35])}
    together = Together(members, [[] for _ in members], epoch=2)
    finite = np.array([False, True, True, True])
    better = together.after_epoch(np.ones(4, bool), means, checked, finite, patience=5)
    after = together.members
    assert [member.diverged for member in after] == [True, True, True, False]
    np.testing.assert_array_equal(better, [False, False, False, True])
    assert min(after, key=lambda member: member.loss) is after[3]
    assert sweep_table(after).count("diverged") == 3

    worse = {"loss": np.full(4, 9.0)}
    kept = together.after_epoch(better, {"loss": np.ones(4)}, worse, np.ones(4, bool), patience=0)
    np.testing.assert_array_equal(kept, better)  # without patience the last weights are kept
    assert together.members[3].is_training(0)


def test_configurations_fill_their_ranges(out):
    task = task_named("entropy", out)
    members = draw_members(SweepConfig(members=64), task)
    for name, low, high in (("learning_rate", 3e-4, 1e-2), ("weight_decay", 1e-4, 1e-1), ("dropout", 0, 0.5)):
        values = np.array([getattr(member, name) for member in members])
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.2 * (high - low) < values.max() <= high
    assert [member.seed for member in members] == list(range(64))
    fixed = draw_members(SweepConfig(members=3, dropout=(0.1, 0.1), same_start=True), task)
    assert {(member.dropout, member.seed) for member in fixed} == {(0.1, 0)}
    assert {member.dropout for member in draw_members(SWEEP, task_named("classifier", out))} == {0.0}
    for config, told in (
        (SweepConfig(members=0), "--sweep.members 0 is too few"),
        (SweepConfig(learning_rate=(0.0, 1.0)), "--sweep.learning-rate 0.0 1.0 must be a range above 0"),
        (SweepConfig(dropout=(0.5, 1.0)), r"--sweep.dropout 0.5 1.0 must be a range within \[0, 1\)"),
    ):
        with pytest.raises(DataError, match=told):
            draw_members(config, task)


def test_grids_and_lists_give_every_configuration_the_same_seeds(out, tmp_path):
    task = task_named("entropy", out)
    config = SweepConfig(grid=("learning-rate=1e-4,3e-4,1e-3", "dropout=0,0.5"), seeds=2)
    members = draw_members(config, task)
    assert len(members) == len(set(members)) == 12
    assert {(one.learning_rate, one.dropout, one.seed) for one in members} == {
        (rate, dropout, seed) for rate in (1e-4, 3e-4, 1e-3) for dropout in (0.0, 0.5) for seed in (0, 1)
    }
    assert {one.weight_decay for one in members} == {task.optimiser.weight_decay}
    assert len(by_configurations(members)) == 6
    (tmp_path / "some.csv").write_text("learning-rate,weight_decay\n1e-4,0.1\n2e-4,0.2\n")
    content = '[{"learning_rate": 1e-4, "weight-decay": 0.1}, {"learning_rate": 2e-4, "weight-decay": 0.2}]'
    (tmp_path / "some.json").write_text(content)
    listed = [draw_members(SweepConfig(list=str(tmp_path / name)), task) for name in ("some.csv", "some.json")]
    assert listed[0] == listed[1]
    assert [(one.learning_rate, one.weight_decay, one.seed) for one in listed[0]] == [(1e-4, 0.1, 0), (2e-4, 0.2, 0)]


@pytest.mark.parametrize(
    ("config", "told"),
    [
        ({"grid": ("learning-rate",)}, "--sweep.grid learning-rate is not NAME=VALUE,VALUE"),
        (
            {"grid": ("rate=1",)},
            "rate cannot be swept for the entropy predictor; learning-rate, weight-decay, dropout",
        ),
        ({"grid": ("learning-rate=1e-4,fast",)}, "'fast' is not a number"),
        ({"grid": ("learning-rate=0",)}, "0 is out of the range of learning-rate"),
        ({"grid": ("dropout=1",)}, "1 is out of the range of dropout"),
        ({"grid": ("dropout=nan",)}, "nan is out of the range of dropout"),
        ({"grid": ("dropout=0.1", "dropout=0.2")}, "--sweep.grid names dropout twice"),
        ({"grid": ("dropout=0.1",), "list": "a.csv"}, "exclude each other"),
        ({"list": "nowhere.csv"}, "--sweep.list nowhere.csv cannot be read"),
        ({"seeds": 0}, "--sweep.seeds 0 is not from 1 to 1000"),
    ],
)
def test_grids_that_mean_nothing_are_refused(config, told, out):
    with pytest.raises(DataError, match=re.escape(told)):
        draw_members(SweepConfig(**config), task_named("entropy", out))


def test_lists_that_mean_nothing_are_refused(out, tmp_path):
    task = task_named("entropy", out)
    for content in ("[]", "{}", "[1]", "learning-rate\n", "[{}]", '[{"learning-rate": null}]', "{"):
        for suffix in (".json", ".csv"):
            (tmp_path / f"some{suffix}").write_text(content)
            with pytest.raises(DataError, match=r"--sweep\.list"):
                draw_members(SweepConfig(list=str(tmp_path / f"some{suffix}")), task)


def test_halving_drops_the_worse_half_of_the_configurations():
    """Configurations are compared by the mean over their seeds."""
    losses = {1e-1: (0.1, 0.9), 1e-2: (0.4, 0.4), 1e-3: (0.3, 0.3), 1e-4: (0.8, 0.8), 1e-5: (0.45, 0.46)}
    members = [
        Member(rate, 0.0, 0.0, 1.0, seed, 1, {"loss": loss}, 1)
        for rate, pair in losses.items()
        for seed, loss in enumerate(pair)
    ]
    assert best_of(members).learning_rate == 1e-3
    together = Together(members, [])
    left = []
    for _ in range(3):
        together.halve()
        left.append(sorted({one.learning_rate for one in together.members if not one.dropped}))
    assert left == [[1e-5, 1e-3, 1e-2], [1e-3, 1e-2], [1e-3]]
    assert [one.is_training(5) for one in together.members].count(True) == 2


@pytest.mark.slow
def test_a_halved_sweep_trains_the_best_to_the_end_is_shown_and_adopted(out, tmp_path):
    shutil.copytree(out / "data", tmp_path / "data")
    entropy = replace(SETTINGS.entropy, optimiser=replace(SETTINGS.entropy.optimiser, epochs=4))
    config = SweepConfig(grid=("learning-rate=1e-7,1e-3,1e-6,3e-6",), halving=True)
    settings = replace(SETTINGS, entropy=entropy, sweep=config)
    folder, network, members = train_sweep(settings, tmp_path)
    assert [one.epochs for one in members] == [1, 4, 1, 2]
    assert best_of(members) is members[1]
    table, best = (folder / "members.md").read_text().splitlines(), min(members, key=lambda member: member.loss)
    assert len(table) == 2 + len(members)
    assert table[2].startswith(f"| {members.index(best)} | {best.learning_rate:.2e}")
    assert (folder / "parallel_coordinates.png").stat().st_size > 5000
    assert [Member(**member) for member in json.loads((folder / "members.json").read_text())] == members
    rows = metrics_of(folder)
    assert len(rows) == sum(one.epochs for one in members)
    assert {"member", "epoch", "train/loss", "val/loss"} <= set(rows[0])
    there, adopted = adopt(settings, tmp_path, network)
    assert there == tmp_path / "entropy"
    assert adopted.entropy.optimiser.learning_rate == 1e-3
    assert replace(adopted.entropy, optimiser=entropy.optimiser) == entropy
    summary = fit(
        tasks(adopted, load_statistics(tmp_path / "data"))[1],
        tmp_path / "data",
        load_statistics(tmp_path / "data"),
        there,
    )
    assert summary["best_loss"] == members[1].loss  # nothing is trained again
    assert adopt(settings, tmp_path, network) == (there, adopted)
    (there / "config.json").write_text((there / "config.json").read_text().replace("0.001", "0.002"))
    (there / "checks.json").unlink()
    with pytest.raises(DataError, match="holds another network; delete it"):
        adopt(settings, tmp_path, network)


@pytest.mark.slow
def test_the_recogniser_is_swept_too(turned, data, tmp_path):
    (tmp_path / "learned").mkdir()
    shutil.copytree(data, tmp_path / "data")
    shutil.copytree(turned, tmp_path / "learned" / "turned")
    settings = replace(TINY, sweep=SweepConfig(network="recogniser", grid=("learning-rate=1e-4,1e-3",)))
    _, network, members = train_sweep(settings, tmp_path)
    assert len(members) == 2
    there, adopted = adopt(settings, tmp_path, network)
    assert there == tmp_path / "learned" / "seed_0" / "recogniser"
    assert adopted.learned.recogniser.optimiser.learning_rate == best_of(members).learning_rate
    study = Stages(adopted.learned, adopted.dataset, tmp_path, 0)
    study.train_recogniser()  # it is trained
    assert summary_of(there)["best_loss"] == best_of(members).loss
