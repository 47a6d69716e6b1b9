"""The command line as tests call it: as a program, or in this process."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mevs_jax.cli import main as cli

MEVS = [sys.executable, "-m", "mevs_jax"]


def mevs(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess:
    return subprocess.run([*MEVS, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, timeout=600)


@pytest.fixture
def at_once(monkeypatch, capfd):
    """`mevs` in this process, which imports nothing anew."""

    def run(*arguments: str | Path) -> subprocess.CompletedProcess:
        handlers = {sign: signal.getsignal(sign) for sign in (signal.SIGINT, signal.SIGALRM)}
        monkeypatch.setattr(sys, "argv", ["test", *map(str, arguments)])  # not `mevs`, which would begin again
        capfd.readouterr()
        code: object = 0
        try:
            cli.main()
        except SystemExit as ended:
            code = ended.code
        finally:
            for sign, handler in handlers.items():
                signal.signal(sign, handler)
        return subprocess.CompletedProcess([], code or 0, *capfd.readouterr())

    return run


@pytest.fixture
def refuses(at_once):
    """The sentence with which it refuses something."""
    return lambda *arguments: refused(at_once(*arguments))


def refused(result: subprocess.CompletedProcess, code: int = 2) -> str:
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    message = [line for line in result.stderr.splitlines() if line.startswith("mevs: ")]
    assert len(message) == 1
    assert result.stderr.strip().splitlines()[-1] == message[0]
    return message[0]
