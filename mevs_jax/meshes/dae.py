"""COLLADA (.dae): the polygons of the scene with all transforms, and the axis that the file declares as up.

Source: COLLADA 1.4.1 and 1.5, Khronos Group, chapters 5 and 6. pycollada, with which tests compare, reads NaN as 0, leaves out
second lists of corners, and ignores transforms that it does not know.
"""

from __future__ import annotations

import urllib.parse
from collections import defaultdict
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from mevs_jax.errors import Damage, EmptyMesh
from mevs_jax.meshes.markup import parse_markup
from mevs_jax.meshes.polygons import (
    check_indices,
    fan_triangles,
    merged,
    moved,
    strip_triangles,
    triangulate,
)
from mevs_jax.meshes.text import numbers, whole_number

MOST_CORNERS, MOST_COPIES = 50_000_000, 10_000
"""Largest numbers of corners of polygons and of meshes in a scene, all copies counted. A small file can declare any number."""

MOST_NODES = 1_000_000
"""Largest number of nodes of a scene, all copies counted."""

_SHAPES = ("triangles", "tristrips", "trifans", "polylist", "polygons")
_IGNORED = ("source", "vertices", "lines", "linestrips", "extra")
_IN_SHAPES = ("input", "p", "ph", "vcount", "extra")
_TRANSFORMS = {"matrix": 16, "translate": 3, "rotate": 4, "scale": 3}
"""Transforms of nodes, and how many numbers they have."""

_IN_NODES = (*_TRANSFORMS, "skew", "lookat", "asset", "instance_camera", "instance_light", "evaluate_scene", "extra")


def parse_dae(content: bytes) -> tuple[np.ndarray, np.ndarray, str]:
    """Reads a COLLADA file; also returns the axis that is up (`x`, `y` or `z`).

    Lines, materials and animations are ignored; skins are read in their bind pose. Units are the file's.
    """
    root, _ = parse_markup(content)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # of COLLADA 1.4, 1.5 or no namespace
    if root.tag != "COLLADA":
        raise ValueError(f"its root is <{root.tag[:40]}> and not <COLLADA>")
    declared = (root.findtext("asset/up_axis") or "Y_UP").strip()
    axis = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}.get(declared.upper())
    if axis is None:
        raise Damage(f"declares {declared[:40]!r} as its axis that is up; write X_UP, Y_UP or Z_UP there")
    return *_Reader(root).meshes(), axis


class _Reader:
    """Reads the meshes of one document."""

    def __init__(self, root: Element):
        self.root = root
        self.named: defaultdict[tuple[str, str], list[Element]] = defaultdict(list)
        for element in root.iter():
            if name := element.get("id"):
                self.named[element.tag, name].append(element)
        self.parts: list[tuple[np.ndarray, np.ndarray]] = []
        self.read: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.corners = 0

    def target(self, use: Element, *kinds: str, attribute: str = "url") -> Element:
        """Returns the element of one of some kinds whose address an attribute of `use` holds."""
        address = use.get(attribute, "")
        if not address.startswith("#"):
            raise Damage(f"names {address[:60]!r} in another file, which is not read; export it as one file")
        spellings = {address[1:], urllib.parse.unquote(address[1:])}
        found = [one for kind in kinds for name in spellings for one in self.named.get((kind, name), ())]
        if len(found) != 1:
            raise Damage(f"has {len(found)} elements {kinds[0]!r} of the id {address[1:61]!r}; export it again")
        return found[0]

    def meshes(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the vertices and triangles of all meshes in the scene."""
        geometries = self.root.findall("library_geometries/geometry")
        uses = self.root.findall("scene/instance_visual_scene")
        scenes = [self.target(use, "visual_scene") for use in uses]
        if len(uses) > 1:
            raise Damage(f"shows {len(uses)} scenes at once; export it again")
        if not uses:
            scenes = self.root.findall("library_visual_scenes/visual_scene")
            if len(scenes) > 1:
                raise Damage(f"has {len(scenes)} scenes and does not say which is shown; export it again")
            if not scenes:  # a library of geometries
                for geometry in geometries:
                    self._place(geometry, np.eye(4))
        for scene in scenes:
            self._walk(scene)
        if geometries and not self.parts:
            raise EmptyMesh(f"mesh has no faces: its scene shows none of its {len(geometries)} geometries")
        return merged(self.parts)

    def _walk(self, scene: Element) -> None:
        """Reads all meshes of a scene; nodes are visited in their order."""
        todo = [(scene, np.eye(4), "", 0)]
        visited = 0
        while todo:
            node, place, unread, depth = todo.pop()
            visited += 1
            if depth > 1000 or visited > MOST_NODES:
                raise Damage("has a node within itself, or too many nodes; export a simpler mesh")
            below = []
            for child in node:
                place = place @ _matrix(child) if child.tag in _TRANSFORMS else place
                unread = child.tag if child.tag in ("skew", "lookat") else unread
            for child in node:
                if child.tag in ("node", "instance_node"):
                    inner = child if child.tag == "node" else self.target(child, "node")
                    below.append((inner, place, unread, depth + 1))
                elif child.tag in ("instance_geometry", "instance_controller"):
                    if unread:
                        raise Damage(f"places a mesh by <{unread}>, which is not read; export it with matrices")
                    self._place(self.target(child, child.tag.removeprefix("instance_")), place)
                elif child.tag not in _IN_NODES:
                    raise Damage(f"has a node with <{child.tag[:40]}>, which is not read; export it again")
            todo += below[::-1]

    def _place(self, thing: Element, place: np.ndarray) -> None:
        """Adds a geometry, or that of a controller in its bind pose."""
        above: list[Element] = []
        while thing.tag == "controller":
            above.append(thing)
            skin = thing.find("skin")
            kind = _only(thing, "morph") if skin is None else skin
            if skin is None:
                self._check_morph(kind)
            elif (shape := skin.find("bind_shape_matrix")) is not None:
                place = place @ _matrix(shape)
            thing = self.target(kind, "geometry", "controller", attribute="source")
            if thing in above:
                raise Damage("has a controller of itself; export it again")
        if len(self.parts) >= MOST_COPIES:
            raise Damage(f"unfolds to more than {MOST_COPIES:,} meshes; export a simpler mesh")
        if id(thing) not in self.read:
            self.read[id(thing)] = _geometry(thing)
        vertices, triangles = self.read[id(thing)]
        self.corners += triangles.size
        if self.corners > MOST_CORNERS:
            raise Damage(f"unfolds to more than {MOST_CORNERS:,} corners; export a simpler mesh")
        self.parts.append((moved(vertices, place), triangles))

    def _check_morph(self, morph: Element) -> None:
        """Raises `Damage` if targets of a morph have an effect."""
        for use in morph.iterfind("targets/input[@semantic='MORPH_WEIGHT']"):
            array = self.target(use, "source", attribute="source").find("float_array")
            if array is None or _numbers(array).any():
                raise Damage("has a morph with weights, which is not read; export it without")


def _only(parent: Element, name: str) -> Element:
    """Returns the one child of this name."""
    found = parent.findall(name)
    if len(found) != 1:
        raise ValueError(f"a <{parent.tag}> has {len(found)} <{name}> instead of one")
    return found[0]


def _numbers(element: Element, kind: type[Any] = np.float64) -> np.ndarray:
    """Returns the numbers of an element, which are as many as it declares."""
    if len(element):
        raise ValueError(f"a <{element.tag}> holds other elements")
    values, _ = numbers([element.text or ""], kind)
    _check_count(element, len(values))
    return values


def _check_count(element: Element, there: int) -> None:
    declared = element.get("count")
    if declared is not None and whole_number(declared.strip()) != there:
        raise Damage(f"has a <{element.tag}> that declares {declared[:20]} and holds {there}; export it again")


def _matrix(element: Element) -> np.ndarray:
    """Returns the transform (4, 4) that an element of a node describes."""
    values, wanted = _numbers(element), _TRANSFORMS.get(element.tag, 16)
    if len(values) != wanted:
        raise ValueError(f"a <{element.tag}> has {len(values)} numbers instead of {wanted}")
    found = np.eye(4)
    if wanted == 16:
        found = values.reshape(4, 4)
        if (np.abs(found[3] - (0, 0, 0, 1)) > 1e-6).any():
            raise Damage(f"has a <{element.tag}> whose last row is not 0 0 0 1; export it again")
    elif element.tag == "translate":
        found[:3, 3] = values
    elif element.tag == "scale":
        found[:3, :3] = np.diag(values)
    elif values[:3].any():
        from scipy.spatial.transform import Rotation  # imported late: it takes a fifth of a second

        axis = values[:3] / np.linalg.norm(values[:3])
        found[:3, :3] = Rotation.from_rotvec(np.deg2rad(values[3]) * axis).as_matrix()
    elif values[3]:
        raise ValueError("a <rotate> has no axis")
    return found


def _geometry(geometry: Element) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices and triangles of a geometry; a spline has none."""
    if geometry.find("spline") is not None:
        return merged([])
    if geometry.find("mesh") is None:
        kinds = ", ".join(f"<{child.tag[:40]}>" for child in geometry if child.tag not in ("asset", "extra"))
        raise Damage(f"has a geometry that is no mesh ({kinds or 'empty'}); export it as triangles")
    mesh = _only(geometry, "mesh")
    for child in mesh:
        if child.tag not in _SHAPES + _IGNORED:
            raise Damage(f"has a mesh with <{child.tag[:40]}>, which is not read; export it as triangles")
    shapes = [child for child in mesh if child.tag in _SHAPES and not _is_empty(child)]
    if not shapes:
        return merged([])
    declared = _only(mesh, "vertices")
    sources = {use.get("source") for use in declared.iterfind("input[@semantic='POSITION']")}
    vertices = _points(mesh, sources)
    return vertices, np.concatenate([_triangles(shape, vertices, f"#{declared.get('id')}") for shape in shapes])


def _is_empty(shape: Element) -> bool:
    corners = [child for child in shape if child.tag in ("p", "ph") and (len(child) or (child.text or "").split())]
    if not corners:
        _check_count(shape, 0)
    return not corners


def _points(mesh: Element, names: set[str | None]) -> np.ndarray:
    """Returns the positions (n, 3) that a source of a mesh holds."""
    found = [source for source in mesh.iterfind("source") if f"#{source.get('id')}" in names]
    if len(found) != 1 or len(names) != 1:
        raise ValueError(f"its positions have {len(found)} sources instead of one")
    array, accessor = _only(found[0], "float_array"), _only(_only(found[0], "technique_common"), "accessor")
    if accessor.get("source") != f"#{array.get('id')}":
        raise ValueError(f"its positions are those of {accessor.get('source')!r}, which is not beside them")
    values = _numbers(array)
    count, stride, offset = (
        whole_number(accessor.get(name, default).strip())
        for name, default in (("count", ""), ("stride", "1"), ("offset", "0"))
    )
    axes = [(param.get("name") or "").upper() for param in accessor.iterfind("param")]
    named = [at for at, axis in enumerate(axes) if axis] or list(range(len(axes)))  # numbers without a name are skipped
    if [axes[at] for at in named] not in (["X", "Y", "Z"], ["", "", ""]):
        raise ValueError(f"its positions have the axes {axes} and not X, Y, Z")
    if named[-1] >= stride:
        raise ValueError(f"its positions have {len(axes)} numbers each, and a stride of {stride}")
    if min(count, offset) < 0 or offset + stride * count > len(values):
        raise Damage(f"declares {count} positions, and holds {len(values)} numbers; export it again")
    return values[offset : offset + stride * count].reshape(count, stride)[:, named]


def _triangles(shape: Element, vertices: np.ndarray, name: str) -> np.ndarray:
    """Returns the triangles of an element such as <polylist>; `name` is the address of the vertices."""
    if shape.find("ph") is not None:
        raise Damage("has polygons with holes, which are not read; export it as triangles")
    if other := next((child.tag for child in shape if child.tag not in _IN_SHAPES), None):
        raise Damage(f"has a <{shape.tag}> with <{other[:40]}>, which is not read; export it as triangles")
    offsets = [whole_number(use.get("offset", "").strip()) for use in shape.iterfind("input")]
    corner = [use for use in shape.iterfind("input") if use.get("semantic") == "VERTEX"]
    if len(corner) != 1 or corner[0].get("source") != name:
        raise ValueError(f"a <{shape.tag}> has no input of vertices")
    stride, first = max(offsets) + 1, whole_number(corner[0].get("offset", "").strip())
    lists = [_numbers(one, np.int64) for one in shape.iterfind("p")]
    if any(len(one) % stride for one in lists):
        raise ValueError(f"a <{shape.tag}> has corners of other than {stride} numbers")
    lists = [one[first::stride] for one in lists]
    check_indices(np.concatenate(lists), len(vertices))
    if shape.tag in ("tristrips", "trifans"):
        _check_count(shape, len(lists))
        return np.concatenate([(strip_triangles if shape.tag == "tristrips" else fan_triangles)(one) for one in lists])
    corners = np.concatenate(lists)
    if shape.tag == "triangles":
        counts = np.full(len(corners) // 3, 3)
    elif shape.tag == "polygons":
        counts = np.array([len(one) for one in lists])
    else:
        counts = np.concatenate([np.zeros(0, np.int64), *(_numbers(one, np.int64) for one in shape.iterfind("vcount"))])
    if counts.sum() != len(corners) or (counts < 0).any():
        raise Damage(f"has a <{shape.tag}> of {counts.sum()} corners that holds {len(corners)}; export it again")
    _check_count(shape, len(counts))
    return triangulate(vertices, corners, counts)
