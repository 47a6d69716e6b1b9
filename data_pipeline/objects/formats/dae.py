"""COLLADA (.dae), read by pycollada: the polygons of the scene with all transforms, and the axis that the file declares as up."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from data_pipeline.errors import DamagedMesh, DataError, kind_and_reason_of
from data_pipeline.objects.formats.polygons import triangulate

MOST_CORNERS, MOST_COPIES = 50_000_000, 10_000
"""Largest numbers of corners of polygons and of meshes in a scene, all copies counted. A small file can declare any number."""


def parse_dae(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Returns the vertices (n, 3), triangles (m, 3) and the axis that is up (`x`, `y` or `z`) of a COLLADA file.

    Lines, materials and animations are ignored; controllers (skins) are read in their bind pose. Units are the file's.

    Raises:
        DamagedMesh: if the file is not a readable COLLADA mesh.
    """
    try:
        with np.errstate(all="ignore"):  # numbers that are not finite are refused by the normalisation
            return _parse(content, where)
    except DataError:
        raise
    except Exception as error:  # pycollada raises exceptions of many kinds
        reason = kind_and_reason_of(error)
        raise DamagedMesh(f"{where} is not a readable .dae mesh ({reason}); repair it or take it away") from error


def _primitives(document: Any) -> Iterator[Any]:
    """Returns the primitives of the scene, in the world's frame; those of all geometries if there is no scene."""
    if document.scene is None:
        for geometry in document.geometries:
            yield from geometry.primitives
        return
    for kind in ("geometry", "controller"):
        for thing in document.scene.objects(kind):
            yield from thing.primitives()


def _parse(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray, str]:
    import collada
    from collada.common import DaeUnsupportedError

    if b"<!ENTITY" in content:
        raise DamagedMesh(f"{where} defines XML entities, which are not read; export it again")
    document = collada.Collada(io.BytesIO(content), ignore=[DaeUnsupportedError])
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    corners = first = 0
    for number, primitive in enumerate(_primitives(document)):
        if number >= MOST_COPIES:
            raise DamagedMesh(f"{where} unfolds to more than {MOST_COPIES:,} meshes; export a simpler mesh")
        primitive = getattr(primitive, "primitive", primitive)  # of a skin
        if isinstance(primitive, collada.lineset.LineSet | collada.lineset.BoundLineSet):
            continue
        if primitive.vertex is None or primitive.vertex_index is None:
            continue
        vertices = np.asarray(primitive.vertex, np.float64).reshape(-1, 3)
        indices = np.asarray(primitive.vertex_index, np.int64)
        corners += indices.size
        if corners > MOST_CORNERS:
            raise DamagedMesh(f"{where} unfolds to more than {MOST_CORNERS:,} corners; export a simpler mesh")
        if indices.ndim == 2:  # triangles
            counts = np.full(len(indices), indices.shape[1])
        else:
            counts = np.diff(np.asarray(primitive.polyindex, np.int64).reshape(-1, 2), axis=1)[:, 0]
        triangles = triangulate(vertices, indices.reshape(-1), counts, where)
        parts.append((vertices, triangles + first))
        first += len(vertices)
    up = {"X_UP": "x", "Z_UP": "z"}.get(str(document.assetInfo.upaxis), "y")
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), up
    return (
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([triangles for _, triangles in parts]),
        up,
    )
