"""The mesh files below a folder: links are followed, and nothing that looks like a mesh is passed over without a reason."""

from __future__ import annotations

import os
import stat
from collections import Counter
from pathlib import Path, PurePosixPath

from data_pipeline.errors import DataError
from data_pipeline.files import short_hash
from data_pipeline.objects.layout import Found, Listing
from data_pipeline.objects.names import kind_of_ignored, unread_reason
from data_pipeline.objects.recipes import MeshFile, Unreadable, stamp_of
from mevs_jax.meshes import MESH_SUFFIXES, Up
from mevs_jax.meshes.reading import shown

_MOST_VISITS = 32
"""How often one folder is entered that several links lead to. Links that lead to one another would have n! paths."""


def list_folder(root: Path, up: Up = "auto") -> Listing:
    """Returns what lies below a folder, at any depth.

    Raises:
        DataError: if the folder itself cannot be read.
    """
    found: list[Found] = []
    ignored: Counter[str] = Counter()
    visits: Counter[tuple[int, int]] = Counter()
    try:
        status = os.stat(root)
        os.listdir(root)
    except OSError as error:
        raise DataError(f"{shown(str(root))} cannot be read: {error.strerror}; choose another --data") from error
    todo: list[tuple[str, tuple[str, ...], tuple[tuple[int, int], ...], bool]]
    todo = [(str(root), (), ((status.st_dev, status.st_ino),), False)]
    while todo:
        folder, parts, above, linked = todo.pop()
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: os.fsencode(entry.name))
        except OSError as error:
            found.append(Found(parts, None, (folder,), linked, f"cannot be read: {error.strerror}"))
            continue
        has_gltf = any(entry.name.lower().endswith(".gltf") for entry in entries)
        buffers = _state_of_buffers(entries) if has_gltf else ""
        for entry in entries:
            place, is_link = (*parts, shown(entry.name)), linked or entry.is_symlink()
            if hidden := kind_of_ignored(entry.name):
                ignored[hidden] += 1
                continue
            try:
                status = entry.stat()
            except OSError as error:
                _add_broken(found, entry, place, error)
                continue
            identity = status.st_dev, status.st_ino
            if stat.S_ISDIR(status.st_mode):
                visits[identity] += 1
                if identity not in above and visits[identity] <= _MOST_VISITS:
                    todo.append((entry.path, place, (*above, identity), is_link))
                continue
            suffix = PurePosixPath(entry.name).suffix.lower()
            if suffix in MESH_SUFFIXES and stat.S_ISREG(status.st_mode):
                mark = (buffers if suffix == ".gltf" else "") + stamp_of(status)
                found.append(Found(place, MeshFile(entry.path, mark, up), identity, is_link))
            elif suffix in MESH_SUFFIXES:
                found.append(Found(place, None, identity, is_link, "is not a regular file"))
            elif reason := unread_reason(entry.name):
                found.append(Found(place, None, identity, is_link, reason))
    return Listing(tuple(sorted(found, key=lambda one: one.parts)), ignored)


def _add_broken(found: list[Found], entry: os.DirEntry[str], place: tuple[str, ...], error: OSError) -> None:
    """Adds a link without a target, or a file that cannot be read, if it may be a mesh or a folder of meshes."""
    target = shown(os.readlink(entry.path)) if entry.is_symlink() else ""
    reason = f"is a link to {target}, which does not exist" if target else f"cannot be read: {error.strerror}"
    suffix = PurePosixPath(entry.name).suffix.lower()
    if suffix in MESH_SUFFIXES:
        advice = "; fetch its content (git annex get, dvc pull), or take the link away" if target else ""
        found.append(Found(place, Unreadable(entry.path, reason + advice), (entry.path,), True))
    elif not suffix or unread_reason(entry.name):
        found.append(Found(place, None, (entry.path,), True, reason))


def _state_of_buffers(entries: list[os.DirEntry[str]]) -> str:
    """Returns the state of the files in which the glTF files of a folder may keep their numbers; empty if there are none."""
    found = []
    for entry in entries:
        if entry.name.lower().endswith(".bin"):
            try:
                found.append(f"{os.fsencode(entry.name)!r} {stamp_of(entry.stat())}")
            except OSError:
                found.append(f"{os.fsencode(entry.name)!r} gone")
    return f"{short_hash(' '.join(found).encode())}+" if found else ""
