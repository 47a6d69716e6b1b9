"""The state of a source's files, kept with a finished data set to notice when they change."""

from __future__ import annotations

import os
import zipfile
import zlib
from pathlib import Path

from data_pipeline.errors import DataError
from data_pipeline.objects.folders import list_folder
from data_pipeline.objects.names import shown


def source_state(data: str, split: str = "") -> dict[str, str] | None:
    """Returns the state of each file of a source: size and time of files, checksum and size of members of archives.

    Args:
        data: path of a folder, .zip or .npz.
        split: path of a list of splits, or anything else.

    Returns:
        the states by path; None if there are no files, or they cannot be read.
    """
    path = Path(os.path.expanduser(data))
    try:
        if path.is_dir():
            found = {one.path: getattr(one.recipe, "stamp", "") for one in list_folder(path).found}
            # The last part, the time of the last change of any kind, differs between copies of one file.
            state = {name: stamp.rsplit("-", 1)[0] for name, stamp in found.items()}
        elif path.suffix.lower() in (".zip", ".npz"):
            with zipfile.ZipFile(path) as archive:
                state = {shown(info.filename): f"{info.CRC:08x}-{info.file_size}" for info in archive.infolist()}
        else:
            return None
        if split.lower().endswith((".json", ".csv")):
            state["the list of --dataset.split"] = f"{zlib.crc32(Path(split).expanduser().read_bytes()):08x}"
    except (OSError, DataError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return None
    return state


def changes_between(before: dict[str, str], now: dict[str, str]) -> str:
    """Returns how many files changed, came and went, with an example; empty if none did."""
    changed = sorted(name for name in before.keys() & now.keys() if before[name] != now[name])
    new, gone = sorted(now.keys() - before.keys()), sorted(before.keys() - now.keys())
    counts = [f"{len(names)} {kind}" for names, kind in ((changed, "changed"), (new, "new"), (gone, "gone")) if names]
    return f"{', '.join(counts)}, such as {(changed + new + gone)[0]}" if counts else ""
