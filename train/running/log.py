"""The metrics of a training by epoch: JSON lines, and for TensorBoard."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from data_pipeline.distributed import is_first
from data_pipeline.files import damage_in, write_text
from data_pipeline.progress import console


def read_log(path: Path) -> list[dict[str, float]]:
    """Returns the readable lines of a `metrics.jsonl`; none if there is no such file."""
    found = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        with suppress(ValueError):
            content = json.loads(line)
            if isinstance(content, dict) and "step" in content and "epoch" in content:
                found.append(content)
    return found


class MetricsLog:
    """Writes metrics as JSON lines and for TensorBoard, from the first process only.

    On resuming, lines logged after the checkpoint are removed.
    """

    def __init__(self, folder: Path, step: int):
        self._writes = is_first()
        if not self._writes:
            return
        self._path = folder / "metrics.jsonl"
        kept = [line for line in read_log(self._path) if line["step"] <= step]
        write_text(self._path, "".join(json.dumps(line) + "\n" for line in kept))
        from tensorboardX import SummaryWriter  # imported late: it imports PyTorch if that is installed

        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, metrics: dict[str, float]) -> None:
        if not self._writes:
            return
        with self._path.open("a") as file:
            file.write(json.dumps({"step": step, **metrics}) + "\n")
        for name, value in metrics.items():
            self._board.add_scalar(name, value, step)

    def close(self) -> None:
        if self._writes:
            self._board.close()


def read_history(folder: Path) -> list[dict[str, float]]:
    """Returns the losses of a training by epoch. Of a damaged file, those lines that can be read, after a sentence."""
    found = [line for line in read_log(folder / "metrics.jsonl") if {"train/loss", "val/loss"} <= line.keys()]
    if (damage := damage_in(folder, ["metrics.jsonl"])) is not None or not found:
        console.print(
            f"{damage or folder / 'metrics.jsonl'}: the curves of training show the {len(found)} epochs that can be read",
            markup=False,
        )
    return found
