"""STL, binary and text; all solids of a file together. Colours and normals are ignored."""

from __future__ import annotations

import codecs
import re

import numpy as np

from data_pipeline.errors import Damage, cut_short
from data_pipeline.objects.formats.text import columns, text_of

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_CORNER = re.compile(r"^[ \t]*vertex[ \t]+(.*)", re.IGNORECASE | re.MULTILINE)


def parse_stl(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads an STL file, whose every triangle has vertices of its own."""
    vertices = _corners(content)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _corners(content: bytes) -> np.ndarray:
    """Returns the corners of all triangles, (3 m, 3)."""
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    if count >= 0 and len(content) == 84 + 50 * count:  # also if the text of the header begins with "solid"
        return _of_binary(content, count)
    begin = content[:512].removeprefix(codecs.BOM_UTF8).lstrip().lower()
    if begin.startswith(b"solid") and re.search(rb"facet|end ?solid", content, re.IGNORECASE):
        return _of_text(text_of(content, "an STL"))
    if count < 0:
        raise Damage("is not a readable .stl mesh (neither text nor binary); repair it or take it away")
    there = (len(content) - 84) // 50
    if there < count:
        raise cut_short(f"{there} of {count} triangles are there")
    if len(content) - 84 - 50 * count < 50:  # bytes that fill the file up
        return _of_binary(content, count)
    raise Damage(f"is not a readable .stl mesh: it declares {count} triangles and holds {there}; export it again")


def _of_binary(content: bytes, count: int) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # NaN, which the normalisation refuses
        return np.frombuffer(content, _TRIANGLE, count, offset=84)["corners"].reshape(-1, 3).astype(np.float64)


def _of_text(text: str) -> np.ndarray:
    words = (r"solid", r"end ?solid", r"facet", r"end ?facet")
    patterns = (re.compile(rf"^[ \t]*{word}\b", re.MULTILINE) for word in words)
    opened, closed, facets, whole = (len(pattern.findall(text.lower())) for pattern in patterns)
    if closed < opened or whole < facets:
        raise cut_short(f"{whole} of {facets} facets and {closed} of {opened} solids end")
    vertices = columns(_CORNER.findall(text), 3)
    if len(vertices) != 3 * facets:
        corners = f"it has {len(vertices)} corners in {facets} facets"
        raise Damage(f"is not a readable .stl mesh: {corners}; export it again")
    return vertices
