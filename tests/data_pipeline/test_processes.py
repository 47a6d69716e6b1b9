"""Work is shared by processes in order; one that dies ends the job with the name of what it worked on."""

from __future__ import annotations

import errno
import multiprocessing.spawn
import os
import signal
import threading
import time
from contextlib import suppress

import pytest

from data_pipeline import processes
from data_pipeline.errors import DataError
from data_pipeline.processes import shared


def times(job: int, factor: int) -> int:
    return factor * job


def dies_at_five(job: int, factor: int) -> int:
    if job == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return job


def sleeps_long(job: int, seconds: int) -> int:
    if job:
        time.sleep(seconds)
    return job


def name_of(job: int) -> str:
    return f"object {job}"


def results(work, jobs, **options) -> list[int]:
    with shared(work, jobs, workers=2, given=(3,), name_of=name_of, **options) as found:
        return list(found)


@pytest.mark.parametrize("threads", [False, True])
def test_results_are_in_order_and_nothing_is_left_in_the_folder_for_temporary_files(threads, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert results(times, range(11), threads=threads) == [3 * job for job in range(11)]
    assert list(tmp_path.iterdir()) == []


def test_a_killed_process_is_named(tmp_path):
    with pytest.raises(
        DataError, match=r"killed by signal 9, most likely for lack of memory, while it worked on object 5;"
    ):
        results(dies_at_five, range(20), chunk=2)


@pytest.mark.parametrize("size", [1, 10_000_000])
def test_a_process_that_dies_while_it_starts_ends_the_job(size, monkeypatch, tmp_path):
    """A process that dies before it reads its arguments, which may be larger than a pipe, blocked the job for ever."""
    dies = tmp_path / "python"
    dies.write_text("#!/bin/sh\nkill -9 $$\n")
    dies.chmod(0o755)
    monkeypatch.setattr(multiprocessing.spawn, "_python_exe", os.fsencode(dies))
    with (
        pytest.raises(DataError, match=r"a worker process was .* while it worked on nothing yet"),
        shared(times, range(20), workers=2, given=(bytes(size),), name_of=name_of) as found,
    ):
        list(found)


@pytest.mark.parametrize("victim", [0, 1])
def test_a_process_that_is_killed_when_all_is_done_does_not_block_the_job(victim):
    """One of two processes without work holds the lock of the queue; the other waited for it for ever."""

    def kill() -> None:
        time.sleep(1)
        for at, worker in enumerate(workers):
            with suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGKILL if at == victim else signal.SIGCONT)

    with shared(times, range(20), workers=2, given=(3,), name_of=name_of) as found:
        assert len(list(found)) == 20
        workers: list = multiprocessing.active_children()
        for worker in workers:
            os.kill(worker.pid, signal.SIGSTOP)
        killer = threading.Thread(target=kill)
        killer.start()
    killer.join()
    assert not any(worker.is_alive() for worker in workers)


def test_an_interrupt_ends_the_workers_at_once():
    def interrupted() -> None:
        with shared(sleeps_long, range(8), workers=2, given=(600,), name_of=name_of, chunk=1) as found:
            assert next(found) == 0
            raise KeyboardInterrupt

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - begun < 60


def test_one_process_works_where_no_semaphore_can_be_made(monkeypatch, capsys):
    def refused(*args, **kwargs):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(processes, "ProcessPoolExecutor", refused)
    assert results(times, range(4)) == [0, 3, 6, 9]
    assert "one process does the work" in capsys.readouterr().err


def test_a_process_that_dies_before_python_writes_to_it_is_named(monkeypatch):
    """Python 3.14 closes its own end of the pipe first, so that writing fails."""

    def start(self: multiprocessing.process.BaseProcess) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(multiprocessing.get_context("spawn").Process, "start", start)
    with (
        pytest.raises(DataError, match=r"a worker process was .* while it worked on nothing yet"),
        shared(times, range(20), workers=2, given=(3,), name_of=name_of) as found,
    ):
        list(found)
