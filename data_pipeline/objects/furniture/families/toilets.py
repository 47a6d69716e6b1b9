"""Toilets of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.families.parts import (
    CORNER,
    draws,
    loft,
    moved,
    prism,
    sheet,
    superellipse,
    tube,
    turned,
)
from data_pipeline.objects.furniture.solids import Parts, Random, Solid, box, joined, rod, tilt


def _pan(
    random: Random, height: float, foot: float, width: float, low: float = 0, lean: float = 0.06
) -> tuple[Solid, float, float]:
    """Returns an egg-shaped bowl with a hollow, its length in front of and behind its middle.

    Args:
        foot: size of its foot as a share of that of its rim.
        low: height of its lower end.
        lean: how far its foot stands behind the middle of the rim.
    """
    r, power = width / 2, random.uniform(2, 3.2)
    shape = superellipse(power, 32)
    outline = shape * np.where(shape[:, 1:] < 0, (1, random.uniform(1.25, 1.6)), (1, random.uniform(0.9, 1.1)))
    waist = foot * random.uniform(0.75, 1)
    rim = height - low
    levels = [
        (r * foot, r * foot, 0, lean, low),
        (r * foot, r * foot, 0, lean, low + 0.03),
        (r * waist, r * waist, 0, lean, low + rim * 0.35),
    ]
    levels += [
        (r * 0.88, r * 0.88, 0, lean * 0.3, low + rim * 0.75),
        (r, r, 0, 0, height),
        (r * 0.75, r * 0.75, 0, 0, height),
        (r * 0.4, r * 0.4, 0, lean * 0.5, low + rim * 0.5),
    ]
    return loft(outline, levels), -float(outline[:, 1].min()) * r, float(outline[:, 1].max()) * r


def _seat(random: Random, width: float, front: float, rear: float, height: float) -> Parts:
    """A seat ring, with its lid closed, upright, or absent."""
    shape = superellipse(random.uniform(2, 2.8), 28)
    outline = shape * (width / 2, (front + rear) / 2) + (0, (rear - front) / 2)
    ring = np.stack([np.concatenate([o, o[:1]]) for o in (outline * 1.03, outline * 0.68)])
    parts = [sheet(np.concatenate([ring, np.full((2, 29, 1), height + 0.015)], axis=-1), 0.02)]
    kind = random.integers(3)
    if kind == 0:
        return [
            loft(
                outline,
                [
                    (1.03, 1.03, 0, 0, height + 0.02),
                    (1.04, 1.04, 0, 0, height + 0.04),
                    (0.9, 0.9, 0, 0, height + 0.055),
                ],
            )
        ]
    if kind == 1:
        lid = loft(outline, [(1, 1, 0, 0, 0), (1, 1, 0, 0, 0.018)])
        lid.apply_translation((0, front, 0))
        return parts + tilt(
            moved([lid], 0, rear - 0.03 - front - rear, height + 0.02),
            -np.pi / 2 + random.uniform(0.05, 0.25),
            (0, rear - 0.03, height + 0.02),
        )
    return parts


def _cistern(random: Random, width: float, base: float, y: float) -> Parts:
    """A tank with its back at `y`: rounded, tapering, or oval, with a lid, and a lever or a button."""
    depth, height = draws(random, (0.15, 0.21), (0.3, 0.42))
    wide, power, taper = width * random.uniform(0.95, 1.35), random.choice([3.0, 6.0, 40.0]), random.uniform(0.8, 1)
    outline, middle = superellipse(float(power)), y - depth / 2
    parts = [
        loft(
            outline,
            [(wide / 2 * taper, depth / 2 * taper, 0, middle, base), (wide / 2, depth / 2, 0, middle, base + height)],
        )
    ]
    parts.append(prism(outline, wide + 0.03, depth + 0.03, random.uniform(0.02, 0.04), 0, middle, base + height))
    if random.random() < 0.5:
        return [*parts, box(0.07, 0.03, 0.015, -wide * 0.33, middle - depth / 2, base + height * 0.85)]
    return [*parts, turned([(0.025, base + height), (0.025, base + height + 0.045)], 0, middle)]


def _height(random: Random) -> tuple[float, float]:
    """Draws the height of the rim and the width of the bowl."""
    return random.uniform(0.37, 0.43), random.uniform(0.34, 0.4)


def toilet_close_coupled(random: Random) -> Parts:
    """An egg-shaped bowl on a waisted foot, with a tank on the ledge behind it."""
    height, width = _height(random)
    bowl, front, rear = _pan(random, height, random.uniform(0.5, 0.75), width)
    parts = [bowl, *_seat(random, width, front, rear, height)]
    depth = random.uniform(0.16, 0.24)
    ledge = loft(
        superellipse(5),
        [
            (width * 0.3, depth / 2, 0, rear, 0.0),
            (width * 0.28, depth / 2, 0, rear, height * 0.6),
            (width * 0.45, depth * 0.6, 0, rear, height),
        ],
    )
    return [*parts, ledge, *_cistern(random, width, height, rear + depth * 0.6)]


def toilet_skirted(random: Random) -> Parts:
    """A body with closed straight sides, and a tank that grows out of it."""
    height, width = _height(random)
    bowl, front, rear = _pan(random, height, random.uniform(0.8, 0.95), width, lean=0.02)
    depth, rise = draws(random, (0.18, 0.26), (0.22, 0.42))
    levels = [
        (width * 0.42, depth * 0.7, 0, rear, 0.0),
        (width * 0.46, depth * 0.7, 0, rear, height),
        (width * 0.5, depth * 0.5, 0, rear + 0.06, height + 0.05),
    ]
    tank = loft(
        superellipse(random.uniform(4, 12)),
        [*levels, (width * random.uniform(0.45, 0.55), depth * 0.45, 0, rear + 0.07, height + rise)],
    )
    return [bowl, *_seat(random, width, front, rear, height), tank]


def toilet_tankless(random: Random) -> Parts:
    """A bowl on a foot without a tank, with a pipe and a valve or with a flat back."""
    height, width = _height(random)
    bowl, front, rear = _pan(random, height, random.uniform(0.55, 0.9), width)
    parts = [bowl, *_seat(random, width, front, rear, height), box(width * 0.6, 0.14, height * 0.95, 0, rear)]
    if random.random() < 0.6:
        parts += [
            tube(
                [
                    (0, rear + 0.02, height - 0.06),
                    (0, rear + 0.1, height),
                    (0, rear + 0.1, height + random.uniform(0.2, 0.5)),
                ],
                0.02,
            ),
            rod((0, rear + 0.1, height + 0.2), (0.1, rear + 0.1, height + 0.2), 0.015),
        ]
    return parts


def toilet_floating(random: Random) -> Parts:
    """A bowl that hangs on a wall: alone, or on a slab with a plate of buttons."""
    height, width, low = *_height(random), random.uniform(0.06, 0.16)
    bowl, front, rear = _pan(random, height, random.uniform(0.5, 0.8), width, low, lean=0.05)
    parts = [bowl, *_seat(random, width, front, rear, height), box(width * 0.7, 0.12, height - low, 0, rear, low)]
    if random.random() < 0.5:
        return moved(parts, 0, 0, -low)
    high = random.uniform(0.85, 1.2)
    return [
        *parts,
        box(random.uniform(0.5, 0.9), 0.05, high, 0, rear + 0.08),
        box(0.22, 0.02, 0.14, 0, rear + 0.05, high - 0.2),
    ]


def toilet_corner_tank(random: Random) -> Parts:
    """A bowl with a triangular tank for a corner of the room."""
    height, width = _height(random)
    bowl, front, rear = _pan(random, height, random.uniform(0.55, 0.8), width)
    side, rise = draws(random, (0.32, 0.42), (0.28, 0.38))
    tank = [
        prism(CORNER, side, side, rise, 0, 0, height),
        prism(CORNER, side * 1.06, side * 1.06, 0.03, 0, 0, height + rise),
    ]
    parts = [bowl, *_seat(random, width, front, rear, height), box(width * 0.55, 0.2, height, 0, rear)]
    return parts + moved(tank, 0, rear + side * 0.45, 0, np.pi / 4)


def toilet_boxed(random: Random) -> Parts:
    """A bowl in front of a wide box that hides the tank, half high or as a bench."""
    height, width = _height(random)
    bowl, front, rear = _pan(random, height, random.uniform(0.6, 0.9), width)
    wide, high, depth = draws(random, (0.5, 0.9), (0.75, 1.0), (0.14, 0.22))
    parts = [bowl, *_seat(random, width, front, rear, height), box(width * 0.7, 0.15, height, 0, rear - 0.02)]
    return [
        *parts,
        box(wide, depth, high, 0, rear + depth / 2),
        box(wide + 0.04, depth + 0.03, 0.03, 0, rear + depth / 2, high),
        box(0.2, 0.02, 0.03, 0, rear, high - 0.12),
    ]


def toilet_low_tank(random: Random) -> Parts:
    """A tank on the wall some way above the bowl, joined by a bent pipe."""
    height, width = _height(random)
    bowl, front, rear = _pan(random, height, random.uniform(0.5, 0.75), width)
    base, back = height + random.uniform(0.12, 0.45), rear + 0.24
    pipe = tube([(0, rear - 0.02, height * 0.8), (0, back - 0.1, height * 0.85), (0, back - 0.1, base + 0.05)], 0.025)
    return [
        bowl,
        *_seat(random, width, front, rear, height),
        pipe,
        box(width * 0.5, 0.16, height * 0.8, 0, rear),
        *_cistern(random, width, base, back),
    ]


def toilet_commode(random: Random) -> Parts:
    """A bowl with armrests or a raised rail around it, for people who need support."""
    parts = toilet_close_coupled(random)
    low, high = joined(parts).bounds
    rise, x = draws(random, (0.62, 0.72), (0.27, 0.32))
    for s in (-1, 1):
        line = [
            (s * x, high[1], 0),
            (s * x, high[1], rise),
            (s * x, low[1] * 0.7, rise),
            (s * x, low[1] * 0.9, rise - 0.06),
            (s * x, low[1] * 0.9, 0),
        ]
        parts.append(tube(line, 0.015))
    return parts
