"""Things of a house: appliances, open shelves and racks."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder, four_legs
from data_pipeline.objects.strangers.shapes import (
    FRONT,
    Groups,
    bend,
    blob,
    capsule,
    circle,
    disc,
    either,
    level,
    loft,
    placed,
    rod,
    slab,
    sweep,
)


def _knobs(count: int, radius: float, width: float, y: float, z: float) -> Parts:
    """Round knobs side by side on a front at `y`."""
    return [disc(radius, 0.03, (x, y, z), FRONT, 12) for x in np.linspace(-width / 2, width / 2, count)]


def washing_machine(random: Random) -> Parts:
    """A porthole in the front, or a lid on top."""
    width, depth, height = *random.uniform(0.5, 0.65, 2), random.uniform(0.75, 0.95)
    front, parts = -depth / 2, [box(width, depth, height)]
    parts += [box(width * 0.3, 0.02, 0.08, -width * 0.3, front, height * 0.88)]
    parts += _knobs(2, 0.03, 0.1, front, height * 0.92)
    if either(random, 0.75):
        hole, z = random.uniform(0.14, 0.2), height * random.uniform(0.42, 0.55)
        parts += placed([slab(circle(26) * hole * 1.2, 0.06, circle(26) * hole)], (0, front, z))
        return [*parts, *placed([blob((hole, 0.05, hole))], (0, front, z))]
    return [
        *parts,
        box(width * 0.85, depth * 0.6, 0.04, 0, front * 0.3, height),
        box(width, 0.1, 0.15, 0, -front - 0.05, height),
    ]


def refrigerator(random: Random) -> Parts:
    """One door, two above each other, or two beside each other, with long handles."""
    width, depth, height = random.uniform(0.55, 0.75), random.uniform(0.55, 0.7), random.uniform(1.3, 2.0)
    front, kind = -depth / 2, int(random.integers(3))
    parts = [box(width, depth, height, 0, 0, 0.03), *four_legs(width, depth, 0.03, 0.05)]
    cut = random.choice([random.uniform(0.28, 0.4), random.uniform(0.6, 0.72)]) * height
    if kind == 2:
        width, leaves = width * 1.4, [(-1, 0.03, height), (1, 0.03, height)]
        parts[0] = box(width, depth, height, 0, 0, 0.03)
    else:
        leaves = [(0, 0.03, height)] if kind == 0 else [(0, 0.03, cut), (0, cut + 0.03, height - cut)]
    for side, z, tall in leaves:
        door = width / 2 if side else width
        parts.append(box(door - 0.01, 0.06, tall - 0.015, side * width / 4, front - 0.03, z))
        x = -side * 0.04 if side else -width * 0.42
        parts.append(box(0.025, 0.05, min(tall * 0.6, 0.6), side * 0.06 if side else x, front - 0.08, z + tall * 0.2))
    return parts


def microwave(random: Random) -> Parts:
    width, depth, height = random.uniform(0.42, 0.6), random.uniform(0.3, 0.42), random.uniform(0.24, 0.34)
    front, panel = -depth / 2, width * random.uniform(0.2, 0.3)
    parts = [box(width, depth, height, 0, 0, 0.01), box(width - panel, 0.025, height * 0.94, -panel / 2, front, 0.02)]
    parts.append(box(0.02, 0.04, height * 0.7, (width / 2 - panel) * 0.92, front - 0.03, height * 0.16))
    if either(random):
        return parts + placed(
            _knobs(2, 0.025, 0, front, 0), (width / 2 - panel / 2, 0, height * random.uniform(0.2, 0.4))
        )
    keys = [(column, row) for column in (-1, 0, 1) for row in range(4)]
    return parts + [box(0.02, 0.015, 0.015, width / 2 - panel / 2 + c * 0.03, front, 0.05 + r * 0.035) for c, r in keys]


def cooker(random: Random) -> Parts:
    """An oven with a window and a bar, knobs above it, and rings on top."""
    width, depth, height = random.uniform(0.5, 0.8), random.uniform(0.5, 0.62), random.uniform(0.8, 0.92)
    front = -depth / 2
    parts = [box(width, depth, height), box(width * 0.96, 0.03, height * 0.6, 0, front - 0.01, height * 0.2)]
    parts += [rod((-width * 0.4, front - 0.06, height * 0.75), (width * 0.4, front - 0.06, height * 0.75), 0.012)]
    parts += _knobs(int(random.integers(4, 7)), 0.022, width * 0.75, front - 0.015, height * 0.9)
    rings = [(sx, sy) for sx in (-1, 1) for sy in (-1, 1)]
    parts += [cylinder(random.uniform(0.06, 0.1), 0.02, sx * width / 4, sy * depth / 4, height) for sx, sy in rings]
    return [*parts, box(width, 0.03, random.uniform(0.05, 0.3), 0, depth / 2, height)] if either(random) else parts


def radiator(random: Random) -> Parts:
    """Columns beside each other, or a ladder of tubes for towels."""
    count, high = int(random.integers(6, 16)), random.uniform(0.4, 0.9)
    if either(random, 0.6):
        deep, step = random.uniform(0.06, 0.16), random.uniform(0.05, 0.09)
        parts = [loft([level(circle(10) * (step * 0.42, deep), z) for z in (0.08, high)]) for _ in range(count)]
        for index, part in enumerate(parts):
            placed([part], ((index - (count - 1) / 2) * step, 0, 0))
        ends = [(-count / 2 * step, z) for z in (0.12, high - 0.05)]
        return parts + [rod((x, 0, z), (-x, 0, z), 0.025) for x, z in ends]
    wide = random.uniform(0.4, 0.6)
    parts = [capsule((s * wide / 2, 0, 0), (s * wide / 2, 0, high * 1.6), 0.022) for s in (-1, 1)]
    return parts + [rod((-wide / 2, 0, z), (wide / 2, 0, z), 0.014) for z in np.linspace(0.1, high * 1.55, count)]


def fan(random: Random) -> Parts:
    """Blades in a ring on a stand, on a low foot, or under a ceiling."""
    radius, blades = random.uniform(0.15, 0.3), int(random.integers(3, 6))
    blade = [blob((radius * 0.42, 0.008, radius * 0.2), (radius * 0.55, 0, 0), sections=10) for _ in range(blades)]
    for index, part in enumerate(blade):
        placed(placed([part], turn=(0.4, 0, 0)), turn=(0, index * 2 * np.pi / blades, 0))
    head = [*blade, disc(radius * 0.2, 0.12, (0, 0.03, 0), FRONT)]
    if either(random, 0.3):
        return [*placed(head, turn=(np.pi / 2, 0, 0)), cylinder(0.015, random.uniform(0.2, 0.5))]
    for y in (-0.06, 0.06):
        head += placed([slab(circle(24) * radius * 1.05, 0.012, circle(24) * radius)], (0, y, 0))
        head += [rod((0, y * 1.3, 0), (x * radius, y, z * radius), 0.003) for x, z in circle(10)]
    stem = random.choice([random.uniform(0.05, 0.2), random.uniform(0.7, 1.0)])
    return [*placed(head, (0, -0.06, stem + radius)), cylinder(0.018, stem + radius), cylinder(radius * 0.8, 0.03)]


# ------------------------------------------------------------------------------------------------------ shelves and racks


def bookcase(random: Random) -> Parts:
    """Boards between sides, with or without a back, books, and a middle wall; no fronts."""
    width, depth, height = random.uniform(0.5, 1.2), random.uniform(0.22, 0.35), random.uniform(0.8, 2.0)
    rows, books = int(random.integers(3, 7)), either(random)
    parts = [box(0.025, depth, height, s * width / 2) for s in (-1, 1)]
    parts += [box(width, depth, 0.025, 0, 0, z) for z in np.linspace(0.05, height - 0.025, rows)]
    parts += [box(width, 0.01, height, 0, depth / 2)] * either(random, 0.6)
    parts += [box(0.025, depth, height)] * either(random, 0.3)
    for z in np.linspace(0.05, height - 0.025, rows)[:-1] if books else ():
        x = -width / 2 + 0.03
        for _ in range(random.integers(1, 8)):
            thick, tall = random.uniform(0.02, 0.06), random.uniform(0.5, 0.85) * height / rows
            parts.append(box(thick, depth * 0.7, tall, x + thick / 2, 0, z))
            x += thick + 0.004
    return parts


def ladder_shelf(random: Random) -> Parts:
    """Boards between leaning rails, which become less deep upwards."""
    width, height, deep = random.uniform(0.5, 0.8), random.uniform(1.2, 1.9), random.uniform(0.35, 0.5)
    back = deep if either(random) else 0.05
    parts = [rod((s * width / 2, -deep, 0), (s * width / 2, 0, height), 0.018) for s in (-1, 1)]
    parts += [rod((s * width / 2, back - 0.05, 0), (s * width / 2, 0, height), 0.018) for s in (-1, 1)]
    for t in np.linspace(0.12, 0.85, int(random.integers(3, 6))):
        low, high = -deep * (1 - t), (back - 0.05) * (1 - t)
        parts.append(box(width, high - low + 0.05, 0.02, 0, (low + high) / 2, t * height))
    return parts


def coat_rack(random: Random) -> Parts:
    """A post with arms on a foot or three legs, or a rail between two posts."""
    height, arms = random.uniform(1.4, 1.9), int(random.integers(4, 9))
    if either(random, 0.35):
        wide = random.uniform(0.6, 1.2)
        parts = [rod((s * wide / 2, 0, 0), (s * wide / 2, 0, height), 0.015) for s in (-1, 1)]
        parts += [rod((s * wide / 2, -0.22, 0.02), (s * wide / 2, 0.22, 0.02), 0.015) for s in (-1, 1)]
        return [*parts, *[rod((-wide / 2, 0, z), (wide / 2, 0, z), 0.015) for z in (0.2, height)]]
    parts = [cylinder(0.025, height)]
    for index, (x, y) in enumerate(circle(arms)):
        z = height * (0.95 if index % 2 else 0.85)
        parts.append(
            sweep(bend([(0, 0, z - 0.1), (x * 0.12, y * 0.12, z - 0.1), (x * 0.2, y * 0.2, z + 0.05)], 6), 0.012, 6)
        )
    if either(random):
        return [*parts, cylinder(random.uniform(0.15, 0.22), 0.03)]
    return parts + [rod((0, 0, 0.25), (x * 0.28, y * 0.28, 0.01), 0.018) for x, y in circle(3 + either(random))]


def step_ladder(random: Random) -> Parts:
    """Two rails with rungs that lean alone, or stand against a second pair."""
    height, wide, steps = random.uniform(0.8, 2.2), random.uniform(0.35, 0.5), int(random.integers(3, 8))
    reach = height * random.uniform(0.25, 0.4)
    parts = [rod((s * wide / 2, -reach, 0), (s * wide / 2.6, 0, height), 0.022) for s in (-1, 1)]
    for t in np.linspace(0.12, 0.9, steps):
        parts.append(box(wide * (1 - 0.2 * t), 0.08, 0.025, 0, -reach * (1 - t), t * height))
    if either(random, 0.65):
        parts += [rod((s * wide / 2, reach, 0), (s * wide / 2.6, 0, height), 0.018) for s in (-1, 1)]
        parts += [
            box(wide * 0.85, 0.2, 0.03, 0, 0, height),
            rod((-wide / 2, reach * 0.8, height * 0.2), (wide / 2, reach * 0.8, height * 0.2), 0.012),
        ]
    return parts


def crate(random: Random) -> Parts:
    """An open box of slats with gaps between them."""
    width, depth, height = random.uniform(0.35, 0.6), random.uniform(0.25, 0.4), random.uniform(0.15, 0.35)
    rows, slat = int(random.integers(2, 5)), random.uniform(0.6, 0.85) * height
    parts = [box(0.03, 0.03, height, x * width / 2, y * depth / 2) for x in (-1, 1) for y in (-1, 1)]
    for z in np.linspace(0, height - slat / rows, rows):
        parts += [box(width, 0.012, slat / rows, 0, s * depth / 2, z) for s in (-1, 1)]
        parts += [box(0.012, depth, slat / rows, s * width / 2, 0, z) for s in (-1, 1)]
    return parts + [box(width, depth / 6, 0.012, 0, y) for y in np.linspace(-0.42, 0.42, 5) * depth]


def basket(random: Random) -> Parts:
    """Bars around a floor, wider above, with or without a handle over it."""
    radius, height, flare = random.uniform(0.12, 0.2), random.uniform(0.12, 0.3), random.uniform(1.05, 1.5)
    stretch, bars = random.uniform(0.6, 1), int(random.integers(12, 22))
    ring = np.column_stack([circle(28), np.zeros(28)])[[*range(28), 0]] * (radius, radius * stretch, 1)
    parts = [
        sweep(ring * (1 + (flare - 1) * t, 1 + (flare - 1) * t, 1) + (0, 0, t * height), 0.007, 6) for t in (0, 0.5, 1)
    ]
    low = ring[np.linspace(0, 27, bars).astype(int)]
    parts += [sweep([p, p * (flare, flare, 1) + (0, 0, height)], 0.006, 5) for p in low]
    parts.append(loft([level(circle(28) * (radius, radius * stretch), z) for z in (-0.005, 0.005)]))
    top = radius * flare
    handle = bend([(-top, 0, height), (-top, 0, height * 2.4), (top, 0, height * 2.4), (top, 0, height)])
    return [*parts, sweep(handle, 0.01, 8)] if either(random, 0.6) else parts


GROUPS: Groups = {
    "appliances": {"train": (washing_machine, microwave, radiator, fan), "val": (cooker,), "test": (refrigerator,)},
    "shelves": {"train": (ladder_shelf, step_ladder, crate), "val": (coat_rack,), "test": (bookcase, basket)},
}
