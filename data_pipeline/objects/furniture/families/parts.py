"""Parts of furniture that are not flat: lofts, bent sheets, bent tubes, rounded boxes, bases, backs and legs.

Units and axes are those of the package: metres, z up, the front of a piece faces −y.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import trimesh
from jaxtyping import Float, Int
from numpy import ndarray

from data_pipeline.objects.furniture.solids import Parts, Random, Solid, box, rod

Outline = Float[ndarray, "n 2"]
Level = tuple[float, float, float, float, float]
"""A cross-section of a loft: factors of its outline along x and y, and where its centre is (x, y, z)."""


def draws(random: Random, *ranges: tuple[float, float]) -> tuple[float, ...]:
    """One number from each range."""
    return tuple(random.uniform(low, high) for low, high in ranges)


def superellipse(power: float, points: int = 28) -> Outline:
    """The curve |x|^power + |y|^power = 1, counter-clockwise: 2 is a circle, 4 a rounded square, 1 a rhombus."""
    angles = np.linspace(0, 2 * np.pi, points, endpoint=False) + np.pi / points
    wave = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.sign(wave) * np.abs(wave) ** (2 / power)


CIRCLE, SQUARE = superellipse(2), np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
HALF_ROUND = np.concatenate(
    [[[1.0, 1.0]], [[-1.0, 1.0]], np.c_[-np.cos(t := np.linspace(0, np.pi, 15)), 1 - 2 * np.sin(t)]]
)
"""Straight at the back, round at the front."""
CORNER = np.concatenate(
    [[[1.0, 1.0]], [[-1.0, 1.0]], [[-1.0, 0.1]], [[-0.85, -0.15]], [[-0.15, -0.85]], [[0.1, -1.0]], [[1.0, -1.0]]]
)
"""Fills a corner of a room at the right of the back; its front is cut off obliquely."""


def loft(outline: Outline, levels: Sequence[Level]) -> Solid:
    """A body through cross-sections that are scaled copies of one outline, closed at both ends."""
    count = len(outline)
    rings = [np.c_[outline * (sx, sy) + (x, y), np.full(count, z)] for sx, sy, x, y, z in levels]
    ends = [[levels[0][2:]], [levels[-1][2:]]]
    i, following = np.arange(count), (np.arange(count) + 1) % count
    faces = []
    for level in range(len(levels) - 1):
        a, b = level * count, (level + 1) * count
        faces += [np.c_[a + i, a + following, b + following], np.c_[a + i, b + following, b + i]]
    bottom, last = len(levels) * count, (len(levels) - 1) * count
    faces += [
        np.c_[np.full(count, bottom), following, i],
        np.c_[np.full(count, bottom + 1), last + i, last + following],
    ]
    return trimesh.Trimesh(np.concatenate([*rings, *ends]), np.concatenate(faces), process=False)


def prism(
    outline: Outline, width: float, depth: float, height: float, x: float = 0, y: float = 0, z: float = 0
) -> Solid:
    """An upright body of this outline, stretched to `width` by `depth`, with the centre of its base at (x, y, z)."""
    if outline is SQUARE:
        return box(width, depth, height, x, y, z)
    return loft(outline, [(width / 2, depth / 2, x, y, z), (width / 2, depth / 2, x, y, z + height)])


def turned(profile: Sequence[tuple[float, float]], x: float = 0, y: float = 0) -> Solid:
    """A body of revolution of (radius, height) pairs from the lowest to the highest, around the upright axis at (x, y)."""
    return loft(superellipse(2, 14), [(r, r, x, y, z) for r, z in profile])


def tube(
    points: Float[ndarray, "n 3"] | Sequence[Sequence[float]],
    radius: float | Sequence[float] | Float[ndarray, " n"],
    sections: int = 7,
) -> Solid:
    """A tube along a curve in about one plane, of one radius or one a point."""
    line = np.array(points, float)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    least = np.eye(3)[np.argmin(np.ptp(line, axis=0))]
    first = np.cross(along, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first)
    angles = np.linspace(0, 2 * np.pi, sections, endpoint=False)[:, None]
    reach = np.broadcast_to(radius, len(line))
    rings = [
        p + r * (np.cos(angles) * a + np.sin(angles) * b) for p, r, a, b in zip(line, reach, first, second, strict=True)
    ]
    i, following = np.arange(sections), (np.arange(sections) + 1) % sections
    faces = []
    for a in range(0, (len(line) - 1) * sections, sections):
        b = a + sections
        faces += [np.c_[a + i, a + following, b + following], np.c_[a + i, b + following, b + i]]
    end, last = len(line) * sections, (len(line) - 1) * sections
    faces += [
        np.c_[np.full(sections, end), following, i],
        np.c_[np.full(sections, end + 1), last + i, last + following],
    ]
    return trimesh.Trimesh(np.concatenate([*rings, line[:1], line[-1:]]), np.concatenate(faces), process=False)


def sheet(grid: Float[ndarray, "n m 3"], thickness: float) -> Solid:
    """A bent board: the surface through a grid of points, of this thickness."""
    rows, columns = grid.shape[:2]
    normal = np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    sides = [(grid + sign * normal * thickness / 2).reshape(-1, 3) for sign in (1, -1)]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    top = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]])
    rim = np.concatenate([index[:, 0], index[-1, 1:], index[-2::-1, -1], index[0, -2:0:-1]])
    on, count = np.roll(rim, -1), rows * columns
    edge = np.concatenate([np.c_[rim, rim + count, on + count], np.c_[rim, on + count, on]])
    return trimesh.Trimesh(np.concatenate(sides), np.concatenate([top, top[:, ::-1] + count, edge]), process=False)


def bent(
    profile: Sequence[tuple[float, float]], width: float, thickness: float, bow: float = 0, taper: float = 1
) -> Solid:
    """A board of `width` along x with this profile of (y, z) pairs, bowed and tapered.

    Args:
        bow: how far the middle lies behind the edges, growing along the profile.
        taper: width of its end as a share of that of its beginning.
    """
    line = np.array(profile, float)
    share = np.linspace(0, 1, len(line))[:, None]
    across = np.linspace(-1, 1, 7)[None]
    x = across * width / 2 * (1 + (taper - 1) * share)
    y = line[:, :1] - bow * np.sqrt(share) * across**2
    return sheet(np.stack([x, y, np.broadcast_to(line[:, 1:], x.shape)], axis=-1), thickness)


def crested(width: float, height: float, thickness: float, crest: float = 0.2) -> Solid:
    """An upright board whose upper edge rises by a share `crest` of its height towards the middle."""
    x, z = np.linspace(-1, 1, 9)[None], np.array([[0], [1 - crest], [1]])
    rise = np.where(z == 1, 1 - crest * x**2, z)
    return sheet(np.stack(np.broadcast_arrays(x * width / 2, 0, rise * height), axis=-1), thickness)


def around(width: float, depth: float, low: float, high: float, thickness: float, opening: float = 0.5) -> Solid:
    """An upright wall around the back and the sides of an ellipse; its rim falls from `high` at the back to `low`.

    Args:
        opening: half the angle of the gap at the front in radians.
    """
    angles = np.linspace(-np.pi / 2 + opening, 3 * np.pi / 2 - opening, 17)
    foot = np.stack([width / 2 * np.cos(angles), depth / 2 * np.sin(angles), np.zeros(17)], axis=1)
    rise = low + (high - low) * np.clip(0.5 + 0.6 * np.sin(angles), 0, 1)
    heights = np.linspace(0, 1, 3)[:, None] * rise
    grid = np.broadcast_to(foot, (3, 17, 3)).copy()
    grid[..., 2] = heights
    return sheet(grid, thickness)


@cache
def _cube(steps: int) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"], Int[ndarray, "m 3"]]:
    """A rounded cube of (steps + 1)² squares a corner: the signs of its vertices, their directions, and its faces."""
    quarter = np.tan(np.linspace(0, np.pi / 4, steps + 1))
    offsets = np.concatenate([-quarter[::-1], quarter])
    size = len(offsets)
    side = np.repeat([-1.0, 1.0], steps + 1)
    signs: list[np.ndarray] = []
    directions, faces = [], []
    u, v = (part.ravel() for part in np.meshgrid(np.arange(size), np.arange(size), indexing="ij"))
    index = np.arange(size * size).reshape(size, size)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    square = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]])
    for axis in range(3):
        for end in (0, size - 1):
            order = [axis, (axis + 1) % 3, (axis + 2) % 3]
            at = np.stack([np.full(len(u), end), u, v])[np.argsort(order)].T
            faces.append((square if end else square[:, ::-1]) + len(signs) * size * size)
            signs.append(side[at])
            directions.append(offsets[at] / np.linalg.norm(offsets[at], axis=1, keepdims=True))
    return np.concatenate(signs), np.concatenate(directions), np.concatenate(faces)


def rounded(solid: Solid, radius: float, steps: int = 1) -> Solid:
    """A box, upright or turned, with its edges rounded; anything else as it is."""
    corners = solid.vertices
    if len(corners) != 8 or len(solid.faces) != 12:
        return solid
    axes = corners[[4, 2, 1]] - corners[0]
    lengths = np.linalg.norm(axes, axis=1)
    if not np.allclose(corners[7], corners[0] + axes.sum(axis=0)) or not lengths.all():
        return solid
    signs, directions, faces = _cube(steps)
    reach = np.minimum(radius, lengths.min() * 0.49)
    local = signs * (lengths / 2 - reach) + reach * directions
    return trimesh.Trimesh(local @ (axes / lengths[:, None]) + corners.mean(axis=0), faces, process=False)


def cushion(width: float, depth: float, height: float, x: float = 0, y: float = 0, z: float = 0) -> Solid:
    """A soft box with the centre of its base at (x, y, z)."""
    return rounded(box(width, depth, height, x, y, z), 0.45 * min(width, depth, height), 2)


def moved(parts: Parts, x: float = 0, y: float = 0, z: float = 0, turn: float = 0) -> Parts:
    """Turns the parts about the z axis by `turn` radians, then moves them, in place, and returns them."""
    c, s = np.cos(turn), np.sin(turn)
    for part in parts:
        part.vertices = part.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (x, y, z)
    return parts


def upturned(solid: Solid, y: float, z: float) -> Solid:
    """Turns a part about the x axis, in place, so that its upper side becomes its back; its origin goes to (0, y, z)."""
    return solid.apply_transform(np.array([[1, 0, 0, 0], [0, 0, 1, y], [0, -1, 0, z], [0, 0, 0, 1]]))


def star(reach: float, height: float, arms: int = 5, castors: bool = True) -> Parts:
    """A column on a star of feet."""
    lift = 0.06 if castors else 0.0
    parts = [turned([(0.028, lift + 0.03), (0.028, height * 0.6), (0.02, height * 0.6), (0.02, height)])]
    for arm in range(arms):
        x, y = reach * np.sin(2 * np.pi * arm / arms), -reach * np.cos(2 * np.pi * arm / arms)
        parts.append(
            tube([(0, 0, lift + 0.06), (x * 0.5, y * 0.5, lift + 0.05), (x, y, lift + 0.015)], (0.03, 0.025, 0.015))
        )
        if castors:
            parts.append(turned([(0.02, 0), (0.03, 0.01), (0.03, 0.05), (0.02, 0.06)], x, y))
    return parts


def pedestal(random: Random, reach: float, height: float) -> Parts:
    """One support below the middle: a trumpet, a turned column on curved feet, a star, a drum, or a plate."""
    kind, r = random.integers(5), random.uniform(0.03, 0.055)
    if kind == 0:
        profile = [
            (reach, 0),
            (reach * 0.95, 0.015),
            (reach * 0.4, 0.05),
            (r, height * 0.3),
            (r, height * 0.75),
            (r * 3, height),
        ]
        return [turned(profile)]
    if kind == 1:
        profile = [
            (r, 0.12),
            (r * 1.8, height * 0.3),
            (r, height * 0.45),
            (r * 1.3, height * 0.5),
            (r, height * 0.8),
            (r * 2, height),
        ]
        feet, parts = int(random.integers(3, 5)), [turned(profile)]
        for foot in range(feet):
            x, y = np.sin(t := 2 * np.pi * (foot + 0.5) / feet), -np.cos(t)
            curve = [(s * reach * x, s * reach * y, z) for s, z in ((0, 0.26), (0.35, 0.25), (0.7, 0.1), (1, 0.02))]
            parts.append(tube(curve, (r, r * 0.8, r * 0.6, r * 0.5)))
        return parts
    if kind == 2:
        return star(reach, height, int(random.integers(3, 6)), castors=False)
    if kind == 3:
        waist = random.uniform(0.4, 0.9)
        return [turned([(reach * 0.8, 0), (reach * 0.8 * waist, height * 0.5), (reach * 0.8, height)])]
    shape = SQUARE if random.random() < 0.6 else CIRCLE
    return [prism(shape, 1.6 * reach, 1.6 * reach, 0.025), prism(shape, 2 * r, 2 * r, height)]


def ends(width: float, depth: float, height: float, thickness: float) -> Parts:
    """Two supports like an upside-down T: a foot along the depth, and a post."""
    parts = []
    for side in (-1, 1):
        x = side * width / 2
        parts += [box(thickness, depth, 0.035, x), box(thickness, thickness * 1.4, height, x)]
        parts += [box(thickness, depth * 0.7, 0.03, x, 0, height - 0.03)]
    return parts


def crossed(width: float, depth: float, height: float, radius: float) -> Parts:
    """Two pairs of legs that cross, at the left and the right."""
    parts = []
    for side in (-1, 1):
        x = side * width / 2
        parts += [rod((x, s * depth / 2, 0), (x * 0.97, -s * depth / 2, height), radius) for s in (-1, 1)]
    return parts
