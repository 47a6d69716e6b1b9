"""STL, binary and text; all solids of a file together. Colours and normals are ignored."""

from __future__ import annotations

import codecs
import re

import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.formats.text import columns, text_of

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_CORNER = re.compile(r"^[ \t]*vertex[ \t]+(.*)", re.IGNORECASE | re.MULTILINE)


def parse_stl(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (3 m, 3) and triangles (m, 3) of an STL file.

    Raises:
        DamagedMesh: if the file is not an STL mesh, or its length differs from what it declares.
    """
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    if count >= 0 and len(content) == 84 + 50 * count:  # also if the text of the header begins with "solid"
        return _parse_binary(content, count)
    begin = content[:512].removeprefix(codecs.BOM_UTF8).lstrip().lower()
    if begin.startswith(b"solid") and re.search(rb"facet|end ?solid", content, re.IGNORECASE):
        return _parse_text(content, where)
    if count < 0:
        raise DamagedMesh(f"{where} is not a readable .stl mesh (neither text nor binary); repair it or take it away")
    there = (len(content) - 84) // 50
    if there < count:
        raise DamagedMesh(f"{where} is cut short: {there} of {count} triangles are there; fetch or export it again")
    if len(content) - 84 - 50 * count < 50:  # bytes that fill the file up
        return _parse_binary(content, count)
    raise DamagedMesh(
        f"{where} is not a readable .stl mesh: it declares {count} triangles and holds {there}; export it again"
    )


def _parse_binary(content: bytes, count: int) -> tuple[np.ndarray, np.ndarray]:
    corners = np.frombuffer(content, _TRIANGLE, count, offset=84)["corners"]
    with np.errstate(invalid="ignore"):  # NaN, which the normalisation refuses
        return corners.reshape(-1, 3).astype(np.float64), np.arange(3 * count).reshape(-1, 3)


def _parse_text(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    text = text_of(content, "an STL", where)
    lowered = text.lower()
    words = (r"solid", r"end ?solid", r"facet", r"end ?facet")
    opened, closed, facets, whole = (len(re.findall(rf"^[ \t]*{word}\b", lowered, re.MULTILINE)) for word in words)
    if closed < opened or whole < facets:
        raise DamagedMesh(
            f"{where} is cut short: {whole} of {facets} facets and {closed} of {opened} solids end; fetch or export it again"
        )
    try:
        vertices = columns(_CORNER.findall(text), 3)
    except ValueError as error:
        raise DamagedMesh(f"{where} is not a readable .stl mesh: {error}; repair it or take it away") from error
    if len(vertices) != 3 * facets:
        raise DamagedMesh(
            f"{where} is not a readable .stl mesh: it has {len(vertices)} corners in {facets} facets; export it again"
        )
    return vertices, np.arange(len(vertices)).reshape(-1, 3)
