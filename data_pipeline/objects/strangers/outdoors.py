"""Vehicles and parts of buildings."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder, lathe
from data_pipeline.objects.strangers.shapes import (
    Groups,
    blob,
    circle,
    disc,
    either,
    level,
    loft,
    placed,
    rod,
    slab,
    smooth,
    sweep,
    upright,
)

AXLE = (0, 1, 0)
"""Vehicles head for −x."""


def _wheels(radius: float, xs: tuple[float, ...], track: float, width: float) -> Parts:
    return [disc(radius, width, (x, s * track / 2, radius), AXLE, 20) for x in xs for s in (-1, 1)]


def car(random: Random) -> Parts:
    """A saloon, an estate, a pick-up or a van: one outline, narrower above."""
    long, wide, r = random.uniform(3.6, 4.8), random.uniform(1.6, 1.9), random.uniform(0.28, 0.38)
    low, belt, roof = random.uniform(0.2, 0.3), random.uniform(0.75, 0.95), random.uniform(1.35, 1.6)
    cabin = ((0.25, 0.4, 0.65, 0.85), (0.25, 0.4, 0.95, 1), (0.25, 0.38, 0.5, 0.55), (0.03, 0.2, 0.97, 1))[
        random.integers(4)
    ]
    x = np.array([0, *cabin, 1]) * long - long / 2
    hood = belt * random.uniform(0.8, 0.95)
    body = loft(
        [
            [(a, -wide / 2, low), (a, wide / 2, low), (a, wide / 2, z), (a, -wide / 2, z)]
            for a, z in zip(x, (hood, belt, belt, belt, belt, belt * 0.95), strict=True)
        ]
    )
    glass = [(x[1], belt, 0.48), (x[2], roof, 0.4), (x[3], roof, 0.4), (x[4], belt, 0.48)]
    top = loft([[(a, -wide * w, z) for a, z, w in glass], [(a, wide * w, z) for a, z, w in glass]])
    return [body, top, *_wheels(r, (-long * 0.32, long * 0.3), wide * 0.95, 0.2)]


def bus(random: Random) -> Parts:
    """A coach, a double-decker, or a tram with joints; with windows as frames."""
    long, wide, high = random.uniform(7, 12), 2.5, random.choice([random.uniform(2.6, 3.1), 4.2])
    parts = [box(long, wide, high - 0.4, 0, 0, 0.4), *_wheels(0.48, (-long * 0.33, long * 0.28), wide, 0.3)]
    count, rows = int(random.integers(4, 9)), (1.4,) if high < 4 else (1.2, 2.9)
    for x in np.linspace(-0.42, 0.42, count) * long:
        parts += [box(long / count * 0.7, 0.06, 0.8, x, s * wide / 2, z) for s in (-1, 1) for z in rows]
    return parts + [box(long * 0.3, wide * 0.6, 0.25, 0, 0, float(high))] * either(random)


def bicycle(random: Random) -> Parts:
    r, base = random.uniform(0.28, 0.36), random.uniform(0.95, 1.1)
    parts: Parts = []
    for x in (-base / 2, base / 2):
        tyre = [slab(circle(28) * r, 0.035, circle(28) * (r - 0.035)), disc(0.03, 0.09, (0, 0, 0), AXLE, 10)]
        tyre += [rod((0, 0, 0), (a * r, 0, b * r), 0.003) for a, b in circle(10)]
        parts += placed(tyre, (x, 0, r))
    front, back, pedal = (-base / 2, 0, r), (base / 2, 0, r), (0.05, 0, r * 0.9)
    head, seat = (-base * 0.34, 0, r + random.uniform(0.4, 0.5)), (base * 0.17, 0, r + random.uniform(0.3, 0.5))
    middle = pedal if either(random, 0.3) else seat
    pairs = [(front, head), (head, middle), (head, pedal), (seat, pedal), (seat, back), (pedal, back)]
    parts += [rod(a, b, 0.018) for a, b in pairs] + [disc(0.09, 0.01, pedal, AXLE)]
    bar = np.add(head, (0.03, 0, 0.12))
    parts += [
        rod(head, bar, 0.015),
        rod(np.subtract(bar, (0, 0.28, 0)), np.add(bar, (0, 0.28, 0)), 0.014),
        rod(seat, np.add(seat, (0.03, 0, 0.12)), 0.014),
    ]
    return [*parts, blob((0.13, 0.07, 0.03), np.add(seat, (0.04, 0, 0.14)), sections=12)]


def boat(random: Random) -> Parts:
    """A hull: open, with a sail, or with a cabin and a funnel."""
    long, wide, high, kind = (
        random.uniform(2.5, 5),
        random.uniform(0.35, 0.5),
        random.uniform(0.5, 0.8),
        int(random.integers(3)),
    )
    t = np.linspace(0, 1, 13)
    beam, keel = (
        wide * long * 0.35 * np.maximum(np.sin(np.pi * (0.15 + 0.85 * t)) ** 0.7, 0.01),
        high * (2 * t - 0.9).clip(0) ** 2 * 0.6,
    )
    section = [
        [(x, -b, high), (x, -b * 0.75, k + 0.2), (x, 0, k), (x, b * 0.75, k + 0.2), (x, b, high)]
        for x, b, k in zip((t - 0.5) * long, beam, keel, strict=True)
    ]
    if kind == 0:
        section = [[*row, *[(x, y * 0.88, z + 0.06 * (z < high)) for x, y, z in row[::-1]]] for row in section]
    parts = [loft(section, caps=kind > 0)]
    if kind == 0:
        return parts + [box(0.25, wide * long * 0.55, 0.04, x * long, 0, high * 0.75) for x in (-0.2, 0.1)]
    if kind == 1:
        mast = long * random.uniform(0.9, 1.3)
        parts.append(cylinder(0.04, mast, 0, 0, high))
        sails = [
            ((0.05, 0.2), (long * 0.45, 0.2), (0.05, mast)),
            ((-0.05, 0.2), (-long * 0.45, 0.1), (-0.05, mast * 0.85)),
        ]
        return parts + [s for points in sails for s in placed([slab(np.array(points), 0.02)], (0, 0, high), (0, 0, 0))]
    parts += [
        box(long * 0.35, wide * long * 0.4, 0.5, -long * 0.1, 0, high),
        box(long * 0.2, wide * long * 0.35, 0.4, -long * 0.1, 0, high + 0.5),
    ]
    return [*parts, cylinder(0.15, random.uniform(0.6, 1.2), 0, 0, high + 0.5)]


def aeroplane(random: Random) -> Parts:
    """A monoplane or a biplane, with a propeller or engines under its wings."""
    long, r, span = random.uniform(6, 10), random.uniform(0.45, 0.7), random.uniform(0.8, 1.2)
    body = smooth([(0, 0), (r * 0.7, long * 0.03), (r, long * 0.2), (r, long * 0.55), (r * 0.2, long), (0, long)])
    parts = placed(
        [loft([level(circle(16) * max(a, 0.01), z) for a, z in body])], (-long / 2, 0, 1.2), (0, np.pi / 2, 0)
    )
    sweep_by = random.uniform(-0.02, 0.25) * long

    def wing(x: float, z: float, half: float, chord: float, tip: float) -> Parts:
        outline = np.array([(0, 0), (0.4, 0.06), (1, 0), (0.4, -0.04)])
        ends = ((-half, sweep_by * half / long * 2, tip), (0, 0, chord), (half, sweep_by * half / long * 2, tip))
        rows = [upright(outline * c, y) + np.array([x + back, 0, z]) for y, back, c in ends]
        return [loft(rows)]

    low, jets = random.choice([-0.6, 0.1, 0.8]) * r + 1.2, either(random)
    parts += wing(-long * 0.18, low, long * span / 2, long * 0.2, long * random.uniform(0.06, 0.16))
    parts += wing(long * 0.4, 1.3, long * 0.18, long * 0.1, long * 0.06)
    fin = np.array([(long * 0.36, 0), (long * 0.5, 0), (long * 0.52, long * 0.16), (long * 0.45, long * 0.16)])
    parts += placed([slab(fin, 0.08)], (0, 0, 1.3))
    if jets:
        return parts + [disc(r * 0.35, long * 0.13, (-long * 0.08, s * long * 0.2, low - r * 0.45)) for s in (-1, 1)]
    if either(random):
        parts += wing(-long * 0.18, low + 1.3, long * span / 2, long * 0.2, long * 0.14)
        parts += [
            rod((-long * 0.1, s * long * 0.3, low), (-long * 0.1, s * long * 0.3, low + 1.3), 0.05) for s in (-1, 1)
        ]
    return [
        *parts,
        *placed([box(0.06, 0.2, 2.2, 0, 0, -1.1)], (-long / 2 - 0.05, 0, 1.2), (random.uniform(0, 3), 0, 0)),
    ]


def rocket(random: Random) -> Parts:
    """A body with a nose and fins, with or without boosters."""
    r, long, fins = random.uniform(0.3, 0.6), random.uniform(3, 6), int(random.integers(3, 5))
    profile = smooth([(r * 0.9, 0.3), (r, long * 0.3), (r, long * 0.7), (r * 0.5, long * 0.92), (0, long)])
    parts = [lathe([(0, 0.3), *profile], 1), lathe([(r * 0.75, 0), (r * 0.4, 0.35), (0, 0.35)], 1)]
    out, rise = r * random.uniform(0.9, 1.8), long * random.uniform(0.15, 0.35)
    outline = np.array([(r * 0.8, 0.35), (r + out, 0), (r + out, rise * 0.4), (r * 0.8, 0.35 + rise)])
    for index in range(fins):
        parts += placed([slab(outline, 0.05)], turn=(0, 0, index * 2 * np.pi / fins))
    if either(random, 0.35):
        for side in (-1, 1):
            parts += placed(
                [lathe([(0, 0), (r * 0.5, 0), (r * 0.5, long * 0.5), (0, long * 0.62)], 1)], (side * r * 1.5, 0, 0)
            )
    return parts


def cart(random: Random) -> Parts:
    """A tray on two wheels with a shaft, a wheelbarrow, or a trolley of wire on four wheels."""
    long, wide, r, kind = (
        random.uniform(0.8, 1.3),
        random.uniform(0.5, 0.7),
        random.uniform(0.15, 0.3),
        int(random.integers(3)),
    )
    floor = r * (1.1 if kind < 2 else 0.7)
    inner, outer = (np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (long * f / 2, wide * f / 2) for f in (0.75, 1))
    rim = floor + random.uniform(0.25, 0.4)
    parts = [
        loft(
            [
                level(inner, floor),
                level(outer, rim),
                level(outer * 0.95, rim),
                level(inner * 0.95, floor + 0.03),
                level(inner * 0, floor + 0.03),
            ]
        )
    ]
    if kind == 0:
        shafts = [
            rod((long * 0.3, s * wide * 0.4, floor), (long * 1.1, s * wide * 0.35, floor + 0.1), 0.02) for s in (-1, 1)
        ]
        return [*parts, *_wheels(r * 1.3, (0,), wide * 1.15, 0.05), *shafts]
    if kind == 1:
        bars = [rod((-long * 0.6, s * 0.06, r), (long * 0.95, s * wide * 0.42, floor + 0.3), 0.02) for s in (-1, 1)]
        legs = [
            rod((long * 0.35, s * wide * 0.3, 0), (long * 0.35, s * wide * 0.3, floor + 0.1), 0.018) for s in (-1, 1)
        ]
        return [*parts, disc(r, 0.08, (-long * 0.6, 0, r), AXLE), *bars, *legs]
    bars = [
        rod((long * 0.45, s * wide * 0.45, floor), (long * 0.6, s * wide * 0.45, rim + 0.45), 0.015) for s in (-1, 1)
    ]
    bars.append(rod((long * 0.6, -wide * 0.45, rim + 0.45), (long * 0.6, wide * 0.45, rim + 0.45), 0.018))
    return [*parts, *_wheels(r * 0.4, (-long * 0.3, long * 0.3), wide * 0.7, 0.04), *bars]


# ------------------------------------------------------------------------------------------------------ parts of buildings


def wall_corner(random: Random) -> Parts:
    """Two or three walls that meet, with or without a floor."""
    a, b, high, thick = *random.uniform(1, 3, 2), random.uniform(0.8, 2.6), random.uniform(0.05, 0.25)
    parts = [box(a, thick, high, 0, b / 2), box(thick, b, high, a / 2)]
    parts += [box(a, b, thick)] * either(random)
    return parts + [box(thick, b * random.uniform(0.3, 1), high, -a / 2, 0)] * either(random, 0.25)


def stairs(random: Random) -> Parts:
    """Steps that are solid, that are boards on beams, or that wind around a post."""
    count, wide, rise, going = (
        int(random.integers(3, 12)),
        random.uniform(0.6, 1.4),
        random.uniform(0.14, 0.2),
        random.uniform(0.2, 0.32),
    )
    kind = int(random.integers(3))
    if kind == 0:
        return [box(wide, going, rise * (i + 1), 0, i * going) for i in range(count)]
    if kind == 1:
        ends = (0, 0, 0), (0, count * going, count * rise)
        beams = [sweep(np.add(ends, (s * wide * 0.45, 0, 0)), 0.06, 4) for s in (-1, 1)]
        return beams + [box(wide, going, 0.04, 0, (i + 0.5) * going, (i + 1) * rise - 0.04) for i in range(count)]
    parts = [cylinder(0.06, count * rise + 0.8)]
    for i in range(count):
        parts += placed([box(wide * 0.7, going, 0.05, wide * 0.35)], (0, 0, (i + 1) * rise), (0, 0, i * 0.4))
    return parts


def door(random: Random) -> Parts:
    """A leaf in a frame, closed or open, with panels and a handle."""
    wide, high, turn = random.uniform(0.7, 1.0), random.uniform(1.9, 2.2), random.uniform(0, 1.9) * either(random, 0.6)
    rows, columns = int(random.integers(1, 4)), int(random.integers(1, 3))
    leaf = [box(wide, 0.04, high, wide / 2)]
    for x in (np.arange(columns) + 0.5) * wide / columns:
        leaf += [
            box(wide / columns * 0.65, 0.06, high / rows * 0.75, x, 0, (i + 0.12) * high / rows) for i in range(rows)
        ]
    leaf += [rod((wide * 0.92, y, high * 0.48), (wide * 0.78, y, high * 0.48), 0.012) for y in (-0.06, 0.06)]
    frame = [box(0.08, 0.12, high + 0.08, x) for x in (-0.04, wide + 0.04)] + [
        box(wide + 0.16, 0.12, 0.08, wide / 2, 0, high)
    ]
    return [*placed(leaf, turn=(0, 0, -turn)), *frame]


def window_frame(random: Random) -> Parts:
    """A frame with bars and no panes, rectangular or round above, with or without a sill."""
    wide, high, bar = random.uniform(0.6, 1.4), random.uniform(0.7, 1.5), random.uniform(0.04, 0.08)
    parts = [box(bar, bar, high, s * wide / 2) for s in (-1, 1)] + [
        box(wide + bar, bar, bar, 0, 0, z) for z in (0, high)
    ]
    parts += [
        box(bar * 0.6, bar * 0.6, high, x) for x in np.linspace(-0.5, 0.5, int(random.integers(3, 5)))[1:-1] * wide
    ]
    parts += [box(wide, bar * 0.6, bar * 0.6, 0, 0, z) for z in np.linspace(0, high, int(random.integers(2, 5)))[1:-1]]
    if either(random, 0.35):
        t = np.linspace(0, np.pi, 20)
        curve = np.stack([np.cos(t) * wide / 2, 0 * t, high + np.sin(t) * wide / 2], axis=1)
        parts += [sweep(curve, bar * 0.55, 6), *[rod((0, 0, high), curve[i], bar * 0.3) for i in (5, 10, 14)]]
    return parts + [box(wide * 1.15, 0.2, 0.04, 0, -0.06, -0.04)] * either(random)


def column(random: Random) -> Parts:
    """Smooth or fluted, between a base and a capital."""
    r, high, flutes = random.uniform(0.12, 0.25), random.uniform(1.2, 2.4), either(random)
    grooves = 1 - 0.09 * flutes * np.abs(np.sin(np.arange(64) * 10 * np.pi / 64))[:, None]
    swell = [(1, 0), (1.02, 0.35), (random.uniform(0.75, 0.95), 1)]
    parts = [loft([level(circle(64) * grooves * r * a, 0.15 + z * high) for a, z in swell])]
    top = 0.15 + high
    rings = [(1.3, 0.05), (1.4, 0.1), (1.15, 0.15)]
    parts += [lathe([(0, 0.04), *[(r * a, z) for a, z in rings]], 1), box(r * 3, r * 3, 0.05)]
    if either(random):
        return [
            *parts,
            lathe([(r * 0.9, top), (r * 1.4, top + 0.12), (0, top + 0.12)], 1),
            box(r * 3, r * 3, 0.07, 0, 0, top + 0.12),
        ]
    scrolls = [disc(r * 0.45, r * 2.4, (s * r * 1.2, 0, top + 0.02), AXLE) for s in (-1, 1)]
    return [*parts, *scrolls, box(r * 3.2, r * 2.6, 0.08, 0, 0, top + 0.06)]


def fence(random: Random) -> Parts:
    """Pales on two rails, or rails between posts."""
    long, high, count = random.uniform(1.5, 3), random.uniform(0.7, 1.3), int(random.integers(8, 18))
    if either(random, 0.35):
        posts = [cylinder(0.05, high, x) for x in np.linspace(-long / 2, long / 2, int(random.integers(2, 5)))]
        return posts + [
            rod((-long / 2, 0, z), (long / 2, 0, z), 0.035)
            for z in np.linspace(0.25, 0.9, int(random.integers(2, 4))) * high
        ]
    wide, peak = long / count * random.uniform(0.4, 0.8), random.uniform(0, 0.12)
    outline = np.array([(-wide / 2, 0), (wide / 2, 0), (wide / 2, high), (0, high + peak), (-wide / 2, high)])
    parts = [box(long, 0.04, 0.07, 0, 0.03, z * high) for z in (0.2, 0.75)]
    for x in np.linspace(-long / 2, long / 2, count):
        parts += placed([slab(outline, 0.02)], (x, 0, 0))
    return parts


def fireplace(random: Random) -> Parts:
    """Jambs, a lintel and a shelf around a hearth, with or without a chimney."""
    wide, high, deep, jamb = (
        random.uniform(1.1, 1.6),
        random.uniform(0.95, 1.2),
        random.uniform(0.25, 0.45),
        random.uniform(0.18, 0.3),
    )
    parts = [box(jamb, deep, high, s * (wide - jamb) / 2) for s in (-1, 1)] + [box(wide, deep, jamb, 0, 0, high - jamb)]
    parts += [
        box(wide * 1.12, deep * 1.2, 0.06, 0, -0.03, high),
        box(wide, 0.05, high, 0, deep / 2),
        box(wide * 1.1, deep * 2, 0.05, 0, -deep * 0.4),
    ]
    parts += [rod((-0.2, y, 0.1), (0.22, y + 0.03, 0.12), 0.045) for y in (-0.06, 0.07)] * either(random)
    return parts + [box(wide * random.uniform(0.5, 0.8), deep, random.uniform(0.5, 1.1), 0, 0, high)] * either(
        random, 0.4
    )


GROUPS: Groups = {
    "vehicles": {"train": (car, boat, cart, rocket), "val": (bus,), "test": (bicycle, aeroplane)},
    "buildings": {"train": (stairs, door, column, wall_corner), "val": (fence,), "test": (window_frame, fireplace)},
}
