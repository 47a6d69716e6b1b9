"""Checkpoints of a training run: its latest state, its best state, and its progress. Orbax writes them.

A save appears completely under its step, or not at all; older saves are removed afterwards. Training continues during writing.
"""

from __future__ import annotations

import logging
from copy import deepcopy
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import orbax.checkpoint as ocp

from train.devices import is_lost_process
from train.preemption import interrupts_held

logging.getLogger("absl").setLevel(logging.ERROR)  # Orbax logs every step of every save


def _placed(leaf: Any) -> Any:
    """Returns a shape without a sharding as one on a device of this process; anything else unchanged."""
    if isinstance(leaf, jax.ShapeDtypeStruct) and leaf.sharding is None:
        here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=here)
    return leaf


class Checkpoints:
    """Two slots, `latest` and `best`, each holding one state (a tree of arrays) and its progress (plain numbers)."""

    def __init__(self, folder: Path):
        options = ocp.CheckpointManagerOptions(
            max_to_keep=1, create=True, enable_async_checkpointing=True, cleanup_tmp_directories=True
        )
        self._slots = {
            name: ocp.CheckpointManager((folder / name).absolute(), options=options) for name in ("latest", "best")
        }

    @interrupts_held()
    def save(self, slot: str, step: int, state: Any, progress: dict[str, Any]) -> None:
        """Starts to save into a slot; does nothing if the slot already holds this step."""
        manager = self._slots[slot]
        if manager.latest_step() == step:
            return
        for other in self._slots.values():
            other.wait_until_finished()  # `best` must be complete before a `latest` that refers to it
        manager.save(
            step,
            args=ocp.args.Composite(state=ocp.args.StandardSave(state), progress=ocp.args.JsonSave(deepcopy(progress))),
        )

    def restore(self, slot: str, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """Returns state and progress of a slot's newest save, or None if there is none.

        Args:
            like: a tree of arrays or shapes, whose shapes and placement the restored state gets.
        """
        manager = self._slots[slot]
        step = manager.latest_step()
        if step is None:
            return None
        abstract = jax.tree.map(lambda leaf: ocp.utils.to_shape_dtype_struct(_placed(leaf)), like)
        restored = manager.restore(
            step, args=ocp.args.Composite(state=ocp.args.StandardRestore(abstract), progress=ocp.args.JsonRestore())
        )
        return restored["state"], restored["progress"]

    def latest_step(self, slot: str) -> int:
        """Returns the step of a slot's newest save; 0 if there is none."""
        return self._slots[slot].latest_step() or 0

    @interrupts_held()
    def close(self) -> None:
        for manager in self._slots.values():
            manager.close()

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None or not is_lost_process(
            error
        ):  # with a lost process, waiting for its part of a save would never end
            self.close()
