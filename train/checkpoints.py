"""What a training run leaves on disk: its latest state, its best one, and how far it got. Orbax does the writing.

Each save appears whole under its step, or not at all; older ones are removed after. Training goes on while it is written.
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

logging.getLogger("absl").setLevel(logging.ERROR)  # Orbax tells every step of every save


def _placed(leaf: Any) -> Any:
    """A shape without a place is on a device of this process; arrays are where they are."""
    if isinstance(leaf, jax.ShapeDtypeStruct) and leaf.sharding is None:
        here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=here)
    return leaf


class Checkpoints:
    """Two slots, `latest` and `best`, each holding one (state, progress): a tree of arrays, and plain numbers."""

    def __init__(self, folder: Path):
        options = ocp.CheckpointManagerOptions(
            max_to_keep=1, create=True, enable_async_checkpointing=True, cleanup_tmp_directories=True
        )
        self._slots = {
            name: ocp.CheckpointManager((folder / name).absolute(), options=options) for name in ("latest", "best")
        }

    @interrupts_held()
    def save(self, slot: str, step: int, state: Any, progress: dict[str, Any]) -> None:
        manager = self._slots[slot]
        if manager.latest_step() == step:
            return
        for other in self._slots.values():
            other.wait_until_finished()  # what `latest` says of `best` has to be there before
        manager.save(
            step,
            args=ocp.args.Composite(state=ocp.args.StandardSave(state), progress=ocp.args.JsonSave(deepcopy(progress))),
        )

    def restore(self, slot: str, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """The newest of a slot, shaped and placed as `like`, which may be shapes alone; None where nothing was saved."""
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
        """The newest step of a slot; 0 where nothing was saved."""
        return self._slots[slot].latest_step() or 0

    @interrupts_held()
    def close(self) -> None:
        for manager in self._slots.values():
            manager.close()

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None or not is_lost_process(error):  # a lost process never finishes its part of a save
            self.close()
