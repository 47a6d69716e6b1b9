"""Objects: a normalised triangle mesh, the recipe that makes it, and a source that lists many objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from mevs_jax.meshes.reading import surface_of

MODELNET10_CLASSES = ("bathtub", "bed", "chair", "desk", "dresser", "monitor", "night_stand", "sofa", "table", "toilet")
"""The classes of ModelNet10 and of furniture10, in alphabetical order, which is the order of labels."""
UNKNOWN_OBJECT = "unknown object"
"""The class of objects that belong to no other class. Equal to that of `mevs_jax.trained.description`, which imports JAX."""
SOURCE_SPLITS = ("train", "test")


@dataclass(frozen=True)
class Mesh:
    """One normalised object as triangles: centred, in the unit sphere, z up.

    Attributes:
        vertices: (n, 3) float32.
        faces: (m, 3) int32.
        extent: (3,) float32, size of the bounding box before normalisation, in the units of the file.
        radius: distance of the furthest vertex from the centre before normalisation, in the units of the file; NaN if unknown.
    """

    vertices: np.ndarray
    faces: np.ndarray
    extent: np.ndarray
    radius: float = np.nan


@runtime_checkable
class Recipe(Protocol):
    """Makes one mesh. Recipes are small and picklable, so that worker processes receive them instead of meshes."""

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns vertices (n, 3) and triangles (m, 3), not normalised."""


@dataclass(frozen=True)
class ObjectEntry:
    """One object of a source: a unique name, its label, its split (`train`, `val` or `test`), and its recipe."""

    name: str
    label: int
    split: str
    recipe: Recipe = field(repr=False)


@dataclass(frozen=True)
class ObjectSource:
    """A list of objects.

    Attributes:
        classes: names of the classes, in the order of the labels.
        left_out: files left out when the source was listed, by split and name, with the reasons. Files without a split are under
            `other`.
        notes: sentences on how files were read, for the summary of the data set.
        said: sentences on files ignored by rule, only shown.
    """

    name: str
    classes: tuple[str, ...]
    entries: tuple[ObjectEntry, ...]
    left_out: dict[str, dict[str, str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    said: tuple[str, ...] = ()


def normalise(vertices: np.ndarray, faces: np.ndarray, where: str) -> Mesh:
    """Returns the mesh centred on its bounding box and scaled into the unit sphere.

    Vertices that no face uses and faces without area are removed before. `where` names the mesh in error messages.

    Raises:
        DamagedMesh, EmptyMesh: as `surface_of`.
    """
    vertices, faces = surface_of(vertices, faces, where)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centred = vertices - (low + high) / 2
    radius = np.linalg.norm(centred, axis=1).max()
    extent = (high - low).astype(np.float32)
    return Mesh((centred / radius).astype(np.float32), faces.astype(np.int32), extent, float(radius))
