"""Faults of depth cameras and of what is said about them: what drivers, converters and people get wrong, in many strengths.

Each fault takes what is true of an image, and returns what a caller gives instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from data_pipeline.capture.casting import Cast
from eval.checks.camera import Shot, cast_shot
from mevs_jax.agent.candidates import pose_towards


@dataclass(frozen=True)
class Given:
    """What an agent is given: an image with its camera, and where the object is; and where its lowest point is, in radii from
    the centre."""

    depth: Any
    K: np.ndarray
    pose: np.ndarray
    center: Any
    radius: float
    up: Any = (0.0, 0.0, 1.0)
    mask: Any = None
    floor: float | None = None
    lowest: float = -0.75


Fault = Callable[[Given], Given]

SIZE = (640, 480)
CENTER, RADIUS = np.array([0.4, -0.3, 0.9]), 0.5


def taken(
    cast: Cast,
    direction: np.ndarray,
    *,
    distance: float = 2.4,
    size: tuple[int, int] = SIZE,
    fields: float = 65.0,
    pose: np.ndarray | None = None,
    lowest: float = -0.75,
    room: bool = False,
    noise: float = 0.0,
    seed: int = 0,
) -> Given:
    """The image that a camera takes of a prepared mesh at `CENTER`.

    Args:
        cast: of the mesh, in the unit sphere.
        direction: unit vector from the object to the camera.
        distance: in radii.
        size: width and height.
        fields: horizontal field of view in degrees.
        pose: in place of one that aims at the centre.
        lowest: height of the object's lowest point in radii from its centre, where the ground is.
        room: whether there are a ground and walls behind the object, which is then told from them by a mask.
        noise: of depth, as a share of the radius.
        seed: of the noise.
    """
    width, height = size
    focal = width / 2 / np.tan(np.deg2rad(fields) / 2)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    if pose is None:
        pose = pose_towards(np.asarray(direction, float), CENTER, distance * RADIUS, np.array([0, 0, 1.0]))
    depth = cast_shot(cast, Shot(width, height, K, pose, CENTER, RADIUS)).astype(np.float32)
    mask = None
    if noise:
        depth = np.where(depth > 0, depth + np.random.default_rng(seed).normal(0, noise * RADIUS, depth.shape), 0)
    depth = np.where(depth > 0, depth, np.inf).astype(np.float32)
    if room:
        mask = np.isfinite(depth)
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(K).T @ pose[:3, :3].T
        ground = CENTER[2] + RADIUS * lowest
        for axis, at in ((2, ground), (0, CENTER[0] - 3), (0, CENTER[0] + 3), (1, CENTER[1] - 3), (1, CENTER[1] + 3)):
            with np.errstate(divide="ignore", invalid="ignore"):
                far = (at - pose[axis, 3]) / rays[..., axis]
            depth = np.where(far > 0, np.minimum(depth, far), depth).astype(np.float32)
    return Given(depth, K, pose, CENTER.copy(), RADIUS, mask=mask, lowest=lowest)


def _scaled(matrix: np.ndarray, fx: float = 1, fy: float = 1, cx: float = 1, cy: float = 1) -> np.ndarray:
    changed = matrix.copy()
    changed[0, 0] *= fx
    changed[1, 1] *= fy
    changed[0, 2] *= cx
    changed[1, 2] *= cy
    return changed


def _K(**scales: float) -> Fault:
    return lambda given: replace(given, K=_scaled(given.K, **scales))


def _K_of(share: float) -> Fault:
    """Intrinsics of an image of another resolution."""

    def change(given: Given) -> Given:
        changed = given.K.copy()
        changed[:2] *= share
        changed[:2, 2] += (share - 1) / 2
        return replace(given, K=changed)

    return change


def _moved_principal(right: float, down: float) -> Fault:
    def change(given: Given) -> Given:
        height, width = np.shape(given.depth)
        changed = given.K.copy()
        changed[:2, 2] += right * width, down * height
        return replace(given, K=changed)

    return change


def _swapped(given: Given) -> Given:
    changed = given.K.copy()
    changed[0, 2], changed[1, 2] = given.K[1, 2], given.K[0, 2]
    return replace(given, K=changed)


def _image(change: Callable[[np.ndarray], Any]) -> Fault:
    """Another image, and its mask alike where the mask has its shape."""

    def fault(given: Given) -> Given:
        mask = None if given.mask is None else np.asarray(change(np.asarray(given.mask, np.float32)))
        if mask is not None:
            mask = np.nan_to_num(mask) > 0.5
        return replace(given, depth=change(given.depth), mask=mask)

    return fault


def _depth(change: Callable[[np.ndarray], Any]) -> Fault:
    return lambda given: replace(given, depth=change(given.depth))


def _finite(depth: np.ndarray) -> np.ndarray:
    """Depth with 0 where nothing is hit."""
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def _buffer(near: float, far: float, depth: np.ndarray) -> np.ndarray:
    """What a renderer keeps: 0 at the near plane, 1 at the far one."""
    away = np.minimum(np.where(depth > 0, depth, far), far)
    return ((far / (far - near)) * (1 - near / away)).astype(np.float32)


def _smallest_to_largest(depth: np.ndarray) -> np.ndarray:
    shown = depth[np.isfinite(depth) & (depth > 0)]
    span = max(float(np.ptp(shown)), 1e-6)
    return np.where(np.isfinite(depth) & (depth > 0), (depth - shown.min()) / span, 0).astype(np.float32)


def _of_largest(depth: np.ndarray) -> np.ndarray:
    return (_finite(depth) / _finite(depth).max()).astype(np.float32)


def _along_rays(given: Given) -> Given:
    """Euclidean distance in place of depth."""
    height, width = given.depth.shape
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(given.K).T
    return replace(given, depth=(given.depth * np.linalg.norm(rays, axis=-1)).astype(np.float32))


def _pose(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    return lambda given: replace(given, pose=change(given.pose))


def _turned(axis: str, degrees: float) -> Fault:
    """The camera turned about one of its own axes."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return _pose(lambda pose: pose @ turn)


def _in_world(axis: str, degrees: float) -> Fault:
    """A pose in another world: turned about a world's axis through the origin."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return _pose(lambda pose: turn @ pose)


def _shifted_pose(metres: tuple[float, float, float]) -> Fault:
    """The camera elsewhere, along its own axes."""

    def change(pose: np.ndarray) -> np.ndarray:
        moved = pose.copy()
        moved[:3, 3] += pose[:3, :3] @ metres
        return moved

    return _pose(change)


def _translation(by: float) -> Fault:
    def change(pose: np.ndarray) -> np.ndarray:
        scaled = pose.copy()
        scaled[:3, 3] *= by
        return scaled

    return _pose(change)


def _quaternion_order(pose: np.ndarray) -> np.ndarray:
    changed = pose.copy()
    changed[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)).as_matrix()
    return changed


def _sphere(**change: Any) -> Fault:
    return lambda given: replace(given, **{name: make(given) for name, make in change.items()})


def _at(x: float, y: float, z: float) -> Fault:
    return _sphere(center=lambda given: given.center + given.radius * np.array([x, y, z]))


def _masked(change: Callable[[np.ndarray], Any]) -> Fault:
    return lambda given: replace(given, mask=change(_mask(given)))


def _mask(given: Given) -> np.ndarray:
    return np.isfinite(given.depth) & (given.depth > 0) if given.mask is None else np.asarray(given.mask)


def _rolled(right: int, down: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda mask: np.roll(mask, (down, right), (0, 1))


def _smaller(step: int) -> Fault:
    """A sound image of few pixels, with its own intrinsics."""

    def change(given: Given) -> Given:
        first = (step - 1) / 2
        K = given.K.copy()
        K[:2, 2] -= first
        K[:2] /= step
        pick = (slice(step // 2, None, step),) * 2
        return replace(given, K=K, depth=given.depth[pick], mask=None if given.mask is None else given.mask[pick])

    return change


def _holes(share: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda depth: np.where(np.random.default_rng(0).uniform(size=depth.shape) < share, 0, depth).astype(
        np.float32
    )


def _of_whole_numbers(kind: Any, scale: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda depth: (_finite(depth) * scale).astype(kind)


MIRRORED = np.diag([-1.0, 1, 1, 1])
OPENGL = np.diag([1.0, -1, -1, 1])

ONE: dict[str, dict[str, Fault]] = {
    "intrinsics": {
        **{
            f"K of {name} the resolution": _K_of(share)
            for name, share in (
                ("half", 0.5),
                ("a third of", 1 / 3),
                ("three quarters of", 0.75),
                ("1.5 times", 1.5),
                ("twice", 2.0),
                ("a quarter of", 0.25),
            )
        },
        **{f"focal lengths {100 * (by - 1):+.0f} %": _K(fx=by, fy=by) for by in (1.1, 1.2, 1.5, 2.0, 0.9, 0.8, 0.6)},
        "focal lengths of 60 pixels": lambda given: replace(
            given, K=np.array([[60, 0, given.K[0, 2]], [0, 60, given.K[1, 2]], [0, 0, 1.0]])
        ),
        "focal lengths in millimetres": _K(fx=0.008, fy=0.008),
        "focal lengths 30 times too long": _K(fx=30, fy=30),
        "fx twice fy": _K(fx=2),
        "fy 1.3 times fx": _K(fy=1.3),
        "fx in place of fy, of a camera of 60 pixels": _K(fy=0.12),
        "cx and cy swapped": _swapped,
        "principal point at the corner": lambda given: replace(
            given, K=np.array([[given.K[0, 0], 0, 0], [0, given.K[1, 1], 0], [0, 0, 1.0]])
        ),
        **{
            f"principal point off by {right:.0%}, {down:.0%}": _moved_principal(right, down)
            for right, down in ((0.05, 0.0), (0.1, 0.1), (0.2, 0.0), (0.0, -0.3), (0.6, 0.0))
        },
        "K transposed": lambda given: replace(given, K=given.K.T),
        "K is its inverse": lambda given: replace(given, K=np.linalg.inv(given.K)),
    },
    "image": {
        "transposed": _image(lambda depth: depth.T),
        "turned by 90°": _image(np.rot90),
        "turned by 180°": _image(lambda depth: depth[::-1, ::-1]),
        "mirrored left to right": _image(lambda depth: depth[:, ::-1]),
        "upside down": _image(lambda depth: depth[::-1]),
        "of half the resolution": _image(lambda depth: depth[::2, ::2]),
        "cropped": _image(lambda depth: depth[60:420, 80:560]),
        "of 1×1 pixel": _smaller(480),
        "of 8×6 pixels": _smaller(80),
        "of 16×12 pixels": _smaller(40),
        "with an axis of channels": _depth(lambda depth: depth[..., None]),
        "flattened": _depth(lambda depth: depth.reshape(-1)),
        "shifted by 100 pixels": _image(lambda depth: np.roll(depth, 100, 1)),
        "empty": _depth(lambda depth: depth[:0]),
    },
    "depth": {
        "millimetres": _depth(lambda depth: depth * 1000),
        "centimetres": _depth(lambda depth: depth * 100),
        "uint16 millimetres": _depth(_of_whole_numbers(np.uint16, 1000)),
        "whole metres": _depth(_of_whole_numbers(np.int32, 1)),
        "feet": _depth(lambda depth: depth * 3.28),
        "a quarter too long (1/4000 m)": _depth(lambda depth: depth * 1.25),
        "a tenth too long": _depth(lambda depth: depth * 1.1),
        "a tenth too short": _depth(lambda depth: depth * 0.9),
        "a fifth too short": _depth(lambda depth: depth * 0.8),
        "halved": _depth(lambda depth: depth * 0.5),
        "inverse": _depth(lambda depth: np.where(depth > 0, 1 / depth, 0).astype(np.float32)),
        "z-buffer, planes 0.1 and 10": _depth(partial(_buffer, 0.1, 10)),
        "z-buffer, planes 0.5 and 5": _depth(partial(_buffer, 0.5, 5)),
        "z-buffer, planes 0.01 and 100": _depth(partial(_buffer, 0.01, 100)),
        "scaled from smallest to largest": _depth(_smallest_to_largest),
        "as a share of the largest": _depth(_of_largest),
        "as a share of the largest, reversed": _depth(
            lambda depth: np.where(_of_largest(depth) > 0, 1 - _of_largest(depth), 0).astype(np.float32)
        ),
        "of 8 bits / 255": _depth(lambda depth: (np.round(255 * _of_largest(depth)) / 255).astype(np.float32)),
        "Euclidean distance": _along_rays,
        "negative": _depth(lambda depth: -depth),
        "NaN": _depth(lambda depth: np.full_like(depth, np.nan)),
        "zero": _depth(np.zeros_like),
        "infinite": _depth(lambda depth: np.full_like(depth, np.inf)),
        "constant": _depth(lambda depth: np.full_like(depth, 1.2)),
        "noise": _depth(lambda depth: np.random.default_rng(0).uniform(0.6, 1.8, depth.shape).astype(np.float32)),
        "masked array": _depth(lambda depth: np.ma.masked_greater(depth, 3)),
        "holes at 99 % of the pixels": _depth(_holes(0.99)),
        "logarithm": _depth(lambda depth: np.where(np.isfinite(depth), np.log(depth), 0).astype(np.float32)),
        "of complex numbers": _depth(lambda depth: depth.astype(np.complex64)),
        "of strings": _depth(lambda depth: depth.astype(str)),
    },
    "pose": {
        "inverse": _pose(np.linalg.inv),
        "transposed": _pose(np.transpose),
        "of an OpenGL camera": _pose(lambda pose: pose @ OPENGL),
        "mirrored": _pose(lambda pose: pose @ MIRRORED),
        "with scale": _pose(lambda pose: pose @ np.diag([1.1, 1.1, 1.1, 1])),
        "not orthogonal": _pose(lambda pose: pose + np.pad(np.full((1, 1), 0.1), ((0, 3), (1, 2)))),
        "NaN": _pose(lambda pose: pose * np.nan),
        "identity": _pose(lambda pose: np.eye(4)),
        "in millimetres": _translation(1000.0),
        "in centimetres": _translation(100.0),
        "quaternion in another order": _pose(_quaternion_order),
        "of a body with x forward": _pose(
            lambda pose: pose @ np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
        ),
        **{f"turned about its optical axis by {angle}°": _turned("z", angle) for angle in (10, 90, 180)},
        **{f"turned about its vertical axis by {angle}°": _turned("y", angle) for angle in (5, 10, 20)},
        "in a world whose y is up": _in_world("x", 90),
        "in a world turned by 30°": _in_world("z", 30),
        **{f"{metres[0]} m aside": _shifted_pose(metres) for metres in ((0.1, 0, 0), (0.25, 0, 0), (0.5, 0, 0))},
        **{f"{-metres[2]} m further back": _shifted_pose(metres) for metres in ((0, 0, -0.1), (0, 0, -0.25))},
        "0.25 m further forward": _shifted_pose((0, 0, 0.25)),
        "of three rows": _pose(lambda pose: pose[:3]),
    },
    "sphere": {
        **{
            f"radius {by:g} times": _sphere(radius=lambda given, by=by: given.radius * by)
            for by in (0.25, 0.5, 0.7, 0.85, 1.2, 1.5, 2.0, 100.0)
        },
        "center at the bottom": _at(0, 0, -0.7),
        "center at the top": _at(0, 0, 0.7),
        **{f"center {x:g} radii aside": _at(x, 0, 0) for x in (0.15, 0.3, 0.6, 1.5)},
        "center in millimetres": _sphere(center=lambda given: 1000 * given.center),
        "radius in millimetres": _sphere(radius=lambda given: 1000 * given.radius),
        "diameter as radius": _sphere(radius=lambda given: 2 * given.radius),
        "up is y": _sphere(up=lambda given: (0, 1.0, 0)),
        "up is −z": _sphere(up=lambda given: (0, 0, -1.0)),
        "up leans by 20°": _sphere(up=lambda given: (0, np.sin(0.35), np.cos(0.35))),
        "radius is NaN": _sphere(radius=lambda given: np.nan),
        "center of two numbers": _sphere(center=lambda given: given.center[:2]),
    },
    "mask and floor": {
        **{f"mask shifted by {pixels} pixels": _masked(_rolled(pixels, 0)) for pixels in (10, 40, 100)},
        "mask of the background": _masked(np.logical_not),
        "mask of all pixels": _masked(np.ones_like),
        "mask of none": _masked(np.zeros_like),
        "mask upside down": _masked(lambda mask: mask[::-1]),
        "mask mirrored": _masked(lambda mask: mask[:, ::-1]),
        "mask of the left half": _masked(lambda mask: mask & (np.arange(mask.shape[1]) < mask.shape[1] / 2)),
        "mask transposed": _masked(np.transpose),
        "mask of −1": _masked(lambda mask: -mask.astype(np.int8)),
        "mask of strings": _masked(lambda mask: np.where(mask, "True", "False")),
        "mask of shares": _masked(lambda mask: np.where(mask, 0.7, 0.01)),
        "mask of NaN": _masked(lambda mask: np.where(mask, 1, np.nan)),
        "mask of another resolution": _masked(lambda mask: mask[::2, ::2]),
        **{
            f"floor {height:g} radii too high": _sphere(
                floor=lambda given, height=height: given.center[2] + given.radius * (given.lowest + height)
            )
            for height in (0.2, 0.5, 0.8)
        },
        "floor above the object": _sphere(floor=lambda given: given.center[2] + 1.1 * given.radius),
        "floor in millimetres": _sphere(floor=lambda given: 1000 * (given.center[2] - 0.5)),
        "floor relative to the center": _sphere(floor=lambda given: -0.5),
        "floor is NaN": _sphere(floor=lambda given: np.nan),
    },
}
