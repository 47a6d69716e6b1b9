"""Commands in processes of their own that find each other on this machine."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CPU = {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
"""Environment of processes of their own."""


def of_processes(processes: int) -> list[dict[str, str]]:
    """The environment of each of several processes that find each other by a free port; that of one alone is without."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    others = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port}", "JAX_NUM_PROCESSES": str(processes)}
    given = others if processes > 1 else {}
    return [os.environ | CPU | given | {"JAX_PROCESS_ID": str(number)} for number in range(processes)]


def start(*arguments: str, processes: int = 2) -> list[subprocess.Popen]:
    """A command of `mevs` in several processes."""
    command = [sys.executable, "-m", "mevs_jax", *arguments, "--distributed"]
    return [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=own)
        for own in of_processes(processes)
    ]
