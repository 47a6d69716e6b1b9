"""Captures of many objects: several processes at a time, each object into a file of its own, so that a stopped job goes on."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

from data_pipeline.capture import Capture, CaptureConfig, Rig, capture, rig_for, save_capture
from data_pipeline.files import write_text
from data_pipeline.meshes import DamagedMesh, EmptyMesh, Mesh, ObjectEntry, load_object
from data_pipeline.progress import progress_bar
from data_pipeline.visualizer import capture_with_visualizer


def capture_path(folder: Path, entry: ObjectEntry) -> Path:
    return folder / (entry.name.replace("/", "__") + ".npz")


def _left_out_path(folder: Path, entry: ObjectEntry) -> Path:
    return capture_path(folder, entry).with_suffix(".left_out")


_rig: Rig | None = None
_folder: Path | None = None
_backend = "raycast"
_BACKENDS: dict[str, Callable[[Mesh, Rig], Capture]] = {"raycast": capture, "visualizer": capture_with_visualizer}


def _start_worker(rig: Rig, folder: Path, backend: str) -> None:
    global _rig, _folder, _backend
    _rig, _folder, _backend = rig, folder, backend
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers Ctrl-C and ends its workers


def _capture_entry(entry: ObjectEntry) -> str | None:
    """Captures one object into the folder; returns what is wrong with a damaged one."""
    assert _rig is not None
    assert _folder is not None
    try:
        save_capture(capture_path(_folder, entry), _BACKENDS[_backend](load_object(entry), _rig))
    except EmptyMesh as reason:
        write_text(_left_out_path(_folder, entry), str(reason))
    except DamagedMesh as reason:
        return str(reason)
    return None


def capture_all(
    entries: Sequence[ObjectEntry],
    config: CaptureConfig,
    folder: Path,
    *,
    skip_damaged: bool = False,
    workers: int | None = None,
) -> dict[str, str]:
    """Captures every object into `folder`, several at a time, and returns the objects left out with the reason.

    Objects whose capture is there already are not captured again, so an interrupted run goes on where it stopped.

    Raises:
        DamagedMesh: at the first damaged mesh, unless `skip_damaged`, which leaves them out like empty ones.
    """
    folder.mkdir(parents=True, exist_ok=True)
    there = {path.name for path in folder.iterdir()}
    todo = [
        entry
        for entry in entries
        if capture_path(folder, entry).name not in there and _left_out_path(folder, entry).name not in there
    ]
    if todo:
        workers = workers or os.cpu_count() or 1
        context = multiprocessing.get_context("spawn")
        with (
            progress_bar("objects") as bar,
            context.Pool(min(workers, len(todo)), _start_worker, (rig_for(config), folder, config.backend)) as pool,
        ):
            task = bar.add_task("Capturing", total=len(entries), completed=len(entries) - len(todo), note="")
            for entry, damage in zip(todo, pool.imap(_capture_entry, todo, chunksize=4), strict=True):
                if damage and not skip_damaged:
                    raise DamagedMesh(f"{damage}, or leave such objects out with --dataset.skip-damaged")
                if damage:
                    write_text(_left_out_path(folder, entry), damage)
                bar.advance(task)
    return {
        entry.name: _left_out_path(folder, entry).read_text()
        for entry in entries
        if _left_out_path(folder, entry).exists()
    }
