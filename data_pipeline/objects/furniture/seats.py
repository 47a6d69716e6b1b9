"""Chairs and sofas."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder, four_legs, rod, tilt


def _chair_size(random: Random) -> tuple[float, float, float, float]:
    """Draws the width, the depth, the height of the seat, and the height of the back above the seat."""
    return random.uniform(0.4, 0.52), random.uniform(0.4, 0.52), random.uniform(0.4, 0.5), random.uniform(0.35, 0.65)


def _chair_back(random: Random, width: float, depth: float, seat: float, back: float) -> Parts:
    """A back in one of four styles (panel, vertical slats, ladder, panel on two posts), leaning backwards."""
    y = depth / 2 - 0.025
    style = random.integers(4)
    parts: Parts = []
    if style == 0:
        parts.append(box(width * 0.95, 0.03, back, 0, y, seat))
    elif style == 1:  # vertical slats
        parts.append(box(width, 0.03, 0.07, 0, y, seat + back - 0.07))
        parts += [box(0.025, 0.025, back, x, y, seat) for x in np.linspace(-width / 2 + 0.02, width / 2 - 0.02, 6)]
    elif style == 2:  # ladder
        parts += [box(0.035, 0.035, back, sx * (width / 2 - 0.02), y, seat) for sx in (-1, 1)]
        parts += [box(width, 0.02, 0.06, 0, y, seat + back * t) for t in (0.3, 0.6, 0.88)]
    else:  # panel on two posts
        parts += [box(0.035, 0.035, back, sx * (width / 2 - 0.06), y, seat) for sx in (-1, 1)]
        parts.append(box(width, 0.035, back * 0.45, 0, y, seat + back * 0.55))
    return tilt(parts, random.uniform(0, 0.25), (0, y, seat))


def _chair_arms(width: float, depth: float, seat: float, rise: float) -> Parts:
    """Two armrests, `rise` above the seat."""
    parts: Parts = []
    for side in (-1, 1):
        parts.append(box(0.05, depth * 0.9, 0.035, side * width / 2, 0, seat + rise))
        parts.append(box(0.035, 0.035, rise, side * width / 2, -depth * 0.38, seat))
    return parts


def chair_dining(random: Random) -> Parts:
    """Four legs, upright or splayed, sometimes with armrests."""
    width, depth, seat, back = _chair_size(random)
    splay = random.uniform(0.02, 0.08) if random.random() < 0.4 else 0
    parts = [box(width, depth, random.uniform(0.03, 0.08), 0, 0, seat - 0.04)]
    parts += four_legs(width, depth, seat - 0.03, random.uniform(0.03, 0.05), 0.01, round_legs=True, splay=splay)
    parts += _chair_back(random, width, depth, seat, back)
    return parts + (_chair_arms(width, depth, seat, 0.22) if random.random() < 0.35 else [])


def chair_office(random: Random) -> Parts:
    """A seat on a column and a star of five feet."""
    width, depth, seat, back = _chair_size(random)
    arms = 5
    parts = [box(width, depth, 0.09, 0, 0, seat - 0.05), cylinder(0.03, seat - 0.08, 0, 0, 0.06)]
    for arm in range(arms):
        angle = 2 * np.pi * arm / arms
        tip = (0.3 * np.cos(angle), 0.3 * np.sin(angle))
        parts += [
            rod((0, 0, 0.11), (*tip, 0.07), 0.025),
            trimesh.creation.icosphere(1, 0.035).apply_translation((*tip, 0.035)),
        ]
    backrest = [
        box(width * 0.9, 0.06, back * 0.8, 0, depth / 2, seat + back * 0.2),
        box(0.06, 0.03, back * 0.3, 0, depth / 2, seat),
    ]
    parts += tilt(backrest, random.uniform(0, 0.2), (0, depth / 2, seat))
    return parts + (_chair_arms(width * 1.15, depth, seat, 0.2) if random.random() < 0.6 else [])


def chair_cantilever(random: Random) -> Parts:
    """A frame of bent tube without back legs."""
    width, depth, seat, back = _chair_size(random)
    r = 0.016
    parts = [box(width, depth, 0.05, 0, 0, seat - 0.02)]
    for side in (-1, 1):
        x = side * width / 2
        parts += [rod((x, depth / 2, r), (x, -depth / 2, r), r), rod((x, -depth / 2, r), (x, -depth / 2, seat), r)]
        parts += [
            rod((x, -depth / 2, seat), (x, depth / 2, seat), r),
            rod((x, depth / 2, seat), (x, depth / 2 + 0.06, seat + back), r),
        ]
    parts.append(rod((-width / 2, depth / 2, r), (width / 2, depth / 2, r), r))
    parts.append(box(width, 0.03, back * 0.55, 0, depth / 2 + 0.04, seat + back * 0.42))
    return parts


def chair_tub(random: Random) -> Parts:
    """A low armchair with thick sides."""
    width, depth = random.uniform(0.6, 0.8), random.uniform(0.6, 0.75)
    seat, back, wall = random.uniform(0.36, 0.44), random.uniform(0.35, 0.55), random.uniform(0.09, 0.15)
    parts = [box(width, depth, seat - 0.1, 0, 0, 0.1), *four_legs(width, depth, 0.1, 0.05, 0.04)]
    parts.append(box(width, wall, back + 0.05, 0, depth / 2 - wall / 2, seat - 0.05))
    rise = back * random.uniform(0.4, 1.0)
    parts += [box(wall, depth, rise, side * (width - wall) / 2, 0, seat - 0.02) for side in (-1, 1)]
    return parts


def chair_stool_back(random: Random) -> Parts:
    """A bar stool with a ring of braces and a low back."""
    radius, seat, back = random.uniform(0.17, 0.23), random.uniform(0.5, 0.75), random.uniform(0.2, 0.4)
    parts = [cylinder(radius, 0.05, 0, 0, seat)]
    parts += four_legs(radius * 1.5, radius * 1.5, seat, 0.035, splay=0.07)
    z = seat * 0.35
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        parts.append(
            rod((ax * radius * 0.85, ay * radius * 0.85, z), (bx * radius * 0.85, by * radius * 0.85, z), 0.012)
        )
    y = radius * 0.8
    parts += [rod((sx * radius * 0.5, y, seat), (sx * radius * 0.6, y + 0.05, seat + back), 0.014) for sx in (-1, 1)]
    return [*parts, box(radius * 1.7, 0.03, 0.1, 0, y + 0.05, seat + back - 0.06)]


def _sofa_body(
    random: Random, seats: int, *, arms: bool = True, arm_rise: float | None = None, round_arms: bool = False
) -> tuple[Parts, float, float, float]:
    """Returns the seat, cushions, back and arms, with their width, depth and seat height.

    Args:
        arm_rise: height of the arms above the seat as a share of the back; drawn if None.
    """
    width, depth = seats * random.uniform(0.58, 0.75), random.uniform(0.75, 0.95)
    seat, back = random.uniform(0.36, 0.46), random.uniform(0.32, 0.5)
    thick, arm = random.uniform(0.16, 0.24), random.uniform(0.12, 0.22)
    feet = float(random.choice([0.0, random.uniform(0.05, 0.14)]))
    parts = [box(width, depth, seat - 0.12 - feet, 0, 0, feet)]
    if feet:
        parts += four_legs(width, depth, feet, 0.05, 0.03)
    cushion = width / seats
    for index in range(seats):
        x = -width / 2 + cushion * (index + 0.5)
        parts.append(box(cushion - 0.02, depth - thick, 0.14, x, -thick / 2, seat - 0.12))
        if random.random() < 0.9:
            parts += tilt(
                [box(cushion - 0.03, 0.14, back * 0.85, x, depth / 2 - thick, seat)], 0.15, (x, depth / 2 - thick, seat)
            )
    parts.append(box(width, thick, seat + back - feet, 0, depth / 2 - thick / 2, feet))
    if arms:
        rise = back * random.uniform(0.35, 0.7) if arm_rise is None else arm_rise * back
        for side in (-1, 1):
            x = side * (width + arm) / 2
            parts.append(box(arm, depth, seat + rise - feet, x, 0, feet))
            if round_arms:
                parts.append(rod((x, -depth / 2, seat + rise), (x, depth / 2, seat + rise), arm * 0.6))
    return parts, width, depth, seat


def _sofa(**shape: Any) -> Callable[[Random], Parts]:
    """A sofa for two or three of this shape, see `_sofa_body`."""
    return lambda random: _sofa_body(random, int(random.integers(2, 4)), **shape)[0]


def sofa_corner(random: Random) -> Parts:
    """An L-shaped sofa: a chaise, or a second wing with its own back."""
    parts, width, depth, seat = _sofa_body(random, 3)
    side, reach, wing = random.choice([-1, 1]), random.uniform(0.6, 1.3), random.uniform(0.6, 0.8)
    x, y = side * (width / 2 - wing / 2), -depth / 2 - reach / 2
    parts += [box(wing, reach, seat - 0.13, x, y), box(wing - 0.02, reach, 0.14, x, y, seat - 0.12)]
    if random.random() < 0.6:
        parts.append(box(0.18, reach, seat + 0.35, side * (width / 2 + 0.09), y))
    return parts


CHAIRS = (chair_dining, chair_office, chair_cantilever, chair_tub, chair_stool_back)
SOFAS = (_sofa(), _sofa(round_arms=True), _sofa(arm_rise=1.0), _sofa(arms=False), sofa_corner)
