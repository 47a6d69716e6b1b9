"""OFF, with and without colours, normals and texture coordinates, as text or binary; also as ModelNet's files violate it."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from mevs_jax.errors import Damage, EmptyMesh, cut_short
from mevs_jax.meshes.polygons import triangulate
from mevs_jax.meshes.text import (
    is_filler,
    lines_of,
    number,
    numbers,
    quoted,
    starts_of,
    text_of,
    whole_number,
    without_comments,
)

_HEADER = re.compile(r"(?P<kinds>(?:ST|C|N|4|st|c|n(?=off))*)(?P<dimensions>n)?(?i:OFF)(?P<rest>.*)", re.DOTALL)
"""Kinds: ST texture coordinates, C colours, N normals after the coordinates of a vertex, 4 a fourth, homogeneous coordinate."""


def parse_off(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads OFF, COFF, NOFF, CNOFF, STOFF and combinations.

    Colours, normals and texture coordinates are ignored. A vertex or face may be written over several lines, and a line may hold
    several vertices, but none begins or ends within a line of others: a number too many in one line and one too few in the next
    is an error. Also reads counts on the first line as in ModelNet (`OFF490 518 0`) and comments in any encoding.
    """
    first = content.removeprefix(b"\xef\xbb\xbf")[:64].split(b"\n", 1)[0].split()
    if len(first) > 1 and first[1].upper() == b"BINARY":
        return _parse_binary(content)
    lines = lines_of(without_comments(text_of(content, "an OFF")))
    kinds, rest = _header(lines[0].strip() if lines else "")
    wrong: Exception | None = None
    for vertex_count, face_count, body in _bodies([rest, *lines[1:]]):
        for width in _widths(kinds, body[:vertex_count]):
            try:
                return _read(body, vertex_count, face_count, width, 4 if "4" in kinds else 3)
            except (Damage, ValueError) as error:  # in the first way that the file may be meant
                wrong = wrong or error
    raise wrong or ValueError("its counts are missing")


def _header(line: str) -> tuple[str, str]:
    """Returns the kinds of numbers of a vertex, and what follows them in the first line."""
    header = _HEADER.match(line)
    if header is None:
        raise ValueError("it does not begin with 'OFF'")
    if header["dimensions"]:
        raise Damage("is an nOFF mesh, which may have any number of dimensions; export it as OFF")
    return header["kinds"], header["rest"]


def _bodies(lines: list[str]) -> Iterator[tuple[int, int, list[str]]]:
    """Returns the numbers of vertices and faces, and the lines that follow: with and without a number of edges after them."""
    words, used = lines[0].split(), 1
    while len(words) < 2 and used < min(4, len(lines)):
        words += lines[used].split()
        used += 1
    try:
        counts = [whole_number(word) for word in words[:3]]
    except ValueError:
        counts = []
    if len(counts) < 2 or min(counts[:2]) < 0:
        raise ValueError("its counts are missing")
    after = [" ".join(words[3:])] if len(words) > 3 else []  # the vertices begin in the line of the counts
    yield counts[0], counts[1], [*after, *lines[used:]]
    if len(words) == 2 and used < len(lines) and len(lines[used].split()) == 1:
        yield counts[0], counts[1], lines[used + 1 :]


def _widths(kinds: str, lines: list[str]) -> list[int]:
    """Returns how many numbers a vertex may have: as many as all lines have, if these are alike, or by the kinds."""
    least = 4 if "4" in kinds else 3
    in_lines = {len(line.split()) for line in lines}
    by_kind = least + 3 * ("N" in kinds.upper()) + 2 * ("ST" in kinds.upper())
    widths = [by_kind + 3, by_kind + 4] if "C" in kinds.upper() else [by_kind]
    return list(dict.fromkeys([*(width for width in in_lines if len(in_lines) == 1 and width >= least), *widths]))


def _read(lines: list[str], vertex_count: int, face_count: int, width: int, kept: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices and triangles, if every vertex has `width` numbers, of which the first `kept` are its coordinates."""
    counts = np.array([len(line.split()) for line in lines], np.int64)
    ends = np.cumsum(counts)
    used = int(np.searchsorted(ends, vertex_count * width)) + 1 if vertex_count else 0
    begin, end = starts_of(counts)[:used], ends[:used]
    whole = (begin % width == 0) & (end % width == 0)
    torn = np.flatnonzero(~whole & (begin // width != (end - 1) // width))
    if len(torn):
        at = torn[0] - int(begin[torn[0]] % width > 0)  # the line before has too few
        line = f"the line {quoted(lines[at])} has {counts[at]} numbers instead of {width}"
        raise ValueError(f"{line}, as one of its {vertex_count} vertices")
    if used > len(lines):
        raise cut_short(f"{int(ends[-1]) // width if len(ends) else 0} of {vertex_count} vertices are there")
    if used and end[-1] > vertex_count * width:
        raise ValueError(f"its {vertex_count} vertices end within the line {quoted(lines[used - 1])}")
    vertices = numbers(lines[:used])[0].reshape(-1, width)[:, :kept]
    corners, sizes, after = _faces(lines[used:], face_count)
    if len(sizes) < face_count:
        raise cut_short(f"{len(sizes)} of {face_count} faces are there")
    if used + after < len(lines):
        raise Damage(f"declares {vertex_count} vertices and {face_count} faces, and holds more; export it again")
    if face_count and (sizes < 3).all():
        raise EmptyMesh(f"mesh has no faces: its {face_count} polygons have fewer than three corners")
    vertices = _cartesian(vertices)
    return vertices, triangulate(vertices, corners, sizes)


def _cartesian(points: np.ndarray) -> np.ndarray:
    """Returns points (n, 3) from such, or from homogeneous coordinates (n, 4)."""
    with np.errstate(all="ignore"):
        return points[:, :3] / points[:, 3:] if points.shape[1] == 4 else points


def _faces(lines: list[str], face_count: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Returns the corners of all faces, their number in each, and the number of lines read.

    Colours of one, three or four numbers may follow the corners of a face. There are fewer faces if the last is cut short.
    """
    try:
        values, counts = numbers(lines[:face_count], np.int64)
        if (counts == 4).all() and (values[::4] == 3).all():
            return values.reshape(-1, 4)[:, 1:].reshape(-1), np.full(len(counts), 3), len(counts)
    except ValueError:  # colours may be fractions
        pass
    corners: list[int] = []
    sizes: list[int] = []
    colours: dict[int, str] = {}
    at = 0
    while len(sizes) < face_count and at < len(lines):
        words, first = lines[at].split(), at
        size = whole_number(words[0])
        if size < 0:
            raise ValueError(f"a face has {size} corners")
        at += 1
        while len(words) < size + 1 and at < len(lines):
            words += lines[at].split()
            at += 1
        if len(words) < size + 1:
            break
        colour = [number(word) for word in words[size + 1 :]]
        if len(colour) not in (0, 1, 3, 4) or (colour and (at > first + 1 or size < 3)):
            raise ValueError(f"the face {quoted(lines[first])} has {len(words)} numbers instead of {size + 1}")
        corners += [whole_number(word) for word in words[1 : size + 1]]
        sizes.append(size)
        colours.setdefault(len(colour), lines[first])
    if 1 in colours and len(colours) > 1:  # one number more is a colour only if all faces have one
        raise ValueError(f"the face {quoted(colours[1])} has one number more than its corners, and others have none")
    return np.array(corners, np.int64), np.array(sizes, np.int64), at


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
    with np.errstate(invalid="ignore"):  # NaN, which is refused if a face uses it
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
    if not is_filler(body[4 * (end + at) :]):
        raise Damage(f"declares {vertex_count} vertices and {face_count} faces, and holds more; export it again")
    return vertices, triangulate(vertices, np.array(corners, np.int64), np.array(sizes, np.int64))
