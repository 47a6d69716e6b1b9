"""Desks of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.families.parts import (
    CORNER,
    HALF_ROUND,
    SQUARE,
    bent,
    draws,
    ends,
    loft,
    moved,
    prism,
    tube,
)
from data_pipeline.objects.furniture.solids import Parts, Random, box, drawers, four_legs, rod, tabletop, tilt
from data_pipeline.objects.furniture.tables import board, drawer_pedestal


def desk_trestle(random: Random) -> Parts:
    """Two trestles or T legs and a modesty panel."""
    width, depth, height, thick = board(random)
    under = height - thick
    parts = [
        tabletop(width, depth, height, thick),
        box(width * 0.82, 0.02, under * random.uniform(0.3, 0.6), 0, depth * random.uniform(0.05, 0.35), under * 0.4),
    ]
    if random.random() < 0.6:
        return parts + ends(width * 0.85, depth * 0.85, under, random.uniform(0.04, 0.07))
    for s in (-1, 1):
        for x in (s * width * 0.32, s * width * 0.45):
            parts += [
                rod((x, t * depth * 0.42, 0), (s * width * 0.385, t * depth * 0.38, under), 0.02) for t in (-1, 1)
            ]
        parts.append(box(width * 0.13, depth * 0.8, 0.02, s * width * 0.385, 0, under * 0.4))
    return parts


def desk_standing(random: Random) -> Parts:
    """A high top on two lifting columns, with a beam, and a cable tray or a box of drawers."""
    width, depth, height, thick = board(random)
    height = random.uniform(0.75, 1.1)
    parts = [
        tabletop(width, depth, height, thick),
        *ends(width * 0.75, depth * 0.9, height - thick, 0.07),
        box(width * 0.75, 0.05, 0.05, 0, 0, height - thick - 0.08),
    ]
    parts.append(box(width * 0.6, 0.12, 0.08, 0, depth * 0.3, height - thick - 0.12))
    if random.random() < 0.6:
        body = drawer_pedestal(
            random, 0.38, depth * 0.75, random.uniform(0.45, 0.6), random.choice([-1, 1]) * width * 0.25
        )
        parts += body
    return parts + ([box(width, 0.02, 0.35, 0, depth / 2, height - 0.05)] if random.random() < 0.3 else [])


def desk_computer(random: Random) -> Parts:
    """Panels, a tray for the keyboard, a raised shelf for the screen, and a tower with shelves or drawers at a side."""
    width, depth, height = draws(random, (0.9, 1.4), (0.5, 0.65), (0.7, 0.78))
    t, s, tower = 0.025, random.choice([-1, 1]), random.uniform(0.25, 0.4)
    tall = height + float(random.choice([0.0, random.uniform(0.2, 0.6)]))
    x = s * (width - tower) / 2
    parts = [tabletop(width, depth, height, t), box(t, depth, height, -s * width / 2)]
    parts += [box(t, depth * 0.9, tall, x + side * tower / 2, 0.03) for side in (-1, 1)]
    parts += [box(tower, depth * 0.9, t, x, 0.03, z) for z in np.linspace(0.06, tall - t, int(random.integers(3, 6)))]
    parts += [
        box(width - tower, depth * 0.6, 0.02, -s * tower / 2, -depth * 0.18, height - 0.13),
        box(width, 0.015, height * 0.5, 0, depth * 0.45, height * 0.3),
    ]
    if random.random() < 0.6:
        parts += drawers(
            random, tower, height * random.uniform(0.3, 0.9), int(random.integers(1, 4)), 1, x, -depth * 0.4, 0.06
        )
    if random.random() < 0.6:
        lift, place = random.uniform(0.12, 0.4), -s * tower / 2
        parts += [box(width - tower, depth * 0.4, t, place, depth * 0.25, height + lift)]
        parts += [
            box(t, depth * 0.4, lift, place + side * (width - tower) / 2, depth * 0.25, height) for side in (-1, 1)
        ]
    return parts


def desk_secretary(random: Random) -> Parts:
    """A chest with drawers, a sloping or open writing flap, and small compartments above it."""
    width, depth, height, rise = draws(random, (0.75, 1.0), (0.4, 0.5), (0.7, 0.78), (0.25, 0.9))
    feet = float(random.choice([0.0, 0.12]))
    parts = [
        box(width, depth, height - feet, 0, 0, feet),
        *drawers(random, width * 0.95, height - feet - 0.06, int(random.integers(2, 4)), 1, 0, -depth / 2, feet + 0.02),
    ]
    parts += [box(0.02, depth * 0.7, rise, s * (width / 2 - 0.01), depth * 0.15, height) for s in (-1, 1)]
    parts += [
        box(width, 0.02, rise, 0, depth / 2 - 0.01, height),
        box(width, depth * 0.7, 0.025, 0, depth * 0.15, height + rise),
    ]
    if feet:
        parts += four_legs(width, depth, feet, 0.05)
    if random.random() < 0.6:  # open
        parts += [
            box(width * 0.95, 0.4, 0.02, 0, -depth / 2 - 0.16, height),
            *_pigeonholes(width, depth * 0.3, rise, depth * 0.3, height),
        ]
        return parts
    line = [(-depth / 2, height), (-depth * 0.15, height + rise * 0.9)]
    return [*parts, bent(line, width * 0.96, 0.025)]


def _pigeonholes(width: float, depth: float, rise: float, y: float, z: float) -> Parts:
    """Small open compartments on a desk."""
    parts = [box(0.012, depth, rise, x, y, z) for x in np.linspace(-0.45, 0.45, 5) * width]
    return [*parts, box(width * 0.95, depth, 0.012, 0, y, z + rise * 0.5)]


def desk_roll_top(random: Random) -> Parts:
    """Two pedestals below a curved shutter, closed or half open."""
    width, depth, height = draws(random, (1.1, 1.5), (0.65, 0.8), (0.72, 0.78))
    rise, body = draws(random, (0.3, 0.5), (0.3, 0.4))
    parts = [tabletop(width, depth, height, 0.03)]
    for s in (-1, 1):
        parts += drawer_pedestal(random, body, depth * 0.95, height - 0.03, s * (width - body) / 2)
        parts.append(
            loft(
                SQUARE,
                [
                    (0.015, depth * 0.48, s * (width / 2 - 0.02), 0, height),
                    (0.015, depth * 0.2, s * (width / 2 - 0.02), depth * 0.28, height + rise),
                ],
            )
        )
    closed = random.random() < 0.5
    angles = np.linspace(0 if closed else 0.8, np.pi / 2, 7)
    line = [(depth * 0.1 - depth * 0.58 * np.cos(a), height + rise * np.sin(a)) for a in angles]
    parts += [bent([*line, (depth / 2, height + rise)], width, 0.02), box(width, 0.02, rise, 0, depth / 2, height)]
    return parts + _pigeonholes(width, depth * 0.3, rise * 0.8, depth * 0.3, height)


def desk_executive(random: Random) -> Parts:
    """A heavy top on two pedestals with a closed panel that is seen by visitors; straight or bowed."""
    width, depth, height, thick = draws(random, (1.5, 2.0), (0.75, 1.0), (0.72, 0.78), (0.04, 0.07))
    body, state = random.uniform(0.38, 0.5), int(random.integers(2**31))
    parts = [tabletop(width, depth, height, thick), box(width * 0.95, 0.04, height - thick, 0, depth * 0.42)]
    if random.random() < 0.4:
        parts[0] = prism(HALF_ROUND[::-1] * (1, -1), width, depth * 1.3, thick, 0, 0, height - thick)
    for s in (-1, 1):
        parts += drawer_pedestal(
            np.random.default_rng(state), body, depth * 0.85, height - thick, s * (width * 0.94 - body) / 2
        )
    return parts


def desk_corner_wedge(random: Random) -> Parts:
    """A desk for a corner of the room: its front runs obliquely or in a curve."""
    side, height, thick = random.uniform(0.9, 1.4), random.uniform(0.7, 0.78), 0.03
    parts = [prism(CORNER, side, side, thick, 0, 0, height - thick)]
    parts += [
        box(side * 0.95, 0.02, height * 0.6, 0, side * 0.47, height * 0.35),
        box(0.02, side * 0.95, height - thick, side * 0.47),
    ]
    parts += [
        box(0.025, side * 0.45, height - thick, -side * 0.47, side * 0.25),
        box(side * 0.45, 0.025, height - thick, side * 0.25, -side * 0.47),
    ]
    if random.random() < 0.7:
        parts += [
            prism(CORNER, side * 0.7, side * 0.7, 0.02, side * 0.15, side * 0.15, height + 0.25),
            box(side * 0.7, 0.02, 0.26, side * 0.15, side * 0.49, height),
        ]
    if random.random() < 0.6:
        parts += moved(drawer_pedestal(random, 0.35, 0.4, height - thick, 0), -side * 0.28, side * 0.28)
    return parts


def desk_l_return(random: Random) -> Parts:
    """A desk with a lower return on a pedestal, on legs of metal, with a panel."""
    width, depth, height, thick = board(random)
    wing, reach, s = random.uniform(0.4, 0.55), random.uniform(0.5, 0.9), random.choice([-1, 1])
    low = height - float(random.choice([0.0, 0.06]))
    x, y = s * (width - wing) / 2, -depth / 2 - reach / 2
    parts = [
        tabletop(width, depth, height, thick),
        box(wing, reach, thick, x, y, low - thick),
        *ends(width * 0.9, depth * 0.9, height - thick, 0.05),
    ]
    parts += moved(drawer_pedestal(random, wing * 0.9, 0.42, low - thick, 0), x, -depth / 2 - reach + 0.22)
    return [*parts, box(width * 0.9, 0.02, height * 0.4, 0, depth * 0.35, height * 0.5)]


def desk_school(random: Random) -> Parts:
    """A small desk with an open box below its top, on legs of tube, or with a sloping top."""
    width, depth, height, drop = draws(random, (0.6, 1.1), (0.45, 0.6), (0.62, 0.78), (0.1, 0.16))
    parts: Parts = [
        box(width * 0.95, depth * 0.9, 0.015, 0, 0, height - drop),
        box(width * 0.95, 0.015, drop, 0, depth * 0.44, height - drop),
    ]
    parts += [box(0.015, depth * 0.9, drop, s * width * 0.47, 0, height - drop) for s in (-1, 1)]
    parts += tilt(
        [box(width, depth, 0.022, 0, 0, height)],
        float(random.choice([0.0, random.uniform(-0.25, 0)])),
        (0, depth / 2, height),
    )
    r = random.uniform(0.012, 0.02)
    for s in (-1, 1):
        line = [
            (s * width * 0.45, -depth * 0.42, height - drop),
            (s * width * 0.45, -depth * 0.44, r),
            (s * width * 0.45, depth * 0.44, r),
            (s * width * 0.45, depth * 0.42, height - drop),
        ]
        parts.append(tube(line, r))
    return parts
