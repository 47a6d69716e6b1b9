"""The best view of one object by gradient ascent: the thesis's methods by differentiable rendering (§4.2.1).

A method defines the representation that is rendered, and the objective. All start views run together. `mevs draw ascent` runs a
method on one object and draws it; `benchmarks/ascent.py` measures the quality of the views that are found.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from data_pipeline.dataset.builder import DataConfig, open_objects
from data_pipeline.errors import DataError, EmptyMesh
from data_pipeline.files import write_bytes
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.reconstruction import decimate, require_open3d, voxelise
from data_pipeline.objects.sources import load_object
from eval.config import AscentConfig
from eval.projections import longitude_latitude
from mevs_jax.geometry.cameras import Camera, cameras_at
from mevs_jax.geometry.viewpoints import fibonacci_sphere
from mevs_jax.rendering import (
    Ascent,
    ascend,
    corners_of_cells,
    distinct_optima,
    march,
    opacity_entropy,
    render_mesh,
    soft_depth_entropy,
)

FACES = 500
"""largest number of faces of a mesh after decimation"""
_PADDED = 512


@dataclass(frozen=True)
class Method:
    """A method by differentiable rendering.

    Attributes:
        prepare: converts a mesh to the representation that is rendered; its shape is the same for all objects.
        picture: renders the representation from a camera for display; NaN where nothing is seen.
        objective: the objective of the representation and a camera, which is maximised.
        title: the name of the objective in figures and messages.
    """

    prepare: Callable[[Mesh], Any]
    picture: Callable[[Any, Camera], Float[Array, "side side"]]
    objective: Callable[[Any, Camera], Float[Array, ""]]
    title: str


def padded_triangles(mesh: Mesh, faces: int) -> Float[np.ndarray, "faces 3 3"]:
    """The corners of exactly `faces` triangles; the padding has no area and is not visible."""
    padded = np.zeros((faces, 3, 3), np.float32)
    kept = mesh.faces[:faces]
    padded[: len(kept)] = mesh.vertices[kept]
    return padded


def _mesh_picture(triangles: Array, camera: Camera) -> Array:
    seen = render_mesh(triangles, camera)
    return jnp.where(seen.silhouette > 0.5, seen.depth, jnp.nan)


def _mesh_objective(triangles: Array, camera: Camera) -> Array:
    seen = render_mesh(triangles, camera)
    return soft_depth_entropy(seen.depth, seen.silhouette)


def _volume_picture(cells: Array, camera: Camera) -> Array:
    seen = march(cells, camera)
    return jnp.where(seen.opacity > 0.5, seen.depth, jnp.nan)


METHODS: dict[str, Method] = {
    "volume": Method(
        lambda mesh: np.asarray(corners_of_cells(voxelise(mesh))),
        _volume_picture,
        lambda cells, camera: opacity_entropy(march(cells, camera).opacity),
        "opacity entropy of the volume",
    ),
    "mesh": Method(
        lambda mesh: padded_triangles(decimate(mesh, FACES), _PADDED),
        _mesh_picture,
        _mesh_objective,
        "depth entropy of the mesh (bits)",
    ),
}


def ascend_on_sphere(method: Method, thing: Any, starts: int, resolution: int) -> Ascent:
    """Gradient ascent on `thing`, as returned by `method.prepare`, from Fibonacci viewpoints."""
    return ascend(
        lambda pose: method.objective(thing, Camera(pose, resolution=resolution)),
        cameras_at(fibonacci_sphere(starts)).pose,
    )


def look_everywhere(method: Method, thing: Any, directions: np.ndarray, resolution: int) -> Float[Array, " views"]:
    """The objective (views,) from every direction (views, 3)."""
    poses = cameras_at(directions.astype(np.float32)).pose
    return jax.lax.map(lambda pose: method.objective(thing, Camera(pose, resolution=resolution)), poses)


def find(data: DataConfig, name: str | None) -> ObjectEntry:
    """Returns the object with this name, or the first test object.

    Raises:
        DataError: there is no such object.
    """
    entries = open_objects(data).entries
    if name is None:
        return next(entry for entry in entries if entry.split == "test")
    for entry in entries:
        if entry.name == name:
            return entry
    raise DataError(
        f"{data.source} has no object {name!r}; its first objects are {', '.join(entry.name for entry in entries[:3])}"
    )


def ascend_on(data: DataConfig, config: AscentConfig, out: Path) -> tuple[str, Path]:
    """Runs gradient ascent on one object; returns a sentence with the result, and the path of the animation.

    Raises:
        DataError: there is no such object, or its mesh is empty.
    """
    if config.starts < 2 or config.resolution < 8:
        raise DataError("--ascent.starts must be at least 2 and --ascent.resolution at least 8")
    require_open3d()
    entry, method = find(data, config.object), METHODS[config.method]
    try:
        thing = jnp.asarray(method.prepare(load_object(entry)))
    except EmptyMesh as reason:
        raise DataError(f"{entry.name} cannot be rendered ({reason}); choose another --ascent.object") from reason
    found = jax.jit(lambda thing: ascend_on_sphere(method, thing, config.starts, config.resolution))(thing)
    order, kept = distinct_optima(found.poses, found.values)
    best = int(order[0])
    x, y, z = np.asarray(found.poses[best, :3, 3]) / 2
    path = out / f"ascent_{entry.name.replace('/', '_')}_{config.method}.gif"
    write_bytes(path, animation(method, thing, found, config.resolution))
    return (
        f"{entry.name}: best view from ({x:.3f}, {y:.3f}, {z:.3f}), {method.title} {float(found.values[best]):.4f}; "
        f"{int(kept.sum())} distinct optima from {config.starts} starts, {float(found.steps.mean()):.0f} steps each"
    ), path


def animation(method: Method, thing: Any, found: Ascent, resolution: int, frames_a_second: int = 8) -> bytes:
    """Returns a GIF: the images along the best path, and all paths on a map of the objective."""
    from matplotlib.animation import (  # imported late: matplotlib takes a quarter of a second
        FuncAnimation,
        PillowWriter,
    )
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    longitude, latitude = np.meshgrid(np.linspace(-180, 180, 49), np.linspace(-90, 90, 25))
    along, up = np.radians(longitude), np.radians(latitude)
    directions = np.stack([np.cos(up) * np.cos(along), np.cos(up) * np.sin(along), np.sin(up)], axis=-1)
    field = jax.jit(lambda thing: look_everywhere(method, thing, directions.reshape(-1, 3), resolution))(thing)
    field = np.asarray(field).reshape(longitude.shape)
    draw = jax.jit(lambda thing, pose: method.picture(thing, Camera(pose, resolution=resolution)))
    best, steps = int(np.argmax(found.values)), int(np.max(found.steps)) + 1
    paths = np.asarray(found.path)[:, :steps] / 2
    degrees = longitude_latitude(paths)
    poses = cameras_at(paths[best]).pose

    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    view, sphere = figure.subplots(1, 2, width_ratios=(1, 1.7))
    view.axis("off")
    picture = view.imshow(np.asarray(draw(thing, poses[0])), cmap="viridis_r")
    title = view.set_title("")
    sphere.pcolormesh(longitude, latitude, field, cmap="magma", shading="gouraud")
    sphere.set(xlabel="longitude (°)", ylabel="latitude (°)", title=method.title, xlim=(-180, 180), ylim=(-90, 90))
    others = sphere.scatter([], [], s=9, color="white", alpha=0.8)
    (path_line,) = sphere.plot([], [], ".-", color="#22d3ee", linewidth=1.2, markersize=3)
    here = sphere.scatter([], [], s=60, facecolor="none", edgecolor="#22d3ee", linewidth=2)

    def frame(step: int) -> None:
        picture.set_data(np.asarray(draw(thing, poses[step])))
        title.set_text(f"step {step}: {float(found.path_values[best, step]):.3f}")
        others.set_offsets(np.stack([degrees[0][:, step], degrees[1][:, step]], axis=1))
        line = np.stack([degrees[0][best, : step + 1], degrees[1][best, : step + 1]])
        jumps = np.flatnonzero(np.abs(np.diff(line[0])) > 180) + 1  # where the path crosses the edge of the map
        path_line.set_data(*np.insert(line, jumps, np.nan, axis=1))
        here.set_offsets(line[:, -1:].T)

    frames = [*range(steps), *[steps - 1] * 8]
    moving = FuncAnimation(figure, frame, frames=frames)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ascent.gif"
        moving.save(path, writer=PillowWriter(fps=frames_a_second))
        content = path.read_bytes()
    return content
