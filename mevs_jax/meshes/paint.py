"""Colours of meshes: textures, vertex colours and materials of OBJ, glTF, COLLADA and PLY, as trimesh reads them.

The triangles are those of this package's own readers. Each is given the colours of the triangle of trimesh's that lies where it
does, so a file that the two read otherwise is noticed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mevs_jax.arguments import numbers
from mevs_jax.errors import DataError
from mevs_jax.geometry.colours import colours_of
from mevs_jax.geometry.faces import have_area
from mevs_jax.geometry.triangles import centred_triangles, weights_of_corners

Colouring = Callable[[Int[np.ndarray, " points"], Float[np.ndarray, "points 3"]], Float[np.ndarray, "points 3"]]
"""Colours at points, each of which lies in the triangle of this number."""
COLOURED_SUFFIXES = (".obj", ".glb", ".gltf", ".dae", ".ply")
"""Formats whose colours are read."""
_LARGEST = 1024
"""Pixels along a side to which textures are reduced, by means; a gallery's images have far fewer."""
_APART = 1e-3
"""Largest distance, in sizes of the mesh, between the same triangle of two readers."""
_ELSEWHERE = 0.01
"""Share of the area that may lie further apart: polygons that are not flat, or slivers."""
_NEAREST = 16
"""Triangles with the nearest centres, one of which a point is looked for in."""
_TURNS = (np.eye(3), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]))
"""Rotations to z up that readers of formats with another upward axis apply; see `mevs_jax.meshes`."""


@dataclass(frozen=True, eq=False)
class Paint:
    """The colours of the triangles of a mesh.

    Attributes:
        colours: (triangles, 3, 3) of the corners, red, green and blue from 0 to 1 as images hold them (sRGB); NaN where unknown.
        uv: (triangles, 3, 2) coordinates of the corners in the texture, from its lower left; it repeats beyond 0 to 1.
        texture: (triangles,) index of the texture that the colours are multiplied with; −1 for none.
        textures: images (height, width, 3), as `colours`.
        notes: sentences on what could not be read.
    """

    colours: Float[np.ndarray, "triangles 3 3"]
    uv: Float[np.ndarray, "triangles 3 2"]
    texture: Int[np.ndarray, " triangles"]
    textures: Sequence[Float[np.ndarray, "height width 3"]] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, colours: Any, faces: Int[np.ndarray, "triangles 3"], vertices: int) -> Paint:
        """The paint of an array of colours: one for each vertex, or one for each triangle.

        Raises:
            ValueError: for an array of another shape, or values that are no colours.
        """
        given = colours_of(colours, "the colours of a mesh")
        if given.shape not in ((vertices, 3), (len(faces), 3)):
            raise ValueError(
                f"the colours of a mesh must be (vertices, 3) or (triangles, 3), here {vertices} or {len(faces)} rows, got "
                f"shape {given.shape}"
            )
        corners = given[faces] if len(given) == vertices else np.repeat(given[:, None], 3, axis=1)
        return cls(corners, np.zeros((len(faces), 3, 2), np.float32), np.full(len(faces), -1))

    def on(self, vertices: np.ndarray, faces: np.ndarray) -> Colouring:
        """Colours at points of the `centred_triangles` of the mesh, which has this paint."""
        corners, kept = centred_triangles(vertices, faces)[0], np.flatnonzero(have_area(numbers(vertices), faces))
        return lambda triangles, points: self.at(kept[triangles], weights_of_corners(points, corners[triangles]))

    def at(
        self, triangles: Int[np.ndarray, " points"], weights: Float[np.ndarray, "points 3"]
    ) -> Float[np.ndarray, "points 3"]:
        """Colours at points of triangles, each given by the weights of its corners; NaN where unknown."""
        found = np.einsum("pc,pck->pk", weights, self.colours[triangles])
        places = np.einsum("pc,pck->pk", weights, self.uv[triangles])
        for number, texture in enumerate(self.textures):
            here = np.flatnonzero(self.texture[triangles] == number)
            height, width = texture.shape[:2]
            across, up = places[here].T
            column = np.floor((across % 1) * width).astype(int).clip(0, width - 1)
            row = np.floor((1 - up % 1) * height).astype(int).clip(0, height - 1)
            found[here] *= texture[row, column]
        return found.astype(np.float32)


def read_paint(
    path: str | Path, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "triangles 3"]
) -> Paint | None:
    """Returns the colours of a mesh file for the triangles that `mevs_jax.read_mesh` read from it; None if it has none.

    A texture that is missing or unreadable is said in `Paint.notes`; its triangles have no known colour. Alpha is used where a
    glTF material says so: what is transparent has no known colour.

    Args:
        path: of the file.
        vertices, faces: the mesh, without triangles that have no area.

    Raises:
        DataError: if the file's colours cannot be read, or belong to other triangles.
        ImportError: without trimesh and Pillow, or pycollada for COLLADA.
    """
    path = Path(path)
    if path.suffix.lower() not in COLOURED_SUFFIXES:
        return None
    if path.suffix.lower() == ".dae" and b'semantic="COLOR"' in path.read_bytes():
        raise DataError(
            f"the colours of the vertices of {path.name} are not read from COLLADA; export it again as .glb"
        )
    parts, notes = _parts_of(path)
    corners = np.concatenate([part[0] for part in parts]) if parts else np.zeros((0, 3, 3))
    if not any(np.isfinite(part[1]).any() for part in parts):
        return None if not notes else Paint(*_blank(len(faces)), notes=notes)
    textures = [part[3] for part in parts if part[3] is not None]
    number = iter(range(len(textures)))
    index = np.concatenate([np.full(len(part[0]), -1 if part[3] is None else next(number)) for part in parts])
    own, weights = _placed_in(vertices[faces], corners, path)
    colours, uv = (np.concatenate([part[at] for part in parts])[own] for at in (1, 2))
    colours = np.clip(np.einsum("pcw,pwk->pck", weights, colours), 0, 1)
    return Paint(colours, np.einsum("pcw,pwk->pck", weights, uv), index[own], textures, notes)


def _blank(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    nothing = np.full((count, 3, 3), np.nan, np.float32)
    return nothing, np.zeros((count, 3, 2), np.float32), np.full(count, -1)


_Part = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]
"""Corners (n, 3, 3), their colours (n, 3, 3) and texture coordinates (n, 3, 2), and the texture, of which all are."""


def _parts_of(path: Path) -> tuple[list[_Part], tuple[str, ...]]:
    try:
        import PIL.Image
        import trimesh
    except ImportError as error:
        raise ImportError("the colours of a mesh need trimesh and Pillow: pip install mevs-jax[mesh]") from error

    folder, missing = path.parent, dict[str, str]()

    class Beside(trimesh.resolvers.FilePathResolver):
        """The files beside a mesh; those that cannot be read are noted, since trimesh goes on without them."""

        def get(self, name: str) -> bytes:
            # Exporters write paths of the machine that they ran on; the file usually lies beside the mesh.
            name = name.strip().replace("\\", "/")
            for file in (folder / name, folder / Path(name).name):
                if file.is_file() and file.resolve().is_relative_to(folder.resolve()):
                    try:
                        if file.suffix.lower() not in (".mtl", ".bin"):
                            PIL.Image.open(file).verify()
                    except Exception as error:  # Pillow's plugins raise what they like for a damaged image
                        missing[name] = f"cannot be read ({str(error).splitlines()[0][:80]})"
                    return file.read_bytes()
            missing[name] = "is not beside it"
            raise OSError(name)

    said = _Said()
    logger = logging.getLogger("trimesh")
    level, passed = logger.level, logger.propagate
    logger.addHandler(said)
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    try:
        scene = trimesh.load_scene(path, resolver=Beside(str(path)), process=False)
        parts = [part for mesh in scene.dump() for part in _part_of(mesh, path)]
    except Exception as error:  # trimesh's readers raise what they like
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise DataError(f"the colours of {path.name} cannot be read ({reason}); export it again as .glb") from error
    finally:
        logger.removeHandler(said)
        logger.setLevel(level)
        logger.propagate = passed
    notes = [
        f"{path.name} needs {name!r}, which {why}: its parts have no known colour" for name, why in missing.items()
    ]
    if said.found and not notes:
        notes = [f"not all colours of {path.name} can be read ({said.found}): its parts have no known colour"]
    return parts, tuple(notes)


class _Said(logging.Handler):
    """What trimesh leaves out without an error."""

    found = ""

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if any(word in text for word in ("image", "texture", "color", "materials", "not loaded")):
            self.found = self.found or text[:80]


def _part_of(mesh: Any, path: Path) -> list[_Part]:
    """The triangles of one of trimesh's meshes, with their colours."""
    from trimesh.visual.color import to_float

    if not hasattr(mesh, "faces") or not len(mesh.faces):
        return []
    mesh.update_faces(mesh.area_faces > 0)
    corners, visual = np.asarray(mesh.triangles, float), mesh.visual
    colours, uv, _ = _blank(len(corners))
    texture: np.ndarray | None = None
    if visual.kind == "texture":
        material = visual.material
        own = material.baseColorTexture if hasattr(material, "baseColorTexture") else material.image
        if own is not None and path.suffix.lower() in (".obj", ".ply") and own.format is None:
            own = None  # trimesh's own grey, where a material or its texture is missing
        factor, told = _factor_of(material, own, path), visual.vertex_attributes.get("color")
        if own is not None and visual.uv is not None:
            uv = np.asarray(visual.uv, np.float32)[mesh.faces]
            texture = _pixels(own, getattr(material, "alphaMode", None) in ("MASK", "BLEND"))
        if own is not None or factor is not None or told is not None:
            colours[:] = 1.0 if factor is None else factor
        if told is not None:
            colours = colours * to_float(told)[mesh.faces][..., :3]
    elif visual.kind == "vertex":
        colours = to_float(visual.vertex_colors)[mesh.faces][..., :3]
    elif visual.kind == "face":
        colours = np.repeat(to_float(visual.face_colors)[:, None, :3], 3, axis=1)
    return [(corners, colours, uv, texture)]


def _factor_of(material: Any, texture: Any, path: Path) -> np.ndarray | None:
    """The colour of a material (3,) in sRGB; None if it says none. That of glTF is linear."""
    from trimesh.visual.color import linear_to_srgb, to_float

    if hasattr(material, "baseColorFactor"):
        given = material.baseColorFactor
        if given is None or path.suffix.lower() == ".dae":
            return None if given is None else to_float(given)[:3]
        return linear_to_srgb(to_float(given)[:3])
    if "kd" not in {key.lower() for key in material.kwargs}:
        return None
    given = to_float(material.diffuse)[:3]
    return None if texture is not None and not given.any() else given


def _pixels(image: Any, transparent: bool) -> Float[np.ndarray, "height width 3"]:
    """An image of Pillow's as colours, reduced to at most `_LARGEST` pixels; NaN where it is transparent."""
    wide = image.mode == "F" or image.mode.startswith("I")  # Pillow would cut 16 bits off
    kind = "F" if image.mode == "F" else "I" if wide else "RGBA" if transparent else "RGB"
    image = image.convert(kind).reduce(-(-max(image.size) // _LARGEST))
    pixels = np.asarray(image, np.float32) / {"F": 1, "I": 65535}.get(kind, 255)
    if wide:
        pixels = np.repeat(np.clip(pixels, 0, 1)[..., None], 3, axis=-1)
    return np.where(pixels[..., 3:] < 0.5, np.nan, pixels[..., :3]) if kind == "RGBA" else pixels


def _placed_in(own: np.ndarray, other: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """For each triangle of one reader, the one of another that its middle lies in, and the weights (3, 3) by which its corners
    are sums of that one's corners. They are others where the readers divide polygons otherwise."""
    from scipy.spatial import cKDTree
    from trimesh.triangles import closest_point

    own = _normal(own)
    areas = np.linalg.norm(np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0]), axis=1)
    middles, best = own.mean(axis=1), (np.inf, np.zeros(0, int), np.zeros((0, 3, 3)))
    for turn in _TURNS:
        turned = _normal(other @ turn.T)
        number = min(_NEAREST, len(turned))
        near = cKDTree(turned.mean(axis=1)).query(middles, number)[1].reshape(-1)
        many = middles.repeat(number, axis=0)
        far = np.linalg.norm(closest_point(turned[near], many) - many, axis=1).reshape(len(own), number)
        chosen = near.reshape(far.shape)[np.arange(len(own)), far.argmin(axis=1)]
        elsewhere = np.average(far.min(axis=1) > _APART, weights=areas)
        if elsewhere < best[0]:
            weights = weights_of_corners(own.reshape(-1, 3), turned[chosen].repeat(3, axis=0))
            best = elsewhere, chosen, weights.reshape(-1, 3, 3)
    if best[0] > _ELSEWHERE:
        raise DataError(
            f"the colours of {path.name} belong to another shape than its triangles; export it again as .glb, or leave them out"
        )
    return best[1], best[2]


def _normal(triangles: np.ndarray) -> np.ndarray:
    """Triangles centred and scaled by their bounding box."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    return (triangles - (low + high) / 2) / max(float((high - low).max()), 1e-30)
