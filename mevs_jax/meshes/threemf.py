"""3MF: the triangles of all items to build, with their transforms, z up. Colours, materials and supports are ignored.

Source: 3MF core specification 1.3 and Open Packaging Conventions.
"""

from __future__ import annotations

import io
import zipfile
from collections import deque
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from mevs_jax.errors import Damage, EmptyMesh
from mevs_jax.meshes.markup import parse_markup
from mevs_jax.meshes.polygons import check_indices, merged, moved
from mevs_jax.meshes.text import number, whole_number

_NAMESPACES = "http://schemas.microsoft.com/3dmanufacturing/"
_CORE = f"{{{_NAMESPACES}core/2015/02}}"
_PATH = f"{{{_NAMESPACES}production/2015/06}}path"
_START = f"{_NAMESPACES}2013/01/3dmodel"
"""The type of the relationship that names the document in which a file begins."""

_HARMLESS = tuple(f"{_NAMESPACES}{name}/" for name in ("core", "material", "production", "trianglesets"))
"""Beginnings of the names of extensions that leave the geometry as it is, or whose use is noticed."""

_SETS = f"{{{_NAMESPACES}trianglesets/"
_SUPPORTS = ("support", "solidsupport")

MOST_COPIES = 100_000
"""Largest number of uses of objects that a file may unfold to."""

LARGEST = 1 << 28
"""Largest unpacked size of the model in bytes."""

MOST_TRIANGLES = 50_000_000
"""Largest number of triangles that all copies in a file may have together."""


def parse_3mf(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads the items of a 3MF file that are to be built."""
    root = _model(content)
    objects: dict[str | None, Element] = {}
    for entry in root.iterfind(f"{_CORE}resources/{_CORE}object"):
        if objects.setdefault(entry.get("id"), entry) is not entry:
            raise Damage(f"has two objects of the id {entry.get('id')!r}; export it again")
    items = _children(root, "build", "item")
    if objects and not items:
        raise EmptyMesh(f"mesh has no faces: none of its {len(objects)} objects is built")
    todo: deque[tuple[Element, np.ndarray, tuple[str | None, ...]]] = deque((item, np.eye(4), ()) for item in items)
    read: dict[str | None, tuple[np.ndarray, np.ndarray]] = {}
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    unfolded = supports = 0
    while todo:
        use, parent, above = todo.popleft()
        if use.get(_PATH):
            raise Damage("keeps parts in other files of its archive, which is not read; export it as .stl")
        name = use.get("objectid")
        if name in above or len(above) > 50 or len(parts) >= MOST_COPIES or len(todo) > MOST_COPIES:
            raise Damage("has an object within itself, or too many copies; export it again")
        if name not in objects:
            raise Damage(f"builds an object of the id {name!r}, which it does not have; export it again")
        entry, place = objects[name], parent @ _matrix(use.get("transform"))
        if (kind := entry.get("type", "model")) in _SUPPORTS:
            supports += 1
            continue
        if kind != "model":
            raise Damage(f"builds an object of the type {kind!r}, which is not read; export it as .stl")
        if name not in read:
            read[name] = _mesh(entry)
        vertices, triangles = read[name]
        unfolded += len(triangles)
        if unfolded > MOST_TRIANGLES:
            raise Damage(f"unfolds to more than {MOST_TRIANGLES:,} triangles; export a simpler mesh")
        parts.append((moved(vertices, place), triangles))
        todo += [(part, place, (*above, name)) for part in _children(entry, "components", "component")]
    if supports and not unfolded:
        raise EmptyMesh("mesh has no faces: it builds supports only")
    return merged(parts)


def _model(content: bytes) -> Element:
    """Returns the document of the model in the archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        root, written = parse_markup(_member(archive, _start(archive)))
    if root.tag != f"{_CORE}model":
        raise Damage(f"has a model of the kind {root.tag[:90]!r}, not of 3MF's core/2015/02; export it again")
    for prefix in written.get("requiredextensions", "").split():
        name = written.get(f"xmlns:{prefix}", prefix)
        if not name.startswith(_HARMLESS):
            raise Damage(f"requires the extension {name[:90]}, which is not read; export it without, or as .stl")
    return root


def _start(archive: zipfile.ZipFile) -> str:
    """Returns the path of the model's document: that which the archive's relationships name, or the only one."""
    names = [name for name in archive.namelist() if name.lower().endswith(".model")]
    if not any(_plain(name) == "_rels/.rels" for name in archive.namelist()):
        if len(names) != 1:
            raise Damage(f"has {len(names)} models and no _rels/.rels that names one; export it again")
        return names[0]
    relationships = parse_markup(_member(archive, "_rels/.rels"))[0]
    targets = [one.get("Target", "") for one in relationships if one.get("Type") == _START]
    if len(targets) != 1:
        raise Damage(f"names {len(targets)} models in its _rels/.rels instead of one; export it again")
    return targets[0]


def _plain(name: str) -> str:
    """Returns a path in the archive in a form that is equal for all spellings."""
    return name.lstrip("/").lower()


def _member(archive: zipfile.ZipFile, path: str) -> bytes:
    names = [name for name in archive.namelist() if _plain(name) == _plain(path)]
    if len(names) != 1:
        raise Damage(f"has {path[:60]!r} {len(names)} times in its archive instead of once; export it again")
    if archive.getinfo(names[0]).file_size > LARGEST:
        raise Damage(f"unpacks to more than {LARGEST >> 20} MB; export a simpler mesh")
    return archive.read(names[0])


def _mesh(entry: Element) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices and triangles of an object, of which one of components has none."""
    mesh, components = entry.find(f"{_CORE}mesh"), entry.find(f"{_CORE}components")
    if (mesh is None) == (components is None):
        raise Damage(f"has an object {entry.get('id')!r} that is no mesh; export it as .stl")
    if mesh is None:
        return merged([])
    for child in mesh:
        if child.tag not in (f"{_CORE}vertices", f"{_CORE}triangles") and not child.tag.startswith(_SETS):
            raise Damage(f"has a mesh with {child.tag[:90]!r}, which is not read; export it as .stl")
    vertices = [_values(one, ("x", "y", "z"), number) for one in _children(mesh, "vertices", "vertex")]
    triangles = [_values(one, ("v1", "v2", "v3"), whole_number) for one in _children(mesh, "triangles", "triangle")]
    found = np.array(triangles, np.int64).reshape(-1, 3)
    check_indices(found, len(vertices))
    return np.array(vertices, np.float64).reshape(-1, 3), found


def _children(parent: Element, *names: str) -> list[Element]:
    """Returns the elements that a path of names leads to, of which the last element on the path must have no others."""
    *above, last = (f"{_CORE}{name}" for name in names)
    lists = parent.findall("/".join(above))
    found = [child for one in lists for child in one]
    if other := next((child.tag for child in found if child.tag != last), None):
        raise Damage(f"has {other[:90]!r} in its {names[0]!r}, which is not read; repair it or export it as .stl")
    return found


def _values(element: Element, names: tuple[str, ...], read: Any) -> list[Any]:
    """Returns attributes of an element as numbers."""
    if lost := [name for name in names if name not in element.attrib]:
        raise ValueError(f"a <{element.tag.rpartition('}')[2]}> has no {lost[0]!r}")
    return [read(element.attrib[name].strip()) for name in names]


def _matrix(text: str | None) -> np.ndarray:
    """Returns the transform (4, 4) of a build item or component, which 3MF writes as four rows of three for row vectors."""
    if text is None:
        return np.eye(4)
    values = [number(word) for word in text.split()]
    if len(values) != 12:
        raise ValueError(f"a transform has {len(values)} numbers instead of 12")
    found = np.eye(4)
    found[:3, :] = np.reshape(values, (4, 3)).T
    return found
