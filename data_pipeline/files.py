"""Reading and writing of files. Every file is written atomically: under a temporary name, then renamed."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

_SAFE_NAME = re.compile(r"[a-z0-9_][a-z0-9_.-]*")
_UNSAFE = re.compile(r"[^a-z0-9_.-]")


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file atomically and makes its folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, content: str) -> None:
    """Writes text as UTF-8, atomically."""
    write_bytes(path, content.encode())


def write_npz(path: Path, **arrays: Any) -> None:
    """Writes arrays to an uncompressed `.npz` file, atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def npz_of(folder: Path, name: str) -> Path:
    """Returns the path of the `.npz` file in `folder` for the object called `name`.

    Names that a file system may not hold, or may not tell apart (long, with capitals, other than ASCII), get a checksum.
    """
    plain = name.replace("/", "__")
    if not _SAFE_NAME.fullmatch(plain) or "__" in name or len(plain) > 180:
        digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:20]
        plain = f"{_UNSAFE.sub('_', plain)[:80]}.{digest}"
    return folder / f"{plain}.npz"


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def write_json(path: Path, content: Any) -> None:
    """Writes JSON atomically. Arrays become lists, paths become strings.

    Raises:
        ValueError: if a number is not finite.
    """
    write_text(path, json.dumps(content, indent=1, default=_plain, allow_nan=False) + "\n")


def as_read(content: Any) -> Any:
    """Returns `content` as `read_json` would return it after writing, for comparison with a stored identity."""
    return json.loads(json.dumps(content))


def read_json(path: Path) -> Any:
    """Returns the content of a JSON file."""
    return json.loads(path.read_text())
