"""A study of Optuna by two processes, of which one is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.reference.processes import CPU
from train.results.identity import summary_of

optuna = pytest.importorskip("optuna")

GIVEN = ("sweep", "--preset", "tiny", "--sweep.network", "classifier", "--sweep.members", "2", "--sweep.halving")


def start(out: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "mevs_jax", *GIVEN, "--out", str(out), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | CPU)


@pytest.mark.slow
def test_a_process_takes_over_the_trials_of_one_that_is_killed(data, tmp_path):
    (tmp_path / "data").symlink_to(data)
    study, given = tmp_path / "sweep" / "classifier_study", ("--sweep.trials", "8")
    killed = start(tmp_path, *given)
    until = time.monotonic() + 240
    while not list(study.glob("job_*/config.json")):
        assert killed.poll() is None, killed.communicate()
        assert time.monotonic() < until
        time.sleep(0.01)
    other = start(tmp_path, *given)
    while len(list(study.glob("job_*/config.json"))) < 2:  # both train
        assert time.monotonic() < until
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    said = other.communicate(timeout=500)
    assert other.returncode == 0, said
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(study / "journal.log")))
    trials = optuna.load_study(storage=storage, study_name="classifier").trials
    assert len(trials) == 8
    assert all(trial.state.is_finished() and trial.state.name != "FAIL" for trial in trials)
    least = min(
        member["best"]["loss"] for job in study.glob("job_*/members.json") for member in json.loads(job.read_text())
    )
    adopted = start(tmp_path, *given, "--adopt")  # trains nothing
    said = adopted.communicate(timeout=200)
    assert adopted.returncode == 0, said
    assert "Best of 8" in said[0]
    assert summary_of(tmp_path / "classifier")["best_loss"] == least
    assert len(list(study.glob("job_*"))) == 4
