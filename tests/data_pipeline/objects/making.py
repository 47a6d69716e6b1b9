"""Meshes in many formats, written by hand so that tests know what is in them."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_pipeline.objects.sources import open_source
from mevs_jax.meshes import parse_mesh

Polygons = Sequence[Sequence[int]]

BOX_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def box(size: Sequence[float] = (1, 2, 3), at: Sequence[float] = (0, 0, 0)) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and quads of a box; its area is 2 (ab + bc + ca)."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return corners * size + at, BOX_FACES


def u_profile() -> tuple[np.ndarray, list[list[int]]]:
    """A U of 3 × 3 × 0.5 with walls 1 thick: two concave ends of area 7 and eight sides."""
    outline = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
    vertices = np.array([(x, y, z) for z in (0, 0.5) for x, y in outline], float)
    sides = [[i, (i + 1) % 8, (i + 1) % 8 + 8, i + 8] for i in range(8)]
    return vertices, [list(range(8))[::-1], list(range(8, 16)), *sides]


U_AREA = 2 * 7 + 0.5 * 16
"""Ends, and the outline of length 16 times the height."""


def triangles_of(faces: Polygons) -> np.ndarray:
    return np.array([(face[0], face[i], face[i + 1]) for face in faces for i in range(1, len(face) - 1)])


def off(vertices: np.ndarray, faces: Polygons, header: str = "OFF", extra: str = "", joined: bool = False) -> bytes:
    lines = [f"{header}{' ' if joined else chr(10)}{len(vertices)} {len(faces)} 0"]
    lines += [" ".join(map(repr, map(float, vertex))) + extra for vertex in vertices]
    lines += [f"{len(face)} " + " ".join(map(str, face)) for face in faces]
    return ("\n".join(lines) + "\n").encode()


def obj(vertices: np.ndarray, faces: Polygons, relative: bool = False) -> bytes:
    lines = ["# made by hand", *("v " + " ".join(map(repr, map(float, vertex))) for vertex in vertices)]
    shift = -len(vertices) if relative else 1
    lines += ["f " + " ".join(str(corner + shift) for corner in face) for face in faces]
    return ("\n".join(lines) + "\n").encode()


def stl(vertices: np.ndarray, faces: Polygons, text: bool = False) -> bytes:
    corners = vertices[triangles_of(faces)]
    if not text:
        body = b"".join(struct.pack("<12fH", 0, 0, 1, *triangle.reshape(-1), 0) for triangle in corners)
        return b"solid in name only".ljust(80) + struct.pack("<I", len(corners)) + body
    lines = ["solid one"]
    for triangle in corners:
        lines += [" facet normal 0 0 1", "  outer loop"]
        lines += ["   vertex " + " ".join(map(repr, map(float, corner))) for corner in triangle]
        lines += ["  endloop", " endfacet"]
    return ("\n".join([*lines, "endsolid one"]) + "\n").encode()


def ply(vertices: np.ndarray, faces: Polygons, order: str = "ascii", comment: bytes = b"by hand") -> bytes:
    name = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = (
        b"ply\nformat %s 1.0\ncomment %s\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face %d\nproperty list uchar int vertex_indices\nend_header\n"
    ) % (name.encode(), comment, len(vertices), len(faces))
    if order == "ascii":
        rows = [" ".join(map(repr, map(float, vertex))) for vertex in vertices]
        rows += [f"{len(face)} " + " ".join(map(str, face)) for face in faces]
        return head + ("\n".join(rows) + "\n").encode()
    body = np.asarray(vertices, order + "f4").tobytes()
    return head + body + b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)


class Glb:
    """A GLB file put together piece by piece."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "meshes": [], "nodes": [], "scene": 0,
            "scenes": [{}],
        }  # fmt: skip
        self.binary = b""

    def view(self, content: bytes, **more: Any) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)} | more
        )
        self.binary += content
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, **more: Any) -> int:
        kinds = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
        shape = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[values.shape[1] if values.ndim == 2 else 1]
        entry = {"componentType": kinds[values.dtype.name], "count": len(values), "type": shape}
        view = self.view(np.ascontiguousarray(values).tobytes())
        self.document["accessors"].append({"bufferView": view} | entry | more)
        return len(self.document["accessors"]) - 1

    def mesh(self, *primitives: dict[str, Any]) -> int:
        self.document["meshes"].append({"primitives": list(primitives)})
        return len(self.document["meshes"]) - 1

    def primitive(self, vertices: np.ndarray, triangles: np.ndarray | None, **more: Any) -> dict[str, Any]:
        entry: dict[str, Any] = {"attributes": {"POSITION": self.accessor(np.asarray(vertices, np.float32))}}
        if triangles is not None:
            entry["indices"] = self.accessor(np.asarray(triangles, np.uint16).reshape(-1))
        return entry | more

    def node(self, root: bool = True, **content: Any) -> int:
        self.document["nodes"].append(content)
        if root:
            self.document["scenes"][0].setdefault("nodes", []).append(len(self.document["nodes"]) - 1)
        return len(self.document["nodes"]) - 1

    def require(self, *names: str) -> None:
        self.document |= {"extensionsUsed": list(names), "extensionsRequired": list(names)}

    def bytes(self) -> bytes:
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        body = (
            struct.pack("<I4s", len(text), b"JSON")
            + text
            + struct.pack("<I4s", len(self.binary), b"BIN\0")
            + self.binary
        )
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    def gltf(self, buffer: str) -> bytes:
        """The document alone, with its numbers in another file."""
        self.document["buffers"] = [{"byteLength": len(self.binary), "uri": buffer}]
        return json.dumps(self.document).encode()


def glb(vertices: np.ndarray, faces: Polygons) -> bytes:
    made = Glb()
    made.node(mesh=made.mesh(made.primitive(vertices, triangles_of(faces))))
    return made.bytes()


def draco(vertices: np.ndarray, faces: Polygons) -> bytes:
    import DracoPy

    made = Glb()
    packed = DracoPy.encode(
        np.asarray(vertices, np.float32), triangles_of(faces).astype(np.uint32), quantization_bits=16
    )
    view = made.view(packed)
    bounds = {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
    made.document["accessors"] = [
        {"componentType": 5126, "count": len(vertices), "type": "VEC3"} | bounds,
        {"componentType": 5125, "count": 3 * len(triangles_of(faces)), "type": "SCALAR"},
    ]
    extension = {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": {"POSITION": 0}}}
    made.node(mesh=made.mesh({"attributes": {"POSITION": 0}, "indices": 1, "extensions": extension}))
    made.require("KHR_draco_mesh_compression")
    return made.bytes()


def dae(
    vertices: np.ndarray, faces: Polygons, up: str = "Z_UP", matrix: str = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
) -> bytes:
    numbers = " ".join(map(repr, map(float, vertices.reshape(-1))))
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
 <asset><created>2026-01-01T00:00:00</created><modified>2026-01-01T00:00:00</modified><up_axis>{up}</up_axis></asset>
 <library_geometries><geometry id="g"><mesh>
  <source id="p"><float_array id="a" count="{vertices.size}">{numbers}</float_array>
   <technique_common><accessor source="#a" count="{len(vertices)}" stride="3"><param name="X" type="float"/>
    <param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
  <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
  <polylist count="{len(faces)}"><input semantic="VERTEX" source="#v" offset="0"/>
   <vcount>{" ".join(str(len(face)) for face in faces)}</vcount>
   <p>{" ".join(str(c) for face in faces for c in face)}</p></polylist>
 </mesh></geometry></library_geometries>
 <library_visual_scenes><visual_scene id="s"><node id="n"><matrix>{matrix}</matrix><instance_geometry url="#g"/></node>
 </visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene>
</COLLADA>""".encode()


def threemf(vertices: np.ndarray, faces: Polygons, transform: str = "", named: bool = True) -> bytes:
    core = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    points = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in vertices)
    corners = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in triangles_of(faces))
    given = f' transform="{transform}"' if transform else ""
    mesh = f"<mesh><vertices>{points}</vertices><triangles>{corners}</triangles></mesh>"
    model = (
        f'<?xml version="1.0"?><model unit="millimeter" xmlns="{core}"><resources><object id="1" type="model">{mesh}</object>'
        f'</resources><build><item objectid="1"{given}/></build></model>'
    )
    there = '<Relationship Id="a" Target="/3D/3dmodel.model" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>'
    rels = (
        f'<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">{there}</Relationships>'
    )
    return zipped({"3D/3dmodel.model": model.encode(), **({"_rels/.rels": rels.encode()} if named else {})})


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def members(classes: Sequence[str] = ("mug", "rack"), prefix: str = "") -> dict[str, bytes]:
    """Three boxes of each class, all of different sizes, in ModelNet's layout."""
    return {
        f"{prefix}{name}/{split}/{name}_{index}.off": off(*box((1, 1 + at, 2 + index)))
        for at, name in enumerate(classes)
        for index, split in enumerate(("train", "train", "test"))
    }


def write(root: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return root


def opened(path: Path | str, **options: Any):
    return open_source(str(path), train_per_class=2, test_per_class=1, **options)


def area(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (vertices[triangles[:, at]] for at in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def extent(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    used = vertices[np.unique(triangles)]
    return used.max(axis=0) - used.min(axis=0)


BOX_AREA = 2 * (2 + 6 + 3)
"""Of `box()`."""


def check(
    content: bytes, suffix: str, size=(1, 2, 3), surface: float = BOX_AREA, *, rtol: float = 1e-6, **options
) -> None:
    """A file has this extent and surface."""
    mesh = parse_mesh(content, suffix, f"thing{suffix}", **options)
    np.testing.assert_allclose(extent(*mesh), size, rtol=rtol, atol=1e-6)
    assert area(*mesh) == pytest.approx(surface, rel=max(rtol, 1e-6))
