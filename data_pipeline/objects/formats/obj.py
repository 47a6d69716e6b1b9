"""Wavefront OBJ: vertices and polygons. Lines, points, curves, normals, texture coordinates and materials are ignored."""

from __future__ import annotations

import re

import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.formats.polygons import triangulate
from data_pipeline.objects.formats.text import COMMENT, columns, integers, text_of

_VERTEX = re.compile(r"^[ \t]*v[ \t]+(.*)$", re.MULTILINE)
_FACE = re.compile(r"^[ \t]*fo?[ \t]+(.*)$", re.MULTILINE)
_OTHER_CORNERS = re.compile(r"/\S*")
"""The indices of texture coordinates and normals after the index of a corner's vertex."""


def parse_obj(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3) and triangles (m, 3) of an OBJ file, all its groups and objects together.

    Raises:
        DamagedMesh: if the file is not an OBJ mesh, or ends within a face.
    """
    text = text_of(content, "an OBJ", where)
    if "#" in text:
        text = COMMENT.sub("", text)
    if "\\" in text:
        text = re.sub(r"\\[ \t]*\n", " ", text)  # a statement may go on in the next line
    vertex_lines, face_lines = _VERTEX.findall(text), _FACE.findall(text)
    if not vertex_lines:
        raise DamagedMesh(f"{where} is not a readable .obj mesh (it has no vertices); repair it or take it away")
    try:
        vertices = columns(vertex_lines, 3)
        joined = "\n".join(face_lines)
        corners = integers(_OTHER_CORNERS.sub("", joined) if "/" in joined else joined)
    except ValueError as error:
        raise DamagedMesh(f"{where} is not a readable .obj mesh: {error}; repair it or take it away") from error
    counts = np.array([len(line.split()) for line in face_lines], np.int64)
    if counts.sum() != len(corners):  # such as `- 6`, or a corner without a vertex
        raise DamagedMesh(f"{where} has a face whose corners are not whole numbers; repair it or take it away")
    if len(counts) and counts[-1] < 3 and _FACE.findall(text[text.rstrip().rfind("\n") + 1 :]):
        raise DamagedMesh(f"{where} is cut short: its last face has {counts[-1]} corners; fetch or export it again")
    if (corners == 0).any():
        raise DamagedMesh(f"{where} has a face that names vertex 0, but OBJ counts from 1; repair it or take it away")
    if (corners < 0).any():  # −1 is the vertex that was given last before the face
        given = np.searchsorted(_positions(_VERTEX, text), _positions(_FACE, text))
        corners = np.where(corners < 0, np.repeat(given, counts) + corners, corners - 1)
    else:
        corners = corners - 1
    return vertices, triangulate(vertices, corners, counts, where)


def _positions(pattern: re.Pattern[str], text: str) -> np.ndarray:
    return np.array([found.start() for found in pattern.finditer(text)], np.int64)
