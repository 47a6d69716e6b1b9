"""OFF, with and without colours, normals and texture coordinates, as text or binary; also as ModelNet's files violate it."""

from __future__ import annotations

import re

import numpy as np

from data_pipeline.errors import Damage, cut_short
from data_pipeline.objects.formats.polygons import triangulate
from data_pipeline.objects.formats.text import columns, numbers, text_of, whole_numbers, without_comments

_HEADER = re.compile(r"(?P<kinds>(?:ST|C|N|4|st|c|n(?=off))*)(?P<dimensions>n)?(?i:OFF)(?P<rest>.*)", re.DOTALL)
"""Kinds: ST texture coordinates, C colours, N normals after the coordinates of a vertex, 4 a fourth, homogeneous coordinate."""


def parse_off(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads OFF, COFF, NOFF, CNOFF, STOFF and combinations.

    What follows the coordinates of a vertex or the corners of a face is ignored. Also reads counts on the first line as in
    ModelNet (`OFF490 518 0`) and comments in any encoding.
    """
    first = content.removeprefix(b"\xef\xbb\xbf")[:64].split(b"\n", 1)[0].split()
    if len(first) > 1 and first[1].upper() == b"BINARY":
        return _parse_binary(content)
    lines = without_comments(text_of(content, "an OFF")).split("\n")
    lines = [line for line in lines if line and not line.isspace()]
    kinds, rest = _header(lines[0].strip() if lines else "")
    (vertex_count, face_count), body = _counts([rest, *lines[1:]])
    vertex_lines, face_lines = body[:vertex_count], body[vertex_count : vertex_count + face_count]
    if len(vertex_lines) < vertex_count or (vertex_lines and len(vertex_lines[-1].split()) < 3):
        whole = sum(len(line.split()) >= 3 for line in vertex_lines)
        raise cut_short(f"{whole} of {vertex_count} vertices are there")
    vertices = _cartesian(columns(vertex_lines, 4 if "4" in kinds else 3))
    corners, sizes = _faces(face_lines)
    if len(sizes) < face_count:
        raise cut_short(f"{len(sizes)} of {face_count} faces are there")
    return vertices, triangulate(vertices, corners, sizes)


def _header(line: str) -> tuple[str, str]:
    """Returns the kinds of numbers of a vertex, and what follows them in the first line."""
    header = _HEADER.match(line)
    if header is None:
        raise ValueError("it does not begin with 'OFF'")
    if header["dimensions"]:
        raise Damage("is an nOFF mesh, which may have any number of dimensions; export it as OFF")
    return header["kinds"], header["rest"]


def _cartesian(points: np.ndarray) -> np.ndarray:
    """Returns points (n, 3) from such, or from homogeneous coordinates (n, 4)."""
    with np.errstate(all="ignore"):
        return points[:, :3] / points[:, 3:] if points.shape[1] == 4 else points


def _counts(lines: list[str]) -> tuple[tuple[int, int], list[str]]:
    """Returns the numbers of vertices and faces, and the lines that follow them; `lines` begin after the header."""
    words, used = lines[0].split(), 1
    while len(words) < 2 and used < min(4, len(lines)):
        words += lines[used].split()
        used += 1
    try:
        counts = int(words[0]), int(words[1])  # the number of edges is not needed
    except (IndexError, ValueError):
        counts = -1, -1
    if min(counts) < 0:
        raise ValueError("its counts are missing")
    return counts, lines[used:]


def _faces(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners of all faces and their number in each, up to the first face that is cut short.

    Colours may follow the corners of a face.
    """
    try:
        values = numbers("\n".join(lines), np.int64)
        if len(values) == 4 * len(lines) and (values[::4] == 3).all():
            return values.reshape(-1, 4)[:, 1:].reshape(-1), np.full(len(lines), 3)
    except ValueError:  # colours may be fractions or words
        pass
    corners: list[str] = []
    sizes: list[int] = []
    for line in lines:
        words = line.split()
        size = int(words[0])
        if size < 0:
            raise ValueError(f"a face has {size} corners")
        if len(words) < size + 1:
            break
        corners += words[1 : size + 1]
        sizes.append(size)
    return whole_numbers(corners), np.array(sizes, np.int64)


def _parse_binary(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads Geomview's binary variant: big-endian int32 and float32 after the first line."""
    first, _, body = content.partition(b"\n")
    kinds = _header(first.split()[0].decode("latin-1"))[0].upper()
    width = 4 if "4" in kinds else 3
    stride = width + 3 * ("N" in kinds) + 4 * ("C" in kinds) + 2 * ("ST" in kinds)
    words = np.frombuffer(body, ">i4", len(body) // 4)
    vertex_count, face_count = words[:2].tolist() if len(words) > 2 else (-1, -1)
    end = 3 + vertex_count * stride
    if min(vertex_count, face_count) < 0 or end > len(words):
        raise cut_short("its counts are not all there")
    vertices = _cartesian(words[3:end].view(">f4").reshape(-1, stride)[:, :width].astype(np.float64))
    corners: list[int] = []
    sizes: list[int] = []
    values, at = words[end:].tolist(), 0
    while len(sizes) < face_count:
        size = values[at] if at < len(values) else -1
        after = at + 1 + size
        if size < 0 or after >= len(values) or values[after] < 0 or after + values[after] >= len(values):
            raise cut_short(f"{len(sizes)} of {face_count} faces are there")
        corners += values[at + 1 : after]
        sizes.append(size)
        at = after + 1 + values[after]  # the number of colour components, and they
    return vertices, triangulate(vertices, np.array(corners, np.int64), np.array(sizes, np.int64))
