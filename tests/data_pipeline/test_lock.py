"""One job at a time writes into a run directory; a lock whose process is gone is taken over."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from data_pipeline import lock
from data_pipeline.errors import DataError
from data_pipeline.lock import NAME, locked

HOLD = """
import sys
from pathlib import Path
from data_pipeline.lock import locked
with locked(Path(sys.argv[1]), "mevs run"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock."""
    root = Path(__file__).resolve().parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(root)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def take(out: Path) -> None:
    with locked(out, "mevs data"):
        assert json.loads((out / NAME).read_text())["pid"] == os.getpid()
    assert not (out / NAME).exists()


@pytest.mark.parametrize("flock", [True, False])
def test_a_second_job_is_told_by_whom_and_takes_over_when_it_is_gone(flock, tmp_path, holder, monkeypatch):
    if not flock:
        monkeypatch.setattr(lock, "_flock", lambda file: None)
    said = rf"in use by process {holder.pid} on {platform.node()} \(mevs run\); wait until it ends, or choose another --out"
    with pytest.raises(DataError, match=said):
        take(tmp_path)
    holder.kill()
    holder.wait()
    assert (tmp_path / NAME).exists()
    take(tmp_path)
    take(tmp_path)


def test_a_lock_of_another_machine(tmp_path, monkeypatch):
    (tmp_path / NAME).write_text(json.dumps({"host": "elsewhere", "pid": 1, "command": "mevs run"}))
    monkeypatch.setattr(lock, "_flock", lambda file: None)
    with pytest.raises(
        DataError, match=r"may be in use by process 1 on elsewhere.*or delete .*\.lock if that process is"
    ):
        take(tmp_path)
    monkeypatch.undo()
    take(tmp_path)  # it is not held


@pytest.mark.parametrize("content", ["", "{", "[]", '{"pid": "many"}'])
def test_a_damaged_lock_that_is_not_held_is_taken_over(content, tmp_path):
    (tmp_path / NAME).write_text(content)
    take(tmp_path)


def test_the_number_of_a_process_that_is_used_again_is_another_process(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "_flock", lambda file: None)
    job = {"host": platform.node(), "pid": os.getpid(), "started": "1"}
    (tmp_path / NAME).write_text(json.dumps(job))
    if Path("/proc/self/stat").exists():
        take(tmp_path)


def test_a_failed_job_leaves_no_lock(tmp_path):
    def fails() -> None:
        with locked(tmp_path, "mevs data"):
            raise DataError("no")

    with pytest.raises(DataError):
        fails()
    assert list(tmp_path.iterdir()) == []
