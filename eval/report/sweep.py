"""The report of a sweep: a table of its members and a parallel-coordinates plot."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from data_pipeline.files import write_bytes, write_text
from mevs_jax.markdown import markdown_table
from train.many.members import Member

_AXES = {
    "learning_rate": "learning rate",
    "weight_decay": "weight decay",
    "dropout": "dropout",
    "augmentation": "augmentation",
    "best_epoch": "best epoch",
    "loss": "validation loss",
}
_LOGARITHMIC = ("learning_rate", "weight_decay", "loss")


def sweep_table(members: Sequence[Member]) -> str:
    """A Markdown table of the members, best first and diverged ones last."""
    rows = []
    for member in sorted(members, key=lambda member: member.loss):
        loss = "diverged" if member.diverged or member.best is None else f"{member.loss:.5f}"
        numbers = [f"{member.learning_rate:.2e}", f"{member.weight_decay:.2e}", f"{member.dropout:.2f}"]
        numbers += [f"{member.augmentation:.2f}", str(member.best_epoch), loss, str(member.epochs)]
        rows.append([str(members.index(member)), *numbers])
    return markdown_table(["member", *_AXES.values(), "epochs"], rows) + "\n"


def parallel_coordinates(members: Sequence[Member]) -> Figure:
    """A line for each member over the swept parameters, darker for a lower loss.

    Members without a finite loss are left out; the title counts them.
    """
    finite = [member for member in members if np.isfinite(member.loss)]
    names = [name for name in _AXES if len({getattr(member, name) for member in finite}) > 1]
    columns, ticks = [], []
    for name in names:
        values = np.array([getattr(member, name) for member in finite], float)
        scaled = np.log10(values) if name in _LOGARITHMIC else values
        low, high = scaled.min(), scaled.max()
        columns.append((scaled - low) / (high - low))
        marks = np.linspace(low, high, 4)
        shown = 10**marks if name in _LOGARITHMIC else marks
        ticks.append([f"{mark:.0f}" if name == "best_epoch" else f"{mark:.2g}" for mark in shown])
    figure = Figure(figsize=(1.6 * max(3, len(names)) + 1, 3.6), layout="constrained")
    axes = figure.subplots()
    order = np.argsort([-member.loss for member in finite])
    heights = np.array(columns).T
    lines = LineCollection(
        [np.column_stack([np.arange(len(names)), heights[i]]) for i in order],
        array=np.linspace(0, 1, len(order)),
        cmap="viridis_r",
        linewidths=1.6,
    )
    axes.add_collection(lines)
    for position, (name, labels) in enumerate(zip(names, ticks, strict=True)):
        axes.axvline(position, color="0.6", linewidth=0.8)
        for height, label in zip(np.linspace(0, 1, 4), labels, strict=True):
            axes.annotate(label, (position, height), (4, 0), textcoords="offset points", va="center", fontsize=7)
        axes.annotate(_AXES[name], (position, 1), (0, 10), textcoords="offset points", ha="center", fontsize=9)
    axes.set(xlim=(-0.2, len(names) - 0.5), ylim=(-0.05, 1.05))
    axes.axis("off")
    left_out = len(members) - len(finite)
    title = f"{len(finite)} members, the darkest is the best" + (f"; {left_out} diverged" if left_out else "")
    figure.suptitle(title, fontsize=9)
    return figure


def write_sweep_report(members: Sequence[Member], folder: Path) -> None:
    """Writes `members.md` and `parallel_coordinates.png` beside `members.json`."""
    write_text(folder / "members.md", sweep_table(members))
    if any(np.isfinite(member.loss) for member in members):
        buffer = io.BytesIO()
        parallel_coordinates(members).savefig(buffer, dpi=150)
        write_bytes(folder / "parallel_coordinates.png", buffer.getvalue())
