"""What goes on in a run directory: the job that runs, how far it is, and what was saved last."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

from data_pipeline.errors import Unreadable
from data_pipeline.files import read_json
from data_pipeline.lock import job_of
from data_pipeline.progress import STATUS
from train.running.checkpoints import steps_saved
from train.running.log import read_log


def _ago(moment: float) -> str:
    return f"{timedelta(seconds=max(0, round(time.time() - moment)))} ago"


def status_of(out: Path) -> Iterator[str]:
    """Yields lines on a run directory: its job, what the job works on, and each network that is or was trained."""
    job = job_of(out)
    if job is None:
        yield "no job is running"
    else:
        yield f"{job.get('command')}: {_process(job)}, since {job.get('since')}"
        if hosts := Counter(job.get("hosts", ())):
            each = ", ".join(f"{host} ({count})" for host, count in hosts.items())
            yield f"{hosts.total()} processes on {len(hosts)} hosts: {each}"
        with suppress(FileNotFoundError, Unreadable):  # it has not said anything yet
            state = read_json(out / STATUS)
            yield from (f"{line} ({_ago(state['time'])})" for line in state["lines"])
    for part in sorted(out.glob("sweep/*_study/job_*")):
        if (job := job_of(part)) is not None:
            yield f"{part.relative_to(out)}: {_process(job)}, since {job.get('since')}"
    for depth in range(1, 4):
        for latest in sorted(out.glob("*/" * depth + "latest")):
            yield f"{latest.parent.relative_to(out)}: {_of_network(latest.parent)}"


def _process(job: dict[str, Any]) -> str:
    return f"process {job.get('pid')} on {job.get('host')}"


def _of_network(folder: Path) -> str:
    """Returns how far the training of a network is."""
    saved, log = steps_saved(folder / "latest"), read_log(folder / "metrics.jsonl")
    said = ["finished"] if (folder / "summary.json").exists() else []
    if log:
        losses = [f"{name} {log[-1][name]:.4f}" for name in ("train/loss", "val/loss") if name in log[-1]]
        said.append(", ".join([f"epoch {log[-1]['epoch']:.0f}, step {log[-1]['step']:,.0f}", *losses]))
    if saved:
        newest = max(saved, key=lambda path: int(path.name))
        said.append(f"checkpoint after step {int(newest.name):,}, {_ago(newest.stat().st_mtime)}")
    return "; ".join(said) or "nothing is saved yet"
