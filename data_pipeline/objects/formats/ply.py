"""PLY, text and binary: vertices, polygons and triangle strips. Other elements and properties are ignored."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.checks import check_indices
from data_pipeline.objects.formats.polygons import strip_triangles, triangulate
from data_pipeline.objects.formats.text import floats, number

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "int64": "i8", "uint64": "u8",
}  # fmt: skip

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
    properties: tuple[_Property, ...]

    @property
    def lists(self) -> list[_Property]:
        return [one for one in self.properties if one.length]


@dataclass(frozen=True)
class _List:
    """The values of a list property of all rows, one row after the other, and the number of values in each."""

    values: np.ndarray
    counts: np.ndarray


class _Cut(Exception):
    """The data of an element ends early. The argument is the number of rows that are there."""


def parse_ply(content: bytes, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3) and triangles (m, 3) of a PLY file.

    Raises:
        DamagedMesh: if the file is not a PLY mesh, or holds less than its header declares.
    """
    order, elements, start = _header(content, where)
    numbers = _numbers(content[start:], where) if order == "ascii" else np.zeros(0)
    found: dict[str, dict[str, Any]] = {}
    at = 0 if order == "ascii" else start
    for element in elements:
        if not element.properties or not element.count:
            continue
        try:
            if order == "ascii":
                found[element.name], at = _text_rows(numbers, at, element)
            else:
                found[element.name], at = _binary_rows(content, at, element, order)
        except _Cut as cut:
            raise DamagedMesh(
                f"{where} is cut short: {cut} of {element.count} rows of its element {element.name!r} are there; "
                f"fetch or export it again"
            ) from cut
        except ValueError as error:
            raise DamagedMesh(f"{where} is not a readable .ply mesh: {error}; repair it or take it away") from error
    vertex = found.get("vertex", {})
    if not all(isinstance(vertex.get(axis), np.ndarray) for axis in "xyz"):
        raise DamagedMesh(f"{where} is not a readable .ply mesh: it has no vertices x, y, z; repair it or take it away")
    kinds = {one.name: one.kind for element in elements if element.name == "vertex" for one in element.properties}
    with np.errstate(all="ignore"):  # numbers of text have the precision that the header declares
        columns = [vertex[axis].astype("f4" if kinds[axis] == "f4" else "f8") for axis in "xyz"]
    vertices = np.stack(columns, axis=1).astype(np.float64)
    return vertices, _triangles(vertices, elements, found, where)


def _triangles(vertices: np.ndarray, elements: list[_Element], found: dict[str, Any], where: str) -> np.ndarray:
    parts = [np.zeros((0, 3), np.int64)]
    for element in elements:
        if element.name not in ("face", "faces", "tristrips") or element.name not in found:
            continue
        named = [one.name for one in element.lists if one.name.lower() in _INDICES] or [
            one.name for one in element.lists
        ]
        if not named:
            raise DamagedMesh(
                f"{where} is not a readable .ply mesh: its element {element.name!r} has no list of vertices; export it again"
            )
        corners: _List = found[element.name][named[0]]
        values = corners.values
        if values.dtype.kind == "f":
            if not (values == np.floor(values)).all():  # nor NaN
                raise DamagedMesh(f"{where} has a face whose corners are not whole numbers; repair it or take it away")
            values = values.clip(-1.0, 2.0**53)
        values = values.astype(np.int64)
        if element.name != "tristrips":
            parts.append(triangulate(vertices, values, corners.counts, where))
            continue
        strips = np.split(values, np.cumsum(corners.counts)[:-1])
        for strip in strips:  # −1 ends a strip within a list
            parts += [strip_triangles(part[part >= 0]) for part in np.split(strip, np.flatnonzero(strip == -1))]
    triangles = np.concatenate(parts)
    check_indices(triangles, len(vertices), where)
    return triangles


def _header(content: bytes, where: str) -> tuple[str, list[_Element], int]:
    """Returns the byte order (`<`, `>` or `ascii`), the elements, and where the data begins."""

    def refuse(reason: str) -> NoReturn:
        raise DamagedMesh(f"{where} is not a readable .ply mesh: {reason}; repair it or take it away")

    body = content.removeprefix(b"\xef\xbb\xbf")
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", body)
    if first is None:
        refuse("it does not begin with 'ply'")
    newline = first[1]
    last = re.search(re.escape(newline) + rb"[ \t]*end_header[ \t]*" + re.escape(newline), body)
    if last is None:
        refuse("its header does not end")
    order, elements = "", []
    for line in body[first.end() : last.start()].decode("latin-1").split(newline.decode()):
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                order = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), ()))
            elif words[0] == "property":
                length = _TYPES[words[2]] if words[1] == "list" else None
                one = _Property(words[-1], _TYPES[words[3 if length else 1]], length)
                if length and length[0] == "f":
                    refuse(f"the length of its list {one.name!r} is no integer")
                element = elements.pop()
                elements.append(_Element(element.name, element.count, (*element.properties, one)))
            else:
                refuse(f"its header has the line {line[:40]!r}")
        except (IndexError, KeyError, ValueError) as error:
            if isinstance(error, DamagedMesh):
                raise
            refuse(f"its header has the line {line[:40]!r}")
    if not order:
        refuse("its header names no format")
    for element in elements:
        names = [one.name for one in element.properties]
        if element.count < 0 or len(set(names)) < len(names):
            refuse(f"its element {element.name!r} has a negative count or a property twice")
    if len({element.name for element in elements}) < len(elements):
        refuse("its header has an element twice")
    return order, elements, last.end() + len(content) - len(body)


def _numbers(body: bytes, where: str) -> np.ndarray:
    """Returns all numbers of the data of a text file, up to the first word that is none."""
    text = body.decode("latin-1")
    try:
        return floats(text)
    except ValueError:
        found: list[float] = []
        for word in text.split():
            try:
                found.append(number(word))
            except ValueError:
                break
        return np.array(found)


def _text_rows(numbers: np.ndarray, at: int, element: _Element) -> tuple[dict[str, Any], int]:
    """Returns the properties of the rows of an element in a text file, and where the next element begins."""
    names = [one.name for one in element.properties]
    if not element.lists:
        end = at + element.count * len(names)
        if end > len(numbers):
            raise _Cut((len(numbers) - at) // len(names))
        return dict(zip(names, numbers[at:end].reshape(-1, len(names)).T, strict=True)), end
    if len(names) == 1 and at < len(numbers):  # nothing but a list, which mostly has one length
        length = numbers[at]
        end = at + element.count * (int(length) + 1) if 0 <= length < len(numbers) else len(numbers) + 1
        rows = numbers[at:end].reshape(element.count, -1) if end <= len(numbers) else numbers[:0, None]
        if len(rows) and (rows[:, 0] == length).all():
            return {names[0]: _List(rows[:, 1:].reshape(-1), rows[:, 0].astype(np.int64))}, end
    values = numbers.tolist()
    where: dict[str, list[int]] = {name: [] for name in names}
    counts: dict[str, list[int]] = {one.name: [] for one in element.lists}
    for row in range(element.count):
        for one in element.properties:
            if at >= len(values):
                raise _Cut(row)
            if one.length:
                length = values[at]
                if not length >= 0 or length != int(min(length, 2**53)):
                    raise ValueError(f"a list {one.name!r} has the length {length:g}")
                counts[one.name].append(int(length))
                where[one.name].append(at + 1)
                at += 1 + int(length)
                if at > len(values):
                    raise _Cut(row)
            else:
                where[one.name].append(at)
                at += 1
    found: dict[str, Any] = {}
    for one in element.properties:
        places = np.array(where[one.name], np.int64)
        if one.length:
            many = np.array(counts[one.name], np.int64)
            found[one.name] = _List(numbers[_spread(places, many, 1)], many)
        else:
            found[one.name] = numbers[places]
    return found, at


def _spread(starts: np.ndarray, counts: np.ndarray, step: int) -> np.ndarray:
    """Returns the places of all values of lists that begin at `starts` and have `counts` values, `step` apart."""
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(starts, counts) + step * within


def _binary_rows(content: bytes, at: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    """Returns the properties of the rows of an element in a binary file, and where the next element begins."""
    sizes = {one.name: np.dtype(one.length or one.kind).itemsize for one in element.properties}
    if at + element.count * sum(sizes.values()) > len(content):
        raise _Cut((len(content) - at) // sum(sizes.values()) if not element.lists else "not all")
    lengths = _lengths_of_first(content, at, element, order)
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
    if end <= len(content):  # mostly, all lists of a property are as long as the first
        rows = np.frombuffer(content, row, element.count, offset=at)
        if all((rows[f"{name} length"] == length).all() for name, length in lengths.items()):
            found: dict[str, Any] = {one.name: rows[one.name] for one in element.properties}
            for name, length in lengths.items():
                found[name] = _List(rows[name].reshape(-1), np.full(element.count, length))
            return found, end
    elif not element.lists:
        raise _Cut((len(content) - at) // row.itemsize)
    return _walk(content, at, element, order)


def _lengths_of_first(content: bytes, at: int, element: _Element, order: str) -> dict[str, int]:
    """Returns the lengths of the lists in the first row of an element."""
    lengths = {}
    for one in element.properties:
        if one.length:
            length = _length(content, at, one, order)
            if length > len(content):
                raise _Cut(0)
            lengths[one.name] = length
            at += np.dtype(one.length).itemsize + length * np.dtype(one.kind).itemsize
        else:
            at += np.dtype(one.kind).itemsize
    return lengths


def _length(content: bytes, at: int, one: _Property, order: str) -> int:
    assert one.length is not None
    size = int(one.length[1])
    if at + size > len(content):
        raise _Cut(0)
    length = int.from_bytes(content[at : at + size], "little" if order == "<" else "big", signed=one.length[0] == "i")
    if length < 0:
        raise ValueError(f"a list {one.name!r} has the length {length}")
    return length


def _walk(content: bytes, at: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    """Returns what `_binary_rows` returns, for lists of different lengths, row by row."""
    steps = [(one, int(one.length[1]) if one.length else 0, int(one.kind[1])) for one in element.properties]
    starts: dict[str, list[int]] = {one.name: [] for one in element.properties}
    counts: dict[str, list[int]] = {one.name: [] for one in element.lists}
    end, endian = len(content), "little" if order == "<" else "big"
    for row in range(element.count):
        for one, size, item in steps:
            if not size:
                starts[one.name].append(at)
                at += item
                continue
            if at + size > end:
                raise _Cut(row)
            length = content[at] if size == 1 else int.from_bytes(content[at : at + size], endian, signed=False)  # type: ignore[arg-type]
            starts[one.name].append(at + size)
            counts[one.name].append(length)
            at += size + length * item
        if at > end:  # also what a negative length ends in
            raise _Cut(row)
    octets = np.frombuffer(content, np.uint8)
    found: dict[str, Any] = {}
    for one, size, item in steps:
        places = np.array(starts[one.name], np.int64)
        many = np.array(counts[one.name], np.int64) if size else np.ones(len(places), np.int64)
        octets_of = _spread(places, many, item)[:, None] + np.arange(item)
        values = octets[octets_of].view(order + one.kind).reshape(-1)
        found[one.name] = _List(values, many) if size else values
    return found, at
