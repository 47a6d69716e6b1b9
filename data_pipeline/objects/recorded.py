"""Meshes of objects that were recorded: posed depth images, fused, as files that a data set is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from data_pipeline.errors import DataError, reason_of
from data_pipeline.files import digest_of, read_json, write_bytes, write_json
from data_pipeline.frames.reading import is_recording, read_frames
from data_pipeline.frames.recording import Recording
from data_pipeline.progress import progress_bar
from data_pipeline.scene.looking import scene_in
from mevs_jax.agent.looking import Frames
from mevs_jax.gallery.frames import GRID, fused


@dataclass(frozen=True)
class Recorded:
    """A mesh that was made of a recording.

    Attributes:
        mesh: its path in the folder of meshes.
        images: number of images that it is made of.
        left_out: sentences on those that it is not made of.
    """

    mesh: str
    images: int
    left_out: tuple[str, ...]


def meshes_of_recordings(folder: Path, to: Path) -> list[Recorded]:
    """Makes a mesh in metres, `to`/CLASS/OBJECT.ply, of every recording FOLDER/CLASS/OBJECT; those that are there are kept.

    A recording FOLDER/OBJECT is the one object of its class. What each was made of is written into `recordings` beside `to`.

    Raises:
        DataError: if there are none, or one cannot be read or does not show one object.
    """
    found = [path for path in sorted(folder.glob("*")) if is_recording(path)]
    found += [
        path
        for of in sorted(folder.glob("*"))
        if of not in found
        for path in sorted(of.glob("*"))
        if is_recording(path)
    ]
    if not found:
        raise DataError(
            f"{folder} has no recordings; put them there as CLASS/OBJECT.npz, or as the bags and folders of docs/frames.md"
        )
    made = []
    with progress_bar("recordings") as bar:
        for path in bar.track(found, description="Fusing recordings"):
            name = path.stem if path.is_file() else path.name
            mesh = Path(name if path.parent == folder else path.parent.name, f"{name}.ply")
            made.append(_kept(path, to, mesh))
    return made


def _kept(path: Path, to: Path, mesh: Path) -> Recorded:
    """The mesh of a recording, made unless it was made of these files."""
    note, files = (
        to.with_name("recordings") / mesh.with_suffix(".json"),
        sorted(path.rglob("*")) if path.is_dir() else [path],
    )
    state = digest_of([[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in files])
    if (to / mesh).exists() and note.exists() and (kept := read_json(note))["of"] == state:
        return Recorded(str(mesh), kept["images"], tuple(kept["left_out"]))
    try:
        recording = read_frames(path)
        frames = _frames_of(recording)
        shown = frames.shown()
        vertices, faces = mesh_of_frames(frames.only(shown))
    except ValueError as error:
        raise DataError(f"{path}: {reason_of(error).removeprefix(f'{path}: ')}") from error
    lost = (f"{np.sum(~shown)} of {len(shown)} images do not show the object, and are left out",) * bool(np.sum(~shown))
    made = Recorded(str(mesh), int(shown.sum()), (*recording.notes, *lost))
    write_bytes(to / mesh, _ply(vertices, faces))
    write_json(note, {"of": state, "images": made.images, "left_out": list(made.left_out)})
    return made


def _frames_of(recording: Recording) -> Frames:
    """The images of a recording's object: where the file says that it is, or else the one that stands on the ground."""
    if recording.mask is not None or "center" in recording.known:
        return Frames.of(recording.arrays())
    floor = recording.known.get("floor")
    scene = scene_in(recording, recording.known.get("up"), None if floor is None else float(floor))
    if len(scene.spheres) != 1:
        raise DataError(
            f"it shows {len(scene.spheres)} objects, not one; record each alone, or write center and radius of one into an .npz"
        )
    sphere = scene.spheres[0]
    place = {
        "center": sphere.position,
        "radius": np.array(sphere.radius),
        "up": sphere.axis,
        "floor": np.array(scene.floor),
    }
    return Frames.of(recording.arrays() | place)


def mesh_of_frames(frames: Frames) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """The surface of what images do not show to be empty, in metres, z up and the sphere's centre at 0.

    What no image has shown counts as part of the object, so that its surface is closed.

    Raises:
        ValueError: if an image shows nothing of the object.
    """
    from skimage.measure import marching_cubes  # late, since it takes half a second

    field = np.asarray(fused([frames.image(index) for index in range(len(frames.depth))], frames.sphere))
    solid = np.pad(np.where(np.isnan(field), -1.0, field), 1, constant_values=1.0)
    vertices, faces, _, _ = marching_cubes(solid, 0.0, gradient_direction="ascent")
    return ((vertices - 0.5) * (2 / GRID) - 1) * frames.sphere.radius, faces


def _ply(vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> bytes:
    import trimesh

    content = trimesh.Trimesh(vertices, faces, process=False).export(file_type="ply")
    assert isinstance(content, bytes)
    return content
