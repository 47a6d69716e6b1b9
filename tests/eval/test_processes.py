"""Several processes evaluate a run as one does."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.train.test_scaling import CPU
from train.devices import from_all, own_share, unresolved_name


def start(out: Path, processes: int = 2) -> list[subprocess.Popen]:
    """`mevs eval` in several processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    others = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port}", "JAX_NUM_PROCESSES": str(processes)}
    return [
        subprocess.Popen(
            [sys.executable, "-m", "mevs_jax", "eval", "--out", str(out), "--distributed"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | CPU | others | {"JAX_PROCESS_ID": str(number)},
        )
        for number in range(processes)
    ]


def finished(processes: list[subprocess.Popen]) -> list[tuple[str, str]]:
    said = [process.communicate(timeout=400) for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), said
    return said


@pytest.mark.slow
def test_two_processes_evaluate_as_one_does(whole, tmp_path):
    """Also once a process was killed, and when all is there already."""
    if name := unresolved_name():
        pytest.skip(f"processes on CPUs cannot reach each other: the name of this machine, {name}, has no address")
    out = tmp_path / "run"
    shutil.copytree(whole, out, symlinks=True)
    for made in ("metrics.json", "metrics.csv"):
        (out / made).unlink()
    shutil.rmtree(out / "tables")
    processes = start(out)
    until = time.monotonic() + 240
    while not (out / "tables").exists() and time.monotonic() < until:
        time.sleep(0.05)
    processes[1].send_signal(signal.SIGKILL)
    processes[0].communicate(timeout=120)
    assert processes[0].returncode in (0, 75, -6)
    (first, _), (second, told) = finished(start(out))
    assert "test objects right" in first
    assert "test objects" not in second  # one speaks for all
    assert "Walking" not in told
    for made in ("metrics.json", "metrics.csv"):
        assert (out / made).read_bytes() == (whole / made).read_bytes(), made
    with np.load(out / "tables" / "test.npz") as mine, np.load(whole / "tables" / "test.npz") as theirs:
        for key in theirs:
            np.testing.assert_array_equal(mine[key], theirs[key])
    times = [path.stat().st_mtime_ns for path in sorted(out.rglob("*.json"))]
    finished(start(out))
    assert [path.stat().st_mtime_ns for path in sorted(out.rglob("*.json"))] == times


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
