"""Captures of many objects: several processes at a time, each object into a file of its own, so that a stopped job goes on."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.pool import ThreadPool
from pathlib import Path

from data_pipeline.capture.casting import Capture, CaptureConfig, Rig, capture, rig_for, save_capture
from data_pipeline.capture.visualizer import capture_with_visualizer
from data_pipeline.errors import DamagedMesh, EmptyMesh
from data_pipeline.files import npz_of, write_text
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.sources import load_object
from data_pipeline.progress import progress_bar


def capture_path(folder: Path, entry: ObjectEntry) -> Path:
    return npz_of(folder, entry.name)


def _left_out_path(folder: Path, entry: ObjectEntry) -> Path:
    return capture_path(folder, entry).with_suffix(".left_out")


def _rasterise(mesh: Mesh, rig: Rig) -> Capture:
    from data_pipeline.capture.rasterise import capture_by_rasterising

    return capture_by_rasterising(mesh, rig)


_BACKENDS: dict[str, Callable[[Mesh, Rig], Capture]] = {
    "raycast": capture,
    "rasterise": _rasterise,
    "visualizer": capture_with_visualizer,
}


def capture_entry(entry: ObjectEntry, rig: Rig, folder: Path, backend: str, skip_damaged: bool) -> str | None:
    """Captures one object into the folder; returns what is wrong with a damaged one, unless such are left out like empty ones."""
    try:
        save_capture(capture_path(folder, entry), _BACKENDS[backend](load_object(entry), rig.around(entry.name)))
    except (EmptyMesh, DamagedMesh) as reason:
        if isinstance(reason, DamagedMesh) and not skip_damaged:
            return str(reason)
        write_text(_left_out_path(folder, entry), str(reason))
    return None


def still_to_capture(entries: Sequence[ObjectEntry], folder: Path) -> list[ObjectEntry]:
    """Those that are neither captured nor left out yet."""
    folder.mkdir(parents=True, exist_ok=True)
    there = {path.name for path in folder.iterdir()}
    done = (capture_path, _left_out_path)
    return [entry for entry in entries if not any(path(folder, entry).name in there for path in done)]


def left_out_of(entries: Sequence[ObjectEntry], folder: Path) -> dict[str, str]:
    """The objects left out, with the reason."""
    paths = {entry.name: _left_out_path(folder, entry) for entry in entries}
    return {name: path.read_text() for name, path in paths.items() if path.exists()}


_FEW = 64
"""Objects for which no processes are started: each begins after some five seconds, in which this one captures a hundred or two
of small meshes."""
_worker: tuple[Rig, Path, str, bool] | None = None


def _start_worker(rig: Rig, folder: Path, backend: str, skip_damaged: bool) -> None:
    global _worker
    _worker = rig, folder, backend, skip_damaged
    if threading.current_thread() is threading.main_thread():  # of a process of its own
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers Ctrl-C and ends its workers


def _work(entry: ObjectEntry) -> str | None:
    assert _worker is not None
    return capture_entry(entry, *_worker)


@contextmanager
def _captured(
    todo: Sequence[ObjectEntry], workers: int, rig: Rig, folder: Path, backend: str, skip_damaged: bool
) -> Iterator[Iterator[str | None]]:
    """What `capture_entry` returns for each object, in their order."""
    given = rig, folder, backend, skip_damaged
    if workers == 1 and backend == "raycast":
        yield (capture_entry(entry, *given) for entry in todo)
        return
    # What rasterises is one program on one device; threads read meshes for it and write captures.
    make_pool = ThreadPool if backend == "rasterise" else multiprocessing.get_context("spawn").Pool
    with make_pool(workers, _start_worker, given) as pool:
        yield pool.imap(_work, todo, chunksize=4)


def say_damaged(damage: str) -> DamagedMesh:
    """The error about a damaged object, with the way around it."""
    return DamagedMesh(f"{damage}, or leave such objects out with --dataset.skip-damaged")


def capture_all(
    entries: Sequence[ObjectEntry],
    config: CaptureConfig,
    folder: Path,
    *,
    skip_damaged: bool = False,
    workers: int | None = None,
) -> dict[str, str]:
    """Captures every object into `folder`, several at a time, and returns the objects left out with the reason.

    Casting rays at a few objects takes less time than starting processes for it, and happens in this one, as with one worker.
    Objects whose capture is there already are not captured again, so an interrupted run goes on where it stopped.

    Raises:
        DamagedMesh: at the first damaged mesh, unless `skip_damaged`, which leaves them out like empty ones.
    """
    todo = still_to_capture(entries, folder)
    if todo:
        workers = workers or (1 if len(todo) <= _FEW else os.cpu_count() or 1)
        given = rig_for(config), folder, config.backend, skip_damaged
        with progress_bar("objects") as bar, _captured(todo, min(workers, len(todo)), *given) as captured:
            task = bar.add_task("Capturing", total=len(entries), completed=len(entries) - len(todo), note="")
            for damage in captured:
                if damage:
                    raise say_damaged(damage)
                bar.advance(task)
    return left_out_of(entries, folder)
