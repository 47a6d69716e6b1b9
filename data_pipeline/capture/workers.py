"""Capture of many objects by several processes. Each object has its own file, so an interrupted job can be resumed.

Worker processes import this module, so neither it nor the modules it imports may import JAX, which would slow their start.
"""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from data_pipeline.capture.casting import Capture, Rig, capture, rig_for, save_capture
from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.capture.visualizer import capture_with_visualizer
from data_pipeline.errors import DamagedMesh, EmptyMesh
from data_pipeline.files import npz_of, write_text
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.recipes import identity_of
from data_pipeline.objects.sources import load_object
from data_pipeline.processes import shared, usable_cpus
from data_pipeline.progress import progress_bar


def capture_path(folder: Path, entry: ObjectEntry) -> Path:
    """Returns the path of an object's capture, in one of 256 folders in `folder`. It depends on the content of the object's file.

    So a capture of a file that has changed since is not found, and the file is captured again.
    """
    stamp = identity_of(entry.recipe)
    state = f".{hashlib.sha256(stamp.encode()).hexdigest()[:12]}" if stamp else ""
    place = hashlib.sha256(entry.name.encode("utf-8", "surrogateescape")).hexdigest()[:2]
    return npz_of(folder / place, entry.name + state)


def _left_out_path(folder: Path, entry: ObjectEntry) -> Path:
    """Returns the path of the file that says why an object was left out."""
    return capture_path(folder, entry).with_suffix(".left_out")


def _rasterise(mesh: Mesh, rig: Rig) -> Capture:
    from data_pipeline.capture.rasterise import capture_by_rasterising  # imports JAX

    return capture_by_rasterising(mesh, rig)


_BACKENDS: dict[str, Callable[[Mesh, Rig], Capture]] = {
    "raycast": capture,
    "rasterise": _rasterise,
    "visualizer": capture_with_visualizer,
}


def capture_entry(entry: ObjectEntry, rig: Rig, folder: Path, backend: str, skip_damaged: bool) -> str | None:
    """Captures one object into `folder`, or records there why it is left out.

    Returns:
        None, or the damage of a mesh if it is damaged and `skip_damaged` is off.
    """
    try:
        seen = _BACKENDS[backend](load_object(entry), rig.around(entry.name))
        if not seen.depth.any():
            pixels = f"{seen.depth.shape[1]}×{seen.depth.shape[2]}"
            raise EmptyMesh(f"no view shows it: it is thinner than the pixels of {pixels} views")
        save_capture(capture_path(folder, entry), seen)
    except (EmptyMesh, DamagedMesh) as reason:
        if isinstance(reason, DamagedMesh) and not skip_damaged:
            return str(reason)
        write_text(_left_out_path(folder, entry), str(reason))
    return None


def still_to_capture(entries: Sequence[ObjectEntry], folder: Path) -> list[ObjectEntry]:
    """Returns the objects that are neither captured nor left out yet."""

    def is_done(path: Path) -> bool:
        return any(one.is_file() and one.stat().st_size for one in (path, path.with_suffix(".left_out")))

    return [entry for entry in entries if not is_done(capture_path(folder, entry))]


def left_out_of(entries: Sequence[ObjectEntry], folder: Path) -> dict[str, str]:
    """Returns the names of the objects left out, with the reasons."""
    paths = {entry.name: _left_out_path(folder, entry) for entry in entries}
    reasons = {name: path.read_text(errors="replace") for name, path in paths.items() if path.exists()}
    return {name: reason for name, reason in reasons.items() if reason}  # an empty file is a damaged one


_FEW_OBJECTS = 64
"""Up to this many objects are captured without worker processes. A worker needs about five seconds to start, in which this
process captures one or two hundred small meshes."""


def say_damaged(damage: str) -> DamagedMesh:
    """Returns the error about a damaged object, with the option that leaves such objects out."""
    return DamagedMesh(f"{damage}, or leave such objects out with --dataset.skip-damaged")


def capture_all(
    entries: Sequence[ObjectEntry],
    config: CaptureConfig,
    folder: Path,
    *,
    skip_damaged: bool = False,
    workers: int | None = None,
) -> dict[str, str]:
    """Captures every object into `folder` and returns the names of the objects left out, with the reasons.

    Objects that already have a capture are skipped, so an interrupted run resumes where it stopped.

    Args:
        skip_damaged: leave damaged meshes out, like empty ones.
        workers: number of processes (threads for the backend `rasterise`). By default one for each usable CPU, or one for a
            few objects. One worker that casts rays is this process itself.

    Raises:
        DamagedMesh: at the first damaged mesh, unless `skip_damaged`.
        DataError: if a process dies, for example for lack of memory.
    """
    todo = still_to_capture(entries, folder)
    if todo:
        workers = workers or (1 if len(todo) <= _FEW_OBJECTS else usable_cpus())
        workers, given = min(workers, len(todo)), (rig_for(config), folder, config.backend, skip_damaged)
        captured: AbstractContextManager[Iterator[str | None]]
        if workers == 1 and config.backend == "raycast":
            captured = nullcontext(capture_entry(entry, *given) for entry in todo)
        else:
            # Rasterisation is one program on one device; its threads read meshes and write captures.
            threads, name_of = config.backend == "rasterise", operator.attrgetter("name")
            captured = shared(capture_entry, todo, given=given, workers=workers, name_of=name_of, threads=threads)
        with progress_bar("objects") as bar, captured as damages:
            task = bar.add_task("Capturing", total=len(entries), completed=len(entries) - len(todo), note="")
            for damage in damages:
                if damage:
                    raise say_damaged(damage)
                bar.advance(task)
    return left_out_of(entries, folder)
