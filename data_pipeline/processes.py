"""Work shared by several processes or threads, in order. A process that dies ends the job with the name of what it worked on.

Worker processes import this module, so it may not import JAX.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any, TypeVar

from data_pipeline.errors import DataError
from data_pipeline.progress import console

Job = TypeVar("Job")
Result = TypeVar("Result")


def usable_cpus() -> int:
    """Returns the number of CPUs that this process may use, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def end_with_parent() -> None:
    """Lets a thread end this process once the one that started it is gone; a parent that is killed cannot."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


_TASK = "task"
"""File of the folder of notes that holds what worker processes do: the work, what it is given, and how jobs are named.

Python writes the arguments of a new process into a pipe before the process reads them. More than the pipe holds (64 KB on Linux)
would block this process for ever if the new one dies first.
"""

_task: tuple[Callable[..., Any], tuple, Callable[[Any], str], FileIO]
"""The same in a worker process, and the file that names what it works on."""


def _begin(notes: Path) -> None:
    """Starts a worker process."""
    global _task
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends its workers
    end_with_parent()
    note = FileIO(notes / str(os.getpid()), "w")
    _task = *pickle.loads((notes / _TASK).read_bytes()), note


def _noted(job: Any) -> Any:
    work, given, name_of, note = _task
    note.seek(0)
    note.truncate()
    note.write(name_of(job).encode("utf-8", "replace"))
    return work(job, *given)


def _death(children: Sequence[Any], notes: Path) -> DataError:
    """Returns the error about worker processes of which one died."""
    # `join` also returns when the executor's thread has just waited for a child, whose exit code is not noted yet.
    deadline = time.monotonic() + 5
    for child in children:
        while child.exitcode is None and time.monotonic() < deadline:
            child.join(0.1)
            time.sleep(0.001)
    dead = [child for child in children if child.exitcode not in (None, 0, -signal.SIGTERM)]
    on = [(notes / str(child.pid)).read_text() for child in dead or children if (notes / str(child.pid)).exists()]
    how = "ended"
    if dead and dead[0].exitcode < 0:
        how = f"killed by signal {-dead[0].exitcode}"
    elif dead:
        how = f"ended with code {dead[0].exitcode}"
    if dead and dead[0].exitcode == -signal.SIGKILL:
        how += ", most likely for lack of memory,"
    return DataError(
        f"a worker process was {how} while it worked on {', '.join(filter(None, on)) or 'nothing yet'}; what is done is kept: "
        f"repeat the command with more memory, on fewer CPUs (taskset -c 0 mevs ...), or leave that object out"
    )


def _is_broken(pool: Executor) -> bool:
    """Returns whether a process of the pool died. While others are started, this also raises errors about closed handles."""
    try:
        pool.submit(int)
    except (BrokenProcessPool, BrokenPipeError):
        return True
    except RuntimeError:  # it is shut down
        return False
    return False


def _pool(workers: int, notes: Path, task: tuple) -> Executor | None:
    """Returns a pool of processes, or None, with a message, where they cannot be started.

    Semaphores cannot be made in `/dev/shm`, or the folder for temporary files is full.
    """
    try:
        (notes / _TASK).write_bytes(pickle.dumps(task))
        return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin, (notes,))
    except OSError as error:
        reason = f"{error.strerror}; are /dev/shm and {notes} writable?"
        console.print(f"Worker processes cannot be started ({reason}), so one process does the work", markup=False)
        return None


@contextmanager
def shared(
    work: Callable[..., Result],
    jobs: Sequence[Job],
    *,
    given: tuple,
    workers: int,
    name_of: Callable[[Job], str],
    threads: bool = False,
    chunk: int = 4,
) -> Iterator[Iterator[Result]]:
    """Yields an iterator over the results of `work(job, *given)` for all jobs, in order.

    Where processes cannot be started, this process does the work.

    Args:
        workers: number of processes or threads.
        name_of: returns the name of a job, for the message if its process dies.
        threads: whether to use threads.
        chunk: number of jobs that a process is given at a time.

    Raises:
        DataError: if a process dies.
    """

    def do(job: Job) -> Result:
        return work(job, *given)

    if threads:
        some = ThreadPoolExecutor(workers)
        try:
            yield some.map(do, jobs)
        finally:
            some.shutdown(wait=False, cancel_futures=True)
        return
    with tempfile.TemporaryDirectory(prefix="mevs-", ignore_cleanup_errors=True) as folder:
        pool = _pool(workers, Path(folder), (work, given, name_of))
        if pool is None:
            yield map(do, jobs)
            return
        with _mapped(pool, jobs, Path(folder), chunk) as results:
            yield results


@contextmanager
def _mapped(pool: Executor, jobs: Sequence[Any], notes: Path, chunk: int) -> Iterator[Iterator[Any]]:
    """Yields an iterator over the results of a pool of processes, which end afterwards."""
    before = set(multiprocessing.active_children())

    def begun() -> list[Any]:
        return [child for child in multiprocessing.active_children() if child not in before]

    children: list[Any] = []
    try:
        try:
            results = pool.map(_noted, jobs, chunksize=chunk)
        except BrokenPipeError as error:  # a process died before Python had given it its work
            raise _death(begun(), notes) from error
        children = begun()
        yield results
    except Exception as error:
        if _is_broken(pool):
            raise _death(children, notes) from error
        raise
    finally:
        # Idle processes are ended, too: if one were killed now, others would wait for ever for a lock that it held.
        running = begun()
        for child in running:
            child.terminate()
        pool.shutdown(wait=bool(children or running), cancel_futures=True)
