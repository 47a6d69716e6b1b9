"""3MF: the triangles of all items to build, with their transforms, z up. Colours, materials and supports are ignored."""

from __future__ import annotations

import io
import zipfile
from collections import deque
from typing import Any
from xml.etree import ElementTree

import numpy as np

from data_pipeline.errors import DamagedMesh, DataError, kind_and_reason_of

_CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
_PATH = "{http://schemas.microsoft.com/3dmanufacturing/production/2015/06}path"

MOST_COPIES = 100_000
"""Largest number of uses of objects that a file may unfold to."""

LARGEST = 1 << 28
"""Largest unpacked size of the model in bytes."""

MOST_TRIANGLES = 50_000_000
"""Largest number of triangles that all copies in a file may have together."""


def parse_3mf(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3) and triangles (m, 3) of a 3MF file.

    Raises:
        DamagedMesh: if the file is not a readable 3MF mesh.
    """
    try:
        return _parse(content, where)
    except DataError:
        raise
    except Exception as error:  # zip streams and XML fail in many ways
        reason = kind_and_reason_of(error)
        raise DamagedMesh(f"{where} is not a readable .3mf mesh ({reason}); repair it or take it away") from error


def _parse(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = {name.lstrip("/").lower(): name for name in archive.namelist()}
        model = names.get("3d/3dmodel.model") or min(name for name in names.values() if name.lower().endswith(".model"))
        if archive.getinfo(model).file_size > LARGEST:
            raise DamagedMesh(f"{where} unpacks to more than {LARGEST >> 20} MB; export a simpler mesh")
        text = archive.read(model)
    if b"<!ENTITY" in text:
        raise DamagedMesh(f"{where} defines XML entities, which are not read; export it again")
    root = ElementTree.fromstring(text)
    objects = {entry.get("id"): entry for entry in root.iter(f"{_CORE}object")}
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    total = unfolded = first = 0
    todo: deque[tuple[Any, np.ndarray, tuple[str, ...]]] = deque(
        (item, np.eye(4), ()) for item in root.iter(f"{_CORE}item")
    )
    read: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    while todo:
        use, parent, above = todo.popleft()
        if use.get(_PATH):
            raise DamagedMesh(
                f"{where} keeps parts in other files of its archive, which is not read; export it as .stl"
            )
        name = use.get("objectid")
        total += 1
        if name in above or len(above) > 50 or total > MOST_COPIES or len(todo) > MOST_COPIES:
            raise DamagedMesh(f"{where} has an object within itself, or too many copies; export it again")
        entry, place = objects[name], parent @ _matrix(use.get("transform"))
        if name not in read:
            mesh = entry.find(f"{_CORE}mesh")
            read[name] = _mesh(mesh) if mesh is not None else (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
        vertices, triangles = read[name]
        unfolded += len(triangles)
        if unfolded > MOST_TRIANGLES:
            raise DamagedMesh(f"{where} unfolds to more than {MOST_TRIANGLES:,} triangles; export a simpler mesh")
        parts.append((vertices @ place[:3, :3].T + place[:3, 3], triangles + first))
        first += len(vertices)
        todo += [(part, place, (*above, name)) for part in entry.iter(f"{_CORE}component")]
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate([triangles for _, triangles in parts])


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
