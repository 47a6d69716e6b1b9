"""Reading and writing of files. Every file is written atomically: under a temporary name, to the disk, then renamed.

A folder may hold `checks.json`: size and CRC-32 of files in it. A file that differs from its check is damaged. Files without a
check, such as those of older versions, are accepted as they are.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.errors import DataError, Unreadable, causes_of

CHECKS = "checks.json"
"""File name of the checks of the files in a folder."""

_SAFE_NAME = re.compile(r"[a-z0-9_][a-z0-9_.-]*")
_UNSAFE = re.compile(r"[^a-z0-9_.-]")


_NO_WRITING = {
    errno.ENOSPC: "the disk is full; free some space, and the same command goes on",
    errno.EDQUOT: "your quota of the disk is used up; free some space, and the same command goes on",
    errno.EFBIG: "it would be larger than files may be here; raise the limit (ulimit -f), and the same command goes on",
    errno.EROFS: "the file system is read-only; choose another --out, or mount it for writing",
}
_NO_ACCESS = {
    errno.EACCES: "change its permissions, or choose another --out",
    errno.EPERM: "change its permissions, or choose another --out",
    errno.EISDIR: "a folder lies where a file belongs; remove it, and the same command goes on",
    errno.ENOTDIR: "a file lies where a folder belongs; remove it, and the same command goes on",
    errno.EEXIST: "a file lies where a folder belongs; remove it, and the same command goes on",
}


def _sentence(error: OSError, path: Path | str | None) -> str | None:
    number = error.errno or 0
    if number in _NO_WRITING:
        return f"cannot write {path}: {_NO_WRITING[number]}" if path else f"cannot write: {_NO_WRITING[number]}"
    if number in _NO_ACCESS and path:
        return f"cannot use {path} ({error.strerror}): {_NO_ACCESS[number]}"
    return None


def why_not_written(error: BaseException) -> str | None:
    """Returns why the operating system refused to write, and what to do; None for an error of another kind.

    Libraries raise their own kinds of errors, with the system's words in their messages, so the causes are looked through too.
    """
    chain = causes_of(error)
    for link in chain:
        if isinstance(link, OSError) and (sentence := _sentence(link, link.filename)):
            return sentence
    for number, what_to_do in _NO_WRITING.items():
        if any(os.strerror(number).lower() in str(link).lower() for link in chain):
            return f"cannot write: {what_to_do}"
    return None


def _to_disk(path: Path) -> None:
    """Waits until a folder's entries are on the disk; file systems that cannot do this are left alone."""
    with suppress(OSError):
        folder = os.open(path, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


PARTIAL = ".partial"
"""How the names of files end that are being written."""
_OWN = os.urandom(3).hex()
"""Tells processes of several machines or containers apart, whose numbers may be the same."""


def write_bytes(path: Path, content: bytes, durable: bool = True) -> None:
    """Writes a file atomically and makes its folder if needed.

    Args:
        durable: whether to wait until the content is on the disk, so that after a power failure the file is the old or the new
            one. It takes milliseconds; without it, the file may be empty then.

    Raises:
        DataError: if the file cannot be written, for example because the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}_{_OWN}{PARTIAL}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if durable:
            _to_disk(path.parent)
    except OSError as error:
        if (sentence := _sentence(error, path)) is None:
            raise
        raise DataError(sentence) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: Path, content: str) -> None:
    """Writes text as UTF-8, atomically."""
    write_bytes(path, content.encode())


def npz_bytes(**arrays: Any) -> bytes:
    """Returns the content of an uncompressed `.npz` file, which holds checksums of its arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def write_npz(path: Path, **arrays: Any) -> None:
    """Writes arrays to an uncompressed `.npz` file, atomically."""
    write_bytes(path, npz_bytes(**arrays))


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


def json_of(content: Any) -> bytes:
    """Returns what a JSON file with this content holds. Arrays become lists, paths become strings.

    Raises:
        ValueError: if a number is not finite.
    """
    return (json.dumps(content, indent=1, default=_plain, allow_nan=False) + "\n").encode()


def write_json(path: Path, content: Any) -> None:
    """Writes JSON atomically, as `json_of` has it."""
    write_bytes(path, json_of(content))


def as_read(content: Any) -> Any:
    """Returns `content` as `read_json` would return it after writing, for comparison with a stored identity."""
    return json.loads(json.dumps(content))


def read_json(path: Path) -> Any:
    """Returns the content of a JSON file.

    Raises:
        Unreadable: if it cannot be read, is no JSON, or differs from its check.
        FileNotFoundError: if it does not exist.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise Unreadable(path, error.strerror or type(error).__name__) from error
    if not _agrees(checks_in(path.parent).get(path.name), check_of(content)):
        raise Unreadable(path, f"it is not as it was written, by its check in {CHECKS}")
    try:
        return json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise Unreadable(path, f"it is no JSON: {error}" if content else "it is empty") from error


# ----------------------------------------------------------------------------------------------------------------- checks


def digest_of(content: Any) -> str:
    """Returns a short hash of what JSON can hold; the order of entries in dictionaries does not matter."""
    return short_hash(json.dumps(content, sort_keys=True).encode())


def short_hash(content: bytes) -> str:
    """Returns the first 64 bits of the SHA-256 of bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()[:16]


def check_of(content: bytes) -> str:
    """Returns size and CRC-32 of a file's content, which differ for damaged content."""
    return f"{len(content)}:{zlib.crc32(content):08x}"


def check_of_file(path: Path) -> str:
    """Returns the check of a file, read in pieces."""
    size, crc = 0, 0
    with path.open("rb") as file:
        while piece := file.read(2**20):
            size, crc = size + len(piece), zlib.crc32(piece, crc)
    return f"{size}:{crc:08x}"


def checks_in(folder: Path) -> dict[str, list[str]]:
    """Returns the checks of the files in `folder`, by name: those of the file as it is and as it was before.

    Both are accepted, since a job may end between writing a check and its file. Without a readable `checks.json` there are none.
    """
    try:
        content = json.loads((folder / CHECKS).read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(content, dict):
        return {}
    return {name: of for name, of in content.items() if isinstance(of, list) and of}


def _agrees(accepted: list[str] | None, found: str) -> bool:
    return accepted is None or found in accepted


def keep_checks(folder: Path, found: dict[str, str], only: bool = False) -> None:
    """Adds checks to `checks.json` in `folder`, or replaces it by them.

    Args:
        found: checks by name, relative to `folder`.
        only: whether all other checks are removed, and only one check of each file is accepted.
    """
    before = {} if only else checks_in(folder)
    after = before | {
        name: [*(old for old in before.get(name, [])[-1:] if old != new), new] for name, new in found.items()
    }
    if after != before:
        write_json(folder / CHECKS, after)


def keep_json(path: Path, content: Any) -> None:
    """Writes JSON as `write_json` does, and its check, which `read_json` compares."""
    written = json_of(content)
    keep_checks(path.parent, {path.name: check_of(written)})
    write_bytes(path, written)


def was_written(path: Path, content: Any) -> bool:
    """Returns whether the check of a JSON file, which may be damaged or missing, is that of this content; False without one."""
    return check_of(json_of(content)) in checks_in(path.parent).get(path.name, [])


def files_in(folder: Path) -> list[str]:
    """Returns the names of all files in `folder` and its folders but `checks.json`, relative to it and sorted."""
    found = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in found if name != CHECKS)


def damage_in(
    folder: Path, names: Iterable[str] | None = None, check: Callable[[Path], str] = check_of_file
) -> str | None:
    """Returns a sentence's part about the first file in `folder` that is missing or differs from its check; None if all agree.

    Args:
        names: of the files that have a check; all of them by default.
        check: computes the check of a file; `size_of_file` compares sizes alone.
    """
    checks = checks_in(folder)
    for name in checks if names is None else names:
        path = folder / name
        try:
            found = check(path)
        except OSError as error:
            return f"{path} is missing" if isinstance(error, FileNotFoundError) else f"{path}: {error.strerror}"
        accepted = checks.get(name)
        if accepted is not None and not any(one.startswith(found) for one in accepted):
            return f"{path} is not as it was written"
    return None


def size_of_file(path: Path) -> str:
    """Returns the first part of a file's check, its size."""
    if not path.is_file():
        raise FileNotFoundError(path)
    return f"{path.stat().st_size}:"
