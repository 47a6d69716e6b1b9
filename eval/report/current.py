"""Whether the report of a run is the one that its results give, without drawing it: this module imports no plots."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from data_pipeline.files import damage_in, short_hash
from data_pipeline.progress import console
from eval.report.html import SCRIPT, STYLE
from eval.report.scenes import VIEWER
from train.log import read_log


def mark(described: Any, content: str) -> str:
    """Returns the last line of a page: hashes of what it was made from, with the versions of the packages, and of itself."""
    versions = [version(package) for package in ("mevs-jax", "jax", "matplotlib")]
    made_of = json.dumps([described, versions, STYLE, SCRIPT, VIEWER], sort_keys=True, default=str)
    hashes = [short_hash(text.encode()) for text in (made_of, content)]
    return f"<!-- made of {hashes[0]}, content {hashes[1]} -->\n"


def is_current(path: Path, described: Any) -> bool:
    """Returns whether a report was made from this, and is as it was written.

    Args:
        described: what `write_report` was given.
    """
    try:
        content, line = path.read_bytes().decode().rsplit("\n", 2)[:2]
    except (OSError, ValueError):
        return False
    return line + "\n" == mark(described, content + "\n")


def read_history(folder: Path) -> list[dict[str, float]]:
    """Returns the losses of a training by epoch. Of a damaged file, those lines that can be read, after a sentence."""
    found = [line for line in read_log(folder / "metrics.jsonl") if {"train/loss", "val/loss"} <= line.keys()]
    if (damage := damage_in(folder, ["metrics.jsonl"])) is not None or not found:
        console.print(
            f"{damage or folder / 'metrics.jsonl'}: the curves of training show the {len(found)} epochs that can be read",
            markup=False,
        )
    return found
