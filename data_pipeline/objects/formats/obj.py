"""Wavefront OBJ: vertices and polygons. Lines, points, curves, normals, texture coordinates and materials are ignored."""

from __future__ import annotations

import re

import numpy as np

from data_pipeline.errors import Damage, cut_short
from data_pipeline.objects.formats.polygons import triangulate
from data_pipeline.objects.formats.text import columns, numbers, text_of, without_comments

_VERTEX = re.compile(r"^[ \t]*v[ \t]+(.*)$", re.MULTILINE)
_FACE = re.compile(r"^[ \t]*fo?[ \t]+(.*)$", re.MULTILINE)
_OTHER_CORNERS = re.compile(r"/\S*")
"""The indices of texture coordinates and normals after the index of a corner's vertex."""


def parse_obj(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads all groups and objects of an OBJ file together."""
    text = without_comments(text_of(content, "an OBJ"))
    if "\\" in text:
        text = re.sub(r"\\[ \t]*\n", " ", text)  # a statement may go on in the next line
    vertex_lines, face_lines = _VERTEX.findall(text), _FACE.findall(text)
    if not vertex_lines:
        raise Damage("is not a readable .obj mesh (it has no vertices); repair it or take it away")
    vertices = columns(vertex_lines, 3)
    joined = "\n".join(face_lines)
    corners = numbers(_OTHER_CORNERS.sub("", joined) if "/" in joined else joined, np.int64)
    counts = np.array([len(line.split()) for line in face_lines], np.int64)
    if counts.sum() != len(corners):  # such as `- 6`, or a corner without a vertex
        raise Damage("has a face whose corners are not whole numbers; repair it or take it away")
    if len(counts) and counts[-1] < 3 and _FACE.findall(text[text.rstrip().rfind("\n") + 1 :]):
        raise cut_short(f"its last face has {counts[-1]} corners")
    if (corners == 0).any():
        raise Damage("has a face that names vertex 0, but OBJ counts from 1; repair it or take it away")
    if (corners < 0).any():  # −1 is the vertex that was given last before the face
        given = np.searchsorted(_positions(_VERTEX, text), _positions(_FACE, text))
        corners = np.where(corners < 0, np.repeat(given, counts) + corners, corners - 1)
    else:
        corners = corners - 1
    return vertices, triangulate(vertices, corners, counts)


def _positions(pattern: re.Pattern[str], text: str) -> np.ndarray:
    return np.array([found.start() for found in pattern.finditer(text)], np.int64)
