"""The image that the data set's camera would have taken, computed from the image of any depth camera.

The networks are trained on depth images of one camera, which looks at the object's centre from a fixed distance with z upwards in
its image (`mevs_jax.ViewCamera`). `canonical_view` takes the depth image of any pinhole camera and returns the image of
that camera from the same *direction*: roll and aim are undone, and the distance is changed.

Each pixel of the result is a ray. In the source image it is a straight segment, along which inverse depth is linear too. Points
along the segment are compared with the depth that the source measured there, and the first point where the ray meets the measured
surface is taken (relief mapping; Policarpo, Oliveira and Comba, 2005). Around each measured pixel the surface is continued as a
plane, in which inverse depth is linear as well, so that the intersection is a division. An intersection counts only if the sample
that it falls on agrees, so that surfaces end where they end in the source. Where the source is at the data set's distance, all
segments are single points and the result is exact up to the source's resolution. From another distance, the two cameras see
slightly different surfaces: what the source did not see remains empty and is not `known`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mevs_jax.arguments import numbers
from mevs_jax.arrays import AnyArray, AnyVector, ByContent
from mevs_jax.beliefs.entropy import DEPTH_SCALE, DEPTH_STEP
from mevs_jax.geometry.cameras import ViewCamera, in_sphere, look_at_origin, pixel_directions
from mevs_jax.geometry.colours import colours_of
from mevs_jax.geometry.doubts import doubt_of
from mevs_jax.geometry.source_view import MARGIN, DepthImage, Window, why_empty, window_of
from mevs_jax.geometry.sphere import Sphere, upright

_LEAST_SAMPLES = 512
"""Of the source image along each side. For 64 pixels, 256 took 1.9 ms, not 3.4, but the median overlap of masks was 0.989, not
0.993 (`benchmarks/canonical.py`)."""

_STRIDE = 1.0
"""Distance, in samples of the source, of the points along a ray that are compared with it."""

_MOST_STEPS = 16
"""Largest number of steps between such points. With 40 the masks were not better by more than 0.001."""

_STEPS_ASIDE = 64
"""The same where the data set's camera is not in the direction of the source, so that segments in the image are long."""

_APART = 0.1
"""Radii by which the source's depth may differ from that of a point whose colour is taken from it."""

_MOST_SAMPLES = 4
"""Largest number of samples of colour along each side of a pixel, whose mean is taken."""

_REACH = 1.0
"""How far the plane of a sample is continued along a ray, in steps; half a step would leave gaps between planes."""

_AGAIN = 0.75
"""How far, in steps, the intersection may move when it is computed again from the sample that it falls on."""

_NOISE = 0.04
"""Depth in radii by which both may be wrong in any case, since depth cameras measure with noise."""

_STEEPEST = 10.0
"""Tangent of the largest angle between a surface and the image plane: neighbouring pixels further apart are not one surface."""


@dataclass(frozen=True, eq=False)
class CanonicalView(ByContent):
    """A view as the data set's camera would have taken it.

    The frame of the object has its origin at the object's centre, z up, and the object's radius as its unit.

    Attributes:
        depth: (resolution, resolution) float32 depth along the optical axis in radii, 0 where there is no object.
        known: (resolution, resolution) bool, True where the source shows what this camera would see, object or background.
        pose: (4, 4) float32, from this camera to the frame of the object.
        direction: (3,) float32, unit vector from the object's centre to both cameras, in the frame of the object.
        in_image: share of the object's sphere that is inside the source image, from 0 to 1.
        unknown: share of the pixels of the object's sphere that are not `known`, from 0 to 1: outside the source image, without a
            measured depth, or hidden from the source.
        doubt: what is wrong with the source, its camera or the object's sphere by what it shows; empty if nothing was noticed.
        colours: (resolution, resolution, 3) of the object from 0 to 1, NaN where not known; None if the source has none.
    """

    depth: Float[np.ndarray, "resolution resolution"]
    known: Bool[np.ndarray, "resolution resolution"]
    pose: Float[np.ndarray, "4 4"]
    direction: Float[np.ndarray, " 3"]
    in_image: float
    unknown: float
    doubt: str = ""
    colours: Float[np.ndarray, "resolution resolution 3"] | None = None

    @property
    def image(self) -> Float[np.ndarray, "resolution resolution"]:
        """Depth with NaN where it is not `known` what is there, as networks that are told so are given it."""
        return np.where(self.known, self.depth, np.float32(np.nan))


def canonical_view(
    depth: AnyArray,
    K: AnyArray,
    T_world_camera: AnyArray,
    *,
    center: AnyVector,
    radius: float,
    up: AnyVector = (0.0, 0.0, 1.0),
    camera: ViewCamera,
    mask: AnyArray | None = None,
    floor: float | None = None,
) -> CanonicalView:
    """Returns the image that the data set's camera would have taken from the direction of this camera.

    Only what lies inside the object's sphere is kept, so the background is removed. A surface that supports the object passes
    through the sphere: remove it with `mask` or `floor`. The program is compiled once for each `camera`, whatever the size of the
    source image.

    Args:
        depth, K, T_world_camera, mask: as of `DepthImage`, whose `pose` is `T_world_camera`.
        center, radius, up: as of `Sphere`.
        camera: the data set's camera.
        floor: height of the supporting surface above `center` along `up`, in metres, so usually negative; what lies below is not
            the object. It should be a little above the true height, by the depth camera's error.

    Raises:
        ValueError: for an argument out of its range, a camera inside the object's sphere, or an image that shows nothing inside
            the sphere.
    """
    sphere = Sphere(center, radius, up)
    height: Any = floor
    if floor is not None:
        height = numbers(floor) + float(sphere.position @ sphere.axis)  # checked with the image
    return convert(DepthImage(depth, K, T_world_camera, mask, height), sphere, camera)


def convert(
    image: DepthImage, sphere: Sphere, camera: ViewCamera, towards: Float[np.ndarray, " 3"] | None = None
) -> CanonicalView:
    """`canonical_view` of an image with its camera, around an object at a place, whose yaw is not used.

    Args:
        image, sphere, camera: as of `canonical_view`.
        towards: unit vector from the object to the data set's camera, in the object's frame; by default that of the image.
            What the image does not show from there is not `known`.
    """
    window = window_of(image, sphere, max(_LEAST_SAMPLES, 2 * camera.resolution))
    own = np.asarray(window.eye / np.linalg.norm(window.eye), np.float32)
    direction, steps = (own, _MOST_STEPS) if towards is None else (np.asarray(towards, np.float32), _STEPS_ASIDE)
    with jax.default_matmul_precision("highest"):  # accelerators round more, by pixels
        inverse = _without_small_holes(*_inverse_depth(window), window.rays)
        depth, known, pose, in_image = jax.device_get(_render(window, inverse, direction, camera, steps))
    if not depth.any():
        raise ValueError(why_empty(window))
    depth = np.round(depth * DEPTH_SCALE) * DEPTH_STEP  # to the bit as the data set's views are read
    unknown = share_of_sphere(~known, camera)
    doubt = doubt_of(image, window) if towards is None else ""
    colours = None if image.image is None else colours_from([image], depth, pose, camera, sphere, _APART)
    return CanonicalView(depth, known, pose, direction, float(in_image), unknown, doubt, colours)


def colours_from(
    images: Sequence[DepthImage],
    depth: Float[np.ndarray, "*cameras side side"],
    poses: Float[np.ndarray, "*cameras 4 4"],
    camera: ViewCamera,
    sphere: Sphere,
    apart: float,
) -> Float[np.ndarray, "*cameras side side 3"]:
    """Colours of the surface that other cameras see, as means over the images that show it; NaN where none does.

    Args:
        images: those without colours are left out.
        depth, poses: of the other cameras, in radii, in the object's frame without its yaw; 0 where nothing is hit.
        camera: what they are.
        sphere: of the object.
        apart: radii by which the depth of an image may differ from that of a point whose colour is taken from it.
    """
    side, hit = depth.shape[-1], depth > 0
    pinhole = camera.at(jnp.eye(4), side)
    rays = np.asarray(pixel_directions(pinhole)) @ np.swapaxes(poses[..., None, :3, :3], -1, -2)
    places = (rays * depth[..., None] + poses[..., None, None, :3, 3])[hit]
    world = sphere.radius * places @ upright(sphere.up) + sphere.position
    across = depth[hit] * sphere.radius / float(pinhole.focal_length)
    total, count = np.zeros((len(places), 3)), np.zeros((len(places), 1))
    for image in images:
        if image.image is not None:
            found = _colours_at(world, across, image, apart * sphere.radius)
            known = ~np.isnan(found).any(axis=1, keepdims=True)
            total, count = total + np.where(known, found, 0), count + known
    colours = np.full((*depth.shape, 3), np.nan, np.float32)
    colours[hit] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return colours


def _colours_at(
    world: Float[np.ndarray, "points 3"], across: Float[np.ndarray, " points"], image: DepthImage, apart: float
) -> Float[np.ndarray, "points 3"]:
    """Colours of points in an image, NaN where it does not show them; as means over a width of `across` metres."""
    colours, depth = colours_of(image.image, "image"), np.asarray(image.depth)
    pose, K, (height, width) = np.asarray(image.pose, float), np.asarray(image.K, float), depth.shape
    points = (world - pose[:3, 3]) @ pose[:3, :3]
    z = np.maximum(points[:, 2], 1e-6)
    pixels = points @ K.T / z[:, None]
    wide = np.median(across * K[0, 0] / z) if len(z) else 1.0
    steps = int(np.clip(round(wide), 1, _MOST_SAMPLES))
    total, count = np.zeros((len(points), 3)), np.zeros((len(points), 1))
    for offset in product(((np.arange(steps) + 0.5) / steps - 0.5) * wide, repeat=2):
        column, row = np.round(pixels[:, :2] + offset).astype(int).T
        at = row.clip(0, height - 1), column.clip(0, width - 1)
        inside = (row == at[0]) & (column == at[1]) & (points[:, 2] > 0)
        with np.errstate(invalid="ignore"):
            shown = (inside & (np.abs(depth[at] - z) < apart) & np.isfinite(colours[at]).all(axis=1))[:, None]
        total, count = total + np.where(shown, colours[at], 0), count + shown
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def share_of_sphere(pixels: Bool[np.ndarray, "side side"], camera: ViewCamera) -> float:
    """The share of some pixels among those that look at the object's sphere."""
    return float(np.mean(pixels, where=in_sphere(camera, len(pixels))))


def combined(views: Sequence[CanonicalView], camera: ViewCamera) -> CanonicalView:
    """One view from images that were converted towards the same direction: what any of them shows, where several do the nearest.

    Its `in_image` is that of the image that shows most, so at most the true share.
    """
    depths = np.stack([np.where(view.depth > 0, view.depth, np.inf) for view in views]).min(axis=0)
    known = np.any([view.known for view in views], axis=0)
    depth = np.where(np.isfinite(depths), depths, np.float32(0)).astype(np.float32)
    unknown, in_image = share_of_sphere(~known, camera), max(view.in_image for view in views)
    seen = [view.colours for view in views if view.colours is not None]
    colours = reduce(lambda before, more: np.where(np.isnan(before), more, before), seen) if seen else None
    return replace(
        views[0], depth=depth, known=known, unknown=unknown, in_image=in_image, doubt=views[-1].doubt, colours=colours
    )


@partial(jax.jit, static_argnames=("camera", "most_steps"))
def _render(
    window: Window,
    inverse: Float[Array, "grid grid"],
    direction: Float[Array, " 3"],
    camera: ViewCamera,
    most_steps: int,
) -> tuple[Array, ...]:
    """Returns depth, known, pose and in_image of a `CanonicalView`."""
    surface = _surface(inverse, window.rays)
    pose = look_at_origin(camera.distance * direction)
    directions = pixel_directions(camera.at(pose)).reshape(-1, 3)
    square, along = jnp.sum(directions**2, axis=-1), directions @ pose[:3, 3]
    inside = along**2 - square * (camera.distance**2 - (1 + MARGIN) ** 2)  # below 0 for rays that miss the sphere
    half = jnp.sqrt(jnp.maximum(inside, 0.0)) / square
    near, far = -along / square - half, -along / square + half
    depth, certain = _meet(surface, window, pose[:3, 3], directions, (near, far), most_steps)
    disc = along**2 >= square * (camera.distance**2 - 1)
    depth = jnp.where(inside > 0, depth, 0.0)
    known = certain & (inside > 0)
    column, row, _ = _seen(window, pose[:3, 3] - directions * (along / square)[:, None])
    left, right, top, bottom = window.limits
    seen = (column >= left) & (column <= right) & (row >= top) & (row <= bottom)
    count = jnp.maximum(jnp.sum(disc), 1)
    in_image = jnp.sum(disc & seen) / count
    shape = (camera.resolution, camera.resolution)
    return depth.reshape(shape), (known | (inside <= 0)).reshape(shape), pose, in_image


@jax.jit
def _inverse_depth(window: Window) -> tuple[Float[Array, "grid grid"], Bool[Array, "grid grid"]]:
    """Returns the inverse depth of the object at each sample, 0 where there is certainly nothing of it and −1 where unknown,
    and where no depth was measured.

    This and `_without_small_holes` are programs of their own: as parts of `_render`, XLA computed them again for every
    neighbour of a sample, which took ten times as long.
    """
    depth = jnp.asarray(window.depth) / window.radius
    number = jnp.arange(depth.shape[0], dtype=jnp.float32)
    column, row = number[None, :], number[:, None]
    to_right, down, first = window.rays.T
    along = column * (to_right @ window.eye) + (row * (down @ window.eye) + first @ window.eye)
    rise = column * to_right[2] + (row * down[2] + first[2])
    square = column * (column * (to_right @ to_right) + 2 * (row * (to_right @ down) + to_right @ first))
    square += row * (row * (down @ down) + 2 * (down @ first)) + first @ first
    measured = (depth > 0) & jnp.isfinite(depth)
    z = jnp.where(measured, depth, 0.0)
    outside = jnp.sum(window.eye**2) + 2 * z * along + z**2 * square > (1 + MARGIN) ** 2
    above = window.eye[2] + z * rise >= window.floor
    in_front = measured & outside & (z * square < -along)  # something between the camera and the object hides it
    hole = ~measured & window.mask & (depth != jnp.inf)
    inverse = jnp.where(measured & ~outside & above & window.mask, 1 / jnp.maximum(z, 1e-6), 0.0)
    return jnp.where(hole | in_front, -1.0, inverse), hole


def _surface(inverse: Float[Array, "grid grid"], rays: Float[AnyArray, "3 3"]) -> Float[Array, "3 samples"]:
    """The measured surface: inverse depth, and its change to the next column and to the next row, 0 where there is none."""
    limits = _steepest(rays)
    return jnp.stack([inverse, _slope(inverse, 1, limits[0]), _slope(inverse, 0, limits[1])]).reshape(3, -1)


def _steepest(rays: Float[AnyArray, "3 3"]) -> Float[Array, " 2"]:
    """The largest change of inverse depth to the next column and row within a surface, as a share of the inverse depth."""
    return _STEEPEST * jnp.linalg.norm(rays[:, :2], axis=0)


def _shifted(array: Array, by: int, axis: int) -> Array:
    """The array moved along an axis by a few samples, so that [i] holds [i + by]; −1 from outside."""
    size = array.shape[axis]
    padding = [(0, 0), (0, 0)]
    padding[axis] = (max(-by, 0), max(by, 0))
    padded = jnp.pad(array, padding, constant_values=-1.0)
    return jax.lax.slice_in_dim(padded, max(by, 0), max(by, 0) + size, axis=axis)


@jax.jit
def _without_small_holes(
    inverse: Float[Array, "grid grid"], hole: Bool[Array, "grid grid"], rays: Float[AnyArray, "3 3"]
) -> Float[Array, "grid grid"]:
    """Inverse depth with holes of up to three samples filled, by linear interpolation across both image axes.

    A hole is filled only if it lies within one surface along both axes, so slits and notches remain.
    """
    total, count = jnp.zeros_like(inverse), jnp.zeros_like(inverse)
    for axis, limit in zip((1, 0), _steepest(rays), strict=True):
        ends, steps = [], []
        for sign in (-1, 1):
            one, two = _shifted(inverse, sign, axis), _shifted(inverse, 2 * sign, axis)
            ends.append(jnp.where(one > 0, one, two))
            steps.append(jnp.where(one > 0, 1.0, 2.0))
        whole = (ends[0] > 0) & (ends[1] > 0)
        apart = jnp.abs(ends[0] - ends[1])
        whole &= apart <= limit * jnp.minimum(ends[0], ends[1]) * (steps[0] + steps[1])
        total += jnp.where(whole, (ends[0] * steps[1] + ends[1] * steps[0]) / (steps[0] + steps[1]), 0.0)
        count += whole
    return jnp.where(hole & (count == 2), total / 2, inverse)


def _slope(inverse: Float[Array, "grid grid"], axis: int, steepest: Float[Array, ""]) -> Float[Array, "grid grid"]:
    """The change of inverse depth to the next sample, from the neighbour that is closer in depth; 0 without one."""
    before, after = _shifted(inverse, -1, axis), _shifted(inverse, 1, axis)
    limit = steepest * inverse
    ahead = jnp.where((after > 0) & (jnp.abs(after - inverse) <= limit), after - inverse, jnp.inf)
    back = jnp.where((before > 0) & (jnp.abs(inverse - before) <= limit), inverse - before, jnp.inf)
    slope = jnp.where(jnp.abs(ahead) <= jnp.abs(back), ahead, back)
    return jnp.where((inverse > 0) & jnp.isfinite(slope), slope, 0.0)


def _meet(
    surface: Float[Array, "3 samples"],
    window: Window,
    origin: Float[Array, " 3"],
    directions: Float[Array, "rays 3"],
    between: tuple[Float[Array, " rays"], Float[Array, " rays"]],
    most_steps: int,
) -> tuple[Float[Array, " rays"], Bool[Array, " rays"]]:
    """Where rays first meet the measured surface, between two distances.

    Returns:
        The distance along each ray in units of its direction, 0 where it meets nothing; and whether this is certain: until it
        meets something, it is in front of all that was measured.
    """
    grid, (near, far) = window.depth.shape[0], between
    start, stop = (_seen(window, origin + directions * t[:, None]) for t in (near, far))
    change, shape = stop - start, near.shape

    def compare(share: Array) -> tuple[Array, Array, Array]:
        """For a point of each ray: inverse depth of the surface there, by how much the point is in front of the plane there (in
        inverse depth), and the share at which the ray meets this plane."""
        column, row, inverse = (first + share * rate for first, rate in zip(start, change, strict=True))
        nearest_column, nearest_row = jnp.round(column), jnp.round(row)
        outside = (nearest_column < 0) | (nearest_column >= grid) | (nearest_row < 0) | (nearest_row >= grid)
        index = jnp.where(outside, 0, nearest_row * grid + nearest_column).astype(jnp.int32)
        found, to_right, down = surface[0][index], surface[1][index], surface[2][index]
        found = jnp.where(outside, -1.0, found)
        gap = inverse - (found + to_right * (column - nearest_column) + down * (row - nearest_row))
        rate = change[2] - to_right * change[0] - down * change[1]
        return found, gap, share - gap / jnp.where(jnp.abs(rate) > 1e-9, rate, -1e-9)

    longest = jnp.max(jnp.where(far > near, jnp.hypot(change[0], change[1]), 0.0))
    steps = jnp.clip(jnp.ceil(longest / _STRIDE), 1, most_steps)

    def visit(number: Array, state: Array) -> Array:
        """The state of a ray: 1 + the share at which it meets the surface, 3 before that; negative if something may hide this.
        One array, since XLA computes the loop's body again for each."""
        share = jnp.full(shape, number / steps)
        found, gap, crossing = compare(share)
        nearby = jnp.clip(crossing, jnp.maximum(share - _REACH / steps, 0), jnp.minimum(share + _REACH / steps, 1))
        meets = (found > 0) & ((nearby == crossing) | (jnp.abs(gap) <= _NOISE * found**2))
        found_there, gap_there, again = compare(nearby)
        closer = jnp.clip(again, jnp.maximum(nearby - _AGAIN / steps, 0), jnp.minimum(nearby + _AGAIN / steps, 1))
        meets &= (found_there > 0) & ((closer == again) | (jnp.abs(gap_there) <= _NOISE * found_there**2))
        behind = (found < 0) | ((found > 0) & (gap <= 0))
        sign = jnp.where(behind & ~meets, -1.0, jnp.sign(state))
        return jnp.where(jnp.abs(state) > 2.5, sign * jnp.where(meets, 1 + closer, 3.0), state)

    state = jax.lax.fori_loop(0, steps.astype(jnp.int32) + 1, visit, jnp.full(shape, 3.0))
    hit, best = jnp.abs(state) < 2.5, jnp.abs(state) - 1
    found, _, crossing = compare(best)
    best = jnp.where((found > 0) & (jnp.abs(crossing - best) * steps <= _AGAIN), crossing, best)
    first, last = start[2] * (1 - best), stop[2] * best  # inverse depth is linear in the share, distance is not
    return jnp.where(hit, (near * first + far * last) / (first + last), 0.0), state > 0


def _seen(window: Window, points: Float[Array, "points 3"]) -> Float[Array, "3 points"]:
    """Column, row and inverse depth of points in the source, in samples and radii; only for points in front of it."""
    seen = (points - window.eye) @ window.projection.T
    inverse = 1 / jnp.maximum(seen[:, 2], 1e-3)
    return jnp.stack([seen[:, 0] * inverse, seen[:, 1] * inverse, inverse])
