"""An object recognised from beginning to end: a mesh, rendered where the agent wants to see it, or recorded depth images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mevs_jax.agent.agent import Agent
from mevs_jax.agent.present import LEAST, check_shown
from mevs_jax.agent.records import Belief, History, Reason, Step
from mevs_jax.arguments import number, numbers, whole
from mevs_jax.arrays import ByContent
from mevs_jax.gallery.meshes import caster_of, painted, seen_of
from mevs_jax.geometry.cameras import ViewCamera, look_at_origin
from mevs_jax.geometry.canonical import share_of_sphere
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.geometry.sphere import Sphere, estimate_sphere
from mevs_jax.geometry.triangles import centred_triangles
from mevs_jax.meshes.paint import Paint
from mevs_jax.rendering.depth import pad_triangles, render_depth
from mevs_jax.trained.system import TrainedSystem

MOST_FRAMES = 512
MOST_SAID = 8
"""Frames of a walk that are printed with the reason why they were left out."""
FEWEST_POINTS = 16
"""Points within its sphere by which an image shows an object."""


@dataclass(frozen=True, eq=False)
class Walk(ByContent):
    """How an object was recognised.

    Attributes:
        views: indices of the views seen, in order, of the system's viewpoints or of the recorded frames.
        beliefs: after each of them.
        reason: why it ended: `sure`, `budget`, `nothing reachable` or `unknown object`.
        history: everything, so that it can be saved and repeated.
        left_out: recorded frames that could not be used, with the reason.
    """

    views: tuple[int, ...]
    beliefs: tuple[Belief, ...]
    reason: Reason
    history: History
    left_out: dict[int, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The answer: name of the most likely class, or `unknown object`."""
        return "unknown object" if self.reason == "unknown object" else self.beliefs[-1].name

    @property
    def confidence(self) -> float:
        """Calibrated probability of the most likely class at the end."""
        return self.beliefs[-1].confidence

    def __str__(self) -> str:
        lines = [
            f"view {view:3d}: {belief.name} {100 * belief.confidence:.1f} %"
            for view, belief in zip(self.views, self.beliefs, strict=True)
        ]
        both = zip(self.views, self.beliefs, strict=True)
        lines += [f"view {view:3d}: in doubt, {belief.doubt}" for view, belief in both if belief.doubt][:MOST_SAID]
        left_out = list(self.left_out.items())
        lines += [f"view {view:3d}: left out, {why}" for view, why in left_out[:MOST_SAID]]
        lines += [f"{len(left_out) - MOST_SAID} more views: left out"] * (len(left_out) > MOST_SAID)
        count = f"{len(self.views)} view{'s' * (len(self.views) > 1)}"
        lines.append(f"{self.name}, {100 * self.confidence:.1f} % confident after {count} ({self.reason})")
        return "\n".join(lines)


def look(
    system: TrainedSystem,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    first: int | None = None,
    metres: float | None = None,
    paint: Paint | None = None,
    **options: Any,
) -> Walk:
    """Recognises a mesh: renders it from the views that the agent chooses.

    Which way the mesh faces is not known. For a system whose policy needs a yaw, it is assumed to be 0, that of training objects.

    Args:
        system: from `mevs_jax.load`.
        vertices: corners, z up, in any unit; centre and size are taken from the mesh.
        faces: (faces, 3) indices of corners.
        first: index of the first view; by default the agent chooses it.
        metres: in one unit of the mesh, for a system that uses sizes; None if the size of the object is unknown.
        paint: colours of the faces, for a system that compares them.
        options: of `mevs_jax.Agent`.

    Raises:
        ValueError: for a mesh without faces or with coordinates that are not finite, or an option out of its range.
    """
    agent = system.agent(**options)
    if first is not None:
        views = len(system.viewpoints)
        first = whole(first, f"first must be a view from 0 to {views - 1}", 0, views - 1)
    triangles, radius = centred_triangles(vertices, faces)
    padded = jnp.asarray(pad_triangles(triangles))
    camera = system.description.camera
    known = 1.0
    if metres is not None:
        known = radius * number(metres, "metres must be positive, or None", lambda one: 0 < one < np.inf)
    unposed = system.parts.fusion and system.can_run(agent.policy, posed=False)
    yaw = None if unposed else 0.0
    agent.reset(center=(0.0, 0.0, 0.0), radius=known, yaw=yaw, true_size=metres is not None)

    colours = paint.on(vertices, faces) if paint and system.description.colour else None
    cast = caster_of(triangles) if colours else None

    def take(index: int) -> Belief:
        pose = np.asarray(look_at_origin(jnp.asarray(system.viewpoints[index]) * camera.distance))
        seen = painted(colours, *seen_of(cast, pose[None], camera)[1:])[0] if colours and cast else None
        return agent.observe_view(np.asarray(_depth(padded, jnp.asarray(pose), camera)), pose, seen)

    return _walk(agent, agent.decide().index if first is None else first, take, agent.decide)


def _walk(
    agent: Agent, index: int, take: Callable[[int], Belief | None], decide: Callable[[], Step], left_out: Any = None
) -> Walk:
    """Takes one view after another, from the first index on; `take` returns None for one that cannot be used."""
    seen, beliefs = [], []
    while True:
        if (belief := take(index)) is not None:
            seen.append(index)
            beliefs.append(belief)
        step = decide()
        if step.done:
            return Walk(tuple(seen), tuple(beliefs), step.reason, agent.history, left_out or {})
        index = step.index


@partial(jax.jit, static_argnames="camera")
def _depth(triangles: Array, pose: Array, camera: ViewCamera) -> Array:
    depth = render_depth(triangles, camera.at(pose)).depth
    return jnp.where(jnp.isfinite(depth), depth, 0.0)


@dataclass(frozen=True, eq=False)
class Frames(ByContent):
    """Recorded depth images of one object that stands still.

    Attributes:
        depth: (frames, height, width) metres.
        K: (frames, 3, 3) intrinsics.
        T_world_camera: (frames, 4, 4) poses.
        sphere: of the object.
        mask: (frames, height, width) True at the object's pixels, or None.
        floor: height of the supporting surface in the world along the object's upward direction, or None.
        images: (frames, height, width, 3) colours at the depth's pixels, as of `DepthImage`, or None.
    """

    depth: Shaped[np.ndarray, "frames height width"]
    K: Float[np.ndarray, "frames 3 3"]
    T_world_camera: Float[np.ndarray, "frames 4 4"]
    sphere: Sphere
    mask: np.ndarray | None = None
    floor: float | None = None
    images: np.ndarray | None = None

    @classmethod
    def of(cls, stored: dict[str, np.ndarray]) -> Frames:
        """Frames from arrays by name: depth, K, T_world_camera; optionally center, radius, up, yaw, mask, floor, image.

        `K` may be one matrix for all frames. Without `center` and `radius`, they are estimated from the pixels in `mask`.

        Raises:
            ValueError: for missing arrays, or arrays of other shapes.
        """
        depth, K, poses, mask = images_in(stored)
        up, yaw = stored.get("up", np.array((0.0, 0.0, 1.0))), _number(stored, "yaw")
        if "center" in stored and "radius" in stored:
            center, radius = stored["center"], _number(stored, "radius")
        elif "center" in stored or "radius" in stored:
            raise ValueError("center and radius of the object belong together; give both, or neither and a mask")
        elif mask is not None:
            shown = [DepthImage(*one).points() for one in zip(depth, K, poses, mask, strict=True)]
            if not any(map(len, shown)):
                raise ValueError("no image has measured depth within its mask; the mask must be of the object's pixels")
            center, radius = estimate_sphere(np.concatenate(shown), up=up)
        else:
            raise ValueError(
                "center and radius of the object are needed, or a mask of its pixels to estimate them from"
            )
        images = stored.get("image")
        if images is not None and np.shape(images) != (*depth.shape, 3):
            raise ValueError(
                f"image must be {(*depth.shape, 3)}, colours at the depth's pixels, got {np.shape(images)}"
            )
        return cls(depth, K, poses, Sphere(center, radius, up, yaw), mask, _number(stored, "floor"), images)

    def image(self, index: int) -> DepthImage:
        """One of them; raises `ValueError` if it cannot be used."""
        mask = None if self.mask is None else self.mask[index]
        image = None if self.images is None else self.images[index]
        return DepthImage(self.depth[index], self.K[index], self.T_world_camera[index], mask, self.floor, image)

    def shown(self, least: float = 0.0) -> Bool[np.ndarray, " frames"]:
        """Which of them show some points within the object's sphere.

        Args:
            least: share of the sphere that has to be inside the image.

        Raises:
            ValueError: if none does.
        """
        shown = np.zeros(len(self.depth), bool)
        for index in range(len(shown)):
            if self._in_image(index) >= least:
                points = self.image(index).points() - self.sphere.position
                inside = np.linalg.norm(points, axis=1) < self.sphere.radius
                if self.floor is not None:
                    inside &= points @ self.sphere.axis > self.floor - self.sphere.position @ self.sphere.axis
                shown[index] = np.sum(inside) >= FEWEST_POINTS
        if not shown.any():
            raise ValueError("no frame shows anything within the object's sphere; check its center, radius and floor")
        return shown

    def _in_image(self, index: int) -> float:
        """The share of the disc across the sphere, parallel to the image, that is inside the image."""
        across = np.stack(np.meshgrid(*[np.linspace(-1, 1, 32)] * 2), axis=-1).reshape(-1, 2)
        disc = np.pad(across[np.linalg.norm(across, axis=1) < 1], ((0, 0), (0, 1))) * self.sphere.radius
        pose = self.T_world_camera[index]
        x, y, z = self.K[index] @ ((self.sphere.position - pose[:3, 3]) @ pose[:3, :3] + disc).T
        height, width = self.depth.shape[1:]
        return float(
            np.mean((z > 0) & (x > -z / 2) & (x < (width - 0.5) * z) & (y > -z / 2) & (y < (height - 0.5) * z))
        )

    def only(self, chosen: Bool[np.ndarray, " frames"]) -> Frames:
        """Some of them."""
        mask = None if self.mask is None else self.mask[chosen]
        depth, K, poses = self.depth[chosen], self.K[chosen], self.T_world_camera[chosen]
        images = None if self.images is None else self.images[chosen]
        return Frames(depth, K, poses, self.sphere, mask, self.floor, images)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file; nothing in it is executed.

    Raises:
        ValueError: for any other file.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            if not hasattr(stored, "files"):
                raise ValueError("it is a single array")
            arrays = {name: stored[name] for name in stored.files}
        if other := next((name for name, member in arrays.items() if not isinstance(member, np.ndarray)), None):
            raise ValueError(f"its member {other!r} is no array")
        return arrays
    except FileNotFoundError as error:
        raise ValueError(f"there is no file {path}") from error
    except Exception as error:  # the content of a damaged file decides which
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:120]
        raise ValueError(f"{path} is no .npz of arrays that can be read ({reason})") from error


def images_in(stored: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Depth, K and T_world_camera of each frame, and the masks or None, from arrays by name.

    Raises:
        ValueError: for missing arrays, or arrays of other shapes.
    """
    for name in ("depth", "K", "T_world_camera"):
        if name not in stored:
            raise ValueError(f"there is no array {name!r}; it holds {', '.join(stored) or 'nothing'}")
    depth, poses, K = np.asarray(stored["depth"]), *(numbers(stored[name]) for name in ("T_world_camera", "K"))
    number = len(depth) if depth.ndim == 3 else 0
    if not 1 <= number <= MOST_FRAMES:
        raise ValueError(
            f"depth must be (frames, height, width) with 1 to {MOST_FRAMES} frames, got shape {depth.shape}"
        )
    if poses.shape != (number, 4, 4):
        raise ValueError(f"T_world_camera must be ({number}, 4, 4), got shape {poses.shape}")
    if K.shape not in ((3, 3), (number, 3, 3)):
        raise ValueError(f"K must be (3, 3) or ({number}, 3, 3), got shape {K.shape}")
    mask = np.asarray(stored["mask"]) if "mask" in stored else None
    if mask is not None and mask.shape != depth.shape:
        raise ValueError(f"mask must have the shape of depth, {depth.shape}, got {mask.shape}")
    return depth, np.broadcast_to(K, (number, 3, 3)), poses, mask


def _number(stored: dict[str, np.ndarray], name: str) -> Any:
    """A number, or None if it is not stored."""
    if name not in stored:
        return None
    if np.size(stored[name]) != 1:
        raise ValueError(f"{name} must be one number, got shape {np.shape(stored[name])}")
    return number(stored[name], f"{name} must be a finite number")


def look_at_frames(
    agent: Agent, frames: Frames, *, first: int = 0, usable: Bool[np.ndarray, " frames"] | None = None
) -> Walk:
    """Recognises an object from recorded images, of which the agent chooses the next.

    Args:
        agent: with at least as many `max_candidates` as there are frames.
        frames: the recorded images.
        first: the first frame.
        usable: which of the others may be chosen; by default all.
    """
    count = len(frames.depth)
    first = whole(first, f"first must be a frame from 0 to {count - 1}", 0, count - 1)
    agent.begin(frames.sphere)
    left, left_out = np.ones(count, bool) if usable is None else usable.copy(), dict[int, str]()

    def take(index: int) -> Belief | None:
        left[index] = False
        try:
            return agent.see(frames.image(index))
        except ValueError as error:
            left_out[index] = str(error)
            return None

    walk = _walk(agent, first, take, lambda: agent.decide(left, candidates=frames.T_world_camera), left_out)
    if not walk.beliefs:
        raise ValueError(f"no frame can be used; of the first, {left_out[first]}")
    return walk


class ShowsTooLittle(ValueError):
    """No image shows enough of an object."""


def look_at_views(agent: Agent, sphere: Sphere, views: Float[np.ndarray, "views side side"]) -> Walk:
    """Recognises an object from depth images at the system's viewpoints, of which the agent chooses the next.

    Args:
        agent: for objects whose yaw is not known.
        sphere: of the object.
        views: as of `Agent.observe_view`. The walk begins with the one that shows most. Those that show less than half of the
            sphere, or nothing of the object, are left out.

    Raises:
        ShowsTooLittle: if none is left.
    """
    agent.begin(sphere)
    camera, poses = agent.system.description.camera, agent.system.poses
    known = np.array([1 - share_of_sphere(np.isnan(view), camera) for view in views])
    known[[not _shows(view, agent.system) for view in views]] = 0
    left = known >= LEAST
    if not left.any():
        raise ShowsTooLittle(
            f"no view shows the object and {LEAST:.0%} of its sphere; the best shows {known.max():.0%}"
        )

    def take(index: int) -> Belief:
        left[index] = False
        return agent.observe_view(views[index], poses[index])

    return _walk(agent, int(known.argmax()), take, lambda: agent.decide(left))


def _shows(view: Float[np.ndarray, "side side"], system: TrainedSystem) -> bool:
    try:
        check_shown(view, system)
    except ValueError:
        return False
    return True


def replay(history: History, agent: Agent) -> list[Belief]:
    """Gives an agent the images of a history again, in the same order; returns its beliefs.

    Args:
        history: of this agent's system, or of another one with the same camera.
        agent: which is reset first, as it was for the history.

    Raises:
        ValueError: for a history without an object, with options that `reset` does not have, or images of another size than the
            agent's.
    """
    if "reset" not in history.options:
        raise ValueError("the history has no object: its agent was not reset")
    options, required = history.options["reset"], {"center", "radius"}
    if not isinstance(options, dict) or not required <= set(options) <= {*required, "up", "yaw", "true_size"}:
        raise ValueError(f"the history has other options of its object than Agent.reset: {options!r:.80}")
    agent.reset(**options)
    views = zip(history.depths, history.poses, history.colours, strict=True)
    return [agent.observe_view(*view) for view in views]
