"""One look for every progress bar: what, how far, how fast, how much longer."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from data_pipeline.errors import DataError
from data_pipeline.files import write_bytes

console = Console(stderr=True, highlight=False, soft_wrap=True)


class _Rate(ProgressColumn):
    def __init__(self, unit: str):
        super().__init__()
        self.unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:,.1f} {self.unit}/s", style="cyan")


class _Watched(Progress):
    """A bar whose state is written every few seconds for `mevs status`; for logs also as lines, in place of the bar."""

    def __init__(self, *columns: ProgressColumn, unit: str, in_lines: bool):
        super().__init__(*columns, console=console, disable=in_lines)
        self.unit, self._in_lines = unit, in_lines
        self._ended = threading.Event()
        self._writer = threading.Thread(target=self._write, daemon=True)

    def start(self) -> None:
        self._writer.start()
        super().start()

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        if advance and self._tasks[task_id].fields["note"] == COMPILING:
            self.update(task_id, note="")

    def stop(self) -> None:
        self._ended.set()
        if self._writer.is_alive():
            self._writer.join()
        super().stop()

    def _write(self) -> None:
        said = time.monotonic()
        while not self._ended.wait(min(SECONDS_BETWEEN_LINES, _SECONDS_BETWEEN_STATES)):
            lines = [line_of(task, self.unit) for task in self.tasks if task.started and not task.finished]
            if _status is not None:
                with suppress(OSError, DataError):  # the work itself fails with a message then
                    write_bytes(_status, json.dumps({"time": time.time(), "lines": lines}).encode(), durable=False)
            if self._in_lines and time.monotonic() - said >= SECONDS_BETWEEN_LINES:
                said = time.monotonic()
                for line in lines:
                    console.print(line)


COMPILING = "compiling …"
"""Note of a task whose program is compiled at its first call; it is removed when the task advances."""
SECONDS_BETWEEN_LINES = 30.0
_SECONDS_BETWEEN_STATES = 5.0
_status: Path | None = None

STATUS = "status.json"
"""File name of the state of the job that runs in a run directory."""


@contextmanager
def watched(out: Path) -> Iterator[None]:
    """Lets bars write their state into the run directory `out`, until the job ends."""
    global _status
    _status = out / STATUS
    try:
        yield
    finally:
        _status.unlink(missing_ok=True)
        _status = None


def line_of(task: Task, unit: str) -> str:
    """How far a task is, how fast, and how much longer it takes, in one line."""
    if (note := task.fields.get("note")) == COMPILING:
        return f"{task.description}: {note}"
    said = f"{task.description}: {task.completed:,.0f} of {task.total or 0:,.0f} {unit} ({task.percentage:.0f} %)"
    if task.speed:
        said += f", {task.speed:,.1f} {unit}/s"
    if task.time_remaining is not None:
        said += f", {timedelta(seconds=round(task.time_remaining))} left"
    return f"{said}, {note}" if note else said


def progress_bar(unit: str) -> Progress:
    """A bar counted in `unit`; where standard error is no terminal, a line every 30 seconds."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", style="dim"),
    )
    return _Watched(*columns, unit=unit, in_lines=not sys.stderr.isatty())
