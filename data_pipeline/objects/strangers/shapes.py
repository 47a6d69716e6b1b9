"""Building blocks of strangers beside those of furniture: lofts, sweeps, blobs, slabs, hollow vessels; and how parts are placed.

Units and axes are those of furniture: metres, z up, the floor is z = 0, and a front faces −y.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import trimesh

from data_pipeline.objects.furniture.solids import Parts, Random, Solid, lathe

Point = Sequence[float] | np.ndarray
Builder = Callable[[Random], Parts]
Groups = dict[str, dict[str, tuple[Builder, ...]]]
"""Builders, whose names are kinds, by group and split."""

FRONT = (0, 1, 0)
"""The axis of a disc that lies in a front."""


def loft(sections: np.ndarray | Sequence[np.ndarray | Sequence[Point]], caps: bool = True) -> Solid:
    """The skin over sections (m, n, 3), each a closed loop of n points; `caps` closes both ends by fans from their centres."""
    rows = np.asarray(sections, float)
    if caps:
        ends = np.repeat(rows[[0, -1]].mean(axis=1, keepdims=True), rows.shape[1], axis=1)
        rows = np.concatenate([ends[:1], rows, ends[1:]])
    count, n = rows.shape[:2]
    i = np.arange((count - 1) * n).reshape(count - 1, n)
    j = np.roll(i, -1, axis=1)
    lower, upper = np.stack([i, j, j + n], axis=-1), np.stack([i, j + n, i + n], axis=-1)
    if caps:  # the other triangle of a quadrilateral at the centre has no area
        lower, upper = lower[1:], upper[:-1]
    faces = np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])
    return trimesh.Trimesh(rows.reshape(-1, 3), faces, process=False)


def circle(n: int, turn: float = 0) -> np.ndarray:
    """Returns n points (n, 2) on the unit circle, the first at the angle `turn`."""
    angles = turn + np.arange(n) * 2 * np.pi / n
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def level(outline: np.ndarray, z: float, x: float = 0, y: float = 0) -> np.ndarray:
    """Returns an outline (n, 2) as a section (n, 3) at height `z`, moved by `x` and `y`."""
    return np.column_stack([np.add(outline, (x, y)), np.full(len(outline), z)])


def upright(outline: np.ndarray, y: float) -> np.ndarray:
    """Returns an outline (n, 2) of x and z as a section (n, 3) at `y`."""
    return np.column_stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]])


def slab(outer: np.ndarray, thickness: float, inner: np.ndarray | None = None) -> Solid:
    """An upright slab about y = 0 with an outline (n, 2) of x and z; `inner`, with as many points, is the outline of a hole.

    Without a hole, every point of the outline must be visible from the mean of its points.
    """
    front, back = upright(outer, -thickness / 2), upright(outer, thickness / 2)
    if inner is None:
        return loft([front, back])
    return loft([front, back, upright(inner, thickness / 2), upright(inner, -thickness / 2), front], caps=False)


def sweep(path: np.ndarray | Sequence[Point], radii: float | Sequence[float] | np.ndarray, sections: int = 10) -> Solid:
    """A tube along a path (m, 3) with one radius, or one a point."""
    points = np.asarray(path, float)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = np.eye(3)[np.abs(tangents[0]).argmin()]
    ring, rows = circle(sections), []
    for point, tangent, radius in zip(points, tangents, np.broadcast_to(radii, len(points)), strict=True):
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        rows.append(point + radius * ring @ np.stack([side, np.cross(tangent, side)]))
    return loft(rows)


def rod(start: Point, end: Point, radius: float) -> Solid:
    """A cylinder whose axis runs from `start` to `end`."""
    return sweep([start, end], radius)


def bend(points: np.ndarray | Sequence[Point], count: int = 14) -> np.ndarray:
    """Returns `count` points (count, 3) on the Bézier curve of three or four points."""
    t, curve = np.linspace(0, 1, count)[:, None, None], np.asarray(points, float)[None].repeat(count, axis=0)
    while curve.shape[1] > 1:
        curve = curve[:, :-1] * (1 - t) + curve[:, 1:] * t
    return curve[:, 0]


def blob(size: Point, centre: Point = (0, 0, 0), flat: float = 1, square: float = 1, sections: int = 18) -> Solid:
    """A superellipsoid with half axes `size`; its exponents are `flat` from pole to pole and `square` around (1: ellipsoid)."""

    def curve(angles: np.ndarray, exponent: float) -> np.ndarray:
        wave = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return np.sign(wave) * np.abs(wave) ** exponent

    around = curve(np.arange(sections) * 2 * np.pi / sections, square)
    along = curve(np.linspace(-np.pi / 2, np.pi / 2, sections // 2 + 1), flat)
    rows = np.stack([level(around * abs(r), z) for r, z in along])
    return loft(rows * size + centre, caps=False)


def capsule(start: Point, end: Point, radius: float, tip: float = 1) -> Solid:
    """A rod with round ends; the radius at its `end` is `tip` times `radius`."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    axis = (b - a) / np.linalg.norm(b - a)
    low, high = np.linspace(-1.5, 0, 5), np.linspace(0, 1.5, 5)
    path = [a + axis * radius * np.sin(t) for t in low] + [b + axis * radius * tip * np.sin(t) for t in high]
    return sweep(path, [*radius * np.cos(low), *radius * tip * np.cos(high)], 12)


def hollow(profile: Sequence[tuple[float, float]], wall: float, stretch: float = 1) -> Solid:
    """A vessel: the surface of revolution of (radius, height) pairs from the foot to the rim, and back inside."""
    inside = [(max(r - wall, 0.001), z) for r, z in profile[::-1] if z > profile[0][1] + wall]
    bottom = profile[0][1] + wall
    return lathe([(0, profile[0][1]), *profile, *inside, (inside[-1][0], bottom), (0, bottom)], stretch)


def smooth(profile: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Returns a profile whose corners were cut twice; its ends stay."""
    points = np.asarray(profile, float)
    for _ in range(2):
        cut = np.stack([points[:-1] * 0.75 + points[1:] * 0.25, points[:-1] * 0.25 + points[1:] * 0.75], axis=1)
        points = np.concatenate([points[:1], cut.reshape(-1, 2), points[-1:]])
    return [(float(r), float(z)) for r, z in points]


def disc(radius: float, thickness: float, centre: Point, axis: Point = (1, 0, 0), sections: int = 18) -> Solid:
    """A wheel: a short cylinder about `centre` whose axis is `axis`."""
    half = np.asarray(axis, float) * thickness / 2
    return sweep([np.asarray(centre) - half, np.asarray(centre) + half], radius, sections)


def placed(parts: Parts, at: Point = (0, 0, 0), turn: Point = (0, 0, 0)) -> Parts:
    """Turns parts, in place, about the axes x, y, z by `turn` in radians, moves them by `at`, and returns them."""
    matrix = trimesh.transformations.euler_matrix(*turn)
    matrix[:3, 3] = at
    for part in parts:
        part.apply_transform(matrix)
    return parts


def either(random: Random, share: float = 0.5) -> bool:
    """Draws yes with the probability `share`."""
    return bool(random.random() < share)


def tossed(random: Random, parts: Parts, share: float = 0.4) -> Parts:
    """Lays parts on their side with the probability `share`; they are returned."""
    return placed(parts, turn=(np.pi / 2, 0, random.uniform(0, 2 * np.pi))) if either(random, share) else parts
