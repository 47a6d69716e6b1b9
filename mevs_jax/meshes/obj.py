"""Wavefront OBJ: vertices and polygons. Lines, points, curves, normals, texture coordinates and materials are ignored."""

from __future__ import annotations

import re

import numpy as np

from mevs_jax.errors import Damage, EmptyMesh, cut_short
from mevs_jax.meshes.polygons import triangulate
from mevs_jax.meshes.text import WHOLE, columns, numbers, quoted, text_of, without_comments

_VERTEX = re.compile(r"^[^\S\n]*v(?:[^\S\n]+(.*))?$", re.MULTILINE)
_FACE = re.compile(r"^[^\S\n]*fo?(?:[^\S\n]+(.*))?$", re.MULTILINE)
_LINE = re.compile(r"^[^\S\n]*[lL][^\S\n]", re.MULTILINE)
_SWALLOWED = re.compile(r"\\[ \t]*\n([^\S\n]*(?:v|fo?)[^\S\n].*)")
"""A vertex or face after a line that ends with a backslash, as the name of a file may."""

_OTHERS = (
    "vt vn vp l p g o s mg usemtl mtllib usemap maplib cstype deg bmat step curv curv2 parm trim hole scrv sp end con bevel "
    "c_interp d_interp lod shadow_obj trace_obj ctech stech"
)
_UNKNOWN = re.compile(
    rf"^[^\S\n]*(?!(?:v|fo?|(?i:{'|'.join(_OTHERS.split())}))(?!\S))\S.*$",
    re.MULTILINE,
)
"""A line that is neither geometry nor one of the statements that are ignored. Surfaces and other files (`surf`, `call`) are
geometry that is not read."""

_SLASHES = {"/", "//"}
_NO_VERTEX, _HALF = re.compile(r"(?<!\S)/"), re.compile(r"(?<!\S)/|/(?!\S)")
_OTHER_CORNERS = re.compile(r"/\S*")
"""The indices of texture coordinates and normals after the index of a corner's vertex."""


def parse_obj(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads all groups and objects of an OBJ file together."""
    text = without_comments(text_of(content, "an OBJ"))
    if "\\" in text:
        if (swallowed := _SWALLOWED.search(text)) is not None:
            raise Damage(f"has a line that goes on with {quoted(swallowed[1])}; take away the backslash before it")
        text = re.sub(r"\\[ \t]*\n", " ", text)  # a statement may go on in the next line
    vertex_lines, face_lines = _VERTEX.findall(text), _FACE.findall(text)
    if (unknown := _UNKNOWN.search(text)) is not None:
        raise Damage(f"has the line {quoted(unknown[0])}, which is not read; repair the line or take it away")
    if not vertex_lines:
        raise Damage("is not a readable .obj mesh (it has no vertices); repair it or take it away")
    vertices = _vertices(vertex_lines)
    corners, counts = _corners(face_lines)
    if len(counts) and counts[-1] < 3 and _FACE.findall(text[text.rstrip().rfind("\n") + 1 :]):
        raise cut_short(f"its last face has {counts[-1]} corners")
    if (counts < 3).any():
        line = face_lines[np.flatnonzero(counts < 3)[0]]
        raise Damage(f"has the face {quoted(line)} of fewer than three corners; repair it or take it away")
    if not len(counts) and (lines := len(_LINE.findall(text))):
        raise EmptyMesh(f"mesh has no faces: it has {lines} lines")
    if (corners == 0).any():
        raise Damage("has a face that names vertex 0, but OBJ counts from 1; repair it or take it away")
    if (corners < 0).any():  # −1 is the vertex that was given last before the face
        given = np.searchsorted(_positions(_VERTEX, text), _positions(_FACE, text))
        corners = np.where(corners < 0, np.repeat(given, counts) + corners, corners - 1)
    else:
        corners = corners - 1
    return vertices, triangulate(vertices, corners, counts)


def _vertices(lines: list[str]) -> np.ndarray:
    """Returns the coordinates, (n, 3). A weight, or a colour of three or four numbers, may follow them."""
    vertices = columns(lines, 3, 4, 6, 7)
    longer = [line for line in lines if len(line.split()) == 4]
    if 0 < len(longer) < len(lines):  # a number that belongs to another line would be the first of these
        weights = columns(longer, 4)[:, 3]
        if (weights != 1).any():
            line = longer[np.flatnonzero(weights != 1)[0]]
            raise ValueError(f"the line {quoted(line)} has 4 numbers and others have 3")
    return vertices


def _corners(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the indices of the vertices of all faces, and their number in each."""
    counts = np.array([len(line.split()) for line in lines], np.int64)
    joined = "\n".join(lines)
    if "/" in joined:
        _check_alike(lines, joined)
    try:
        corners, _ = numbers(_OTHER_CORNERS.sub("", joined).split("\n") if "/" in joined else lines, np.int64)
    except ValueError as error:
        raise Damage(f"has a face whose corners are not whole numbers ({error}); repair it or take it away") from error
    return corners, counts


def _check_alike(lines: list[str], joined: str) -> None:
    """Raises `Damage` if a corner is no indices with slashes between them, or might be half of one, as in `1/ 2`."""
    if _HALF.search(joined) is None and _SLASHES.issuperset(WHOLE.sub("", joined).split()):
        return
    for line in lines:
        halves = len(_HALF.findall(line))
        apart = halves and (halves != len(line.split()) or _NO_VERTEX.search(line))
        if apart or not _SLASHES.issuperset(WHOLE.sub("", line).split()):
            raise Damage(f"has the face {quoted(line)}, whose corners are not written alike; repair it or take it away")


def _positions(pattern: re.Pattern[str], text: str) -> np.ndarray:
    return np.array([found.start() for found in pattern.finditer(text)], np.int64)
