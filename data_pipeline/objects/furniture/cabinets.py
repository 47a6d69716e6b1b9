"""Dressers and night stands, which share their carcasses, drawers and doors."""

from __future__ import annotations

from data_pipeline.objects.furniture.solids import Parts, Random, box, doors, drawers, four_legs, joined, tabletop


def _carcass(random: Random, width: float, depth: float, height: float, feet: float) -> Parts:
    """A body with an overhanging top; `feet` is the height of its feet, or 0."""
    overhang = random.choice([0, random.uniform(0.01, 0.04)])
    parts = [box(width, depth, height - feet - 0.03, 0, 0, feet)]
    parts.append(box(width + 2 * overhang, depth + 2 * overhang, 0.03, 0, 0, height - 0.03))
    if feet > 0.02:
        parts += four_legs(width, depth, feet, random.uniform(0.04, 0.07), 0.01)
    return parts


def dresser_wide(random: Random) -> Parts:
    """Rows of two or three drawers."""
    width, depth, height = random.uniform(0.95, 1.7), random.uniform(0.42, 0.58), random.uniform(0.7, 0.95)
    feet = float(random.choice([0.0, random.uniform(0.05, 0.2)]))
    rows, columns = int(random.integers(2, 5)), int(random.integers(2, 4))
    parts = _carcass(random, width, depth, height, feet)
    return parts + drawers(random, width * 0.96, height - feet - 0.05, rows, columns, 0, -depth / 2, feet + 0.01)


def dresser_chest(random: Random) -> Parts:
    """Tall and narrow, with three to six drawers; the smallest have the proportions of a night stand."""
    width, depth, height = random.uniform(0.6, 0.95), random.uniform(0.42, 0.58), random.uniform(0.75, 1.35)
    feet = float(random.choice([0.0, random.uniform(0.04, 0.15)]))
    parts = _carcass(random, width, depth, height, feet)
    rows = int(random.integers(3, 7))
    return parts + drawers(random, width * 0.96, height - feet - 0.05, rows, 1, 0, -depth / 2, feet + 0.01)


def dresser_mirror(random: Random) -> Parts:
    """A wide dresser with a mirror on its top."""
    parts = dresser_wide(random)
    low, high = joined(parts).bounds
    width, rise = (high[0] - low[0]) * random.uniform(0.5, 0.9), random.uniform(0.5, 0.9)
    y = high[1] - 0.06
    parts += [box(width, 0.03, rise, 0, y, high[2] + 0.04), box(width * 0.6, 0.06, 0.05, 0, y, high[2])]
    parts += [box(0.05, 0.06, rise + 0.08, side * width / 2, y, high[2]) for side in (-1, 1)]
    return parts


def dresser_doors(random: Random) -> Parts:
    """Doors on one side, drawers on the other."""
    width, depth, height = random.uniform(0.9, 1.6), random.uniform(0.42, 0.58), random.uniform(0.75, 1.0)
    feet = float(random.choice([0.0, random.uniform(0.05, 0.2)]))
    parts = _carcass(random, width, depth, height, feet)
    inside, bottom = height - feet - 0.05, feet + 0.01
    share = random.uniform(0.35, 0.6) * width
    parts += doors(share, inside, 1 if share < 0.55 else 2, -width * 0.48 + share / 2, -depth / 2, bottom)
    rest = width * 0.96 - share
    return parts + drawers(
        random, rest, inside, int(random.integers(2, 5)), 1, width * 0.48 - rest / 2, -depth / 2, bottom
    )


def _stand_size(random: Random) -> tuple[float, float, float, float]:
    """Draws the width, depth, height and height of the feet of a night stand."""
    feet = float(random.choice([0.0, random.uniform(0.04, 0.25)]))
    return random.uniform(0.4, 0.65), random.uniform(0.35, 0.5), random.uniform(0.5, 0.75), feet


def stand_drawers(random: Random) -> Parts:
    """Two or three drawers."""
    width, depth, height, feet = _stand_size(random)
    parts = _carcass(random, width, depth, height, feet)
    rows = int(random.integers(2, 4))
    return parts + drawers(random, width * 0.95, height - feet - 0.05, rows, 1, 0, -depth / 2, feet + 0.01)


def open_shelf(width: float, depth: float, bottom: float, top: float) -> Parts:
    """Two sides, a back and a floor."""
    rise = top - bottom
    parts = [box(0.025, depth, rise, side * (width / 2 - 0.0125), 0, bottom) for side in (-1, 1)]
    return [*parts, box(width, 0.02, rise, 0, depth / 2 - 0.01, bottom), box(width, depth, 0.025, 0, 0, bottom)]


def stand_shelf(random: Random) -> Parts:
    """A drawer above an open compartment."""
    width, depth, height, feet = _stand_size(random)
    split = feet + (height - feet) * random.uniform(0.45, 0.65)
    parts = [*open_shelf(width, depth, feet, split), box(width, depth, height - split, 0, 0, split)]
    if feet > 0.02:
        parts += four_legs(width, depth, feet, 0.045)
    return parts + drawers(random, width * 0.94, height - split - 0.03, 1, 1, 0, -depth / 2, split + 0.01)


def stand_door(random: Random) -> Parts:
    """A drawer above a door."""
    width, depth, height, feet = _stand_size(random)
    parts = _carcass(random, width, depth, height, feet)
    inside, bottom = height - feet - 0.05, feet + 0.01
    drawer = inside * random.uniform(0.25, 0.4)
    parts += doors(width * 0.94, inside - drawer, 1, 0, -depth / 2, bottom)
    return parts + drawers(random, width * 0.94, drawer, 1, 1, 0, -depth / 2, bottom + inside - drawer)


def stand_legs(random: Random) -> Parts:
    """A drawer on long legs, sometimes with a shelf: the structure of a small writing desk at another scale."""
    width, depth, height, _ = _stand_size(random)
    drop, leg = random.uniform(0.13, 0.24), random.uniform(0.035, 0.05)
    parts = [tabletop(width + 0.03, depth + 0.03, height, 0.025), *four_legs(width, depth, height - 0.02, leg)]
    parts.append(box(width - leg / 2, depth - leg / 2, drop, 0, 0.01, height - 0.025 - drop))
    if random.random() < 0.6:
        parts.append(box(width - leg, depth - leg, 0.025, 0, 0, height * random.uniform(0.15, 0.3)))
    return parts + drawers(random, width - leg * 2, drop, 1, 1, 0, -depth / 2 + 0.02, height - 0.025 - drop)


DRESSERS = (dresser_wide, dresser_chest, dresser_mirror, dresser_doors)
NIGHT_STANDS = (stand_drawers, stand_shelf, stand_door, stand_legs)
