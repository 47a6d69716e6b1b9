"""Recipes of meshes: procedural furniture, a file, a member of a zip archive."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.formats import parse_mesh
from data_pipeline.objects.furniture import furniture


@dataclass(frozen=True)
class FurniturePiece:
    """A piece of furniture10."""

    class_name: str
    seed: int

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        piece = furniture(self.class_name, self.seed)
        return piece.vertices, piece.faces


@dataclass(frozen=True)
class MeshFile:
    """A mesh file on disk."""

    path: str

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        try:
            content = Path(self.path).read_bytes()
        except OSError as error:
            raise DamagedMesh(f"{self.path} cannot be read: {error.strerror}") from error
        return parse_mesh(content, Path(self.path).suffix.lower(), self.path)


@dataclass(frozen=True)
class ZipMember:
    """A mesh file in a zip archive."""

    archive: str
    member: str

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        where = f"{self.member} in {self.archive}"
        try:
            with zipfile.ZipFile(self.archive) as archive:
                content = archive.read(self.member)
        except (OSError, zipfile.BadZipFile, EOFError) as error:
            raise DamagedMesh(f"{where} cannot be unpacked: {error}") from error
        return parse_mesh(content, PurePosixPath(self.member).suffix.lower(), where)
