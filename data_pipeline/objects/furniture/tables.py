"""Tables and desks, whose tops are drawn from one distribution."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.solids import (
    Parts,
    Random,
    box,
    cylinder,
    drawers,
    four_legs,
    joined,
    rod,
    tabletop,
)


def board(random: Random) -> tuple[float, float, float, float]:
    """Draws the width, depth, height and thickness of a top.

    Tables and desks share this distribution, so that the top alone does not tell them apart.
    """
    return random.uniform(1.1, 1.8), random.uniform(0.55, 0.9), random.uniform(0.68, 0.8), random.uniform(0.025, 0.06)


def table_four_legs(random: Random) -> Parts:
    """Four legs, usually with an apron below the top."""
    width, depth, height, thick = board(random)
    leg, inset = random.uniform(0.04, 0.09), random.uniform(0, 0.08)
    parts = [
        tabletop(width, depth, height, thick),
        *four_legs(width, depth, height - thick, leg, inset, random.random() < 0.4),
    ]
    if random.random() < 0.6:  # an apron on all sides
        drop = random.uniform(0.06, 0.13)
        for side in (-1, 1):
            parts.append(
                box(width - 2 * inset, 0.025, drop, 0, side * (depth / 2 - inset - leg / 2), height - thick - drop)
            )
            parts.append(
                box(0.025, depth - 2 * inset, drop, side * (width / 2 - inset - leg / 2), 0, height - thick - drop)
            )
    return parts


def table_panel_ends(random: Random) -> Parts:
    """Two upright panels as legs, usually with a beam between them."""
    width, depth, height, thick = board(random)
    inset = random.uniform(0, 0.2)
    parts = [tabletop(width, depth, height, thick)]
    parts += [box(thick, depth * 0.95, height - thick, side * (width / 2 - thick / 2 - inset)) for side in (-1, 1)]
    if random.random() < 0.6:
        parts.append(box(width - 2 * inset, 0.03, random.uniform(0.1, 0.2), 0, 0, height * random.uniform(0.25, 0.6)))
    return parts


def table_round(random: Random) -> Parts:
    """A round or elliptic top on a column or on four splayed legs."""
    radius, height, thick = random.uniform(0.4, 0.7), random.uniform(0.55, 0.8), random.uniform(0.025, 0.06)
    stretch = random.uniform(1.0, 1.5)
    top = cylinder(radius, thick, 0, 0, height - thick, 36)
    top.apply_scale((stretch, 1, 1))
    if random.random() < 0.5:
        return [top, cylinder(random.uniform(0.04, 0.09), height - thick), cylinder(radius * 0.55, 0.04, sections=28)]
    return [top, *four_legs(radius * 1.3 * stretch, radius * 1.3, height - thick, 0.06, splay=random.uniform(0, 0.08))]


def table_trestle(random: Random) -> Parts:
    """Two pairs of crossed legs."""
    width, depth, height, thick = board(random)
    parts = [tabletop(width, depth, height, thick), box(width * 0.7, 0.04, 0.1, 0, 0, height * 0.3)]
    for side in (-1, 1):
        x = side * width * 0.36
        parts += [rod((x, -depth * 0.42, 0), (x, depth * 0.2, height - thick), 0.03)]
        parts += [rod((x, depth * 0.42, 0), (x, -depth * 0.2, height - thick), 0.03)]
    return parts


def table_coffee(random: Random) -> Parts:
    """A low table, usually with a shelf."""
    width, depth, height = random.uniform(0.8, 1.3), random.uniform(0.5, 0.8), random.uniform(0.35, 0.5)
    leg = random.uniform(0.04, 0.09)
    parts = [tabletop(width, depth, height, 0.04), *four_legs(width, depth, height - 0.04, leg)]
    if random.random() < 0.7:
        parts.append(box(width - leg, depth - leg, 0.03, 0, 0, height * 0.3))
    return parts


def _modesty(random: Random, width: float, depth: float, height: float, thick: float, inset: float = 0.05) -> Parts:
    """The modesty panel at the back of a desk."""
    drop = (height - thick) * random.uniform(0.3, 0.95)
    return [box(width - 2 * inset, 0.02, drop, 0, depth / 2 - inset, height - thick - drop)]


def drawer_pedestal(random: Random, width: float, depth: float, height: float, x: float) -> Parts:
    """A column of two to four drawers that stands on the floor, centred at `x`."""
    rows = int(random.integers(2, 5))
    front = -depth / 2 + 0.03
    return [box(width, depth - 0.03, height, x, 0.015), *drawers(random, width, height, rows, 1, x, front, 0)]


def desk_one_pedestal(random: Random) -> Parts:
    """Drawers on one side, a panel or two legs on the other."""
    width, depth, height, thick = board(random)
    body, side = random.uniform(0.32, 0.45), random.choice([-1, 1])
    parts = [tabletop(width, depth, height, thick)]
    parts += drawer_pedestal(random, body, depth * 0.95, height - thick, side * (width - body) / 2)
    if random.random() < 0.5:
        parts.append(box(0.04, depth * 0.95, height - thick, -side * (width / 2 - 0.02)))
    else:
        parts += [
            box(0.05, 0.05, height - thick, -side * (width / 2 - 0.04), sy * (depth / 2 - 0.05)) for sy in (-1, 1)
        ]
    return parts + (_modesty(random, width, depth, height, thick) if random.random() < 0.5 else [])


def desk_two_pedestals(random: Random) -> Parts:
    """Equal drawers on both sides."""
    width, depth, height, thick = board(random)
    width = max(width, 1.25)
    body = random.uniform(0.3, 0.42)
    state = int(random.integers(2**31))
    parts = [tabletop(width, depth, height, thick)]
    for side in (-1, 1):  # one random state for both, so that they are equal
        parts += drawer_pedestal(
            np.random.default_rng(state), body, depth * 0.95, height - thick, side * (width - body) / 2
        )
    return parts + (_modesty(random, width, depth, height, thick) if random.random() < 0.6 else [])


def desk_corner(random: Random) -> Parts:
    """An L-shaped desk with panels."""
    width, depth, height, thick = board(random)
    side, reach, wing = random.choice([-1, 1]), random.uniform(0.5, 0.9), random.uniform(0.45, 0.6)
    x, y = side * (width - wing) / 2, -depth / 2 - reach / 2
    parts = [tabletop(width, depth, height, thick), box(wing, reach, thick, x, y, height - thick)]
    parts += [box(0.04, depth * 0.95, height - thick, -side * (width / 2 - 0.02))]
    parts += [box(wing * 0.95, 0.04, height - thick, x, -depth / 2 - reach + 0.03)]
    parts += [box(width, 0.02, (height - thick) * random.uniform(0.3, 0.8), 0, depth / 2 - 0.02, height * 0.2)]
    if random.random() < 0.6:
        parts += drawer_pedestal(random, 0.38, depth * 0.9, height - thick, -side * (width / 2 - 0.24))
    else:
        parts += [box(0.05, 0.05, height - thick, side * (width / 2 - 0.04), depth / 2 - 0.05)]
    return parts


def desk_writing(random: Random) -> Parts:
    """Looks like a table except for the drawers under its top, which are visible only from the front."""
    width, depth, height, thick = board(random)
    drop, leg = random.uniform(0.1, 0.16), random.uniform(0.04, 0.07)
    parts = [
        tabletop(width, depth, height, thick),
        *four_legs(width, depth, height - thick, leg, round_legs=random.random() < 0.3),
    ]
    parts.append(box(width - leg, depth - leg, drop, 0, 0.01, height - thick - drop))
    front = -depth / 2 + leg / 2 + 0.01
    parts += drawers(random, width - leg * 2, drop, 1, int(random.integers(1, 4)), 0, front, height - thick - drop)
    return parts


def desk_hutch(random: Random) -> Parts:
    """A desk with an open shelf on its top."""
    parts = (desk_writing if random.random() < 0.4 else desk_one_pedestal)(random)
    low, high = joined(parts).bounds
    width, rise, depth = high[0] - low[0], random.uniform(0.25, 0.6), random.uniform(0.2, 0.3)
    y, z = high[1] - depth / 2, high[2]
    parts += [box(0.03, depth, rise, side * (width / 2 - 0.015), y, z) for side in (-1, 1)]
    parts += [box(width, depth, 0.03, 0, y, z + rise), box(width, 0.02, rise, 0, high[1] - 0.01, z)]
    return parts


DESKS = (desk_one_pedestal, desk_two_pedestals, desk_corner, desk_writing, desk_hutch)
TABLES = (table_four_legs, table_panel_ends, table_round, table_trestle, table_coffee)
