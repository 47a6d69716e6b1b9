"""Building blocks of furniture: boxes, cylinders, surfaces of revolution, legs, drawers and doors.

Units and axes are those of the package: metres, z up, the front of a piece faces −y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

Solid = trimesh.Trimesh
Parts = list[Solid]
Random = np.random.Generator


def joined(parts: Parts) -> Solid:
    """Returns all parts as one mesh."""
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def box(width: float, depth: float, height: float, x: float = 0, y: float = 0, z: float = 0) -> Solid:
    """An axis-aligned box with the centre of its base at (x, y, z)."""
    solid = trimesh.creation.box((width, depth, height))
    solid.apply_translation((x, y, z + height / 2))
    return solid


def cylinder(radius: float, height: float, x: float = 0, y: float = 0, z: float = 0, sections: int = 20) -> Solid:
    """An upright cylinder with the centre of its base at (x, y, z)."""
    solid = trimesh.creation.cylinder(radius, height, sections=sections)
    solid.apply_translation((x, y, z + height / 2))
    return solid


def rod(start: Sequence[float], end: Sequence[float], radius: float) -> Solid:
    """A cylinder whose axis runs from `start` to `end`."""
    return trimesh.creation.cylinder(radius, segment=np.array([start, end], float), sections=10)


def lathe(profile: Sequence[tuple[float, float]], stretch: float) -> Solid:
    """The surface of revolution of (radius, height) pairs about the z axis, scaled along y by `stretch`."""
    solid = trimesh.creation.revolve(np.array(profile, float), sections=28)
    solid.apply_scale((1, stretch, 1))
    return solid


def tilt(parts: Parts, angle: float, pivot: Sequence[float]) -> Parts:
    """Rotates the parts, in place, about the x axis through `pivot` and returns them.

    A positive `angle` in radians leans the top backwards (towards +y).
    """
    matrix = trimesh.transformations.rotation_matrix(-angle, (1, 0, 0), pivot)
    for part in parts:
        part.apply_transform(matrix)
    return parts


def four_legs(
    width: float,
    depth: float,
    height: float,
    thickness: float,
    inset: float = 0,
    round_legs: bool = False,
    splay: float = 0,
) -> Parts:
    """Four legs under a rectangle of `width` by `depth`, each `inset` from its edges.

    Args:
        thickness: side of a square leg, diameter of a round one.
        splay: how far the lower ends stand outwards along x and y; legs that splay are always round.
    """
    legs: Parts = []
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (width / 2 - thickness / 2 - inset), sy * (depth / 2 - thickness / 2 - inset)
            if splay:
                legs.append(rod((x + sx * splay, y + sy * splay, 0), (x, y, height), thickness / 2))
            elif round_legs:
                legs.append(cylinder(thickness / 2, height, x, y, sections=12))
            else:
                legs.append(box(thickness, thickness, height, x, y))
    return legs


def _handle(kind: int, width: float, x: float, y: float, z: float) -> Parts:
    """The handle of a panel whose front is at `y`: a knob (`kind` 0), a bar (1) or nothing (2)."""
    if kind == 0:
        return [trimesh.creation.icosphere(1, 0.022).apply_translation((x, y - 0.015, z))]
    if kind == 1:
        return [box(width * 0.35, 0.03, 0.02, x, y - 0.015, z - 0.01)]
    return []


def drawers(
    random: Random, width: float, height: float, rows: int, columns: int, x: float, front: float, z: float
) -> Parts:
    """Drawer fronts with handles, centred at `x`, standing out from the plane y = `front`.

    The fronts fill an area of `width` by `height` above `z`, with gaps between them.
    """
    kind = int(random.integers(3))
    gap, relief = 0.025, 0.03
    heights = np.full(rows, 1.0) if random.random() < 0.6 else np.linspace(0.7, 1.3, rows)[::-1]
    heights = heights / heights.sum() * height
    parts: Parts = []
    bottom = z
    for row in heights:
        for column in range(columns):
            cell = width / columns
            centre = x - width / 2 + cell * (column + 0.5)
            parts.append(box(cell - gap, relief, row - gap, centre, front - relief / 2, bottom + gap / 2))
            parts += _handle(kind, cell, centre, front - relief, bottom + row / 2)
        bottom += row
    return parts


def doors(width: float, height: float, count: int, x: float, front: float, z: float) -> Parts:
    """`count` door fronts with bar handles side by side, centred at `x`, standing out from the plane y = `front`."""
    gap, relief = 0.02, 0.03
    parts: Parts = []
    for door in range(count):
        cell = width / count
        centre = x - width / 2 + cell * (door + 0.5)
        parts.append(box(cell - gap, relief, height - gap, centre, front - relief / 2, z + gap / 2))
        side = 1 if door < count / 2 else -1
        parts.append(
            box(0.02, 0.03, height * 0.2, centre + side * cell * 0.36, front - relief - 0.015, z + height * 0.45)
        )
    return parts


def tabletop(width: float, depth: float, height: float, thickness: float) -> Solid:
    """A board whose upper side is at `height`."""
    return box(width, depth, thickness, 0, 0, height - thickness)
