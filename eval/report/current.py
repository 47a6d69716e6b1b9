"""Whether a written report still matches the results of its run.

This module imports no matplotlib, so that a finished run is checked quickly.
"""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from data_pipeline.files import short_hash
from eval.report.html import SCRIPT, STYLE
from eval.report.scenes import VIEWER


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
