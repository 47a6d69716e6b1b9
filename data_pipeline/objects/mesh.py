"""What an object is: a normalised triangle mesh, the recipe that makes it, and a source that lists many."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from data_pipeline.errors import DamagedMesh, EmptyMesh

SOURCE_SPLITS = ("train", "test")


@dataclass(frozen=True)
class Mesh:
    """Triangles of one normalised object: centred, in the unit sphere, z up.

    Attributes:
        vertices: (n, 3) float32.
        faces: (m, 3) int32.
        extent: (3,) size of the bounding box before normalisation, in the units of the file.
    """

    vertices: np.ndarray
    faces: np.ndarray
    extent: np.ndarray


@runtime_checkable
class Recipe(Protocol):
    """How to make one mesh."""

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n, 3) and triangles (m, 3), as they are."""


@dataclass(frozen=True)
class ObjectEntry:
    """One object of a source: a unique name, its label, `train` or `test`, and how to load it."""

    name: str
    label: int
    split: str
    recipe: Recipe = field(repr=False)


@dataclass(frozen=True)
class ObjectSource:
    """A list of objects, their `name` together, and the names of their classes."""

    name: str
    classes: tuple[str, ...]
    entries: tuple[ObjectEntry, ...]


def normalise(vertices: np.ndarray, faces: np.ndarray, where: str) -> Mesh:
    """Centred on its bounding box and scaled into the unit sphere; only vertices that a face uses count.

    Raises:
        DamagedMesh: coordinates that are not finite, or faces that name vertices that are not there.
        EmptyMesh: no faces, or none with an area.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices).all(axis=1)).sum())
        raise DamagedMesh(
            f"{where} has {bad} vertices that are not finite (NaN or infinite); repair it or take it away"
        )
    if len(faces) == 0 or len(vertices) == 0:
        raise EmptyMesh("mesh has no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise DamagedMesh(f"{where} has faces that name vertices beyond its {len(vertices)}; repair it or take it away")
    used, compact = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], compact.reshape(faces.shape)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centred = vertices - (low + high) / 2
    radius = np.linalg.norm(centred, axis=1).max()
    if radius == 0:
        raise EmptyMesh("mesh is a single point")
    centred /= radius
    corners = centred[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    if area.sum() < 1e-9:
        raise EmptyMesh("mesh has no area: all its faces are degenerate")
    return Mesh(centred.astype(np.float32), faces[area > 0].astype(np.int32), (high - low).astype(np.float32))
