"""Several processes evaluate a run as one does."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.distributed import from_all, own_share
from data_pipeline.files import files_in
from data_pipeline.lock import locked
from eval.runs import tasks
from eval.settings import TINY
from mevs_jax import load
from mevs_jax.cli.parsing import parse
from tests.reference.leaks import LEARNED
from tests.reference.processes import CPU, start
from train.loop import steps_of_an_epoch
from train.results.identity import summary_of

pytestmark = pytest.mark.usefixtures("named")

SECONDS_TO_END = 180
"""Long enough for a machine that is busy, and shorter than Python's own way out, which waits 300 seconds for other processes."""


def alone(*arguments: str) -> None:
    """A command of `mevs` in one process."""
    done = subprocess.run(
        [sys.executable, "-m", "mevs_jax", *arguments],
        capture_output=True,
        text=True,
        env=os.environ | CPU,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr


def killed_and_finished(made: Path, *arguments: str) -> list[tuple[str, str]]:
    """What two processes print, once they were started again after one was killed when `made` was there."""
    processes = start(*arguments)
    until = time.monotonic() + 300
    while not made.exists():
        assert time.monotonic() < until, "nothing is made"
        assert processes[1].poll() is None, processes[1].communicate()
        time.sleep(0.02)
    processes[1].send_signal(signal.SIGKILL)
    processes[0].communicate(timeout=SECONDS_TO_END)
    assert processes[0].returncode in (75, -6)
    return finished(start(*arguments))


def finished(processes: list[subprocess.Popen]) -> list[tuple[str, str]]:
    said = [process.communicate(timeout=900) for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), said
    return said


@pytest.mark.slow
def test_two_processes_evaluate_as_one_does(whole, tmp_path):
    """Also once a process was killed."""
    out = tmp_path / "run"
    shutil.copytree(whole, out, symlinks=True)
    for made in ("metrics.json", "metrics.csv"):
        (out / made).unlink()
    shutil.rmtree(out / "tables")
    (first, _), (second, told) = killed_and_finished(out / "tables", "eval", "--out", str(out))
    assert "test objects right" in first
    assert "test objects" not in second  # one speaks for all
    assert "Walking" not in told
    for made in ("metrics.json", "metrics.csv"):
        assert (out / made).read_bytes() == (whole / made).read_bytes(), made
    with np.load(out / "tables" / "test.npz") as mine, np.load(whole / "tables" / "test.npz") as theirs:
        for key in theirs:
            np.testing.assert_array_equal(mine[key], theirs[key])


@pytest.mark.slow
def test_two_processes_make_the_data_set_that_one_makes(data, tmp_path):
    one, both = data, tmp_path / "data"
    (said, told), _ = killed_and_finished(both / "captures", "data", "--preset", "tiny", "--out", str(tmp_path))
    assert "\nData set: " in "\n" + said
    assert told.count("process 1: ") == 1
    assert files_in(both) == files_in(one)
    for name in files_in(one):
        assert (both / name).read_bytes() == (one / name).read_bytes(), name


@pytest.fixture
def outs(whole, tmp_path) -> list[Path]:
    """Two run directories with the same data set: for one process, and for both."""
    found = [tmp_path / name for name in ("one", "both")]
    for out in found:
        out.mkdir()
        (out / "data").symlink_to(whole / "data")
    return found


def alone_on_two_devices(*arguments: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CPU, "JAX_NUM_CPU_DEVICES", "2")
        alone(*arguments)


@pytest.mark.slow
def test_two_processes_sweep_as_two_devices_do(outs):
    """A grid that is halved; the best of it becomes the run's."""
    given = ("--preset", "tiny", "--grid", "learning-rate=1e-3,1e-4", "--seeds", "2", "--sweep.halving", "--adopt")
    command = ("sweep", *given, "--entropy.optimiser.epochs", "4", "--out")
    alone_on_two_devices(*command, str(outs[0]))
    task = tasks(TINY, load_statistics(outs[0] / "data"))[1]
    epoch = steps_of_an_epoch(task, load_statistics(outs[0] / "data"))
    (said, _), _ = killed_and_finished(outs[1] / "sweep" / "entropy" / "latest" / str(epoch), *command, str(outs[1]))
    assert "Best of 4" in said
    one, both = (json.loads((out / "sweep" / "entropy" / "members.json").read_text()) for out in outs)
    assert [member["dropped"] for member in both] == [member["dropped"] for member in one]
    for mine, theirs in zip(both, one, strict=True):
        assert mine["best"] == pytest.approx(theirs["best"], rel=1e-5)
        assert mine["epochs"] == theirs["epochs"]
    adopted = [summary_of(out / "entropy") for out in outs]
    assert adopted[1]["best"] == pytest.approx(adopted[0]["best"], rel=1e-5)


@pytest.mark.slow
def test_two_processes_study_as_one_does(studied, tmp_path):
    """Two seeds, from the first recogniser to the exported system."""
    outs = studied, tmp_path
    for made in ("data", "learned/turned"):
        shutil.copytree(studied / made, tmp_path / made)
    given = ["--preset", "tiny", "--seeds", "2", "--learned.recogniser.optimiser.learning-rate", "1e-4"]
    given += ["--learned.ablations", "--learned.novel", "0", "--learned.rotation-epochs", "0", "--out", str(tmp_path)]
    less = replace(LEARNED.learned, ablations=(), novel=0, rotation_epochs=0)
    assert parse("study learned", given).settings.learned == less
    (first, _), _ = finished(start("study", "learned", *given))
    assert "Report: " in first
    one, both = (json.loads((out / "learned" / "metrics.json").read_text())["together"] for out in outs)
    assert one.keys() == both.keys()
    for views, theirs in both.items():
        assert len(theirs["policies"]) > 5
        for name, policy in theirs["policies"].items():
            # A walk turns where two views are as good as each other but for rounding: of few objects, one walk is 0.001.
            mine = one[views]["policies"][name]["after_views"]
            np.testing.assert_allclose(mine, policy["after_views"], atol=0.02, err_msg=name)
    assert load(outs[1] / "learned" / "system").classes == load(outs[0] / "learned" / "system").classes


@pytest.mark.slow
def test_processes_end_with_the_error_of_one(tmp_path):
    """A damaged mesh in the share of the second process; and a run directory that another job holds, which the first notices."""
    objects = tmp_path / "objects"
    for name in ("ball", "box"):
        for split, count in (("train", 3), ("test", 1)):
            (objects / name / split).mkdir(parents=True)
            for number in range(count):
                trimesh.creation.icosphere(1).export(objects / name / split / f"{number}.off")
    (objects / "ball" / "train" / "1.off").write_text("OFF\n3 1 0\n0 0 0\n")
    given = ("data", "--preset", "tiny", "--data", str(objects), "--views", "6", "--out")
    ended = ends(start(*given, str(tmp_path / "run")))
    assert 2 in [code for code, _ in ended], ended
    assert any("1.off" in said for _, said in ended)
    with locked(tmp_path / "run", "another job"):
        first, second = start(*given, str(tmp_path / "run"))
        try:
            said = first.communicate(timeout=SECONDS_TO_END)[1]
        finally:
            for process in (first, second):
                process.kill()
                process.communicate()
    assert first.returncode == 2, said
    assert "another job" in said


def ends(processes: list[subprocess.Popen]) -> list[tuple[int, str]]:
    """Exit codes and messages of processes that end by themselves."""
    until = time.monotonic() + SECONDS_TO_END
    said = [process.communicate(timeout=max(1, until - time.monotonic()))[1] for process in processes]
    return [(process.returncode, message) for process, message in zip(processes, said, strict=True)]


def test_shares_of_processes_are_put_together_in_order(monkeypatch):
    """The gathering itself is replaced: every process's padded share, one after the other."""
    import jax
    from jax.experimental import multihost_utils

    for count, processes in ((7, 3), (2, 4), (6, 2), (5, 1)):
        whole, shares = np.arange(10.0, 10 + count)[:, None] * np.ones((1, 2)), []
        monkeypatch.setattr(jax, "process_count", lambda number=processes: number)
        for index in range(processes):
            monkeypatch.setattr(jax, "process_index", lambda number=index: number)
            shares.append(whole[own_share(count)])
        most = max(map(len, shares))
        padded = np.stack([np.concatenate([one, np.zeros((most - len(one), 2))]) for one in shares])
        monkeypatch.setattr(multihost_utils, "process_allgather", lambda _, every=padded: every)
        np.testing.assert_array_equal(from_all(shares[0], count), whole)
