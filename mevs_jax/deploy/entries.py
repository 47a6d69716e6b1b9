"""Which compiled programs in a folder are as they were written. Without JAX: the command line looks before it imports it.

JAX takes what a file holds for the program of its name, whatever it holds, and does not replace a file that it cannot read.
"""

from __future__ import annotations

import atexit
import json
import os
import warnings
import zlib
from contextlib import suppress
from pathlib import Path

_RECORD = "checks.json"
_ZSTD = b"\x28\xb5\x2f\xfd"


class DamagedProgramsWarning(UserWarning):
    """Compiled programs were damaged, and are compiled again."""


def check_entries(folder: Path) -> None:
    """Removes programs that are damaged or another's, and says how many; remembers the others now and when the process ends.

    Args:
        folder: of JAX's persistent compilation cache.
    """
    if removed := _removed(folder):
        warnings.warn(
            f"{removed} compiled programs in {folder} were damaged; they are removed, and compiled again",
            DamagedProgramsWarning,
            stacklevel=3,
        )
    atexit.register(_removed, folder, only_new=True)


def _removed(folder: Path, only_new: bool = False) -> int:
    """Removes what is not as it was written, remembers the rest, and returns how many were removed.

    Args:
        only_new: whether those that are remembered are not read again, as where they were checked when the process began.
    """
    known: dict[str, str] = {}
    with suppress(OSError, ValueError):
        read = json.loads((folder / _RECORD).read_text())
        known = read if isinstance(read, dict) else {}
    found, removed = {}, 0
    for path in folder.glob("*-cache"):
        if only_new and path.name in known:
            found[path.name] = known[path.name]
            continue
        with suppress(OSError):  # another process may have removed it
            content = path.read_bytes()
            check = f"{len(content)}:{zlib.crc32(content):08x}"
            if known.get(path.name) == check or (path.name not in known and _is_program(path.name, content)):
                found[path.name] = check
                continue
            path.unlink()
            removed += 1
    if found != known:
        with suppress(OSError):
            beside = folder / f".{_RECORD}.{os.getpid()}"
            beside.write_text(json.dumps(found))
            beside.replace(folder / _RECORD)
    return removed


def _is_program(name: str, content: bytes) -> bool:
    """Whether a file holds a whole program of its name, as far as it can be read here."""
    if content.startswith(_ZSTD):
        return True
    try:
        return name.rsplit("-", 2)[0].encode() in zlib.decompress(content)
    except zlib.error:
        return False
