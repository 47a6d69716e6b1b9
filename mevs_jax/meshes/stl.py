"""STL, binary and text; all solids of a file together. Colours and normals are ignored."""

from __future__ import annotations

import codecs
import re

import numpy as np

from mevs_jax.errors import Damage, cut_short
from mevs_jax.meshes.text import columns, is_filler, lines_of, quoted, text_of

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_KINDS = {
    "v": r"vertex\s.*", "f": r"facet(\s+normal(\s+\S+){3})?", "o": r"outer\s+loop", "l": r"end\s?loop", "e": r"end\s?facet",
    "s": r"solid\b(?!.*\bfacet\s+normal\b).*", "S": r"end\s?solid\b.*",
}  # fmt: skip
_LINE = re.compile("|".join(rf"(?P<{kind}>{form})" for kind, form in _KINDS.items()), re.IGNORECASE)
_SOLIDS = re.compile(r"(?:s(?:fovvvle)*+S)*+")
_BEGUN = re.compile(_SOLIDS.pattern + r"(?:s(?:fovvvle)*+(?:f(?:o(?:v(?:v(?:v(?:le?)?)?)?)?)?)?)?")
"""The kinds of the lines of a whole file, and of one that may end early."""


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
    attributes = np.frombuffer(content, _TRIANGLE, count, offset=84)["attribute"]
    if is_filler(content[84 + 50 * count :]) and not attributes.any():  # else a byte may be one too many, and moves all
        return _of_binary(content, count)
    raise Damage(f"is not a readable .stl mesh: it declares {count} triangles and holds more; export it again")


def _of_binary(content: bytes, count: int) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # NaN, which the normalisation refuses
        return np.frombuffer(content, _TRIANGLE, count, offset=84)["corners"].reshape(-1, 3).astype(np.float64)


def _of_text(text: str) -> np.ndarray:
    lines = [line.strip() for line in lines_of(text)]
    found = [_LINE.fullmatch(line) for line in lines]
    kinds = "".join(one.lastgroup or "" if one else "?" for one in found)
    if _SOLIDS.fullmatch(kinds) is None:
        begun = _BEGUN.match(kinds)
        at = begun.end() if begun else 0
        if at and at >= len(kinds) - kinds.endswith("?"):  # the last line may be cut
            whole, solids = f"{kinds.count('e')} of {kinds.count('f')} facets", kinds.count("s")
            raise cut_short(f"{whole} and {kinds.count('S')} of {solids} solids end")
        raise Damage(f"is not a readable .stl mesh: the line {quoted(lines[at])} is out of place; export it again")
    return columns([line[6:] for line, kind in zip(lines, kinds, strict=True) if kind == "v"], 3)
