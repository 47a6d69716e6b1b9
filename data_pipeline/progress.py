"""One look for every progress bar: what, how far, how fast, how much longer."""

from __future__ import annotations

import sys
import threading
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

console = Console(stderr=True, highlight=False, soft_wrap=True)


class _Rate(ProgressColumn):
    def __init__(self, unit: str):
        super().__init__()
        self.unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:,.1f} {self.unit}/s", style="cyan")


class _ProgressInLines(Progress):
    """For logs: every so often a line for each task that is under way, in place of bars."""

    def __init__(self, unit: str):
        super().__init__(console=console, disable=True)
        self.unit = unit
        self._ended = threading.Event()
        self._writer = threading.Thread(target=self._write, daemon=True)

    def start(self) -> None:
        self._writer.start()
        super().start()

    def stop(self) -> None:
        self._ended.set()
        if self._writer.is_alive():
            self._writer.join()
        super().stop()

    def _write(self) -> None:
        while not self._ended.wait(SECONDS_BETWEEN_LINES):
            for task in self.tasks:
                if task.started and not task.finished:
                    console.print(line_of(task, self.unit))


SECONDS_BETWEEN_LINES = 30.0


def line_of(task: Task, unit: str) -> str:
    """How far a task is, how fast, and how much longer it takes, in one line."""
    said = f"{task.description}: {task.completed:,.0f} of {task.total or 0:,.0f} {unit} ({task.percentage:.0f} %)"
    if task.speed:
        said += f", {task.speed:,.1f} {unit}/s"
    if task.time_remaining is not None:
        said += f", {timedelta(seconds=round(task.time_remaining))} left"
    note = task.fields.get("note")
    return f"{said}, {note}" if note else said


def progress_bar(unit: str) -> Progress:
    """A bar counted in `unit`; where standard error is no terminal, a line every 30 seconds."""
    if not sys.stderr.isatty():
        return _ProgressInLines(unit)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", style="dim"),
        console=console,
    )
