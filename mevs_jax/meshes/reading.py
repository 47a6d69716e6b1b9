"""Mesh files of the disk: what is read of them, and which of it is surface. In NumPy alone, as the readers."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import get_args

import numpy as np
from jaxtyping import Float, Int

from mevs_jax.errors import Damage, DamagedMesh, EmptyMesh, naming
from mevs_jax.geometry.faces import have_area
from mevs_jax.meshes import MESH_SUFFIXES, Up, parse_mesh
from mevs_jax.meshes.polygons import check_indices

LARGEST_FILE = 2 << 30
"""Largest size in bytes of a mesh file that is read."""

LARGEST_COORDINATE = 1e30
"""Coordinates beyond this would overflow float32 when they are squared."""

SMALLEST_RADIUS = 1e-150
"""Meshes smaller than this are a single point, whose size cannot be normalised."""


def read_mesh(
    path: str | Path, up: Up = "auto"
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "triangles 3"]]:
    """Reads the surface of a mesh file: corners, z up, in the units of the file, and triangles, all of which have an area.

    Corners that no triangle uses are left out. Formats: OFF, OBJ, STL, PLY, GLB and glTF, COLLADA, 3MF. Concave polygons need the
    package mapbox-earcut, and Draco meshes DracoPy: `pip install mevs-jax[mesh]`.

    Args:
        path: of the file; its suffix says the format. A glTF may name buffers in files below its folder.
        up: which axis of the file is up: `z`, `y`, or `auto`, which is y for glTF, what it declares for COLLADA, and else z.

    Raises:
        mevs_jax.errors.DataError: a `ValueError`, if it is not a mesh that can be read; the message says why, and what to do.
    """
    where = shown(str(path))
    if up not in get_args(Up):
        raise ValueError(f"up must be one of {', '.join(get_args(Up))}, got {up!r:.80}")
    if Path(path).suffix.lower() not in MESH_SUFFIXES:
        known = f"a mesh that is read here ({', '.join(MESH_SUFFIXES)})"
        raise DamagedMesh(f"{where} has no suffix of {known}; convert it to one of them")
    try:
        return surface_of(*read_with(content_of_file, str(path), where, up), where)
    except EmptyMesh as reason:
        raise DamagedMesh(f"{where} cannot be used: {reason}; choose a mesh with faces") from reason


def read_with(content_of: Callable[[str], bytes], path: str, where: str, up: Up) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3), z up, and triangles (m, 3) of a mesh file, which may need others of its folder.

    Args:
        content_of: returns the content of a file by its path, or raises `Damage`.
        path: of the mesh file.
        where: its name for error messages.
        up: which axis of the file is up.

    Raises:
        DamagedMesh: if it, or a file that it needs, cannot be read.
    """
    folder = path.removesuffix(os.path.basename(path))

    def sibling(name: str) -> bytes:
        with naming(f"{where} needs {shown(name)!r}, which"):
            inside = PurePosixPath(name.replace("\\", "/"))
            if inside.is_absolute() or ".." in inside.parts or ":" in name:
                raise Damage("is outside of its folder; put both into one folder, or export as .glb")
            return content_of(f"{folder}{inside}")

    with naming(where):
        content = content_of(path)
    return parse_mesh(content, PurePosixPath(path).suffix.lower(), where, up=up, sibling=sibling)


def content_of_file(path: str) -> bytes:
    """Returns the content of a file of the disk; raises `Damage` if it cannot be read, or is too large."""
    try:
        if os.path.getsize(path) > LARGEST_FILE:
            raise Damage(f"is larger than {LARGEST_FILE >> 30} GB; export a simpler mesh")
        return Path(path).read_bytes()
    except OSError as error:
        raise Damage(f"cannot be read: {error.strerror}") from error
    except ValueError as error:  # a name with a NUL character
        raise Damage(f"cannot be read: {error}") from error


def surface_of(vertices: np.ndarray, faces: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices, float64, and faces of a mesh without vertices that no face uses and faces without area.

    Raises:
        DamagedMesh: if a coordinate that a face uses is not finite or too large, or a face names a vertex that does not exist.
        EmptyMesh: if there are no faces, or none has an area.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if len(vertices) == 0:
        raise EmptyMesh("mesh has no faces")
    if len(faces) == 0:
        raise EmptyMesh(f"mesh has no faces: it is a point cloud of {len(vertices)} points")
    with naming(where):
        check_indices(faces, len(vertices))
    vertices, faces = _used(vertices, faces)
    if not np.isfinite(vertices).all():
        bad = f"{int((~np.isfinite(vertices).all(axis=1)).sum())} vertices that are not finite (NaN or infinite)"
        raise DamagedMesh(f"{where} has {bad}; repair it or take it away")
    if np.abs(vertices).max() > LARGEST_COORDINATE:
        raise DamagedMesh(f"{where} has coordinates beyond {LARGEST_COORDINATE:g}; repair it or take it away")
    if np.ptp(vertices, axis=0).max() < SMALLEST_RADIUS:
        raise EmptyMesh("mesh is a single point")
    seen = have_area(vertices, faces)
    if not seen.any():
        raise EmptyMesh("mesh has no area: all its faces are degenerate")
    return _used(vertices, faces[seen])


def _used(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, compact = np.unique(faces, return_inverse=True)
    return vertices[used], compact.reshape(faces.shape)


def shown(name: str) -> str:
    """Returns a path as printable text: bytes that are not UTF-8 and control characters become escapes such as `\\xfc`."""
    try:
        name.encode()
    except UnicodeEncodeError:
        name = os.fsencode(name).decode("utf-8", "backslashreplace")
    if name.isprintable():
        return name
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in name)
