"""What one image says against its camera, and against where the object is said to be.

The sphere of an object ends where the object ends. So its surface does not go on beyond the sphere, it nearly reaches it, and its
outline is about the sphere's. Where an image shows something else, its intrinsics, its pose, its depth, the sphere, the mask or
the floor are wrong. The limits are beyond what 2,239 sound images of 140 objects showed: nowhere did the surface go on; the
object reached 0.80 of its radius, and its outline was 0.32 radii aside (docs/camera.md).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from mevs_jax.geometry.source_view import DepthImage, Window

_BEYOND = 1.12
"""Distance from the centre in radii from which on a point is beyond the sphere; depth is measured with noise."""
_GOES_ON = 0.2
"""Length in radii along which a surface may go on beyond the sphere."""
_REACHES = 0.7
"""Share of the radius that the object reaches in an image that shows all of it."""
_ASIDE = 0.4
"""Radii by which the middle of an outline may lie aside of the centre."""
_WRONG_MASK = 0.2
"""Share of a mask's pixels that may show something beyond the sphere, or nothing at all (+inf)."""
_BELOW, _UNDER = 0.1, 0.03
"""Radii below the floor, and the share of the points in the sphere that may lie there."""
_HIDDEN = 0.2
"""Share of the sphere that may be hidden, or have no depth, where the outline is looked at."""
_STEEPEST = 3.0
"""How many times the distance of neighbouring rays two points of one surface are apart at most."""
_STRETCH = 1.9
"""Ratio of the focal lengths, which a wide image that was made a square has."""
_SAMPLES = 128
"""Along each side of the window."""


def doubt_of(image: DepthImage, window: Window) -> str:
    """A sentence on what is wrong with an image, its camera or the object's sphere; empty if nothing is noticed.

    Args:
        image: of which the window is.
        window: the part of it that contains the sphere.
    """
    if said := _of_camera(image):
        return said
    step = max(1, len(window.depth) // _SAMPLES)
    eye, depth, mask = (
        np.asarray(array) for array in (window.eye, window.depth[::step, ::step], window.mask[::step, ::step])
    )
    depth = depth / np.asarray(window.radius)
    number = np.arange(0, len(window.depth), step, dtype=np.float32)
    measured = (depth > 0) & np.isfinite(depth)
    z = np.where(measured, depth, 0)
    to_right, down, first = np.asarray(window.rays).T
    rays = number[None, :, None] * to_right + number[:, None, None] * down + first
    points = eye + rays * z[..., None]
    away = np.linalg.norm(points, axis=-1)
    if image.mask is not None and (said := _of_mask(np.where(depth == np.inf, depth, away), mask & (depth > 0))):
        return said
    object_ = measured & mask & (points[..., 2] >= window.floor)
    inside, outside = object_ & (away <= _BEYOND), object_ & (away > _BEYOND)
    along = step * np.linalg.norm([to_right, down], axis=1)
    if (length := _goes_on(points, z, inside, outside, along)) > _GOES_ON:
        return (
            f"the surface goes on beyond the object's sphere, along {length:.1f} radii: check K, the pose, the units, center and "
            "radius, or give a mask or a floor that leaves out what is beside the object"
        )
    under = measured & mask & (away <= 1)
    if under.any() and np.mean(points[under][:, 2] < window.floor - _BELOW) > _UNDER:
        return "there is something below the floor within the object's sphere: check the height of the floor, center and up"
    # What hides a part of the object, what has no depth, and the border of the image may hide how far it reaches.
    towards, square = rays @ eye, np.sum(rays**2, axis=-1)
    looks = (towards < 0) & (towards**2 > square * (np.sum(eye**2) - 1))
    hidden = ~measured & mask & (depth != np.inf) | measured & (away > _BEYOND) & (z * square < -towards)
    left, right, top, bottom = window.limits
    edge = np.minimum(number - left, right - number) < 2 * step, np.minimum(number - top, bottom - number) < 2 * step
    ends = inside & (edge[0][None, :] | edge[1][:, None])
    within = ((number >= left) & (number <= right))[None, :] & ((number >= top) & (number <= bottom))[:, None]
    whole = looks.any() and np.mean(hidden[looks & within]) < _HIDDEN and ends.sum() < 3
    return _of_outline(points[inside], eye) if inside.any() and whole else ""


def _of_camera(image: DepthImage) -> str:
    """What intrinsics and numbers say, whatever is seen."""
    (height, width), K, depth = np.shape(image.depth), np.asarray(image.K, float), np.asarray(image.depth)
    right, down = (K[0, 2] + 0.5) / width, (K[1, 2] + 0.5) / height
    middle = max(abs(right - 0.5), abs(down - 0.5)) < 0.05
    if not middle and max(abs((K[0, 2] + 0.5) / height - 0.5), abs((K[1, 2] + 0.5) / width - 0.5)) < 0.05:
        return (
            f"the principal point of K, ({K[0, 2]:g}, {K[1, 2]:g}), is in the middle of an image of {height}×{width} pixels, and "
            f"this one has {width}×{height}: check whether the image is transposed, or cx and cy are swapped"
        )
    if abs(right - down) < 0.01 and abs(right - 0.5) > 0.1:
        return (
            f"by its principal point ({K[0, 2]:g}, {K[1, 2]:g}), K is that of an image of {2 * right:.2g} times as many pixels a "
            f"side as this one of {width}×{height}: scale it with the image"
        )
    if not 1 / _STRETCH < K[0, 0] / K[1, 1] < _STRETCH:
        return f"K has the focal lengths {K[0, 0]:g} and {K[1, 1]:g}: check fx and fy, in pixels"
    shown = depth[np.isfinite(depth)]
    if shown.size and abs(shown.max() - 1) < 1e-6 and not _in_millimetres(shown):
        return "the largest depth is 1: check whether depth is a z-buffer or was scaled to 0..1; it must be in metres"
    return ""


def _in_millimetres(depth: Float[np.ndarray, " pixels"]) -> bool:
    """Whether depth is of a camera that measures in steps of a millimetre or a part of it, so that 1 m is one of its values."""
    steps = 10_000 * depth[:: max(1, len(depth) // 1000)].astype(float)
    return bool(np.abs(steps - np.round(steps)).max() < 0.01 and np.mean(depth > 1 - 1e-6) < 0.01)


def _of_mask(away: Float[np.ndarray, "rows columns"], mask: Bool[np.ndarray, "rows columns"]) -> str:
    """What a mask says, whose pixels are `away` from the centre, infinitely where nothing is hit."""
    beyond = np.sum(mask & (away > _BEYOND)) / max(1, int(mask.sum()))
    what = f"{beyond:.0%} of the mask's pixels show nothing, or something beyond the object's sphere"
    return f"{what}: check the mask, K, the pose, center and radius" if beyond > _WRONG_MASK else ""


def _goes_on(points: np.ndarray, z: np.ndarray, inside: np.ndarray, outside: np.ndarray, along: np.ndarray) -> float:
    """The length, in radii, of the line where a surface crosses the border of the sphere."""
    total = 0.0
    for axis in (0, 1):
        here, there = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        pair = (inside[here] & outside[there]) | (outside[here] & inside[there])
        apart = along[1 - axis] * np.minimum(z[here], z[there])[pair]
        gap = np.linalg.norm(points[here][pair] - points[there][pair], axis=-1)
        total += float(apart[gap <= np.maximum(_STEEPEST * apart, 0.05)].sum())
    return total


def _of_outline(points: Float[np.ndarray, "points 3"], eye: Float[np.ndarray, " 3"]) -> str:
    """What the outline of the object says, in an image that shows all of it."""
    reached = float(np.quantile(np.linalg.norm(points, axis=1), 0.995))
    if reached < _REACHES:
        return (
            f"the object reaches only {reached:.0%} of its radius: check the radius, the focal lengths in K, the pose, the units "
            "and the floor"
        )
    right = np.cross(-eye, (0.0, 0.0, 1.0))
    if (length := np.linalg.norm(right)) < 0.1 * np.linalg.norm(eye):
        right, length = np.cross(-eye, (0.0, 1.0, 0.0)), np.linalg.norm(np.cross(-eye, (0.0, 1.0, 0.0)))
    axes = np.stack([right / length, np.cross(right / length, -eye / np.linalg.norm(eye))])
    middle = np.quantile(points @ axes.T, (0.005, 0.995), axis=0).mean(axis=0)
    if (aside := float(np.abs(middle).max())) > _ASIDE:
        return f"the object is seen {aside:.1f} radii aside of its center: check center, the pose and K"
    return ""
