"""The lock of a run directory: only one job at a time writes into it."""

from __future__ import annotations

import errno
import json
import os
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from data_pipeline.errors import DataError

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"
"""File name of the lock in a run directory. While a job runs, it holds the job's host, process and command."""

_NO_FLOCK = (errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL)


def _flock(file: int) -> bool | None:
    """Returns whether this process holds the lock of an open file now; None where the file system has no such locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in _NO_FLOCK:
            return None
        raise
    return True


def _started(pid: int) -> str:
    """Returns when a process of this machine started, where Linux tells it, so that a number used again is noticed."""
    with suppress(OSError, IndexError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    return ""


def _is_running(job: dict[str, Any]) -> bool:
    """Returns whether the process of a job on this machine still runs."""
    try:
        os.kill(int(job["pid"]), 0)
    except ProcessLookupError:
        return False
    except (OSError, ValueError, KeyError, OverflowError):
        return True
    return str(job.get("started", "")) in ("", _started(int(job["pid"])))


def _job_in(file: int) -> dict[str, Any]:
    """Returns what an open lock says about the job that holds it; empty if that cannot be read."""
    try:
        content = json.loads(os.pread(file, 1_000_000, 0))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def job_of(out: Path) -> dict[str, Any] | None:
    """Returns what the lock of a run directory says of the job that holds it; None if there is none, or its process is gone."""
    try:
        file = os.open(out / NAME, os.O_RDONLY)
    except OSError:
        return None
    try:
        job = _job_in(file)
    finally:
        os.close(file)
    return job if job and (job.get("host") != platform.node() or _is_running(job)) else None


def _in_use(out: Path, job: dict[str, Any], sure: bool) -> DataError:
    who = f"process {job['pid']} on {job.get('host')} ({job.get('command')})" if "pid" in job else "another job"
    wait = "wait until it ends, or choose another --out"
    if sure:
        return DataError(f"{out} is in use by {who}; {wait}")
    return DataError(f"{out} may be in use by {who}; {wait}, or delete {out / NAME} if that process is gone")


def _take(out: Path, path: Path) -> int:
    """Returns the open file of the lock, now held."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            held = _flock(file)
            if held is False:
                raise _in_use(out, _job_in(file), sure=True)
            if held is None and (job := _job_in(file)):
                here = job.get("host") == platform.node()
                if not here or _is_running(job):
                    raise _in_use(out, job, sure=here)
            with suppress(FileNotFoundError):
                if os.fstat(file).st_ino == path.stat().st_ino:
                    return file
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # another job removed it in between


@contextmanager
def locked(out: Path, command: str, hosts: Sequence[str] = ()) -> Iterator[None]:
    """Holds the lock of the run directory `out`. A lock whose process is gone is taken over.

    Where the file system has no locks, the file's content decides; the process is then looked for, if it is of this machine.

    Args:
        command: what this job is, for the message to another one.
        hosts: machines of all its processes, if they are several.

    Raises:
        DataError: if another job holds the lock; the message names its host, process and command.
    """
    path = out / NAME
    file = _take(out, path)
    try:
        job = {
            "host": platform.node(),
            "pid": os.getpid(),
            "started": _started(os.getpid()),
            "command": command,
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
            "hosts": list(hosts),
        }
        os.ftruncate(file, 0)
        os.pwrite(file, json.dumps(job).encode(), 0)
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(file)
