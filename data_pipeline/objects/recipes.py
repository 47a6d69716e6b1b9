"""Recipes of meshes: procedural furniture, a file, a file that cannot be read. Members of archives are in `archives`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.formats import MESH_SUFFIXES, Up, parse_mesh
from data_pipeline.objects.names import shown

LARGEST_FILE = 2 << 30
"""Largest size in bytes of a mesh file that is read."""


@dataclass(frozen=True)
class FurniturePiece:
    """A piece of furniture10."""

    class_name: str
    seed: int

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        from data_pipeline.objects.furniture import furniture  # imported late: it needs trimesh

        piece = furniture(self.class_name, self.seed)
        return piece.vertices, piece.faces


@dataclass(frozen=True)
class MeshFile:
    """A mesh file on disk.

    Attributes:
        path: path of the file.
        stamp: state of the file when it was found, see `stamp_of`.
        up: which axis of the file is up.
    """

    path: str
    stamp: str = ""
    up: Up = "auto"

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        where = shown(self.path)
        content = _content(self.path, where)
        return parse_mesh(content, Path(self.path).suffix.lower(), where, up=self.up, sibling=self._sibling)

    def _sibling(self, name: str) -> bytes:
        where = f"{shown(self.path)} needs {shown(name)!r}, which"
        return _content(os.path.join(os.path.dirname(self.path), within(name, where)), where)


def read_mesh(path: str | Path, up: Up = "auto") -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3), z up, and triangles (m, 3) of a mesh file.

    Args:
        path: a file of one of the formats of `data_pipeline.objects.formats`.
        up: which axis of the file is up.

    Raises:
        DataError: if it is not a mesh that can be read.
    """
    if Path(path).suffix.lower() not in MESH_SUFFIXES:
        known = ", ".join(MESH_SUFFIXES)
        raise DamagedMesh(
            f"{shown(str(path))} has no suffix of a mesh that is read here ({known}); convert it to one of them"
        )
    return MeshFile(str(path), up=up).load()


def _content(path: str, where: str) -> bytes:
    try:
        if os.path.getsize(path) > LARGEST_FILE:
            raise DamagedMesh(f"{where} is larger than {LARGEST_FILE >> 30} GB; export a simpler mesh")
        return Path(path).read_bytes()
    except OSError as error:
        raise DamagedMesh(f"{where} cannot be read: {error.strerror}") from error
    except ValueError as error:  # a name with a NUL character
        raise DamagedMesh(f"{where} cannot be read: {error}") from error


def within(name: str, where: str) -> str:
    """Returns a relative path inside the folder of a mesh file, with slashes.

    Raises:
        DamagedMesh: if the path leaves the folder, or is an address.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in name:
        raise DamagedMesh(f"{where} is outside of its folder; put both into one folder, or export as .glb")
    return str(path)


def stamp_of(status: os.stat_result) -> str:
    """Returns the state of a file as text: its size, and when its content and its entry in the file system last changed.

    Captures of a file in another state are not used.
    """
    return f"{status.st_size}-{status.st_mtime_ns}-{status.st_ctime_ns}"


@dataclass(frozen=True)
class Unreadable:
    """A mesh file that cannot be read, such as a link to a file that does not exist."""

    path: str
    reason: str
    stamp: str = ""

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        raise DamagedMesh(f"{shown(self.path)} {self.reason}")
