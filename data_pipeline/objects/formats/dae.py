"""COLLADA (.dae), read by pycollada: the polygons of the scene with all transforms, and the axis that the file declares as up."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from data_pipeline.errors import Damage
from data_pipeline.objects.formats.polygons import merged, triangulate

MOST_CORNERS, MOST_COPIES = 50_000_000, 10_000
"""Largest numbers of corners of polygons and of meshes in a scene, all copies counted. A small file can declare any number."""


def _primitives(document: Any) -> Iterator[Any]:
    """Returns the primitives of the scene, in the world's frame; those of all geometries if there is no scene."""
    if document.scene is None:
        for geometry in document.geometries:
            yield from geometry.primitives
        return
    for kind in ("geometry", "controller"):
        for thing in document.scene.objects(kind):
            yield from thing.primitives()


def parse_dae(content: bytes) -> tuple[np.ndarray, np.ndarray, str]:
    """Reads a COLLADA file; also returns the axis that is up (`x`, `y` or `z`).

    Lines, materials and animations are ignored; controllers (skins) are read in their bind pose. Units are the file's.
    """
    import collada
    from collada.common import DaeUnsupportedError

    if b"<!ENTITY" in content:
        raise Damage("defines XML entities, which are not read; export it again")
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    corners = 0
    with np.errstate(all="ignore"):  # numbers that are not finite are refused by the normalisation
        document = collada.Collada(io.BytesIO(content), ignore=[DaeUnsupportedError])
        for number, primitive in enumerate(_primitives(document)):
            if number >= MOST_COPIES:
                raise Damage(f"unfolds to more than {MOST_COPIES:,} meshes; export a simpler mesh")
            primitive = getattr(primitive, "primitive", primitive)  # of a skin
            if isinstance(primitive, collada.lineset.LineSet | collada.lineset.BoundLineSet):
                continue
            if primitive.vertex is None or primitive.vertex_index is None:
                continue
            vertices = np.asarray(primitive.vertex, np.float64).reshape(-1, 3)
            indices = np.asarray(primitive.vertex_index, np.int64)
            corners += indices.size
            if corners > MOST_CORNERS:
                raise Damage(f"unfolds to more than {MOST_CORNERS:,} corners; export a simpler mesh")
            if indices.ndim == 2:  # triangles
                counts = np.full(len(indices), indices.shape[1])
            else:
                counts = np.diff(np.asarray(primitive.polyindex, np.int64).reshape(-1, 2), axis=1)[:, 0]
            parts.append((vertices, triangulate(vertices, indices.reshape(-1), counts)))
    return *merged(parts), {"X_UP": "x", "Z_UP": "z"}.get(str(document.assetInfo.upaxis), "y")
