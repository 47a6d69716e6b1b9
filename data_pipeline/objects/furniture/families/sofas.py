"""Sofas of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.families.parts import (
    around,
    bent,
    crested,
    cushion,
    draws,
    moved,
    prism,
    superellipse,
    tube,
)
from data_pipeline.objects.furniture.seats import SOFAS
from data_pipeline.objects.furniture.solids import Parts, Random, box, four_legs, rod, tilt


def sofa_square(random: Random) -> Parts:
    """Cushions between arms like boxes."""
    return SOFAS[0](random)


def sofa_rolled(random: Random) -> Parts:
    """Arms with rolls on them."""
    return SOFAS[1](random)


def sofa_tuxedo(random: Random) -> Parts:
    """Arms as high as the back."""
    return SOFAS[2](random)


def sofa_armless(random: Random) -> Parts:
    """Without arms."""
    return SOFAS[3](random)


def _size(random: Random) -> tuple[float, float, float, float, int]:
    """Draws the width, depth, height of the seat, height of the back above it, and the number of seats."""
    seats = int(random.integers(2, 4))
    width = seats * random.uniform(0.56, 0.74)
    return width, random.uniform(0.78, 0.95), random.uniform(0.38, 0.46), random.uniform(0.34, 0.5), seats


def _cushions(
    random: Random, width: float, depth: float, seat: float, rise: float, seats: int, lean: float = 0.2
) -> Parts:
    """Seat cushions and back cushions, one a seat, one for all, or loose ones; the back stands at y = depth / 2."""
    each, thick = width / seats, random.uniform(0.12, 0.2)
    count = 1 if random.random() < 0.25 else seats
    xs = (np.arange(count) - (count - 1) / 2) * width / count
    parts = [cushion(width / count - 0.01, depth - 0.12, thick, x, -0.08, seat - thick + 0.04) for x in xs]
    if random.random() < 0.85:
        backs = [
            cushion(each - 0.01, random.uniform(0.12, 0.2), rise, x, 0, 0)
            for x in (np.arange(seats) - (seats - 1) / 2) * each
        ]
        parts += tilt(moved(backs, 0, depth / 2 - 0.22, seat), lean, (0, depth / 2 - 0.2, seat))
    for _ in range(int(random.integers(0, 3))):
        x = random.uniform(-0.4, 0.4) * width
        parts += tilt([cushion(0.42, 0.12, 0.4, x, depth / 2 - 0.36, seat + 0.02)], 0.4, (x, depth / 2 - 0.36, seat))
    return parts


def _feet(random: Random, width: float, depth: float, height: float) -> Parts:
    return four_legs(width, depth, height, random.uniform(0.04, 0.07), random.uniform(0.02, 0.08))


def sofa_cushioned(random: Random) -> Parts:
    """Soft arms, soft seats and soft backs."""
    width, depth, seat, rise, seats = _size(random)
    feet, arm = draws(random, (0.02, 0.14), (0.14, 0.28))
    whole = width + 2 * arm
    parts = [box(whole - 0.02, depth * 0.96, seat - 0.14 - feet, 0, 0, feet), *_feet(random, whole, depth, feet)]
    parts += _cushions(random, width, depth, seat, rise, seats)
    parts += tilt(
        [cushion(whole if random.random() < 0.5 else width, 0.2, seat + rise * 0.9 - feet, 0, depth / 2 - 0.1, feet)],
        0.08,
        (0, depth / 2, seat),
    )
    top = seat + random.uniform(0.1, 0.28)
    return parts + [cushion(arm, depth, top - feet, s * (whole - arm) / 2, 0, feet) for s in (-1, 1)]


def sofa_chesterfield(random: Random) -> Parts:
    """Back and arms of one height, all rolled outwards at their tops."""
    width, depth, seat, rise, seats = _size(random)
    feet, arm, roll = random.uniform(0.06, 0.14), 0.12, random.uniform(0.08, 0.13)
    top = seat + rise * random.uniform(0.55, 0.9)
    parts = [box(width, depth, seat - feet - 0.12, 0, 0, feet), *_feet(random, width, depth, feet)]
    xs = (np.arange(seats) - (seats - 1) / 2) * width / seats
    parts += [cushion(width / seats, depth * 0.85, 0.16, x, -0.05, seat - 0.13) for x in xs]
    parts.append(box(width + arm, arm, top - feet, 0, depth / 2, feet))
    parts.append(rod((-width / 2 - arm, depth / 2 + 0.04, top), (width / 2 + arm, depth / 2 + 0.04, top), roll))
    for s in (-1, 1):
        x = s * (width + arm) / 2
        parts += [
            box(arm, depth, top - feet, x, 0, feet),
            rod((x * 1.03, -depth / 2, top), (x * 1.03, depth / 2, top), roll),
        ]
    return parts


def sofa_framed(random: Random) -> Parts:
    """Cushions in an open frame of wood or steel tube."""
    width, depth, seat, rise, seats = _size(random)
    r, arm = random.uniform(0.014, 0.03), seat + random.uniform(0.15, 0.28)
    parts = _cushions(random, width, depth, seat, rise, seats, 0.15)
    parts += [box(width, 0.04, 0.07, 0, s * depth * 0.46, seat - 0.16) for s in (-1, 1)]
    for s in (-1, 1):
        x = s * (width / 2 + 0.03)
        if random.random() < 0.7:
            parts += [rod((x, y, 0), (x, y, arm), r) for y in (-depth / 2, depth / 2)]
            parts.append(box(0.07, depth * 1.05, 0.03, x, 0, arm))
        parts += [rod((x, -depth / 2, z), (x, depth / 2, z), r) for z in (seat * 0.5, arm)]
        parts.append(box(0.05, depth, 0.05, x, 0, 0))
        parts.append(box(0.04, 0.05, arm, x, -depth * 0.46))
        parts.append(box(0.04, 0.05, arm, x, depth * 0.46))
    z = np.linspace(seat - 0.1, seat + rise * 0.85, 4)
    return parts + [rod((-width / 2, depth / 2, v), (width / 2, depth / 2, v), r) for v in z]


def sofa_curved(random: Random) -> Parts:
    """Seat and back follow an arc around the front."""
    radius, half = draws(random, (0.95, 1.6), (0.55, 1.0))
    depth, seat, rise = draws(random, (0.7, 0.85), (0.38, 0.45), (0.35, 0.48))
    count = int(random.integers(3, 6))
    parts: Parts = []
    for t in (np.arange(count) - (count - 1) / 2) * 2 * half / count:
        width = 2 * (radius + depth * 0.6) * np.tan(half / count)
        wedge = [
            box(width, depth, seat - 0.12, 0, radius),
            cushion(width * 0.97, depth * 0.85, 0.18, 0, radius - 0.06, seat - 0.14),
        ]
        wedge += [
            cushion(width * 1.05, 0.22, rise + 0.1, 0, radius + depth / 2 - 0.1, seat - 0.06),
            box(width, 0.1, seat + rise * 0.7, 0, radius + depth / 2),
        ]
        parts += moved(wedge, turn=t)
    if random.random() < 0.7:
        for s in (-1, 1):
            parts += moved([cushion(0.2, depth, seat + 0.2, 0, radius)], turn=s * (half + 0.1))
    return moved(parts, 0, -radius)


def sofa_chaise(random: Random) -> Parts:
    """A long seat with one high end, and a low back along a part of it."""
    length, depth, seat = draws(random, (1.45, 1.9), (0.62, 0.8), (0.36, 0.44))
    feet, rise = draws(random, (0.08, 0.2), (0.3, 0.5))
    parts = [
        box(length, depth, seat - feet - 0.1, 0, 0, feet),
        *_feet(random, length, depth, feet),
        cushion(length, depth, 0.17, 0, 0, seat - 0.14),
    ]
    line = [(0, 0), (0.05, rise * 0.5), (0.14, rise * 0.85), (0.22, rise)]
    end = moved([bent(line, depth, 0.11)], turn=-np.pi / 2)
    parts += moved(end, length / 2 - 0.06, 0, seat - 0.03)
    share = random.uniform(0.4, 0.8)
    parts += [cushion(length * share, 0.15, rise, length * (1 - share) / 2, depth / 2 - 0.06, seat - 0.05)]
    return [
        *parts,
        rod((length / 2 - 0.18, -depth * 0.4, seat + 0.1), (length / 2 - 0.18, depth * 0.4, seat + 0.1), 0.08),
    ]


def sofa_camelback(random: Random) -> Parts:
    """A back that rises to the middle, scrolled arms, and legs that show."""
    width, depth, seat, rise, _ = _size(random)
    feet = random.uniform(0.12, 0.22)
    parts = [box(width, depth, seat - feet - 0.06, 0, 0, feet), *four_legs(width, depth, feet, 0.05, 0.02)]
    parts.append(cushion(width, depth * 0.9, 0.13, 0, 0, seat - 0.08))
    parts += tilt(
        moved([crested(width + 0.1, rise * 1.2, 0.12, random.uniform(0.2, 0.45))], 0, depth / 2 - 0.06, seat - 0.06),
        0.1,
        (0, depth / 2, seat),
    )
    for s in (-1, 1):
        line = [
            (s * width / 2, y, seat + z)
            for y, z in ((-depth * 0.48, 0.2), (-depth * 0.2, 0.21), (depth * 0.2, 0.26), (depth * 0.48, 0.34))
        ]
        parts += [tube(line, 0.06, 10), box(0.07, depth * 0.95, 0.24, s * width / 2, 0, seat - 0.04)]
    return parts


def sofa_sectional(random: Random) -> Parts:
    """Soft modules in a row with a turned one at one or both ends, as an L or a U."""
    side, count = random.uniform(0.75, 0.95), int(random.integers(2, 4))
    seat, rise, feet = draws(random, (0.36, 0.44), (0.3, 0.46), (0.02, 0.1))

    def module(corner: bool, open_end: bool = False) -> Parts:
        parts = [
            box(side, side, seat - feet - 0.12, 0, 0, feet),
            cushion(side, side, 0.2, 0, 0, seat - 0.16),
            box(side * 0.9, side * 0.9, feet),
        ]
        if not open_end:
            parts.append(cushion(side, 0.2, rise + 0.15, 0, side / 2 - 0.1, seat - 0.1))
        return parts + ([cushion(0.2, side, rise + 0.15, side / 2 - 0.1, 0, seat - 0.1)] if corner else [])

    parts: Parts = []
    for place in range(count):
        parts += moved(module(place == count - 1), place * side)
    for wing in range(int(random.integers(1, 3))):
        parts += moved(
            moved(module(False, open_end=random.random() < 0.5), turn=-np.pi / 2),
            (count - 1) * side,
            -(wing + 1) * side,
        )
    if random.random() < 0.25:
        parts += moved(moved(module(False), turn=np.pi / 2), 0, -side)
    elif random.random() < 0.5:
        parts.append(cushion(0.2, side, seat + 0.2, -side / 2 - 0.1, 0))
    return parts


def sofa_bed(random: Random) -> Parts:
    """A sleeper: thick folded seat, flat back that folds down, thin arms or none."""
    width, depth = draws(random, (1.5, 2.1), (0.8, 1.05))
    seat, rise = draws(random, (0.36, 0.44), (0.4, 0.55))
    low = random.uniform(0.06, 0.2)
    parts = [box(width, depth * 0.9, seat - low - 0.2, 0, 0, low), *four_legs(width, depth * 0.9, low, 0.04, 0.1)]
    halves = int(random.integers(1, 3))
    for half in range(halves):
        x = (half - (halves - 1) / 2) * width / halves
        parts.append(cushion(width / halves, depth, 0.2, x, 0, seat - 0.18))
        parts += tilt(
            [cushion(width / halves, 0.17, rise, x, depth / 2 - 0.1, seat)],
            random.uniform(0.15, 0.45),
            (x, depth / 2 - 0.1, seat),
        )
    if random.random() < 0.5:
        parts += [box(0.08, depth * 0.9, seat + 0.15, s * (width / 2 + 0.04)) for s in (-1, 1)]
    return parts


def sofa_settee(random: Random) -> Parts:
    """A bench of wood with a back of slats or spindles, thin arms, with or without a cushion."""
    width, depth, seat, rise = draws(random, (1.05, 1.6), (0.5, 0.62), (0.4, 0.46), (0.4, 0.55))
    parts = [
        box(width, depth, 0.05, 0, 0, seat - 0.05),
        *four_legs(width, depth, seat, 0.055),
        box(width, 0.04, 0.09, 0, depth / 2 - 0.03, seat + rise - 0.09),
    ]
    upper = [box(0.04, 0.04, rise, s * width * 0.48, depth / 2 - 0.03, seat) for s in (-1, 1)]
    xs = np.linspace(-0.44, 0.44, int(random.integers(7, 14))) * width
    upper += [box(random.uniform(0.02, 0.06), 0.02, rise - 0.05, x, depth / 2 - 0.03, seat) for x in xs]
    if random.random() < 0.7:
        parts += [
            cushion(width, depth * 0.9, 0.1, 0, -0.03, seat),
            cushion(width, 0.12, rise * 0.75, 0, depth / 2 - 0.12, seat + 0.08),
        ]
    for s in (-1, 1):
        parts += [
            box(0.06, depth, 0.035, s * width / 2, 0, seat + 0.2),
            box(0.045, 0.045, 0.2, s * width / 2, -depth * 0.42, seat),
        ]
    return parts + tilt(upper, random.uniform(0, 0.15), (0, depth / 2, seat))


def sofa_tub(random: Random) -> Parts:
    """A loveseat inside of one wall around back and sides."""
    width, depth, seat, rise = draws(random, (1.15, 1.7), (0.75, 0.95), (0.38, 0.44), (0.3, 0.45))
    feet, thick = draws(random, (0.06, 0.15), (0.08, 0.16))
    wall = around(
        width, depth, (seat + rise * random.uniform(0.4, 1)) - feet, seat + rise - feet, thick, random.uniform(0.5, 0.9)
    )
    flat = wall.vertices[:, :2] / (width / 2, depth / 2)
    wall.vertices[:, :2] = np.sign(flat) * np.abs(flat) ** 0.75 * (width / 2, depth / 2)
    outline = superellipse(random.uniform(2.4, 3.2))
    parts = [*moved([wall], 0, 0, feet), *four_legs(width * 0.7, depth * 0.7, feet, 0.05)]
    parts.append(prism(outline, width * 0.96, depth * 0.96, seat - 0.1 - feet, 0, 0, feet))
    return [*parts, prism(outline, width * 0.88, depth * 0.9, 0.14, 0, -0.03, seat - 0.11)]
