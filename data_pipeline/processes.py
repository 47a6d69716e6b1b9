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
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any, TypeVar

from data_pipeline.errors import DataError
from data_pipeline.progress import console

Job = TypeVar("Job")
Result = TypeVar("Result")

_note: FileIO | None = None
"""In a worker process, the file that names what it works on."""


def usable_cpus() -> int:
    """Returns the number of CPUs that this process may use, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


_GIVEN = "given"
"""File of the folder of notes that holds what a worker process is started with.

Python writes the arguments of a new process into a pipe before the process reads them. More than the pipe holds (64 KB on Linux)
would block this process for ever if the new one dies first.
"""


def _begin(notes: Path) -> None:
    """Starts a worker process."""
    global _note
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()  # a parent that is killed cannot
    _note = FileIO(notes / str(os.getpid()), "w")
    start, given = pickle.loads((notes / _GIVEN).read_bytes())
    start(*given)


def _noted(work: Callable[[Job], Result], name_of: Callable[[Job], str], job: Job) -> Result:
    if _note is not None:
        _note.seek(0)
        _note.truncate()
        _note.write(name_of(job).encode("utf-8", "replace"))
    return work(job)


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


@contextmanager
def shared(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    workers: int,
    start: Callable[..., None],
    given: tuple,
    name_of: Callable[[Job], str],
    threads: bool = False,
    chunk: int = 4,
) -> Iterator[Iterator[Result]]:
    """Yields an iterator over the results of `work` for all jobs, in order.

    Where processes cannot be started, because semaphores cannot be made in `/dev/shm` or the folder for temporary files is full,
    this process does the work.

    Args:
        workers: number of processes or threads.
        start: called first in each of them, with the arguments `given`.
        name_of: returns the name of a job, for the message if its process dies.
        threads: whether to use threads.
        chunk: number of jobs that a process is given at a time.

    Raises:
        DataError: if a process dies.
    """
    with tempfile.TemporaryDirectory(prefix="mevs-", ignore_cleanup_errors=True) as folder:
        notes, children = Path(folder), list[Any]()
        pool: Executor | None = None
        try:
            if threads:
                pool = ThreadPoolExecutor(workers, initializer=start, initargs=given)
            else:
                spawn = multiprocessing.get_context("spawn")
                (notes / _GIVEN).write_bytes(pickle.dumps((start, given)))
                pool = ProcessPoolExecutor(workers, spawn, _begin, (notes,))
        except OSError as error:
            where = f"are /dev/shm and {folder} writable?"
            console.print(
                f"Worker processes cannot be started ({error.strerror}; {where}), so one process does the work",
                markup=False,
            )
        if pool is None:
            start(*given)
            yield map(work, jobs)
            return
        before = set(multiprocessing.active_children())

        def begun() -> list[Any]:
            return [child for child in multiprocessing.active_children() if child not in before]

        try:
            try:
                results = pool.map(partial(_noted, work, name_of), jobs, chunksize=chunk)
            except BrokenPipeError as error:  # a process died before Python had given it its work
                raise _death(begun(), notes) from error
            children = begun()
            yield results
        except BaseException as error:
            if isinstance(error, Exception) and _is_broken(pool):
                raise _death(children, notes) from error
            raise
        finally:
            # Idle processes are ended, too: if one were killed now, others would wait for ever for a lock that it held.
            running = begun()
            for child in running:
                child.terminate()
            pool.shutdown(wait=bool(children or running), cancel_futures=True)
