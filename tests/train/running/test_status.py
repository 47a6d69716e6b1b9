"""`mevs status`: the job of a run, how far it is, and what it saved."""

from __future__ import annotations

import json
import os
import time

import pytest

from data_pipeline import progress
from data_pipeline.lock import NAME, locked
from data_pipeline.progress import COMPILING, STATUS, line_of, progress_bar, watched
from mevs_jax.cli.failure import Unusable
from mevs_jax.cli.parsing import tool_options
from mevs_jax.cli.stages import status
from train.running.status import status_of


def test_a_run_is_watched_while_it_works(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_STATES", 0.01)
    trained = tmp_path / "learned" / "seed_0" / "recogniser"
    (trained / "latest" / "1200").mkdir(parents=True)
    log = {"step": 1000, "epoch": 2, "train/loss": 0.5, "val/loss": 0.25}
    (trained / "metrics.jsonl").write_text(json.dumps(log) + "\nhalf a li")
    with locked(tmp_path, "mevs train"), watched(tmp_path), progress_bar("views") as bar:
        line = bar.add_task("Training classifier", total=400, note=COMPILING)
        assert line_of(bar.tasks[0], "views") == "Training classifier: compiling …"
        bar.advance(line, 100)
        assert line_of(bar.tasks[0], "views").startswith("Training classifier: 100 of 400 views (25 %)")
        bar.update(line, note="val loss 0.6")
        until = time.monotonic() + 20
        while not (tmp_path / STATUS).exists() or len(found := list(status_of(tmp_path))) < 3:
            assert time.monotonic() < until
            time.sleep(0.01)
    job, work, network = found
    assert job.startswith(f"mevs train: process {os.getpid()} on ")
    assert work.startswith("Training classifier: 100 of 400 views (25 %)")
    assert "val loss 0.6 (0:00:0" in work
    assert network.startswith(
        "learned/seed_0/recogniser: epoch 2, step 1,000, train/loss 0.5000, val/loss 0.2500; check"
    )
    assert "; checkpoint after step 1,200, 0:00:0" in network
    assert not (tmp_path / STATUS).exists()  # nothing is left where a job has ended
    assert list(status_of(tmp_path)) == ["no job is running", network]


def test_all_machines_of_a_job_are_named(tmp_path):
    job = tmp_path / "sweep" / "entropy_study" / "job_0004"
    job.mkdir(parents=True)
    with locked(tmp_path, "mevs train", ["a", "a", "b"]), locked(job, "a job of a study"):
        _, hosts, study = status_of(tmp_path)
    assert hosts == "3 processes on 2 hosts: a (2), b (1)"
    assert study.startswith(f"sweep/entropy_study/job_0004: process {os.getpid()} on ")


def test_a_job_that_was_killed_does_not_run(tmp_path, monkeypatch):
    with locked(tmp_path, "mevs train"):
        left = (tmp_path / NAME).read_text()
    (tmp_path / NAME).write_text(json.dumps(json.loads(left) | {"pid": 2**22 + 1}))
    assert list(status_of(tmp_path)) == ["no job is running"]
    (tmp_path / NAME).write_text(json.dumps(json.loads(left) | {"host": "another", "pid": 2**22 + 1}))
    assert next(status_of(tmp_path)).startswith("mevs train: process 4194305 on another, since ")


def test_a_run_that_is_not_there(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    status(tool_options("status", [str(tmp_path / "run")]))
    assert capsys.readouterr().out == "no job is running\n"
    with pytest.raises(Unusable, match=r"there is no run in .*none; give the folder that --out names"):
        status(tool_options("status", [str(tmp_path / "none")]))
