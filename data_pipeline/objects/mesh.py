"""Objects: a normalised triangle mesh, the recipe that makes it, and a source that lists many objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from data_pipeline.errors import DamagedMesh, EmptyMesh

SOURCE_SPLITS = ("train", "test")


@dataclass(frozen=True)
class Mesh:
    """One normalised object as triangles: centred, in the unit sphere, z up.

    Attributes:
        vertices: (n, 3) float32.
        faces: (m, 3) int32.
        extent: (3,) float32, size of the bounding box before normalisation, in the units of the file.
    """

    vertices: np.ndarray
    faces: np.ndarray
    extent: np.ndarray


@runtime_checkable
class Recipe(Protocol):
    """Makes one mesh. Recipes are small and picklable, so that worker processes receive them instead of meshes."""

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns vertices (n, 3) and triangles (m, 3), not normalised."""


@dataclass(frozen=True)
class ObjectEntry:
    """One object of a source: a unique name, its label, its split (`train` or `test`), and its recipe."""

    name: str
    label: int
    split: str
    recipe: Recipe = field(repr=False)


@dataclass(frozen=True)
class ObjectSource:
    """A list of objects with the name of the source and the names of the classes, in the order of the labels."""

    name: str
    classes: tuple[str, ...]
    entries: tuple[ObjectEntry, ...]


def normalise(vertices: np.ndarray, faces: np.ndarray, where: str) -> Mesh:
    """Returns the mesh centred on its bounding box and scaled into the unit sphere.

    Vertices that no face uses and faces without area are removed. `where` names the mesh in error messages.

    Raises:
        DamagedMesh: if a coordinate is not finite, or a face refers to a vertex that does not exist.
        EmptyMesh: if there are no faces, or none has an area.
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
