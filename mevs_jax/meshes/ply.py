"""PLY, text and binary: vertices, polygons and triangle strips. Other elements and properties are ignored."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from mevs_jax.errors import Damage, EmptyMesh, cut_short
from mevs_jax.meshes.polygons import check_indices, strip_triangles, triangulate
from mevs_jax.meshes.text import is_filler, lines_of, numbers, quoted, starts_of, whole_number

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "int64": "i8", "uint64": "u8",
}  # fmt: skip
_CODES = dict(zip(("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), "bBhHiIqQ", strict=True))
"""How `struct` names the types of lengths."""

_ORDERS = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}
_SHAPES = ("face", "faces", "tristrips")
_INDICES = ("vertex_indices", "vertex_index", "vertexindices", "indices")


@dataclass(frozen=True)
class _Property:
    """A property of an element: a number of `kind`, or a list of them after its length of type `length`."""

    name: str
    kind: str
    length: str | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def lists(self) -> list[_Property]:
        return [one for one in self.properties if one.length]

    def cut(self, rows: Any) -> Damage:
        return cut_short(f"{rows} of {self.count} rows of its element {self.name!r} are there")


@dataclass(frozen=True)
class _List:
    """The values of a list property of all rows, one row after the other, and the number of values in each."""

    values: np.ndarray
    counts: np.ndarray


def parse_ply(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads a PLY file."""
    order, elements, start = _header(content)
    found: dict[str, dict[str, Any]] = {}
    lines = lines_of(content[start:].decode("latin-1").replace("\r", "\n")) if order == "ascii" else []
    at = 0 if order == "ascii" else start
    for element in elements:
        if not element.properties or not element.count:
            continue
        if order == "ascii":
            found[element.name] = _of_lines(lines[at : at + element.count], element, at + element.count >= len(lines))
            at += element.count
        else:
            found[element.name], at = _rows(content, at, element, order)
    if at < len(lines) or (order != "ascii" and not is_filler(content[at:])):
        more = f"more than the rows that its header declares ({_counts(elements)})"
        raise Damage(f"is not a readable .ply mesh: it holds {more}; export it again")
    vertex = found.get("vertex", {})
    if not all(isinstance(vertex.get(axis), np.ndarray) for axis in "xyz"):
        raise ValueError("it has no vertices x, y, z")
    kinds = {one.name: one.kind for element in elements if element.name == "vertex" for one in element.properties}
    with np.errstate(all="ignore"):  # numbers of text have the precision that the header declares
        columns = [vertex[axis].astype(kinds[axis]).astype(np.float64) for axis in "xyz"]
    for axis, column in zip("xyz", columns, strict=True):
        if kinds[axis][0] != "f" and (column != vertex[axis]).any():
            raise ValueError(f"a vertex has a coordinate {axis} that is no number of the type that the header declares")
    vertices = np.stack(columns, axis=1)
    return vertices, _triangles(vertices, elements, found)


def _counts(elements: list[_Element]) -> str:
    return ", ".join(f"{element.count} of {element.name!r}" for element in elements)


def _triangles(vertices: np.ndarray, elements: list[_Element], found: dict[str, Any]) -> np.ndarray:
    parts = [np.zeros((0, 3), np.int64)]
    for element in elements:
        if element.name not in _SHAPES or element.name not in found:
            continue
        lists = [one.name for one in element.lists if one.kind[0] != "f"]
        named = [one.name for one in element.lists if one.name.lower() in _INDICES] or lists
        if len(named) != 1:
            why = f"its element {element.name!r} has {len(named)} lists of vertices"
            raise Damage(f"is not a readable .ply mesh: {why}; export it again")
        corners: _List = found[element.name][named[0]]
        values = corners.values
        if values.dtype.kind == "f":
            if not (values == np.floor(values)).all():  # nor NaN
                raise Damage("has a face whose corners are not whole numbers; repair it or take it away")
            values = values.clip(-2.0, 2.0**53)
        values = values.astype(np.int64)
        if element.name != "tristrips":
            if (least := corners.counts.min()) < 3:  # as in a file that declares more vertices than it has
                raise Damage(f"has a face of {least} corners; repair it or take it away")
            parts.append(triangulate(vertices, values, corners.counts))
            continue
        check_indices(values[values != -1], len(vertices))
        for strip in np.split(values, np.cumsum(corners.counts)[:-1]):  # −1 ends a strip within a list
            parts += [strip_triangles(part[part >= 0]) for part in np.split(strip, np.flatnonzero(strip == -1))]
    others = [one.name for one in elements if one.count and (one.lists or one.name == "edge") and one.name != "vertex"]
    others = [name for name in others if name not in _SHAPES]
    if len(parts) == 1 and others:
        raise EmptyMesh(f"mesh has no faces: its element {others[0]!r} is not read")
    triangles = np.concatenate(parts)
    check_indices(triangles, len(vertices))
    return triangles


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """Returns the byte order (`<`, `>` or `ascii`), the elements, and where the data begins."""
    body = content.removeprefix(b"\xef\xbb\xbf")
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", body)
    if first is None:
        raise ValueError("it does not begin with 'ply'")
    newline = first[1]
    blank = rb"[ \t\r]*" if newline == b"\n" else rb"[ \t]*"  # some writers end the last line of the header otherwise
    last = re.search(re.escape(newline) + rb"[ \t]*end_header" + blank + re.escape(newline), body)
    if last is None:
        raise ValueError("its header does not end")
    order, elements = "", list[_Element]()
    for line in body[first.end() : last.start()].decode("latin-1").split(newline.decode()):
        words = line.split()
        try:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", name, *_]:
                    order = _ORDERS[name]
                case ["element", name, count, *_]:
                    elements.append(_Element(name, whole_number(count), []))
                case ["property", "list", length, kind, *_]:
                    elements[-1].properties.append(_Property(words[-1], _TYPES[kind], _TYPES[length]))
                case ["property", kind, *_]:
                    elements[-1].properties.append(_Property(words[-1], _TYPES[kind]))
                case _:
                    raise ValueError
        except (IndexError, KeyError, ValueError) as error:
            raise ValueError(f"its header has the line {line[:40]!r}") from error
    if not order:
        raise ValueError("its header names no format")
    if len({element.name for element in elements}) < len(elements):
        raise ValueError("its header has an element twice")
    for element in elements:
        names = [one.name for one in element.properties]
        if element.count < 0 or len(set(names)) < len(names):
            raise ValueError(f"its element {element.name!r} has a negative count or a property twice")
        for one in element.lists:
            if one.length in ("f4", "f8"):
                raise ValueError(f"the length of its list {one.name!r} is no integer")
    return order, elements, last.end() + len(content) - len(body)


def _of_lines(lines: list[str], element: _Element, last: bool) -> dict[str, Any]:
    """Returns the properties of the rows of an element of a text file, each of which is a line.

    Args:
        last: whether the file ends with these lines.
    """
    values, counts = numbers(lines)
    starts, padded = starts_of(counts), np.append(values, 0.0)
    ends, at = starts + counts, starts
    places: list[tuple[_Property, np.ndarray, np.ndarray]] = []
    for one in element.properties:
        many = np.ones(len(lines), np.int64)
        if one.length:
            length = padded[np.minimum(at, len(values))]
            wrong = np.flatnonzero((at < ends) & ~((length >= 0) & (length == np.floor(length))))
            if len(wrong):
                raise ValueError(f"a list {one.name!r} has the length {length[wrong[0]]:.15g}")
            many, at = np.where(at < ends, length.clip(0, 2**40), 0).astype(np.int64), at + 1
        places.append((one, at, many))
        at = at + many
    wrong = np.flatnonzero(at != ends)
    if len(wrong) and not (last and wrong[0] == len(lines) - 1 and at[-1] > ends[-1]):
        row, line = wrong[0], quoted(lines[wrong[0]])
        row_has = f"the line {line} has {counts[row]} numbers instead of {at[row] - starts[row]}"
        raise ValueError(f"{row_has}, as one of its {element.count} rows of {element.name!r}")
    if len(lines) < element.count or len(wrong):
        raise element.cut(len(lines) - len(wrong))
    found: dict[str, Any] = {}
    for one, first, many in places:
        within = np.arange(many.sum()) - np.repeat(starts_of(many), many)
        taken = values[np.repeat(first, many) + within]
        found[one.name] = _List(taken, many) if one.length else taken
    return found


def _rows(data: Any, at: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    """Returns the properties of the rows of an element, and where in the data the next element begins."""
    lists = [one.name for one in element.lists]
    if lists and element.count > len(data):
        raise element.cut("not all")
    first = _walk(data, at, element, order, 1)[0] if lists else {}
    lengths = {name: int(first[name].counts[0]) for name in lists}
    row = np.dtype([
        part
        for one in element.properties
        for part in (
            [(f"{one.name} length", order + one.length), (one.name, order + one.kind, (lengths[one.name],))]
            if one.length
            else [(one.name, order + one.kind)]
        )
    ])  # fmt: skip
    end = at + element.count * row.itemsize
    if end <= len(data):  # mostly, all lists of a property are as long as the first
        rows = np.frombuffer(data, row, element.count, offset=at)
        if all((rows[f"{name} length"] == length).all() for name, length in lengths.items()):
            found: dict[str, Any] = {one.name: rows[one.name] for one in element.properties}
            for name, length in lengths.items():
                found[name] = _List(rows[name].reshape(-1), np.full(element.count, length))
            return found, end
    elif not lists:
        raise element.cut((len(data) - at) // row.itemsize)
    return _walk(data, at, element, order, element.count)


def _walk(data: Any, at: int, element: _Element, order: str, rows: int) -> tuple[dict[str, Any], int]:
    """Returns what `_rows` returns, of the first rows and for lists of any lengths, row by row."""
    lengths = [one.length and struct.Struct(order + _CODES[one.length]) for one in element.properties]
    steps = list(zip(element.properties, lengths, [int(one.kind[1]) for one in element.properties], strict=True))
    starts: dict[str, list[int]] = {one.name: [] for one in element.properties}
    counts: dict[str, list[int]] = {one.name: [] for one in element.lists}
    for row in range(rows):
        for one, length, item in steps:
            count = 1
            if length:
                if at + length.size > len(data):
                    raise element.cut(row)
                (count,) = length.unpack_from(data, at)
                if count < 0:
                    raise ValueError(f"a list {one.name!r} has the length {count}")
                at += length.size
                counts[one.name].append(count)
            starts[one.name].append(at)
            at += count * item
        if at > len(data):
            raise element.cut(row)
    found: dict[str, Any] = {}
    for one, length, item in steps:
        places, many = np.array(starts[one.name], np.int64), np.array(counts.get(one.name, [1] * rows), np.int64)
        within = np.arange(many.sum()) - np.repeat(starts_of(many), many)
        anywhere = np.ndarray(max(len(data) - item + 1, 0), order + one.kind, data, 0, (1,))
        values = anywhere[np.repeat(places, many) + item * within]
        found[one.name] = _List(values, many) if length else values
    return found, at
