"""glTF 2.0 and GLB: the triangles of the default scene, with all transforms, y up.

Read are triangles, strips and fans, indexed or not; matrices and translation, rotation, scale of nodes; sparse accessors;
KHR_mesh_quantization; KHR_draco_mesh_compression (by DracoPy); EXT_mesh_gpu_instancing; KHR_node_visibility; skins in their rest
pose; morph targets by their default weights. Materials, animations, points and lines are ignored. A file that requires any other
extension of its geometry is refused.

Source: glTF 2.0 specification, Khronos Group (ISO/IEC 12113:2022), sections 3.5 to 3.7.
"""

from __future__ import annotations

import base64
import json
import math
import urllib.parse
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from mevs_jax.errors import Damage, DamagedMesh, EmptyMesh, cut_short
from mevs_jax.meshes.polygons import check_indices, fan_triangles, library, merged, moved, strip_triangles
from mevs_jax.meshes.text import is_filler

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_INDICES = (5121, 5123, 5125)
_DRACO, _INSTANCING, _VISIBILITY = "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing", "KHR_node_visibility"
_READ = (_DRACO, _INSTANCING, _VISIBILITY, "KHR_mesh_quantization")
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_xmp", "EXT_lights_",
             "KHR_animation", "KHR_node_hoverability", "KHR_node_selectability", "MSFT_packing", "KHR_techniques_",
             "ADOBE_materials")  # fmt: skip
"""Beginnings of the names of extensions that leave the geometry as it is."""

_NAMES = (
    "accessors attributes buffer bufferView bufferViews buffers byteLength byteOffset byteStride children componentType count "
    "extensions extensionsRequired indices inverseBindMatrices joints matrix mesh meshes mode nodes normalized primitives "
    "rotation scale scene scenes skin skins sparse targets translation type uri values weights"
)
_PLAIN = {name.lower(): name for name in _NAMES.split()}
"""Names of parts that are read. One in other capitals would be ignored, as glTF ignores names that it does not define."""

MOST_ELEMENTS, MOST_ZEROS, MOST_COPIES = 50_000_000, 5_000_000, 100_000
"""Largest numbers of vertices and triangles of a scene together, of elements of an accessor without data, and of instances of
one mesh. A small file can declare any number."""


def parse_gltf(content: bytes, sibling: Callable[[str], bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Reads a glTF or GLB file; `sibling` returns the content of a file by its path relative to this one."""
    document, binary = _chunks(content)
    return _Reader(document, binary, sibling).meshes()


def _chunks(content: bytes) -> tuple[Any, bytes]:
    """Returns the JSON document and the binary chunk."""
    if content[:4] != b"glTF":
        return _json(content.decode("utf-8-sig")), b""
    if int.from_bytes(content[4:8], "little") != 2:
        raise Damage(f"is a GLB file of version {content[4]}, not 2; export it again as glTF 2.0")
    declared = int.from_bytes(content[8:12], "little")
    if declared > len(content):
        raise cut_short(f"{len(content)} of {declared} bytes are there")
    if not is_filler(content[declared:]):
        raise Damage(f"is not a readable glTF mesh: it declares {declared} bytes and holds more; export it again")
    document, binary, at = None, b"", 12
    while at + 8 <= declared:
        length, kind = int.from_bytes(content[at : at + 4], "little"), content[at + 4 : at + 8]
        if at + 8 + length > declared:
            raise Damage("is not a readable glTF mesh: a chunk goes beyond its end; export it again")
        chunk = content[at + 8 : at + 8 + length]
        if kind == b"JSON" and document is None:
            document = _json(chunk.decode())
        elif kind == b"BIN\0" and not binary:
            binary = chunk
        at += 8 + length
    return document, binary


def _json(text: str) -> Any:
    """Returns a document, in which no name stands twice in one place."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = dict(pairs)
        if len(names) < len(pairs):
            raise ValueError(f"a part with the names {', '.join(sorted(names))[:60]} has one of them twice")
        return names

    return json.loads(text, object_pairs_hook=once)


def _checked(entry: Any) -> Any:
    """Returns a part of a document, whose names are not in other capitals than glTF's."""
    for name in entry if isinstance(entry, dict) else ():
        if (plain := _PLAIN.get(name.lower(), name)) != name:
            raise ValueError(f"a part has the name {name!r}, which glTF writes {plain!r}")
    return entry


class _Reader:
    """Reads the meshes of one document."""

    def __init__(self, document: Any, binary: bytes, sibling: Callable[[str], bytes]):
        if not isinstance(document, dict) or "asset" not in document:
            raise Damage("is not a readable glTF mesh: it has no asset; repair it or take it away")
        asset = document["asset"]
        least = asset.get("minVersion", "2.0")
        if not str(asset.get("version", "")).startswith("2.") or least != "2.0":
            version = asset.get("version") if least == "2.0" else least
            raise Damage(f"is not glTF 2.0 but {version!r}; export it as glTF 2.0")
        self.document, self.binary, self.sibling = _checked(document), binary, sibling
        self.buffers: dict[int, bytes] = {}
        self.elements = 0
        for name in document.get("extensionsRequired", []):
            if name not in _READ and not str(name).startswith(_HARMLESS):
                without = "export it without (gltf-transform, Blender)"
                raise Damage(f"requires the extension {name}, which is not read; {without}")

    def item(self, kind: str, index: Any) -> Any:
        """Returns one entry of a list of the document, such as accessor 3."""
        if type(index) is not int or not 0 <= index < len(self.document.get(kind, [])):
            raise ValueError(f"{index!r} is no index of its {kind}")
        return _checked(self.document[kind][index])

    def buffer(self, index: Any) -> bytes:
        """Returns the content of a buffer: the binary chunk, a data URI, or another file."""
        if index in self.buffers:
            return self.buffers[index]
        entry = self.item("buffers", index)
        uri = entry.get("uri")
        if uri is None and index == 0:
            content = self.binary
        elif uri is None:
            raise Damage(f"has no data for buffer {index}; export it again")
        elif uri[:5].lower() == "data:":
            head, _, body = uri.partition(",")
            content = urllib.parse.unquote_to_bytes(body)
            if head.lower().endswith(";base64"):
                content = base64.b64decode(b"".join(content.split()), validate=True)
        else:
            content = self._beside(uri)
        if len(content) < entry["byteLength"]:
            raise cut_short(f"buffer {index} has {len(content)} of {entry['byteLength']} bytes")
        self.buffers[index] = content
        return content

    def _beside(self, uri: str) -> bytes:
        """Returns the content of another file, whose name may be written with escapes such as `%20`, or as it is."""
        try:
            return self.sibling(urllib.parse.unquote(uri))
        except DamagedMesh:
            if "%" in uri:
                with suppress(DamagedMesh):
                    return self.sibling(uri)
            raise

    def view(self, index: Any) -> tuple[bytes, int]:
        """Returns the bytes of a buffer view and the distance of its elements, 0 if they are packed."""
        entry = self.item("bufferViews", index)
        for name in entry.get("extensions", {}):  # if its buffer has data all the same, these are not compressed
            if "meshopt" in name and "extensions" in self.item("buffers", entry["buffer"]):
                raise Damage(
                    f"is compressed with {name}, which is not read; unpack it with: gltf-transform copy, or gltfpack"
                )
        start, length = entry.get("byteOffset", 0), entry["byteLength"]
        content = self.buffer(entry["buffer"])
        if min(start, length) < 0 or start + length > len(content):
            raise Damage(f"is cut short: buffer view {index} goes beyond its buffer; export it again")
        return content[start : start + length], int(entry.get("byteStride", 0))

    def _array(self, entry: Any, count: int, kind: str, width: int) -> np.ndarray:
        """Returns `count` elements of `width` numbers from the place in a buffer view that `entry` names."""
        index, offset = entry["bufferView"], entry.get("byteOffset", 0)
        content, stride = self.view(index)
        element = np.dtype((kind, (width,)))
        stride = stride or element.itemsize
        if offset < 0 or count < 0 or stride < element.itemsize or (
            count and offset + stride * (count - 1) + element.itemsize > len(content)
        ):  # fmt: skip
            raise Damage(f"is cut short: an accessor goes beyond buffer view {index}; export it again")
        return np.ndarray((count, width), kind, content, offset, (stride, np.dtype(kind).itemsize))

    def accessor(self, index: Any) -> np.ndarray:
        """Returns the elements of an accessor (count, width); normalised integers become float64 in [−1, 1]."""
        entry = self.item("accessors", index)
        kind, width, count = _COMPONENTS[entry["componentType"]], _WIDTHS[entry["type"]], entry["count"]
        if type(count) is not int or not 0 <= count <= (MOST_ELEMENTS if "bufferView" in entry else MOST_ZEROS):
            raise ValueError(f"accessor {index} has {count!r} elements")
        values = self._array(entry, count, kind, width) if "bufferView" in entry else np.zeros((count, width), kind)
        if sparse := entry.get("sparse"):
            at, new, values = sparse["indices"], sparse["values"], values.copy()
            places = self._array(at, sparse["count"], _COMPONENTS[at["componentType"]], 1)
            values[places[:, 0]] = self._array(new, sparse["count"], kind, width)
        return _unquantised(values) if entry.get("normalized") else values

    def _spend(self, elements: int) -> None:
        self.elements += elements
        if self.elements > MOST_ELEMENTS:
            raise Damage(f"unfolds to more than {MOST_ELEMENTS:,} elements; export a simpler mesh")

    def _indices(self, index: Any) -> np.ndarray:
        entry = self.item("accessors", index)
        if entry["componentType"] not in _INDICES or entry["type"] != "SCALAR" or entry.get("normalized"):
            raise ValueError(f"indices are {entry['type']} of the type {entry['componentType']}, not unsigned integers")
        return self._stored(index)[:, 0]

    def _stored(self, index: Any) -> np.ndarray:
        """Returns the elements of an accessor that has data. One without is all zeros, which would be a single point."""
        if {"bufferView", "sparse"}.isdisjoint(self.item("accessors", index)):
            raise ValueError(f"accessor {index} has no data")
        return self.accessor(index)

    def primitive(self, entry: Any) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], Any] | None:
        """Returns the vertices, triangles and skin of a primitive, and itself; or None for points and lines."""
        mode, attributes = _checked(entry).get("mode", 4), entry["attributes"]
        if mode not in range(7):
            raise ValueError(f"a primitive has mode {mode!r}")
        if mode < 4:
            return None
        if "POSITION" not in attributes:
            raise ValueError("a primitive has no attribute POSITION")
        draco = entry.get("extensions", {}).get(_DRACO)
        if draco is not None:
            vertices, indices = self._draco(draco, entry)
        else:
            vertices = self._stored(attributes["POSITION"])
            indices = self._indices(entry["indices"]) if "indices" in entry else np.arange(len(vertices))
        if vertices.shape[1:] != (3,):
            raise ValueError("positions are not VEC3")
        indices = indices.astype(np.int64)
        if len(indices) % 3 if mode == 4 else 0 < len(indices) < 3 or draco is not None:
            raise ValueError(f"{len(indices)} corners are no whole number of triangles in mode {mode}")
        triangles = indices.reshape(-1, 3) if mode == 4 else (strip_triangles if mode == 5 else fan_triangles)(indices)
        check_indices(triangles, len(vertices))
        skin = {name: self.accessor(at) for name, at in attributes.items() if name.startswith(("JOINTS_", "WEIGHTS_"))}
        return vertices.astype(np.float64), triangles, skin, entry

    def _morphed(self, vertices: np.ndarray, entry: Any, weights: Any) -> np.ndarray:
        """Returns the vertices of a primitive with its morph targets, by weights that a node or mesh has without animation."""
        if not any(weights):
            return vertices
        targets = entry.get("targets", [])
        if len(targets) != len(weights) or _DRACO in entry.get("extensions", {}):
            raise Damage(
                f"has {len(weights)} weights of {len(targets)} morph targets, not read; export it without them"
            )
        for weight, target in zip(weights, targets, strict=True):
            if weight and "POSITION" in target:
                by = self.accessor(target["POSITION"])
                if by.shape != vertices.shape:
                    raise ValueError("a morph target has another number of vertices than its mesh")
                vertices = vertices + weight * by.astype(np.float64)
        return vertices

    def _draco(self, draco: Any, entry: Any) -> tuple[np.ndarray, np.ndarray]:
        draco_py = library("DracoPy", "Draco meshes")
        content, _ = self.view(draco["bufferView"])
        try:
            mesh = draco_py.decode(bytes(content))
        except Exception as error:  # DracoPy raises exceptions of its own and of Cython's
            raise Damage(f"has a Draco mesh that cannot be decoded ({error}); export it again") from error
        vertices = np.asarray(mesh.points)
        position = self.item("accessors", entry["attributes"]["POSITION"])
        if position.get("normalized") and vertices.dtype.kind in "iu":
            vertices = _unquantised(vertices.astype(_COMPONENTS[position["componentType"]]))
        faces = getattr(mesh, "faces", None)
        if faces is None:
            raise Damage("has a Draco point cloud in place of a mesh; export it again")
        return vertices.reshape(-1, 3), np.asarray(faces).reshape(-1)

    def matrix(self, node: Any) -> np.ndarray:
        """Returns the transform of a node into its parent's frame, (4, 4)."""
        if "matrix" in node:
            if not node.keys().isdisjoint(("translation", "rotation", "scale")):
                raise ValueError("a node has a matrix and other transforms")
            found = np.array(node["matrix"], np.float64).reshape(4, 4).T
            if (np.abs(found[3] - (0, 0, 0, 1)) > 1e-6).any():
                raise Damage("has a matrix whose last row is not 0 0 0 1; export it again")
            return found
        return _transform(
            np.array([node.get("translation", (0, 0, 0))], np.float64),
            np.array([node.get("rotation", (0, 0, 0, 1))], np.float64),
            np.array([node.get("scale", (1, 1, 1))], np.float64),
        )[0]

    def placed(self) -> tuple[dict[int, np.ndarray], set[int]]:
        """Returns the nodes of the default scene, by number, with their transforms into the world; and which are hidden."""
        nodes = self.document.get("nodes", [])
        if "scenes" in self.document:
            roots = self.item("scenes", self.document.get("scene", 0)).get("nodes", [])
        else:
            roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
        found: dict[int, np.ndarray] = {}
        hidden: set[int] = set()
        todo = [(root, np.eye(4), False) for root in roots[::-1]]
        while todo:
            index, parent, unseen = todo.pop()
            if index in found:
                raise ValueError(f"node {index} is in the scene twice")
            node = self.item("nodes", index)
            found[index] = parent @ self.matrix(node)
            if unseen := unseen or not node.get("extensions", {}).get(_VISIBILITY, {}).get("visible", True):
                hidden.add(index)
            todo += [(child, found[index], unseen) for child in node.get("children", [])[::-1]]
        return found, hidden

    def instances(self, node: Any) -> np.ndarray:
        """Returns the transforms of the copies of a node's mesh into the node's frame, (copies, 4, 4)."""
        instancing = node.get("extensions", {}).get(_INSTANCING)
        if instancing is None:
            return np.eye(4)[None]
        given = {name: self.accessor(at).astype(np.float64) for name, at in instancing["attributes"].items()}
        counts = {len(values) for name, values in given.items() if name in ("TRANSLATION", "ROTATION", "SCALE")}
        if len(counts) != 1:
            raise ValueError("the attributes of instances differ in their number")
        count = counts.pop()
        if count > MOST_COPIES:
            raise Damage(f"has {count:,} copies of a mesh, more than {MOST_COPIES:,}; export a simpler mesh")
        return _transform(
            given.get("TRANSLATION", np.zeros((count, 3))),
            given.get("ROTATION", np.tile((0.0, 0, 0, 1), (count, 1))),
            given.get("SCALE", np.ones((count, 3))),
        )

    def meshes(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the vertices and triangles of all meshes in the scene."""
        placed, hidden = self.placed()
        parts: list[tuple[np.ndarray, np.ndarray]] = []
        read: dict[int, list[Any]] = {}
        nodes = {index: self.item("nodes", index) for index in placed if index not in hidden}
        shown = {index: node for index, node in nodes.items() if "mesh" in node}
        if not shown and (meshes := self.document.get("meshes")):
            raise EmptyMesh(f"mesh has no faces: its scene shows none of its {len(meshes)} meshes")
        for index, node in shown.items():
            world, mesh = placed[index], node["mesh"]
            content = self.item("meshes", mesh)
            if mesh not in read:
                primitives = [self.primitive(entry) for entry in content["primitives"]]
                read[mesh] = [primitive for primitive in primitives if primitive is not None]
            copies = self.instances(node)
            for vertices, triangles, skin, entry in read[mesh]:
                self._spend(len(copies) * (len(vertices) + len(triangles)))
                vertices = self._morphed(vertices, entry, node.get("weights", content.get("weights", ())))
                if "skin" in node and skin:
                    parts.append((self._skinned(vertices, skin, self.item("skins", node["skin"]), placed), triangles))
                    continue
                for copy in world @ copies:
                    parts.append((moved(vertices, copy), triangles))
        return merged(parts)

    def _skinned(
        self, vertices: np.ndarray, skin: dict[str, np.ndarray], entry: Any, placed: dict[int, np.ndarray]
    ) -> np.ndarray:
        """Returns the vertices of a skinned mesh in the rest pose; the transform of its own node does not count."""
        joints = np.stack([placed[joint] for joint in entry["joints"]])
        if "inverseBindMatrices" in entry:
            inverse = self.accessor(entry["inverseBindMatrices"])[: len(joints)].reshape(-1, 4, 4)
            joints = joints @ inverse.transpose(0, 2, 1)
        posed, total = np.zeros_like(vertices), np.zeros((len(vertices), 1))
        for name in sorted(name for name in skin if name.startswith("JOINTS_")):
            weights = skin[name.replace("JOINTS_", "WEIGHTS_")].astype(np.float64)
            for at in range(4):
                matrices = joints[skin[name][:, at].astype(np.int64)]
                places = np.einsum("nij,nj->ni", matrices[:, :3, :3], vertices) + matrices[:, :3, 3]
                posed, total = posed + weights[:, at, None] * places, total + weights[:, at, None]
        return posed / np.where(total == 0, 1, total)


def _unquantised(values: np.ndarray) -> np.ndarray:
    """Returns normalised integers as numbers in [−1, 1] (section 3.11)."""
    if values.dtype.kind not in "iu":
        return values
    return np.maximum(values.astype(np.float64) / np.iinfo(values.dtype).max, -1.0)


def _transform(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Returns matrices (n, 4, 4) that scale, then rotate by a quaternion (x, y, z, w), then move."""
    if not all(math.isfinite(part.sum()) for part in (translation, rotation, scale)):
        raise ValueError("a transform is not finite")
    from scipy.spatial.transform import Rotation  # imported late: it takes a fifth of a second

    found = np.tile(np.eye(4), (len(translation), 1, 1))
    found[:, :3, :3] = Rotation.from_quat(rotation).as_matrix() * scale[:, None, :]
    found[:, :3, 3] = translation
    return found
