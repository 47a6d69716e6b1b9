"""Tables of further families."""

from __future__ import annotations

from data_pipeline.objects.furniture.families.parts import (
    CIRCLE,
    HALF_ROUND,
    SQUARE,
    crossed,
    draws,
    ends,
    loft,
    moved,
    pedestal,
    prism,
    superellipse,
    tube,
    turned,
)
from data_pipeline.objects.furniture.solids import Parts, Random, box, four_legs, rod, tabletop
from data_pipeline.objects.furniture.tables import board


def table_pedestal(random: Random) -> Parts:
    """A round, oval or square top on one support."""
    radius, height, thick = draws(random, (0.35, 0.75), (0.55, 0.78), (0.02, 0.05))
    top = prism(
        superellipse(float(random.choice([2.0, 2.0, 4.0, 30.0]))),
        2 * radius,
        2 * radius * random.uniform(0.7, 1),
        thick,
        0,
        0,
        height - thick,
    )
    return [top, *pedestal(random, radius * random.uniform(0.45, 0.75), height - thick)]


def table_refectory(random: Random) -> Parts:
    """A long top on two supports like an upside-down T, an A or a panel, with a beam."""
    width, depth, height, thick = board(random)
    width, style = width * random.uniform(1, 1.5), random.integers(3)
    span, under = width * random.uniform(0.55, 0.8), height - thick
    parts = [prism(superellipse(float(random.choice([5.0, 40.0]))), width, depth, thick, 0, 0, under)]
    if style == 0:
        parts += ends(span, depth * 0.8, under, random.uniform(0.05, 0.09))
    elif style == 1:
        for s in (-1, 1):
            x = s * span / 2
            parts += [rod((x, t * depth * 0.4, 0), (x, t * depth * 0.12, under), 0.03) for t in (-1, 1)]
            parts.append(box(0.04, depth * 0.6, 0.05, x, 0, under * 0.25))
    else:
        for s in (-1, 1):
            shape = [(0.05, depth * 0.4), (0.05, depth * 0.36), (0.05, depth * 0.15), (0.05, depth * 0.36)]
            parts.append(
                loft(
                    SQUARE,
                    [
                        (a / 2, b, s * span / 2, 0, z * under)
                        for (a, b), z in zip(shape, (0, 0.07, 0.5, 1), strict=True)
                    ],
                )
            )
    return [*parts, box(span, 0.04, random.uniform(0.05, 0.12), 0, 0, under * random.uniform(0.2, 0.6))]


def table_lifting(random: Random) -> Parts:
    """A work table on two T legs, with a beam below the top."""
    width, depth, height, thick = board(random)
    height *= random.uniform(1, 1.4)
    parts = [
        tabletop(width * 1.2, depth, height, thick),
        *ends(width * 0.85, depth * 0.9, height - thick, random.uniform(0.05, 0.09)),
    ]
    return [*parts, box(width * 0.85, 0.06, 0.05, 0, 0, height - thick - 0.08)] if random.random() < 0.7 else parts


def table_glass(random: Random) -> Parts:
    """A thin top on legs that cross below its middle or at its ends, or on a frame of tube."""
    width, depth, height, _ = board(random)
    height, style, r = height * random.uniform(0.55, 1), random.integers(3), random.uniform(0.012, 0.025)
    parts = [prism(superellipse(float(random.choice([2.0, 5.0, 40.0]))), width, depth, 0.014, 0, 0, height - 0.014)]
    if style == 0:
        x, y = width * 0.36, depth * 0.36
        return parts + [rod((s * x, t * y, 0), (-s * x, -t * y, height - 0.014), r) for s in (-1, 1) for t in (-1, 1)]
    if style == 1:
        return parts + crossed(width * 0.75, depth * 0.9, height - 0.014, r)
    for s in (-1, 1):
        x = s * width * 0.38
        line = [
            (x, -depth * 0.4, height - 0.02),
            (x, -depth * 0.42, r),
            (x, depth * 0.42, r),
            (x, depth * 0.4, height - 0.02),
        ]
        parts.append(tube(line, r))
    return parts


def table_parsons(random: Random) -> Parts:
    """Square legs as thick as the top, flush with its corners, or panels instead of the legs."""
    width, depth, height, _ = board(random)
    height, width = height * random.uniform(0.5, 1), width * random.uniform(0.5, 1)
    thick = random.uniform(0.05, 0.12)
    parts = [tabletop(width, depth, height, thick)]
    if random.random() < 0.6:
        return parts + four_legs(width, depth, height - thick, thick)
    parts += [box(thick, depth, height - thick, s * (width - thick) / 2) for s in (-1, 1)]
    return [*parts, box(width, depth, thick * 0.6)] if random.random() < 0.5 else parts


def table_drop_leaf(random: Random) -> Parts:
    """A narrow top whose leaves hang at its sides, one or both."""
    width, depth, height, thick = board(random)
    width *= random.uniform(0.4, 0.7)
    leaf, outline = random.uniform(0.2, 0.5), superellipse(2)
    parts = [
        tabletop(width, depth, height, thick),
        *four_legs(width, depth * 0.9, height - thick, random.uniform(0.04, 0.07), 0.03),
    ]
    parts.append(box(width * 0.8, depth * 0.75, 0.1, 0, 0, height - thick - 0.1))
    for s in (-1, 1):
        if random.random() < 0.7:
            parts.append(box(0.02, depth, leaf, s * (width / 2 + 0.012), 0, height - leaf))
        else:
            parts.append(prism(outline, 2 * leaf, depth, thick, s * width / 2, 0, height - thick))
    return parts


def table_picnic(random: Random) -> Parts:
    """A top of boards between two benches on A-shaped legs."""
    width, depth, height, thick = random.uniform(1.4, 2.0), random.uniform(0.65, 0.8), random.uniform(0.7, 0.78), 0.04
    boards, reach = int(random.integers(3, 6)), random.uniform(0.6, 0.75)
    parts = [
        box(width, depth / boards - 0.012, thick, 0, (b - (boards - 1) / 2) * depth / boards, height - thick)
        for b in range(boards)
    ]
    parts += [box(width, 0.25, thick, 0, s * reach, height * 0.57) for s in (-1, 1)]
    for s in (-1, 1):
        x = s * width * 0.36
        parts += [
            box(0.05, 2 * reach + 0.2, 0.08, x, 0, height * 0.57 - 0.08),
            box(0.05, depth * 0.95, 0.07, x, 0, height - thick - 0.07),
        ]
        parts += [rod((x, t * (reach - 0.05), 0), (x, t * depth * 0.25, height - thick), 0.035) for t in (-1, 1)]
    return parts


def table_console(random: Random) -> Parts:
    """A narrow half-moon or rectangle against a wall, with or without a shelf."""
    width, depth, height = draws(random, (0.8, 1.4), (0.3, 0.45), (0.72, 0.86))
    outline = HALF_ROUND if random.random() < 0.6 else superellipse(40)
    parts = [
        prism(outline, width, depth, 0.03, 0, 0, height - 0.03),
        prism(outline, width * 0.92, depth * 0.9, 0.09, 0, 0.01, height - 0.12),
    ]
    if random.random() < 0.5:
        parts.append(prism(outline, width * 0.85, depth * 0.85, 0.025, 0, 0.01, height * random.uniform(0.12, 0.3)))
    places = ((-0.43, 0.4), (0.43, 0.4), (-0.26, -0.3), (0.26, -0.3))
    return parts + [box(0.04, 0.04, height - 0.03, x * width, y * depth) for x, y in places]


def table_drum(random: Random) -> Parts:
    """A closed drum, a waisted one, or two discs with a wall or rods between them."""
    radius, height, style = random.uniform(0.25, 0.45), random.uniform(0.38, 0.6), random.integers(3)
    if style == 0:
        return [
            turned(
                [(radius * random.uniform(0.6, 1), 0), (radius * random.uniform(0.4, 1), height / 2), (radius, height)]
            )
        ]
    parts = [prism(CIRCLE, 2 * radius, 2 * radius, 0.03, 0, 0, z) for z in (0, height - 0.03)]
    if style == 1:
        return [*parts, turned([(radius * 0.85, 0.02), (radius * 0.85, height - 0.02)])]
    return parts + [
        rod((radius * 0.9 * x, radius * 0.9 * y, 0), (radius * 0.9 * x, radius * 0.9 * y, height), 0.01)
        for x, y in CIRCLE[::2]
    ]


def table_side(random: Random) -> Parts:
    """A small high table on three or four slender legs, with a shelf, a rim or a drawer."""
    width, height = draws(random, (0.35, 0.55), (0.48, 0.68))
    outline = superellipse(float(random.choice([2.0, 6.0, 40.0])))
    parts = [prism(outline, width, width, 0.025, 0, 0, height - 0.025)]
    parts += four_legs(
        width * 0.68, width * 0.68, height - 0.02, random.uniform(0.02, 0.035), splay=float(random.choice([0.0, 0.05]))
    )
    if random.random() < 0.5:
        parts.append(prism(outline, width * 0.75, width * 0.75, 0.02, 0, 0, height * 0.3))
    return parts


def table_nest(random: Random) -> Parts:
    """Two or three tables that stand partly below each other."""
    width, depth, height = draws(random, (0.5, 0.65), (0.36, 0.45), (0.45, 0.55))
    parts: Parts = []
    for step in range(int(random.integers(2, 4))):
        share = 1 - 0.16 * step
        one = [
            tabletop(width * share, depth * share, height * share, 0.025),
            *four_legs(width * share, depth * share, height * share - 0.02, 0.03),
        ]
        parts += moved(one, 0, -step * random.uniform(0.05, 0.22))
    return parts


def table_conference(random: Random) -> Parts:
    """A long top, boat-shaped, oval or rectangular, on panels or drums."""
    width, depth, height, thick = draws(random, (1.8, 2.6), (0.9, 1.25), (0.7, 0.77), (0.03, 0.07))
    outline = superellipse(float(random.choice([2.0, 3.0, 5.0, 40.0])))
    parts, under = [prism(outline, width, depth, thick, 0, 0, height - thick)], height - thick
    foot = CIRCLE if random.random() < 0.4 else SQUARE
    size = (0.5, 0.5) if foot is CIRCLE else (random.uniform(0.05, 0.2), depth * 0.6)
    parts += [prism(foot, *size, under, s * width * 0.28) for s in (-1, 1)]
    return [*parts, box(width * 0.56, 0.04, 0.2, 0, 0, under * 0.4)] if random.random() < 0.6 else parts
