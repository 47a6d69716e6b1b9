"""One program, from one device to several processes: the same numbers, and nothing lost on the way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

from benchmarks.interruptions import EVERY, killed_training
from data_pipeline.dataset.statistics import load_statistics
from eval.runs import tasks
from tests.reference.processes import CPU
from tests.reference.quick import lines, quick_tasks
from tests.train.running.scaling_worker import SETTINGS
from train.loop import fit, load_best
from train.running.checkpoints import Checkpoints


def work(**asked) -> subprocess.CompletedProcess:
    asked = {key: str(value) if isinstance(value, Path) else value for key, value in asked.items()}
    return subprocess.run(
        [sys.executable, "-m", "tests.train.running.scaling_worker", json.dumps(asked)],
        capture_output=True,
        text=True,
        env=os.environ | CPU,
        timeout=600,
    )


@pytest.mark.slow
def test_steps_on_many_devices_equal_those_on_one(data):
    """Dropout and augmentation on; both networks, and PointNet++ with its weights split in two as well.

    Ten steps: after some dozens rounding decides whether a rectified unit is on, and how far the curves then part depends on the
    processor. Batches and activations stay where they are: devices add up sums, and that is all they say to each other, unless
    weights are split.
    """
    steps = 10
    done = work(data=data, devices=8, steps=steps)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    alone, silent = found.pop("1")
    assert len(alone) == len(tasks(SETTINGS, load_statistics(data))) == 2
    assert all(not said for said in silent.values())
    assert found["all"][1] == {name: ["all-reduce"] for name in alone}
    for mesh, (curve, _) in found.items():
        for name, losses in curve.items():
            assert len(losses) == steps
            assert np.std(losses) > 1e-3
            np.testing.assert_allclose(losses, alone[name], rtol=1e-5, err_msg=f"{name} on {mesh}")


@pytest.mark.slow
def test_a_job_that_is_killed_within_epochs_ends_with_the_same_weights(data, tmp_path):
    """By SIGKILL, at steps apart from the checkpoints. The newest of them may not be written yet, but then the one before is."""
    every, kills = 4, (2, 5, 7, 14, 17, 22)
    statistics = load_statistics(data)
    for at in kills:
        done = work(data=data, devices=1, out=tmp_path / "killed", stop_at=at, by=int(signal.SIGKILL), every=every)
        assert done.returncode == -signal.SIGKILL, done.stderr
        with Checkpoints(tmp_path / "killed") as checkpoints:
            assert at - checkpoints.latest_step("latest") <= every
    assert work(data=data, devices=1, out=tmp_path / "killed", stop_at=10**6, every=every).returncode == 0
    task = quick_tasks(statistics)[1]
    assert work(data=data, devices=1, out=tmp_path / "whole", stop_at=10**6).returncode == 0
    states = [nnx.state(load_best(task, tmp_path / name)) for name in ("killed", "whole")]
    for mine, theirs in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for mine, theirs in zip(lines(tmp_path / "killed"), lines(tmp_path / "whole"), strict=True):
        assert mine | {"seconds": 0} == theirs | {"seconds": 0}


@pytest.mark.slow
@pytest.mark.usefixtures("named")
def test_a_job_that_is_killed_on_one_two_and_one_process_repeats_few_steps(tmp_path):
    _, repeated, apart = killed_training(tmp_path, [1, 2, 1], 3)
    assert len(repeated) == 3
    assert max(repeated) <= EVERY
    assert apart < 2e-4


@pytest.mark.slow
def test_a_run_goes_on_with_fewer_devices(data, tmp_path, capsys):
    """Four devices, told to end at a batch; then two, told to end; then one: as if one had done it all."""
    whole, moved = tmp_path / "whole", tmp_path / "moved"
    for devices, stop_at in ((4, 5), (2, 19)):
        done = work(data=data, devices=devices, out=moved, stop_at=stop_at)
        assert done.returncode == 143, done.stderr
    statistics = load_statistics(data)
    task = quick_tasks(statistics)[1]
    for folder in (whole, moved):
        fit(task, data, statistics, folder)
    assert " ".join(capsys.readouterr().err.split()).count("resuming after epoch") == 1
    for mine, theirs in zip(lines(moved), lines(whole), strict=True):
        assert mine.keys() == theirs.keys()
        for key in set(mine) - {"seconds"}:
            assert mine[key] == pytest.approx(theirs[key], rel=1e-4, abs=1e-7), key
    states = [nnx.state(load_best(task, folder), nnx.Param) for folder in (moved, whole)]
    for mine, theirs in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-3, atol=2e-4)
