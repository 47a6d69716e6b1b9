"""What other readers make of mutated meshes: `python -m tests.fuzz.differences [--inputs 2000] [format …]`.

Each input is read by the project and by trimesh, and by Open3D where it reads the format. What both say is one of few kinds, by
the reason where one refuses. They are counted, with an input of each kind kept in a folder. Two readers agree if they have the
same triangles, as points in space in any order; triangles without area do not count.
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
from mevs_jax.meshes import parse_mesh
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


def _ours(content: bytes, suffix: str) -> np.ndarray:
    vertices, faces = parse_mesh(content, f".{suffix}", "it", up="z")
    return vertices[faces]


READERS: dict[str, tuple[Read, tuple[str, ...]]] = {
    "trimesh": (_by_trimesh, FORMATS if find_spec("lxml") else FORMATS[:-1]),
    "Open3D": (_by_open3d, ("off", "obj", "stl", "glb")),
}
"""Readers and what they read. trimesh needs lxml for 3MF. Open3D ends its process by a signal at some damaged PLY."""


def _shape(corners: np.ndarray) -> np.ndarray | None:
    """Sorted triangles with an area, by six digits; None for numbers that are not finite."""
    corners = np.asarray(corners, np.float64).reshape(-1, 3, 3)
    if not np.isfinite(corners).all():
        return None
    with np.errstate(all="ignore"):
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        kept = corners[area > 1e-9 * max(1e-30, float(np.abs(corners).max(initial=0)) ** 2)]
        size = max(1e-30, float(np.abs(kept).max(initial=0)))
        centres = np.round(kept.mean(axis=1) / size, 5) + 0.0
    return centres[np.lexsort(centres.T)]


def _said(error: BaseException) -> str:
    """The kind of a reason: without numbers, names and what is quoted."""
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return re.sub(r"'[^']*'|[-+]?\d[\w.+-]*|\([^)]*\)", "…", text)[:70]


def compare(content: bytes, suffix: str, other: Read) -> str:
    """The kind of what the project and another reader make of an input."""
    mine = theirs = None
    why = ""
    try:
        mine = _shape(_ours(content, suffix))
    except (DataError, EmptyMesh) as error:
        why = _said(error)
    try:
        theirs = _shape(other(content, suffix))
    except BaseException as error:  # other readers raise anything
        if isinstance(error, KeyboardInterrupt):
            raise
    if mine is None or not len(mine):
        return (
            "both refuse"
            if theirs is None or not len(theirs)
            else f"refused here, read there: {why or 'nothing with an area'}"
        )
    if theirs is None or not len(theirs):
        return "read here, refused there"
    if len(mine) == len(theirs):
        return "the same" if np.allclose(mine, theirs, atol=2e-5) else "other places"
    return "more triangles here" if len(mine) > len(theirs) else "fewer triangles here"


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
