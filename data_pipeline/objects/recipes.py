"""Recipes of meshes: procedural shapes, a file, a file that cannot be read. Members of archives are in `archives`."""

from __future__ import annotations

import hashlib
import os
import re
import urllib.parse
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.mesh import Recipe
from mevs_jax.meshes import Up
from mevs_jax.meshes.reading import content_of_file, read_with, shown

_BUFFER = re.compile(rb'"uri"\s*:\s*"([^"]+\.bin)"', re.IGNORECASE)


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
class FamilyPiece:
    """A piece of furniture10-families: of a family, which belongs to a class and a split."""

    stamp: ClassVar[str] = "1"
    """Raised when the shapes change, so that captures of the old ones are not used."""
    class_name: str
    split: str
    family: str
    seed: int

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        from data_pipeline.objects.furniture.families import family_piece  # imported late: it needs trimesh

        piece = family_piece(self.class_name, self.split, self.family, self.seed)
        return piece.vertices, piece.faces


@dataclass(frozen=True)
class Stranger:
    """A shape of a kind that is none of the ten classes of furniture."""

    stamp: ClassVar[str] = "1"
    """As of `FamilyPiece`."""
    kind: str
    seed: int

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        from data_pipeline.objects.strangers import stranger  # imported late: it needs trimesh

        shape = stranger(self.kind, self.seed)
        return shape.vertices, shape.faces


@dataclass(frozen=True)
class MeshFile:
    """A mesh file on disk, its state when it was found (`stamp_of`), and which of its axes is up."""

    path: str
    stamp: str = ""
    up: Up = "auto"

    @property
    def identity(self) -> str:
        """Hash of the content of the file, and of the buffers that a .gltf names."""
        digest = hashlib.sha256()
        with suppress(OSError, ValueError):  # it is read again, and then refused with a sentence
            with open(self.path, "rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
            if self.path.lower().endswith(".gltf"):
                for uri in _BUFFER.findall(Path(self.path).read_bytes()):
                    beside = Path(self.path).with_name("") / urllib.parse.unquote_to_bytes(uri).decode()
                    digest.update(beside.read_bytes() if beside.is_file() else uri)
        return digest.hexdigest()

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        return read_with(content_of_file, self.path, shown(self.path), self.up)


@dataclass(frozen=True)
class Turned:
    """The mesh of another recipe, turned about the vertical axis by an angle in radians."""

    recipe: Recipe
    angle: float

    @property
    def stamp(self) -> str:
        """The state of the file that it is read from, and the angle."""
        return f"{getattr(self.recipe, 'stamp', '')} turned by {self.angle:.6f}"

    @property
    def identity(self) -> str:
        """As `stamp`, by the file's content."""
        return f"{identity_of(self.recipe)} turned by {self.angle:.6f}"

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        vertices, faces = self.recipe.load()
        x, y, z = np.asarray(vertices, np.float64).reshape(-1, 3).T
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1), faces


def identity_of(recipe: Recipe) -> str:
    """Returns what tells meshes of one name apart: the content of a file, the version of a shape, or nothing."""
    return str(getattr(recipe, "identity", "") or getattr(recipe, "stamp", ""))


def stamp_of(status: os.stat_result) -> str:
    """Returns the state of a file as text: its size, and when its content and its entry in the file system last changed."""
    return f"{status.st_size}-{status.st_mtime_ns}-{status.st_ctime_ns}"


@dataclass(frozen=True)
class Unreadable:
    """A mesh file that cannot be read, such as a link to a file that does not exist."""

    path: str
    reason: str
    stamp: str = ""

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        raise DamagedMesh(f"{shown(self.path)} {self.reason}")
