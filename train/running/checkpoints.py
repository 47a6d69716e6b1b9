"""Checkpoints of a training run: its latest state, its best state, and its progress. Orbax writes them.

A save appears completely under its step, or not at all; older saves are removed afterwards. Training continues during writing.
Checks of its files are added once it is complete (`data_pipeline.files`), since Orbax restores weights with flipped bits.
"""

from __future__ import annotations

import logging
import shutil
import sys
from copy import deepcopy
from pathlib import Path
from types import TracebackType
from typing import Any

import jax

from data_pipeline.distributed import is_first, is_lost_process, wait_for_all
from data_pipeline.errors import DataError, Unreadable, reason_of
from data_pipeline.files import check_of_file, damage_in, files_in, keep_checks
from data_pipeline.progress import console
from train.running.preemption import interrupts_held

for _name in ("absl", "asyncio"):  # Orbax logs every step, and the errors of its threads, which it raises as well
    logging.getLogger(_name).setLevel(logging.CRITICAL)
_say_unraisable = sys.unraisablehook


def _say(lost: sys.UnraisableHookArgs) -> None:
    """Prints what Python cannot raise, but not that threads of TensorStore answer a save that has failed, which is said once."""
    if not (lost.exc_type is RuntimeError and str(lost.exc_value) == "Event loop is closed"):
        _say_unraisable(lost)


sys.unraisablehook = _say


def _placed(leaf: Any) -> Any:
    """Returns a shape without a sharding as one on a device of this process; anything else unchanged."""
    if isinstance(leaf, jax.ShapeDtypeStruct) and leaf.sharding is None:
        here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=here)
    return leaf


def steps_saved(slot: Path) -> list[Path] | None:
    """Returns the saves in the folder of a slot, none if it does not exist; None if it is no folder."""
    if not slot.exists():
        return []
    return [path for path in slot.iterdir() if path.name.isdigit()] if slot.is_dir() else None


def has_save(slot: Path) -> bool:
    """Returns whether the folder of a slot holds a save."""
    return bool(steps_saved(slot))


def damage_of(slot: Path) -> str | None:
    """Returns what is damaged in the save that the folder of a slot holds; None if it is sound by its checks or has none."""
    if not slot.is_dir():
        return f"{slot} is no folder" if slot.exists() else f"{slot} is missing"
    found = [damage_in(step) if step.is_dir() else f"{step} is no folder" for step in steps_saved(slot) or ()]
    return next((damage for damage in found if damage), None) if found else f"{slot} is empty"


def drop_damaged(folder: Path, consequence: str = "so training goes on from what is sound") -> None:
    """Removes the damaged saves of a training, with a sentence.

    Raises:
        DataError: instead of removing, in a training of several processes.
    """
    for name in ("latest", "best"):
        slot = folder / name
        if steps_saved(slot) != [] and (damage := damage_of(slot)) is not None:
            _remove(slot, damage, consequence)


def _remove(slot: Path, damage: str, consequence: str) -> None:
    if jax.process_count() > 1:
        raise DataError(f"{damage}; delete {slot}, and the same command goes on from what is sound")
    console.print(f"{damage}, {consequence}", markup=False)
    if slot.is_dir():
        shutil.rmtree(slot)
    else:
        slot.unlink()


class Checkpoints:
    """Two slots, `latest` and `best`, each holding one state (a tree of arrays) and its progress (plain numbers)."""

    def __init__(self, folder: Path):
        import orbax.checkpoint as ocp  # imported late: it takes a tenth of a second

        self._folder, self._unchecked, self._ocp = folder, set[str](), ocp
        options = ocp.CheckpointManagerOptions(
            max_to_keep=1, create=True, enable_async_checkpointing=True, cleanup_tmp_directories=True
        )
        self._slots = {
            name: ocp.CheckpointManager((folder / name).absolute(), options=options) for name in ("latest", "best")
        }

    @interrupts_held()
    def save(self, slot: str, step: int, state: Any, progress: dict[str, Any]) -> None:
        """Starts to save into a slot; does nothing if the slot already holds this step."""
        manager, args = self._slots[slot], self._ocp.args
        if manager.latest_step() == step:
            return
        self._finish()  # `best` must be complete before a `latest` that refers to it
        saved = args.Composite(state=args.StandardSave(state), progress=args.JsonSave(deepcopy(progress)))
        manager.save(step, args=saved)
        self._unchecked.add(slot)

    def _finish(self) -> None:
        """Waits for saves that are being written, and keeps checks of their files."""
        for name, manager in self._slots.items():
            manager.wait_until_finished()
            if name in self._unchecked and is_first() and (step := manager.latest_step()) is not None:
                saved = self._folder / name / str(step)
                keep_checks(saved, {file: check_of_file(saved / file) for file in files_in(saved)}, only=True)
        self._unchecked.clear()

    def restore(self, slot: str, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """Returns state and progress of a slot's newest save, or None if there is none.

        Args:
            like: a tree of arrays or shapes, whose shapes and placement the restored state gets.

        Raises:
            Unreadable: if the save is damaged, or holds a state of another structure.
        """
        manager, ocp = self._slots[slot], self._ocp
        manager.wait_until_finished()  # a save may still be under way
        step = manager.latest_step()
        if step is None:
            return None
        way_out = "repeat the command that trained this network, such as mevs train, or delete this folder first"
        if (damage := damage_of(self._folder / slot)) is not None:
            raise Unreadable(self._folder / slot, damage, way_out)
        abstract = jax.tree.map(lambda leaf: ocp.utils.to_shape_dtype_struct(_placed(leaf)), like)
        args = ocp.args.Composite(state=ocp.args.StandardRestore(abstract), progress=ocp.args.JsonRestore())
        try:
            restored = manager.restore(step, args=args)
            return restored["state"], restored["progress"]
        except Exception as error:  # TensorStore, Orbax and the file system have kinds of their own
            if is_lost_process(error):
                raise
            raise Unreadable(self._folder / slot, reason_of(error)[:120], way_out) from error

    def resume(self, like: Any, epoch_steps: int) -> tuple[Any, dict[str, Any]] | None:
        """Returns the state and progress from which a training goes on, or None if it begins.

        That is the latest state, or the best one if the latest is damaged. If the best one is lost, the latest replaces it if it
        is of the same epoch; else training begins again.

        Args:
            epoch_steps: number of steps in an epoch.
        """
        found: dict[str, tuple[Any, dict[str, Any]] | None] = {}
        for slot in ("latest", "best"):
            if found.get("latest") is not None and self._slots[slot].latest_step() is not None:
                break  # the best state is not read if it is not needed
            try:
                found[slot] = self.restore(slot, like)
            except Unreadable as error:
                damage = f"{error.path} cannot be read ({error.reason})"
                _remove(self._folder / slot, damage, "so training goes on without")
                self._slots[slot].reload()
        latest, best = found.get("latest"), found.get("best")
        if latest is None or not latest[1]["best_epoch"] or self._slots["best"].latest_step() is not None:
            return latest or best
        step = int(latest[0].step)
        if latest[1]["best_epoch"] == latest[1]["epoch"] and step == latest[1]["epoch"] * epoch_steps:
            self.save("best", step, *latest)
            return latest
        console.print(f"The best weights in {self._folder} are lost, so training begins again", markup=False)
        self.drop("latest")
        return None

    def drop(self, slot: str) -> None:
        """Removes what a slot holds."""
        if is_first():
            shutil.rmtree(self._folder / slot, ignore_errors=True)
        wait_for_all("a save is dropped")
        (self._folder / slot).mkdir(exist_ok=True)
        self._slots[slot].reload()

    def latest_step(self, slot: str) -> int:
        """Returns the step of a slot's newest save; 0 if there is none."""
        return self._slots[slot].latest_step() or 0

    @interrupts_held()
    def close(self) -> None:
        self._finish()
        for manager in self._slots.values():
            manager.close()

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        # With a lost process, waiting for its part of a save would never end.
        if error is None or not is_lost_process(error):
            self.close()
