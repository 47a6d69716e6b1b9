"""3MF: the triangles of all items to build, with their transforms, z up. Colours, materials and supports are ignored."""

from __future__ import annotations

import io
import zipfile
from collections import deque
from typing import Any
from xml.etree import ElementTree

import numpy as np

from data_pipeline.errors import Damage
from data_pipeline.objects.formats.polygons import merged

_CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
_PATH = "{http://schemas.microsoft.com/3dmanufacturing/production/2015/06}path"

MOST_COPIES = 100_000
"""Largest number of uses of objects that a file may unfold to."""

LARGEST = 1 << 28
"""Largest unpacked size of the model in bytes."""

MOST_TRIANGLES = 50_000_000
"""Largest number of triangles that all copies in a file may have together."""


def parse_3mf(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads the items of a 3MF file that are to be built."""
    root = ElementTree.fromstring(_model(content))
    objects = {entry.get("id"): entry for entry in root.iter(f"{_CORE}object")}
    todo: deque[tuple[Any, np.ndarray, tuple[str, ...]]] = deque(
        (item, np.eye(4), ()) for item in root.iter(f"{_CORE}item")
    )
    read: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    unfolded = 0
    while todo:
        use, parent, above = todo.popleft()
        if use.get(_PATH):
            raise Damage("keeps parts in other files of its archive, which is not read; export it as .stl")
        name = use.get("objectid")
        if name in above or len(above) > 50 or len(parts) >= MOST_COPIES or len(todo) > MOST_COPIES:
            raise Damage("has an object within itself, or too many copies; export it again")
        entry, place = objects[name], parent @ _matrix(use.get("transform"))
        if name not in read:
            mesh = entry.find(f"{_CORE}mesh")
            read[name] = _mesh(mesh) if mesh is not None else merged([])
        vertices, triangles = read[name]
        unfolded += len(triangles)
        if unfolded > MOST_TRIANGLES:
            raise Damage(f"unfolds to more than {MOST_TRIANGLES:,} triangles; export a simpler mesh")
        parts.append((vertices @ place[:3, :3].T + place[:3, 3], triangles))
        todo += [(part, place, (*above, name)) for part in entry.iter(f"{_CORE}component")]
    return merged(parts)


def _model(content: bytes) -> bytes:
    """Returns the document of the model in the archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = {name.lstrip("/").lower(): name for name in archive.namelist()}
        model = names.get("3d/3dmodel.model") or min(name for name in names.values() if name.lower().endswith(".model"))
        if archive.getinfo(model).file_size > LARGEST:
            raise Damage(f"unpacks to more than {LARGEST >> 20} MB; export a simpler mesh")
        text = archive.read(model)
    if b"<!ENTITY" in text:
        raise Damage("defines XML entities, which are not read; export it again")
    return text


def _mesh(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    vertices = [[float(vertex.get(axis)) for axis in "xyz"] for vertex in mesh.iter(f"{_CORE}vertex")]
    triangles = [
        [int(triangle.get(corner)) for corner in ("v1", "v2", "v3")] for triangle in mesh.iter(f"{_CORE}triangle")
    ]
    found = np.array(triangles, np.int64).reshape(-1, 3)
    if len(found) and (found.min() < 0 or found.max() >= len(vertices)):
        raise ValueError("a triangle names a vertex that does not exist")
    return np.array(vertices, np.float64).reshape(-1, 3), found


def _matrix(text: str | None) -> np.ndarray:
    """Returns the transform (4, 4) of a build item or component, which 3MF writes as four rows of three for row vectors."""
    if text is None:
        return np.eye(4)
    rows = np.array([float(word) for word in text.split()]).reshape(4, 3)
    found = np.eye(4)
    found[:3, :] = rows.T
    return found
