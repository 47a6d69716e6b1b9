"""Files appear whole or not at all: written under a temporary name, then moved into place."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np


def write_bytes(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, content: str) -> None:
    write_bytes(path, content.encode())


def write_npz(path: Path, **arrays: Any) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def npz_of(folder: Path, name: str) -> Path:
    """The file in `folder` that belongs to an object of this name."""
    return folder / (name.replace("/", "__") + ".npz")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def write_json(path: Path, content: Any) -> None:
    write_text(path, json.dumps(content, indent=1, default=_plain, allow_nan=False) + "\n")


def as_read(content: Any) -> Any:
    """Content as `read_json` would give it back: what a stored identity is compared with."""
    return json.loads(json.dumps(content))


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())
