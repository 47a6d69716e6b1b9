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


def start(*arguments: str, processes: int = 2) -> list[subprocess.Popen]:
    """A command of `mevs` in several processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    others = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port}", "JAX_NUM_PROCESSES": str(processes)}
    return [
        subprocess.Popen(
            [sys.executable, "-m", "mevs_jax", *arguments, "--distributed"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | CPU | others | {"JAX_PROCESS_ID": str(number)},
        )
        for number in range(processes)
    ]
