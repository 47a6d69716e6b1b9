"""Readers of mesh formats: the one place where foreign files become arrays.

One module reads one format. docs/data.md has a table of what each format promises: what is read, ignored and refused.
Libraries read what they read right: DracoPy Draco, mapbox-earcut concave polygons. All formats have readers of our own, since
trimesh, assimp and pycollada lose or misread parts of the files of `tests/data_pipeline/objects`, or read truncated files without
a word. Tests compare them with trimesh, pycollada and the counts that the files declare.

A reader returns the vertices (n, 3) and triangles (m, 3) of a file's content. It raises `Damage`, `EmptyMesh` if it knows why
there are no triangles, or a `ValueError` whose message is the reason why the content is not of its format; readers of glTF,
COLLADA and 3MF may also raise what their libraries raise. What a file holds and a reader does not read is ignored only if it is
named there as no geometry; a line, element or extension that is not known is an error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from mevs_jax.errors import Damage, DamagedMesh, DataError, EmptyMesh, kind_and_reason_of, naming
from mevs_jax.meshes.dae import parse_dae
from mevs_jax.meshes.gltf import parse_gltf
from mevs_jax.meshes.obj import parse_obj
from mevs_jax.meshes.off import parse_off
from mevs_jax.meshes.ply import parse_ply
from mevs_jax.meshes.stl import parse_stl
from mevs_jax.meshes.threemf import parse_3mf

MESH_SUFFIXES = (".off", ".obj", ".stl", ".ply", ".glb", ".gltf", ".dae", ".3mf")

UNREAD_SUFFIXES = (
    ".3ds", ".amf", ".blend", ".brep", ".c4d", ".ctm", ".drc", ".dxf", ".fbx", ".iges", ".igs", ".lwo", ".ma", ".max", ".mb",
    ".mesh", ".msh", ".skp", ".step", ".stp", ".usd", ".usda", ".usdc", ".usdz", ".vrml", ".vtk", ".vtp", ".vtu", ".wrl", ".x3d",
    ".pcd", ".las", ".laz", ".e57",
)  # fmt: skip
"""Suffixes of meshes and scans that are not read. Such files are left out by name."""

AXIS_DECLARED = (".glb", ".gltf", ".dae")
"""Formats that define or declare which axis is up. All others are taken as z up."""

Up = Literal["auto", "z", "y"]
"""Which axis of a file is up: the one its format declares, else z (`auto`), or always z or y."""

TO_Z_UP = {"x": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
"""Rotations that turn x or y up into z up, as COLLADA's and glTF's axes are defined."""

_OWN_READERS: dict[str, tuple[str, Callable[[bytes], tuple[np.ndarray, np.ndarray]]]] = {
    ".off": ("an OFF", parse_off),
    ".obj": ("a readable .obj", parse_obj),
    ".stl": ("a readable .stl", parse_stl),
    ".ply": ("a readable .ply", parse_ply),
}

_POINTERS = {b"version https://git-lfs.github.com/spec/": "git lfs pull", b"/annex/objects/": "git annex get"}
"""How files begin that Git LFS and git-annex leave in place of files that were not fetched, and what fetches them."""


def _no_sibling(name: str) -> bytes:
    raise DamagedMesh(f"it needs the file {name!r}, which cannot be read here")


def parse_mesh(
    content: bytes, suffix: str, where: str, *, up: Up = "auto", sibling: Callable[[str], bytes] = _no_sibling
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3), z up, and triangles (m, 3) of a mesh file.

    Args:
        content: content of the file.
        suffix: format, one of `MESH_SUFFIXES`.
        where: name of the file for error messages.
        up: which axis of the file is up.
        sibling: returns the content of a file by its path relative to this one, for the buffers of glTF.

    Raises:
        DamagedMesh: if the file is not a readable mesh or is truncated.
        EmptyMesh: if it has no triangles, and the reader knows why.
    """
    with naming(where):
        for begin, command in _POINTERS.items():
            if content.startswith(begin) and len(content) < 1024:
                raise Damage(f"only stands for a file that is not here; fetch it with: {command}")
        try:
            if suffix in _OWN_READERS:
                vertices, triangles, axis = *_own(content, suffix), "z"
            else:
                vertices, triangles, axis = _foreign(content, suffix, sibling)
        except (MemoryError, RecursionError) as error:
            raise Damage("is too large or too deeply nested to be read; export a simpler mesh") from error
    turn = TO_Z_UP.get(axis if up == "auto" else up)
    if turn is not None:
        with np.errstate(all="ignore"):  # vertices that no face uses may be NaN
            vertices = vertices @ turn.T
    return vertices, triangles


def _own(content: bytes, suffix: str) -> tuple[np.ndarray, np.ndarray]:
    kind, read = _OWN_READERS[suffix]
    try:
        return read(content)
    except ValueError as error:
        raise Damage(f"is not {kind} mesh: {error}; repair it or take it away") from error


def _foreign(content: bytes, suffix: str, sibling: Callable[[str], bytes]) -> Any:
    """Returns vertices, triangles and axis of a document, whose readers may fail in many ways."""
    try:
        if suffix == ".dae":
            return parse_dae(content)
        return (*parse_3mf(content), "z") if suffix == ".3mf" else (*parse_gltf(content, sibling), "y")
    except (Damage, DataError, EmptyMesh):
        raise
    except Exception as error:
        kind = "glTF" if suffix in (".glb", ".gltf") else suffix
        reason = str(error) if type(error) is ValueError else kind_and_reason_of(error)
        reason = f"it has no {error}" if isinstance(error, KeyError) else reason
        raise Damage(f"is not a readable {kind} mesh ({reason}); repair it or take it away") from error
