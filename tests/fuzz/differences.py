"""What other readers make of mutated meshes: `python -m tests.fuzz.differences [--inputs 2000] [format …]`.

Each input is read by the project and by trimesh, Open3D and assimp where they read the format. What both say is one of few
kinds, by the reason where one refuses. They are counted, with inputs of each kind kept in a folder. Two readers agree if they
have the same surface: its area, and the first and second moments of its points, so that a polygon may be cut into any triangles.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import trimesh
from hypothesis import given, seed

from data_pipeline.errors import DataError, EmptyMesh
from mevs_jax.meshes import TO_Z_UP, parse_mesh
from tests.fuzz.targets import generated, mutated

FORMATS = ("off", "obj", "stl", "ply", "glb", "dae", "3mf")
Read = Callable[[bytes, str], np.ndarray]


def _by_trimesh(content: bytes, suffix: str) -> np.ndarray:
    scene = trimesh.load_scene(io.BytesIO(content), file_type=suffix, process=False)
    parts = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
    return np.concatenate([part.vertices[part.faces] for part in parts]) if parts else np.zeros((0, 3, 3))


def _by_open3d(content: bytes, suffix: str) -> np.ndarray:
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    with tempfile.NamedTemporaryFile(suffix=f".{suffix}") as file:
        Path(file.name).write_bytes(content)
        mesh = open3d.io.read_triangle_mesh(file.name)
    if not len(mesh.triangles):
        raise ValueError("no triangles")
    return np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]


def _by_assimp(content: bytes, suffix: str) -> np.ndarray:
    import assimp_py

    with tempfile.NamedTemporaryFile(suffix=f".{suffix}") as file:
        Path(file.name).write_bytes(content)
        scene = assimp_py.import_file(
            file.name,
            assimp_py.Process_Triangulate | assimp_py.Process_PreTransformVertices | assimp_py.Process_SortByPType,
        )
    parts = [(np.reshape(mesh.vertices, (-1, 3)), np.asarray(mesh.indices)) for mesh in scene.meshes]
    corners = np.concatenate([vertices[indices] for vertices, indices in parts if indices.size % 3 == 0]).reshape(
        -1, 3, 3
    )
    declared = re.search(rb"([XYZ])_UP", content) if suffix == "dae" else None
    axis = declared[1].decode().lower() if declared else "y"
    return corners if suffix != "dae" or axis == "y" else corners @ TO_Z_UP["y"].T @ TO_Z_UP.get(axis, np.eye(3))


def _ours(content: bytes, suffix: str) -> np.ndarray:
    vertices, faces = parse_mesh(content, f".{suffix}", "it", up="z")
    return vertices[faces]


READERS: dict[str, tuple[Read, tuple[str, ...]]] = {
    "trimesh": (_by_trimesh, FORMATS if find_spec("lxml") else FORMATS[:-1]),
    "Open3D": (_by_open3d, ("obj", "stl", "glb")),
    "assimp": (_by_assimp, ("off", "obj", "stl", "glb", "dae", "3mf") if find_spec("assimp_py") else ()),
}
"""Readers and what they read. trimesh needs lxml for 3MF, and assimp the package assimp-py. Open3D ends its process by a signal
at some damaged OFF and PLY, assimp at some PLY."""


def _surface(corners: np.ndarray) -> np.ndarray | None:
    """Area, centre and second moments of a surface; None for none, or numbers that are not finite."""
    corners = np.asarray(corners, np.float64).reshape(-1, 3, 3)
    with np.errstate(all="ignore"):
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        whole, sums = area.sum(), corners.sum(axis=1)
        squares = np.einsum("tki,tkj->tij", corners, corners) + np.einsum("ti,tj->tij", sums, sums)
        moments = np.concatenate([area @ sums / 3, (area @ squares.reshape(-1, 9)) / 12]) / whole
    return np.concatenate([[whole], moments]) if whole > 0 and np.isfinite(moments).all() else None


def _said(error: BaseException) -> str:
    """The kind of a reason: without numbers, names and what is quoted."""
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return re.sub(r"'[^']*'|[-+]?\d[\w.+-]*|\([^)]*\)", "…", text)[:70]


def compare(content: bytes, suffix: str, other: Read) -> str:
    """The kind of what the project and another reader make of an input."""
    mine = theirs = None
    why = "nothing with an area"
    try:
        mine = _surface(_ours(content, suffix))
    except (DataError, EmptyMesh) as error:
        why = _said(error)
    try:
        theirs = _surface(other(content, suffix))
    except BaseException as error:  # other readers raise anything
        if isinstance(error, KeyboardInterrupt):
            raise
    if mine is None:
        return "both refuse" if theirs is None else f"refused here, read there: {why}"
    if theirs is None:
        return "read here, refused there"
    if np.allclose(mine, theirs, rtol=1e-4, atol=1e-4 * np.abs(mine).max()):
        return "the same"
    if np.isclose(mine[0], theirs[0], rtol=1e-4):
        return "as much, elsewhere"
    return "more here" if mine[0] > theirs[0] else "less here"


def count(suffix: str, inputs: int, start: int, keep: Path) -> dict[str, Counter[str]]:
    """How often each kind occurs, by reader; the first input of each kind is kept in a folder."""
    found: dict[str, Counter[str]] = {name: Counter() for name, (_, reads) in READERS.items() if suffix in reads}

    @seed(start)
    @generated(inputs)
    @given(mutated(suffix, 2))
    def check(content: bytes) -> None:
        for name, counted in found.items():
            kind = compare(content, suffix, READERS[name][0])
            counted[kind] += 1
            if counted[kind] <= 3:
                file = re.sub(r"\W+", "_", f"{name} {kind}").strip("_")[:80]
                (keep / f"{file}_{counted[kind]}.{suffix}").write_bytes(content)

    with contextlib.redirect_stderr(io.StringIO()):
        check()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("formats", nargs="*", default=FORMATS)
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("differences"))
    options = parser.parse_args()
    options.keep.mkdir(parents=True, exist_ok=True)
    for suffix in options.formats:
        for name, counted in count(suffix, options.inputs, options.seed, options.keep).items():
            for kind, often in counted.most_common():
                print(f"{suffix} | {name} | {often} | {kind}", flush=True)


if __name__ == "__main__":
    main()
