"""Dressers and night stands of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.cabinets import open_shelf
from data_pipeline.objects.furniture.families.parts import (
    CIRCLE,
    HALF_ROUND,
    SQUARE,
    Outline,
    crested,
    cushion,
    draws,
    loft,
    moved,
    pedestal,
    prism,
    sheet,
    superellipse,
    tube,
)
from data_pipeline.objects.furniture.solids import Parts, Random, box, doors, drawers, four_legs, tabletop


def _body(random: Random, width: float, depth: float, height: float, feet: float, outline: Outline = SQUARE) -> Parts:
    """A body of this outline with a top, on a plinth or feet; `feet` is their height, or 0."""
    parts = [prism(outline, width, depth, height - feet - 0.03, 0, 0, feet)]
    over = random.uniform(0, 0.04)
    parts.append(prism(outline, width + over, depth + over, random.uniform(0.02, 0.045), 0, 0, height - 0.03))
    if feet > 0.02:
        spread = 1 if outline is SQUARE else 0.7
        parts += (
            four_legs(width * spread, depth * spread, feet, random.uniform(0.035, 0.06), 0.02)
            if random.random() < 0.6
            else [prism(outline, width * 0.94, depth * 0.9, feet)]
        )
    return parts


def _feet(random: Random, high: float = 0.2) -> float:
    return float(random.choice([0.0, random.uniform(0.04, 0.1), random.uniform(0.05, high)]))


def dresser_lowboy(random: Random) -> Parts:
    """A low sideboard on high legs, with drawers, doors and an open compartment."""
    width, depth, height, feet = draws(random, (1.2, 1.9), (0.4, 0.5), (0.6, 0.8), (0.14, 0.3))
    parts = [
        box(width, depth, height - feet, 0, 0, feet),
        *four_legs(width * 0.9, depth * 0.9, feet, 0.045, splay=random.uniform(0, 0.07)),
    ]
    cells = int(random.integers(2, 5))
    for cell in range(cells):
        x, w, kind = (cell + 0.5) * width / cells - width / 2, width / cells * 0.98, random.integers(3)
        if kind == 0:
            parts += doors(w, height - feet - 0.04, 1, x, -depth / 2, feet + 0.02)
        else:
            parts += drawers(random, w, height - feet - 0.04, int(random.integers(2, 4)), 1, x, -depth / 2, feet + 0.02)
    return parts


def dresser_bombe(random: Random) -> Parts:
    """Its front bows outwards, its sides may bulge; on short legs."""
    width, depth, height, feet = draws(random, (0.8, 1.4), (0.4, 0.5), (0.78, 0.95), (0.08, 0.22))
    bow = random.uniform(0.3, 0.8)
    front = np.stack([x := np.linspace(1, -1, 11), np.full(11, 0.0)], axis=1)
    outline = np.concatenate([[[1.0, 1.0]], [[-1.0, 1.0]], np.c_[-x, -1 + bow * (x**2)]])
    bulge, inside = random.uniform(0, 0.1), height - feet - 0.04
    levels = [
        (width / 2 * k, depth / 2 * k, 0, 0, feet + z * inside)
        for z, k in ((0, 0.9), (0.25, 0.95), (0.6, 1 + bulge), (0.85, 1), (1, 0.96))
    ]
    parts = [
        loft(outline, levels),
        prism(outline, width * 1.04, depth * 1.04, 0.03, 0, 0, height - 0.03),
        *four_legs(width * 0.85, depth * 0.75, feet, 0.05),
    ]
    rows = int(random.integers(2, 5))
    for row in range(rows):
        low, high = feet + inside * (row + 0.07) / rows, feet + inside * (row + 0.93) / rows
        y = -depth / 2 * (1 - bow * front[:, 0] ** 2) - 0.012
        grid = np.stack([np.stack([x * width * 0.46, y, np.full(11, z)], axis=1) for z in (low, high)])
        parts.append(sheet(grid, 0.025))
        parts += [box(0.1, 0.03, 0.02, s * width * 0.2, -depth / 2 * 1.02 - 0.02, (low + high) / 2) for s in (-1, 1)]
    return parts


def dresser_stepped(random: Random) -> Parts:
    """A lower part that is deeper than the upper one, both with drawers or doors."""
    width, depth, height = draws(random, (0.8, 1.3), (0.42, 0.55), (0.6, 0.85))
    feet, rise = _feet(random), random.uniform(0.4, 1.0)
    upper, narrow = depth * random.uniform(0.55, 0.9), width * random.uniform(0.85, 1)
    y = (depth - upper) / 2
    parts = [
        *_body(random, width, depth, height, feet),
        box(narrow, upper, rise, 0, y, height),
        box(narrow + 0.05, upper + 0.05, 0.04, 0, y, height + rise),
    ]
    parts += drawers(
        random,
        width * 0.95,
        height - feet - 0.06,
        int(random.integers(2, 4)),
        int(random.integers(1, 3)),
        0,
        -depth / 2,
        feet + 0.01,
    )
    if random.random() < 0.5:
        return parts + doors(narrow * 0.95, rise - 0.04, 2, 0, y - upper / 2, height + 0.02)
    return parts + drawers(
        random,
        narrow * 0.95,
        rise - 0.04,
        int(random.integers(2, 4)),
        int(random.integers(1, 3)),
        0,
        y - upper / 2,
        height + 0.02,
    )


def dresser_vanity(random: Random) -> Parts:
    """Drawers at both sides of a lower middle, with an oval, arched or three-part mirror."""
    width, depth, height = draws(random, (1.0, 1.5), (0.4, 0.5), (0.72, 0.82))
    body, feet, rise = random.uniform(0.3, 0.42), _feet(random, 0.14), random.uniform(0.55, 0.9)
    parts = [
        tabletop(width, depth, height, 0.03),
        box(width, depth * 0.9, random.uniform(0.25, 0.5), 0, 0, feet + 0.12),
    ]
    for s in (-1, 1):
        parts += moved(
            [box(body, depth, height - feet, 0, 0, feet), *four_legs(body, depth, feet, 0.04)]
            if feet
            else [box(body, depth, height)],
            s * (width - body) / 2,
        )
        parts += drawers(
            random,
            body,
            height - feet - 0.05,
            int(random.integers(2, 5)),
            1,
            s * (width - body) / 2,
            -depth / 2,
            feet + 0.02,
        )
    y, kind = depth / 2 - 0.06, random.integers(3)
    if kind == 0:
        mirror = loft(CIRCLE, [(width * 0.28, rise / 2, 0, 0, -0.015), (width * 0.28, rise / 2, 0, 0, 0.015)])
        mirror.apply_transform(np.array([[1, 0, 0, 0], [0, 0, -1, y], [0, 1, 0, height + rise / 2], [0, 0, 0, 1]]))
        return [*parts, mirror, box(width * 0.3, 0.06, 0.08, 0, y, height)]
    if kind == 1:
        return parts + moved([crested(width * random.uniform(0.5, 0.95), rise, 0.03)], 0, y, height)
    wings = [moved([box(width * 0.26, 0.025, rise * 0.85)], turn=s * -0.5) for s in (-1, 1)]
    return [
        *parts,
        box(width * 0.4, 0.025, rise, 0, y, height),
        *[p for s, w in zip((-1, 1), wings, strict=True) for p in moved(w, s * width * 0.31, y - 0.06, height)],
    ]


def dresser_changing(random: Random) -> Parts:
    """A chest with a rail around its top and a pad on it; drawers, or open shelves below."""
    width, depth, height = draws(random, (0.75, 1.1), (0.48, 0.6), (0.8, 0.95))
    feet = _feet(random)
    parts = [*_body(random, width, depth, height, feet), cushion(width * 0.9, depth * 0.85, 0.07, 0, 0, height)]
    parts += [box(0.02, depth, 0.12, s * width / 2, 0, height) for s in (-1, 1)] + [
        box(width, 0.02, 0.14, 0, depth / 2, height)
    ]
    rows, inside = int(random.integers(2, 5)), height - feet - 0.05
    if random.random() < 0.5:
        parts += doors(width * 0.45, inside, 1, -width * 0.24, -depth / 2, feet + 0.01)
        return parts + drawers(random, width * 0.48, inside, rows, 1, width * 0.24, -depth / 2, feet + 0.01)
    return parts + drawers(random, width * 0.95, inside, rows, 1, 0, -depth / 2, feet + 0.01)


def dresser_armoire(random: Random) -> Parts:
    """High doors above one or two rows of drawers, with a cornice or a crest."""
    width, depth, height = draws(random, (0.8, 1.3), (0.48, 0.6), (1.3, 1.9))
    feet = _feet(random)
    low = feet + random.uniform(0.25, 0.6)
    parts = [
        *_body(random, width, depth, height, feet),
        *doors(width * 0.95, height - low - 0.06, 2, 0, -depth / 2, low),
    ]
    parts += drawers(
        random,
        width * 0.95,
        low - feet - 0.02,
        int(random.integers(1, 3)),
        int(random.integers(1, 3)),
        0,
        -depth / 2,
        feet + 0.01,
    )
    if random.random() < 0.4:
        return parts + moved([crested(width, 0.18, 0.04, 0.7)], 0, -depth / 2 + 0.03, height)
    return [*parts, box(width * 1.08, depth * 1.06, 0.06, 0, 0, height)]


def dresser_open(random: Random) -> Parts:
    """A frame of posts around drawers that stand apart or hang like baskets."""
    width, depth, height = draws(random, (0.5, 1.1), (0.4, 0.5), (0.75, 1.2))
    rows = int(random.integers(3, 6))
    parts = [tabletop(width, depth, height, 0.03), *four_legs(width, depth, height, 0.035)]
    each = (height - 0.1) / rows
    for row in range(rows):
        z = 0.08 + row * each
        parts += [
            box(width * 0.9, depth * 0.92, each * random.uniform(0.6, 0.85), 0, -random.uniform(0, 0.06), z),
            box(width * 0.3, 0.03, 0.02, 0, -depth / 2 - 0.04, z + each * 0.4),
        ]
    return parts


def dresser_tall_plinth(random: Random) -> Parts:
    """A plain tall chest or filing cabinet on a recessed plinth, grips instead of handles."""
    width, depth, height = draws(random, (0.4, 0.75), (0.42, 0.62), (0.8, 1.4))
    plinth, rows = random.uniform(0.05, 0.12), int(random.integers(3, 7))
    parts = [box(width * 0.95, depth * 0.85, plinth, 0, 0.03), box(width, depth, height - plinth, 0, 0, plinth)]
    each = (height - plinth) / rows
    grip = random.random() < 0.6
    for row in range(rows):
        z = plinth + row * each
        parts.append(box(width * 0.99, random.uniform(0.012, 0.03), each - 0.012, 0, -depth / 2 - 0.01, z))
        if grip:
            curve = [
                (-width * 0.2, -depth / 2 - 0.02, z + each * 0.75),
                (0, -depth / 2 - 0.05, z + each * 0.7),
                (width * 0.2, -depth / 2 - 0.02, z + each * 0.75),
            ]
            parts.append(tube(curve, 0.008))
    return parts


def stand_cube(random: Random) -> Parts:
    """A cube on a plinth or on thin legs, drawers with grips or none."""
    width, depth, height = draws(random, (0.4, 0.55), (0.38, 0.5), (0.38, 0.55))
    feet = _feet(random)
    parts, rows = _body(random, width, depth, height, feet), int(random.integers(1, 3))
    return parts + drawers(random, width * 0.97, height - feet - 0.04, rows, 1, 0, -depth / 2, feet + 0.01)


def stand_round(random: Random) -> Parts:
    """A drum or half-round body with a drawer or a curved front, on a plinth or legs."""
    width, height, feet = random.uniform(0.38, 0.52), random.uniform(0.48, 0.65), _feet(random)
    outline = CIRCLE if random.random() < 0.6 else HALF_ROUND
    parts = _body(random, width, width, height, feet, outline)
    t = np.linspace(-0.7, 0.7, 9)
    for low, high in ((0.08, 0.5), (0.55, 0.94)):
        arc = np.stack([width * 0.505 * np.sin(t), -width * 0.505 * np.cos(t)], axis=1)
        grid = np.stack([np.c_[arc, np.full(9, feet + (height - feet) * z)] for z in (low, high)])
        parts += [
            sheet(grid, 0.02),
            box(0.05, 0.03, 0.015, 0, -width * 0.52, feet + (height - feet) * (low + high) / 2),
        ]
    return parts


def stand_pedestal(random: Random) -> Parts:
    """A box with a drawer, or a round top, on one column."""
    width, height, drop = draws(random, (0.38, 0.5), (0.52, 0.68), (0.12, 0.2))
    outline = (SQUARE, CIRCLE, superellipse(5))[random.integers(3)]
    parts = [prism(outline, width, width, drop, 0, 0, height - drop), *pedestal(random, width * 0.42, height - drop)]
    y = -width / 2
    return [
        *parts,
        box(width * 0.6, 0.03, drop * 0.7, 0, y, height - drop * 0.85),
        box(0.08, 0.03, 0.02, 0, y - 0.02, height - drop / 2),
    ]


def stand_tiers(random: Random) -> Parts:
    """Open shelves between posts or between panels, sometimes with a drawer below the top."""
    width, depth, height = draws(random, (0.36, 0.52), (0.32, 0.45), (0.5, 0.68))
    levels = np.linspace(random.uniform(0.06, 0.15), height, int(random.integers(2, 5)))
    parts = [box(width, depth, 0.025, 0, 0, z - 0.025) for z in levels]
    if random.random() < 0.6:
        parts += four_legs(width, depth, height, random.uniform(0.025, 0.05))
    else:
        parts += [box(0.025, depth, height, s * width / 2) for s in (-1, 1)]
    if random.random() < 0.6:
        parts += [
            box(width * 0.9, depth * 0.9, 0.13, 0, 0, height - 0.155),
            *drawers(random, width * 0.9, 0.13, 1, 1, 0, -depth * 0.45, height - 0.155),
        ]
    return parts


def stand_c_shape(random: Random) -> Parts:
    """A top and a foot on one side wall, like a C or a Z."""
    width, depth, height, thick = draws(random, (0.38, 0.52), (0.32, 0.45), (0.48, 0.65), (0.025, 0.06))
    parts = [box(width, depth, thick), tabletop(width, depth, height, thick), box(thick, depth, height, -width / 2)]
    if random.random() < 0.6:
        z = height * random.uniform(0.35, 0.6)
        parts += [box(width, depth, 0.14, 0, 0, z), *drawers(random, width * 0.96, 0.14, 1, 1, 0, -depth / 2, z)]
    return parts


def stand_rail(random: Random) -> Parts:
    """A drawer on legs, with a rail or a crest around back and sides of the top."""
    width, depth, height, drop = draws(random, (0.4, 0.55), (0.34, 0.45), (0.55, 0.7), (0.14, 0.3))
    parts = [
        tabletop(width, depth, height, 0.02),
        box(width * 0.94, depth * 0.92, drop, 0, 0, height - drop),
        *four_legs(width, depth, height, random.uniform(0.03, 0.05)),
    ]
    parts += drawers(random, width * 0.85, drop * 0.95, int(random.integers(1, 3)), 1, 0, -depth * 0.46, height - drop)
    rise = random.uniform(0.05, 0.14)
    parts += [box(0.018, depth * 0.8, rise * 0.6, s * width * 0.49, depth * 0.1, height) for s in (-1, 1)]
    return [*parts, *moved([crested(width, rise, 0.018, 0.4)], 0, depth / 2 - 0.01, height)]


def stand_hanging(random: Random) -> Parts:
    """A flat box with a drawer or an open niche on hairpin legs or a frame of tube."""
    width, depth, height, drop = draws(random, (0.42, 0.58), (0.34, 0.45), (0.45, 0.62), (0.14, 0.28))
    low, r = height - drop, random.uniform(0.006, 0.011)
    if random.random() < 0.5:
        parts = [box(width, depth, drop, 0, 0, low), *drawers(random, width * 0.96, drop, 1, 1, 0, -depth / 2, low)]
    else:
        parts = [*open_shelf(width, depth, low, height), box(width, depth, 0.025, 0, 0, height - 0.025)]
    for s in (-1, 1):
        if random.random() < 0.5:
            x = s * width * 0.46
            parts.append(
                tube([(x, -depth * 0.45, low), (x, -depth * 0.45, r), (x, depth * 0.45, r), (x, depth * 0.45, low)], r)
            )
        else:
            parts += [
                tube(
                    [(s * width * 0.4, y * 0.7, low), (s * width * 0.47, y, 0.0), (s * width * 0.47, y * 0.75, low)], r
                )
                for y in (-depth * 0.45, depth * 0.45)
            ]
    return parts


def stand_cabinet(random: Random) -> Parts:
    """Doors below a drawer or an open niche, with a framed plinth and a moulded top."""
    width, depth, height = draws(random, (0.42, 0.6), (0.36, 0.48), (0.58, 0.78))
    feet = _feet(random, 0.14)
    inside, split = height - feet, random.uniform(0.25, 0.4)
    parts = [
        *_body(random, width, depth, height, feet),
        box(width * 1.08, depth * 1.06, 0.025, 0, 0, height),
        box(width * 1.04, depth * 1.03, 0.05, 0, 0, feet),
    ]
    parts += doors(width * 0.94, inside * (1 - split) - 0.08, int(random.integers(1, 3)), 0, -depth / 2, feet + 0.06)
    return parts + drawers(
        random,
        width * 0.94,
        inside * split - 0.03,
        1,
        int(random.integers(1, 3)),
        0,
        -depth / 2,
        height - inside * split,
    )


def stand_bedside(random: Random) -> Parts:
    """Sides that stand on the floor and rise above or reach past drawers that lie between them."""
    width, depth, height = draws(random, (0.38, 0.55), (0.36, 0.5), (0.42, 0.65))
    low, rows, t = random.uniform(0.03, 0.2), int(random.integers(1, 4)), random.uniform(0.018, 0.04)
    parts = [box(t, depth, height + random.choice([0, 0.06]), s * (width + t) / 2) for s in (-1, 1)]
    parts += [box(width, depth * 0.96, height - low, 0, 0.01, low)]
    return parts + drawers(random, width, height - low - 0.02, rows, 1, 0, -depth * 0.46, low + 0.01)
