"""The command line as tests call it: as a program, or in this process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mevs_jax.cli import main as cli

MEVS = [sys.executable, "-m", "mevs_jax"]


def one_after_another(*commands: tuple[str | Path, ...], **environment: str) -> subprocess.CompletedProcess:
    """Commands in one process of their own, whose environment is another."""
    calls = [["mevs_jax", *map(str, command)] for command in commands]
    script = f"import sys\nfrom mevs_jax.cli.main import main\nfor sys.argv in {calls!r}: main()"
    environment = os.environ | environment
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600, env=environment)


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


def ended(result: subprocess.CompletedProcess) -> str:
    """What a command that did not fail says."""
    assert result.returncode == 0, result.stderr
    return result.stdout


def refused(result: subprocess.CompletedProcess, code: int = 2) -> str:
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    message = [line for line in result.stderr.splitlines() if line.startswith("mevs: ")]
    assert len(message) == 1
    assert result.stderr.strip().splitlines()[-1] == message[0]
    return message[0]
