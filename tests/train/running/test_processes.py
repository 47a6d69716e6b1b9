"""Several processes train as one does; a lost one ends the others, and the run goes on."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import pytest

from data_pipeline.dataset.statistics import load_statistics
from eval.runs import tasks
from mevs_jax.cli.parsing import parse
from tests.reference.processes import start
from tests.reference.quick import lines
from train.loop import fit

pytestmark = pytest.mark.usefixtures("named")

NETWORKS = ("classifier", "entropy")


def slowly(out: Path) -> list[str]:
    """The options of `mevs train` that train both networks slowly, for one epoch."""
    slow = (("learning-rate", "1e-4"), ("epochs", "1"))
    options = [f"--{network}.optimiser.{name}={value}" for network in NETWORKS for name, value in slow]
    return ["--preset", "tiny", "--out", str(out), *options]


def ended(process: subprocess.Popen, code: int) -> str:
    """What a process said, once it has ended with this exit code."""
    said = process.communicate(timeout=300)[1]
    assert process.returncode == code, said
    return said


@pytest.fixture
def run(data, tmp_path):
    """Makes run directories that hold the data set already."""

    def folder(name: str) -> Path:
        out = tmp_path / name
        out.mkdir()
        (out / "data").symlink_to(data)
        return out

    return folder


@pytest.mark.slow
def test_two_processes_train_as_one_does(run):
    alone, together = run("alone"), run("together")
    statistics = load_statistics(alone / "data")
    settings = parse("train", slowly(alone)).settings
    for task, name in zip(tasks(settings, statistics), NETWORKS, strict=True):
        fit(task, alone / "data", statistics, alone / name)
    first, second = (ended(process, 0) for process in start("train", *slowly(together)))
    assert "classifier: best epoch" in first
    assert "epoch" not in second  # one speaks for all
    for name in NETWORKS:
        for mine, theirs in zip(lines(together / name), lines(alone / name), strict=True):
            for key in set(mine) - {"seconds"}:
                assert mine[key] == pytest.approx(theirs[key], rel=1e-5, abs=1e-7), key


@pytest.mark.slow
def test_a_lost_process_ends_the_others_and_the_run_goes_on(run):
    out = run("lost")
    long = ("--classifier.optimiser.epochs", "500", "--classifier.optimiser.patience", "500")

    def wait_for_epoch(epoch: int) -> None:
        log, until = out / "classifier" / "metrics.jsonl", time.monotonic() + 240
        while not log.exists() or f'"epoch": {epoch}' not in log.read_text():
            assert time.monotonic() < until, "no epoch ends"
            time.sleep(0.2)

    first, second = start("train", *slowly(out), *long)
    wait_for_epoch(1)
    second.kill()
    said = first.communicate(timeout=180)[1]  # Python's own way out waits 300 seconds
    # Where the loss comes out in a computation we say so; where it comes out in waiting for a checkpoint, JAX does.
    ours, jax_own = "another process of this run is gone", "This most likely indicates that another task died"
    assert (first.returncode, ours in said) == (75, True) or (first.returncode, jax_own in said) == (-6, True), said
    done = lines(out / "classifier")[-1]["epoch"]
    assert done >= 1

    # Both go on; told to end, they agree on a step, save and leave.
    both = start("train", *slowly(out), *long)
    wait_for_epoch(done + 1)
    both[0].send_signal(signal.SIGTERM)
    said = [ended(process, 143) for process in both]
    assert "resuming after epoch" in said[0]
    assert all("was asked to end after step" in text for text in said)
    assert len({text.split("after step ")[1].split()[0] for text in said}) == 1
