"""OFF, with and without colours, normals and texture coordinates, as text or binary; also as ModelNet's files violate it."""

from __future__ import annotations

import re

import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.formats.polygons import triangulate
from data_pipeline.objects.formats.text import COMMENT, columns, integers, text_of

_HEADER = re.compile(r"(?P<kinds>(?:ST|C|N|4|st|c|n(?=off))*)(?P<dimensions>n)?(?i:OFF)(?P<rest>.*)", re.DOTALL)
"""Kinds: ST texture coordinates, C colours, N normals after the coordinates of a vertex, 4 a fourth, homogeneous coordinate."""


def parse_off(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3) and triangles (m, 3) of an OFF file.

    Reads OFF, COFF, NOFF, CNOFF, STOFF and combinations; what follows the coordinates of a vertex or the corners of a face is
    ignored. Also reads counts on the first line as in ModelNet (`OFF490 518 0`) and comments in any encoding.

    Raises:
        DamagedMesh: if the file is not an OFF mesh or is truncated.
    """
    first = content.removeprefix(b"\xef\xbb\xbf")[:64].split(b"\n", 1)[0].split()
    if len(first) > 1 and first[1].upper() == b"BINARY":
        return _parse_binary(content, where)
    text = text_of(content, "an OFF", where)
    lines = text.split("\n")
    if "#" in text:
        lines = [COMMENT.sub("", line) if "#" in line else line for line in lines]
    lines = [line for line in lines if line and not line.isspace()]
    header = _HEADER.match(lines[0].strip()) if lines else None
    if header is None:
        raise DamagedMesh(f"{where} is not an OFF mesh: it does not begin with 'OFF'; repair it or take it away")
    if header["dimensions"]:
        raise DamagedMesh(f"{where} is an nOFF mesh, which may have any number of dimensions; export it as OFF")
    lines[0] = header["rest"]
    counts, body = _counts(lines, where)
    vertex_count, face_count = counts
    vertex_lines, face_lines = body[:vertex_count], body[vertex_count : vertex_count + face_count]
    if len(vertex_lines) < vertex_count or (vertex_lines and len(vertex_lines[-1].split()) < 3):
        whole = sum(len(line.split()) >= 3 for line in vertex_lines)
        raise DamagedMesh(
            f"{where} is cut short: {whole} of {vertex_count} vertices are there; fetch or export it again"
        )
    try:
        if "4" in header["kinds"]:
            with np.errstate(all="ignore"):
                points = columns(vertex_lines, 4)
                vertices = points[:, :3] / points[:, 3:]
        else:
            vertices = columns(vertex_lines, 3)
        corners, sizes = _faces(face_lines)
    except ValueError as error:
        raise DamagedMesh(f"{where} is not an OFF mesh: {error}; repair it or take it away") from error
    if len(sizes) < face_count:
        raise DamagedMesh(
            f"{where} is cut short: {len(sizes)} of {face_count} faces are there; fetch or export it again"
        )
    return vertices, triangulate(vertices, corners, sizes, where)


def _counts(lines: list[str], where: str) -> tuple[tuple[int, int], list[str]]:
    """Returns the numbers of vertices and faces, and the lines that follow them; `lines` begin after the header."""
    words, used = lines[0].split(), 1
    while len(words) < 2 and used < min(4, len(lines)):
        words += lines[used].split()
        used += 1
    try:
        vertex_count, face_count = int(words[0]), int(words[1])  # the number of edges is not needed
        if vertex_count < 0 or face_count < 0:
            raise ValueError
    except (IndexError, ValueError) as error:
        raise DamagedMesh(f"{where} is not an OFF mesh: its counts are missing; repair it or take it away") from error
    return (vertex_count, face_count), lines[used:]


def _faces(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners of all faces and their number in each, up to the first face that is cut short.

    Colours may follow the corners of a face.
    """
    try:
        values = integers("\n".join(lines))
        if len(values) == 4 * len(lines) and (values[::4] == 3).all():
            return values.reshape(-1, 4)[:, 1:].reshape(-1), np.full(len(lines), 3)
    except ValueError:  # colours may be fractions or words
        pass
    corners: list[int] = []
    sizes: list[int] = []
    for line in lines:
        words = line.split()
        size = int(words[0])
        if size < 0:
            raise ValueError(f"a face has {size} corners")
        if len(words) < size + 1:
            break
        corners += [int(word) for word in words[1 : size + 1]]
        sizes.append(size)
    return np.array(corners, object).clip(-1, 2**62).astype(np.int64), np.array(sizes, np.int64)


def _parse_binary(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Reads Geomview's binary variant: big-endian int32 and float32 after the first line."""
    first, _, body = content.partition(b"\n")
    header = _HEADER.match(first.split()[0].decode("latin-1"))
    if header is None or header["dimensions"]:
        raise DamagedMesh(f"{where} is not an OFF mesh: it does not begin with 'OFF'; repair it or take it away")
    kinds = header["kinds"].upper()
    width = 4 if "4" in kinds else 3
    stride = width + 3 * ("N" in kinds) + 4 * ("C" in kinds) + 2 * ("ST" in kinds)
    cut = f"{where} is cut short: its counts are not all there; fetch or export it again"
    if len(body) < 12:
        raise DamagedMesh(cut)
    vertex_count, face_count = (int(count) for count in np.frombuffer(body, ">i4", 2))
    words = np.frombuffer(body, ">i4", len(body) // 4)
    end = 3 + vertex_count * stride
    if min(vertex_count, face_count) < 0 or end > len(words):
        raise DamagedMesh(cut)
    points = words[3:end].view(">f4").reshape(-1, stride)[:, :width].astype(np.float64)
    with np.errstate(all="ignore"):
        vertices = points[:, :3] / points[:, 3:] if width == 4 else points
    corners: list[int] = []
    sizes: list[int] = []
    numbers, at = words[end:].tolist(), 0
    while len(sizes) < face_count:
        size = numbers[at] if at < len(numbers) else -1
        after = at + 1 + size
        if size < 0 or after >= len(numbers) or numbers[after] < 0 or after + numbers[after] >= len(numbers):
            raise DamagedMesh(
                f"{where} is cut short: {len(sizes)} of {face_count} faces are there; fetch or export it again"
            )
        corners += numbers[at + 1 : after]
        sizes.append(size)
        at = after + 1 + numbers[after]  # the number of colour components, and they
    return vertices, triangulate(vertices, np.array(corners, np.int64), np.array(sizes, np.int64), where)
