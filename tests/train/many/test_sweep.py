"""A sweep is many runs at once: each member ends as it would have ended alone."""

from __future__ import annotations

import json
import os
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
from eval.stages import tasks, train_sweep
from tests.train.scaling_worker import SETTINGS
from train.devices import device_mesh
from train.loop import fit, load_best, validate, validation_set
from train.many.members import Member, Together, task_of
from train.many.sweep import SweepConfig, draw_members, sweep
from train.preemption import Preempted
from train.step import TrainState, evaluate_step_of, initial_state

SWEEP = SweepConfig(members=4, learning_rate=(1e-5, 3e-4))
"""Low rates: what rounding does to a rectified unit grows with the rate."""


@pytest.fixture(scope="module")
def out(tmp_path_factory, data) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "data").symlink_to(data)
    return folder


def task_named(name: str, out: Path):
    settings = replace(
        SETTINGS,
        classifier=replace(SETTINGS.classifier, optimiser=replace(SETTINGS.classifier.optimiser, patience=1)),
        entropy=replace(SETTINGS.entropy, optimiser=replace(SETTINGS.entropy.optimiser, patience=1)),
    )
    return tasks(settings, load_statistics(out / "data"))[("classifier", "entropy").index(name)]


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["one", "all"])
def test_members_end_as_separate_runs_do(every, out, tmp_path):
    """Some stop early, and are left alone while others continue; the first to stop, or all."""
    statistics, task = load_statistics(out / "data"), task_named("entropy", out)
    members = sweep(task, out / "data", statistics, tmp_path / "sweep", SWEEP)
    by_epochs = sorted(range(len(members)), key=lambda index: members[index].epochs)
    for index in by_epochs if every else by_epochs[:1]:
        member = members[index]
        alone = fit(task_of(task, member), out / "data", statistics, tmp_path / str(index))
        assert (alone["epoch"], alone["best_epoch"]) == (member.epochs, member.best_epoch)
        for metric, value in alone["best"].items():
            assert member.best[metric] == pytest.approx(value, rel=1e-4), metric
    assert min(member.epochs for member in members) < task.optimiser.epochs
    assert len({member.best["loss"] for member in members}) == 4

    best = min(members, key=lambda member: member.loss)
    network = load_best(task, tmp_path / "sweep" / "network")
    structure, state = initial_state(task, 0)
    _, parameters, rest = nnx.split(network, nnx.Param, ...)
    state = TrainState(state.step, parameters, rest, state.moments, state.sums)
    mesh = device_mesh()
    validation = validation_set(task, out / "data", statistics, mesh.shape["data"])
    found = validate(jax.jit(evaluate_step_of(task, structure)), state, validation, mesh)
    assert found["loss"] == pytest.approx(best.loss, rel=1e-5)
    summary = fit(task_of(task, best), out / "data", statistics, tmp_path / "sweep" / "network")  # a finished run
    assert summary["best_loss"] == best.loss


@pytest.mark.slow
def test_a_stopped_sweep_ends_as_if_it_had_not_been(out, tmp_path, monkeypatch):
    statistics, task = load_statistics(out / "data"), task_named("entropy", out)
    task = replace(task, optimiser=replace(task.optimiser, patience=5, epochs=3))
    whole = sweep(task, out / "data", statistics, tmp_path / "whole", SWEEP)
    real = train.many.training.train_batches

    def told_to_end(*arguments, **options):
        for number, batch in enumerate(real(*arguments, **options)):
            if number == 1:
                os.kill(os.getpid(), signal.SIGTERM)
            yield batch

    monkeypatch.setattr(train.many.training, "train_batches", told_to_end)
    with pytest.raises(Preempted, match="after epoch 1"):
        sweep(task, out / "data", statistics, tmp_path / "stopped", SWEEP)
    monkeypatch.undo()
    assert not (tmp_path / "stopped" / "members.json").exists()
    assert sweep(task, out / "data", statistics, tmp_path / "stopped", SWEEP) == whole
    assert sweep(task, out / "data", statistics, tmp_path / "stopped", SWEEP) == whole  # not trained again
    with pytest.raises(DataError, match="other settings"):
        sweep(task, out / "data", statistics, tmp_path / "stopped", replace(SWEEP, members=2))


@pytest.mark.slow
def test_a_member_whose_loss_is_no_number_leaves_the_others_alone(out, tmp_path, monkeypatch):
    statistics, task = load_statistics(out / "data"), task_named("classifier", out)
    task = replace(task, optimiser=replace(task.optimiser, schedule="constant", epochs=1))
    chosen = [Member(rate, 1e-3, 0.0, 1.0, 7) for rate in (1e-4, 1e30)]
    monkeypatch.setattr(train.many.sweep, "draw_members", lambda *_: chosen)
    members = sweep(task, out / "data", statistics, tmp_path / "sweep", SWEEP)
    assert [member.diverged for member in members] == [False, True]
    assert "diverged" in sweep_table(members)
    alone = fit(task_of(task, members[0]), out / "data", statistics, tmp_path / "alone")
    assert members[0].loss == pytest.approx(alone["best_loss"], rel=1e-4)

    chosen[0] = chosen[1]
    for _ in range(2):  # the second time from its checkpoint
        with pytest.raises(
            Diverged, match=r"every member .* diverged, with learning rates from 1e.30 to 1e.30, .* delete"
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
    together = Together(members, epoch_steps=1, epoch=2, histories=[[] for _ in members])
    finite = np.array([False, True, True, True])
    better = together.after_epoch(np.ones(4, bool), means, checked, finite)
    after = together.members
    assert [member.diverged for member in after] == [True, True, True, False]
    np.testing.assert_array_equal(better, [False, False, False, True])
    assert min(after, key=lambda member: member.loss) is after[3]
    assert sweep_table(after).count("diverged") == 3


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


def test_the_command_leaves_table_plot_and_network(out):
    settings = replace(SETTINGS, sweep=SWEEP)
    folder, members = train_sweep(settings, out)
    table = (folder / "members.md").read_text().splitlines()
    assert len(table) == 2 + len(members)
    best = min(members, key=lambda member: member.loss)
    assert table[2].startswith(f"| {members.index(best)} | {best.learning_rate:.2e}")
    assert (folder / "parallel_coordinates.png").stat().st_size > 5000
    assert [Member(**member) for member in json.loads((folder / "members.json").read_text())] == members
