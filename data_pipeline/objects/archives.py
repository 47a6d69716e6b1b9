"""Zip archives of meshes, read in place and never unpacked.

The central directory is read once in a process. Names may have backslashes, `./` and double slashes; of several members of one
name the last counts, as for programs that unpack.
"""

from __future__ import annotations

import bz2
import copy
import functools
import lzma
import os
import posixpath
import stat
import struct
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from data_pipeline.errors import Damage, DataError, reason_of
from data_pipeline.objects.layout import Found, Listing
from data_pipeline.objects.names import kind_of_ignored, unread_reason
from mevs_jax.meshes import MESH_SUFFIXES, Up
from mevs_jax.meshes.reading import read_with, shown

LARGEST_MEMBER = 256 << 20
"""Largest unpacked size of a member in bytes. A small archive can declare, and unpack to, any size."""

_METHODS = {9: "Deflate64", 93: "Zstandard", 95: "XZ", 96: "JPEG", 97: "WavPack", 98: "PPMd", 99: "AES encryption"}
_READ_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


@functools.lru_cache(maxsize=4)
def _opened(
    archive: str, size: int, changed: int, process: int
) -> tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo], int]:
    """Returns an open archive, its files by path, and the number of members that others of the same path replace.

    All arguments but the first only tell states of the file and processes apart, which must not share an open file.
    """
    del size, changed, process
    opened = zipfile.ZipFile(archive)
    members: dict[str, zipfile.ZipInfo] = {}
    replaced = 0
    for info in opened.infolist():
        path = info.filename.replace("\\", "/")
        if path.endswith("/"):  # a folder
            continue
        path = path if path.startswith("/") else posixpath.normpath(path) if ".." not in path.split("/") else path
        replaced += path in members
        members[path] = info
    return opened, members, replaced


def _open(archive: str) -> tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo], int]:
    status = os.stat(archive)
    return _opened(archive, status.st_size, status.st_mtime_ns, os.getpid())


@dataclass(frozen=True)
class ZipMember:
    """A mesh file in a zip archive by its path as `_opened` gives it; its checksum and size, and which axis is up."""

    archive: str
    member: str
    stamp: str = ""
    up: Up = "auto"

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        where = f"{shown(self.member)} in {shown(self.archive)}"
        return read_with(self._content, self.member, where, self.up)

    def _content(self, member: str) -> bytes:
        try:
            opened, members, _ = _open(self.archive)
            info = members.get(posixpath.normpath(member))
            reason = "is not in the archive; pack it again" if info is None else unreadable(info)
            if info is None or reason:
                raise Damage(reason)
            content = _unpacked(opened, info)
        except Damage:
            raise
        except Exception as error:  # damaged streams raise errors of zipfile, zlib, lzma, struct and others
            raise Damage(f"cannot be unpacked ({reason_of(error)}); download or pack the archive again") from error
        if len(content) > LARGEST_MEMBER:
            raise Damage(_too_large())
        return content


def _unpacked(opened: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Returns the content of a member, or more than `LARGEST_MEMBER` bytes of it if it is larger."""
    if info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        with opened.open(info) as file:
            return file.read(LARGEST_MEMBER + 1)
    # For the other methods `zipfile` unpacks all that a chunk holds, whatever is asked for: 600 bytes can become gigabytes.
    packed = copy.copy(info)
    packed.compress_type, packed.file_size = zipfile.ZIP_STORED, info.compress_size
    packed.CRC = None  # type: ignore[assignment]  # that of the unpacked content, checked below
    with opened.open(packed) as file:
        content = file.read()
    if info.compress_type == zipfile.ZIP_BZIP2:
        unpacked = bz2.BZ2Decompressor().decompress(content, info.file_size + 1)
    else:
        (size,) = struct.unpack("<2xH", content[:4])
        properties, dictionary = struct.unpack("<BL", content[4:9])
        method = {
            "id": lzma.FILTER_LZMA1,
            "lc": properties % 9,
            "lp": properties // 9 % 5,
            "pb": properties // 45,
            "dict_size": max(min(dictionary, info.file_size), 4096),
        }
        decompressor = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[method])
        unpacked = decompressor.decompress(content[4 + size :], info.file_size + 1)
    if len(unpacked) != info.file_size or zlib.crc32(unpacked) != info.CRC:
        raise zipfile.BadZipFile("its content is not of the size and checksum that the archive declares")
    return unpacked


def _too_large() -> str:
    return f"unpacks to more than {LARGEST_MEMBER >> 20} MB; unpack the archive and pass the folder, if this is true"


def unreadable(info: zipfile.ZipInfo) -> str | None:
    """Returns why a member cannot be read, with what to do, or None."""
    if info.flag_bits & 1 or info.compress_type == 99:
        return "is encrypted; unpack the archive with its password and pass the folder"
    if info.compress_type not in _READ_METHODS:
        method = _METHODS.get(info.compress_type, "unknown")
        return (
            f"is compressed with method {info.compress_type} ({method}), which Python cannot read; unpack the archive and pass "
            f"the folder, or pack it again with: zip -r"
        )
    if info.file_size > LARGEST_MEMBER:
        return _too_large()
    if stat.S_ISLNK(info.external_attr >> 16):
        return "is a link, which is not followed in an archive; pack the file itself (zip -r does)"
    return None


def list_zip(archive: Path, up: Up = "auto") -> Listing:
    """Returns the files of a zip archive.

    Raises:
        DataError: if the archive is not readable, contains paths outside of it, or none of its meshes can be read.
    """
    where = shown(str(archive))
    try:
        _, members, replaced = _open(str(archive))
    except Exception as error:  # damaged directories raise errors of zipfile, struct and others
        raise DataError(f"{where} is not a readable zip file ({reason_of(error)}); download it again") from error
    found: list[Found] = []
    ignored: Counter[str] = Counter()
    hindered: list[str] = []
    for name, info in members.items():
        parts = PurePosixPath(name).parts
        if name.startswith("/") or ".." in parts or (parts and ":" in parts[0]):
            leaves = f"{shown(info.filename)!r}, a path that leaves its folder"
            raise DataError(f"{where} contains {leaves}; do not trust this archive")
        if hidden := next(filter(None, map(kind_of_ignored, parts)), ""):
            ignored[hidden] += 1
            continue
        place, identity = tuple(shown(part) for part in parts), (name,)
        if PurePosixPath(name).suffix.lower() in MESH_SUFFIXES:
            recipe = ZipMember(str(archive), name, f"{info.CRC:08x}-{info.file_size}", up)
            found.append(Found(place, recipe, identity, False))
            hindrance = unreadable(info)
            hindered += [hindrance] if hindrance else []
        elif unread := unread_reason(name):
            found.append(Found(place, None, identity, False, unread))
    meshes = [one for one in found if one.recipe is not None]
    if meshes and len(hindered) == len(meshes) and len(set(hindered)) == 1:
        raise DataError(f"{where}: every mesh in it, such as {'/'.join(meshes[0].parts)}, {hindered[0]}")
    notes = (f"members replaced by later ones of the same name: {replaced}",) if replaced else ()
    return Listing(tuple(sorted(found, key=lambda one: one.parts)), ignored, notes)
