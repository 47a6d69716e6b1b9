"""Tools and musical instruments. They lie, or lean in any pose."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder, lathe
from data_pipeline.objects.strangers.shapes import (
    Groups,
    bend,
    blob,
    capsule,
    circle,
    disc,
    either,
    hollow,
    level,
    loft,
    placed,
    rod,
    slab,
    smooth,
    sweep,
    tossed,
    upright,
)


def _grip(random: Random, low: float, high: float, radius: float) -> Parts:
    """An upright handle: round, or a flat one."""
    if either(random, 0.6):
        return [capsule((0, 0, low), (0, 0, high), radius, random.uniform(0.7, 1))]
    return [box(radius * 2, radius * 1.3, high - low, 0, 0, low)]


def hammer(random: Random) -> Parts:
    """With a claw, with two faces, or a mallet."""
    long, head, kind = random.uniform(0.22, 0.4), random.uniform(0.09, 0.14), int(random.integers(3))
    parts = _grip(random, 0, long, random.uniform(0.011, 0.017))
    if kind == 2:
        return tossed(random, [*parts, disc(random.uniform(0.03, 0.05), head, (0, 0, long))], 0.7)
    parts += [box(head * 0.7, 0.025, 0.03, 0, 0, long - 0.01), disc(0.018, 0.03, (head * 0.4, 0, long + 0.005))]
    if kind == 0:
        claw = [(-head * 0.3, 0, long + 0.01), (-head * 0.7, 0, long + 0.015), (-head * 0.85, 0, long - 0.035)]
        return tossed(random, [*parts, *[sweep(bend(np.add(claw, (0, y, 0)), 6), 0.007) for y in (-0.01, 0.01)]], 0.7)
    peen = np.array([(0, -0.012), (-head * 0.4, 0), (0, 0.014)])
    return tossed(random, [*parts, *placed([slab(peen, 0.025)], (-head * 0.3, 0, long + 0.005))], 0.7)


def wrench(random: Random) -> Parts:
    """An open jaw or a ring at each end."""
    long, wide, thick = random.uniform(0.14, 0.3), random.uniform(0.01, 0.016), random.uniform(0.006, 0.012)
    parts = [box(wide, thick * 0.7, long, 0, 0, 0)]
    for z, turn in ((0, np.pi), (long, 0)):
        r = wide * random.uniform(1.1, 1.7)
        open_by = 0.6 if either(random, 0.65) else 0
        angles = turn + np.linspace(np.pi / 2 + open_by, np.pi * 2.5 - open_by, 19)
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        rows = [around * r, around * r * 0.6]
        section = [
            np.stack([upright(row, y)[i] for row, y in zip((*rows, *rows[::-1]), (-1, -1, 1, 1), strict=True)])
            for i in range(19)
        ]
        parts += placed([loft(np.array(section) * (1, thick / 2, 1))], (0, 0, z))
    return tossed(random, parts, 0.7)


def screwdriver(random: Random) -> Parts:
    long, r = random.uniform(0.06, 0.2), random.uniform(0.009, 0.018)
    ribs = circle(24) * (1 + 0.1 * np.cos(np.arange(24) * np.pi / 2))[:, None]
    profile = smooth([(0.5, 0), (1, 0.15), (1, 0.7), (0.55, 0.85), (0.7, 1)])
    parts = [loft([np.column_stack([ribs * r * a, np.full(24, z * 0.1)]) for a, z in profile])]
    parts += [cylinder(r * 0.25, long, 0, 0, 0.1), box(r * 0.7, r * 0.15, 0.012, 0, 0, 0.1 + long)]
    return tossed(random, parts, 0.7)


def drill(random: Random) -> Parts:
    """A pistol with a chuck and a bit, with or without a battery under its grip."""
    long, r = random.uniform(0.13, 0.2), random.uniform(0.028, 0.036)
    parts = [disc(r, long, (0, 0, 0.16)), disc(r * 0.6, 0.05, (long / 2 + 0.025, 0, 0.16))]
    parts += [rod((long / 2, 0, 0.16), (long / 2 + random.uniform(0.08, 0.16), 0, 0.16), 0.004)]
    parts += placed([box(0.045, 0.036, 0.14)], (-long * 0.3, 0, 0.02), (0, random.uniform(0.0, 0.35), 0))
    if either(random, 0.7):
        parts.append(box(random.uniform(0.09, 0.13), 0.07, random.uniform(0.03, 0.06), -long * 0.25, 0, -0.02))
    return tossed(random, [*parts, box(0.015, 0.012, 0.03, -long * 0.05, 0, 0.11)], 0.4)


def saw(random: Random) -> Parts:
    """A blade with teeth and a grip, or a bow with a thin blade."""
    long, deep = random.uniform(0.25, 0.5), random.uniform(0.07, 0.13)
    grip = placed([slab(circle(20) * (0.05, 0.065), 0.02, circle(20) * (0.028, 0.038))], (-0.04, 0, deep / 2))
    if either(random, 0.6):
        x = np.linspace(0, long, 40)
        lower = np.stack([x, np.where(np.arange(40) % 2, -0.006, 0)], axis=1)
        upper = np.stack([x, np.linspace(deep, deep * random.uniform(0.3, 0.9), 40)], axis=1)
        rows = [
            [(a, -0.001, b), (a, 0.001, b), (c, 0.001, d), (c, -0.001, d)]
            for (a, b), (c, d) in zip(lower, upper, strict=True)
        ]
        return tossed(random, [loft(rows), *grip], 0.6)
    bow = bend([(0, 0, deep / 2), (0, 0, deep * 1.9), (long, 0, deep * 1.9), (long, 0, 0)])
    return tossed(random, [sweep(bow, 0.008, 8), *placed([box(long, 0.002, 0.015, long / 2, 0, 0)]), *grip], 0.6)


def scissors(random: Random) -> Parts:
    """Two blades with rings, more or less open."""
    long, half, parts = random.uniform(0.08, 0.16), random.uniform(0.02, 0.45), []
    for side in (-1, 1):
        ring = circle(18) * (random.uniform(0.018, 0.028), random.uniform(0.022, 0.035))
        blade = np.array([(-0.008, -0.02), (0.008, -0.02), (0.006, long * 0.5), (0, long), (-0.006, long * 0.5)])
        one = [slab(blade, 0.003), *placed([slab(ring, 0.008, ring * 0.7)], (side * 0.014, 0, -0.09))]
        one.append(rod((0, 0, -0.015), (side * 0.012, 0, -0.065), 0.005))
        parts += placed(one, (0, side * 0.002, 0), (0, -side * half, 0))
    return tossed(random, [*parts, disc(0.006, 0.01, (0, 0, 0), (0, 1, 0), 10)], 0.8)


def spoon(random: Random) -> Parts:
    """A spoon, a ladle or a fork."""
    long, kind = random.uniform(0.1, 0.22), int(random.integers(3))
    stem = bend([(0, 0, 0.015 + 0.01 * kind), (long * 0.4, 0, 0.0), (long, 0, random.uniform(0.01, 0.05))], 10)
    parts = [sweep(stem * (1, 1, 1), np.linspace(0.003, 0.007, 10), 8)]
    for part in parts:
        part.apply_scale((1, 1.5, 1))
    if kind == 2:
        tines = [
            sweep([(0, y * 0.6, 0.033), (-0.02, y, 0.03), (-0.06, y, 0.04)], 0.002, 6)
            for y in np.linspace(-0.01, 0.01, 4)
        ]
        return tossed(random, [*parts, *tines], 0.2)
    deep = random.uniform(0.007, 0.012) if kind == 0 else 0.03
    cup = hollow([(0.03 * np.sin(t), -np.cos(t) * deep) for t in np.linspace(0.1, 1.57, 7)], 0.0015, 0.7 + 0.3 * kind)
    return tossed(random, [*parts, *placed([cup], (-0.028, 0, 0.015 + 0.01 * kind))], 0.2)


# ------------------------------------------------------------------------------------------------------------ instruments


def guitar(random: Random) -> Parts:
    """A body with a waist, a neck and a head; or the pear of a lute."""
    t, deep, scale = np.arange(40) * 2 * np.pi / 40, random.uniform(0.05, 0.1), random.uniform(0.7, 1.1)
    waist = random.uniform(0.15, 0.3) if either(random, 0.75) else 0
    width = 0.19 * (1 - waist * np.exp(-(((np.sin(t) - 0.15) / 0.35) ** 2))) * (1 - 0.2 * np.sin(t))
    body = np.stack([width * np.sign(np.cos(t)) * np.abs(np.cos(t)) ** 0.8, 0.25 * np.sin(t)], axis=1)
    parts = [slab(body, deep), *placed([slab(circle(20) * 0.055, 0.01, circle(20) * 0.045)], (0, -deep / 2, 0.05))]
    parts += [box(0.05, 0.03, 0.38, 0, -deep * 0.4, 0.22), box(0.07, 0.02, 0.15, 0, -deep * 0.3, 0.6)]
    parts += [disc(0.008, 0.03, (s * 0.045, -deep * 0.3, z)) for s in (-1, 1) for z in (0.63, 0.67, 0.71)]
    parts.append(box(0.12, 0.015, 0.02, 0, -deep / 2, -0.12))
    for part in parts:
        part.apply_scale((scale, 1, 1))
    return tossed(random, placed(parts, turn=(-random.uniform(0, 0.4), 0, 0)), 0.4)


def drum(random: Random) -> Parts:
    """A shell between rims, alone, on legs, or waisted."""
    r, high, waist = random.uniform(0.15, 0.3), random.uniform(0.12, 0.5), random.choice([1.0, 1.0, 0.6, 1.15])
    shell = smooth([(r, 0), (r * waist, high * 0.5), (r, high)])
    parts = [lathe([(0, 0.01), *shell, (0, high - 0.01)], 1)]
    parts += [
        lathe([(r, z), (r * 1.06, z), (r * 1.06, z + 0.025), (r, z + 0.025), (r, z)], 1) for z in (0, high - 0.025)
    ]
    parts += [
        rod((x * r * 1.04, y * r * 1.04, 0), (x * r * 1.04, y * r * 1.04, high), 0.008)
        for x, y in circle(int(random.integers(4, 9)))
    ]
    if either(random, 0.4):
        parts = placed(parts, (0, 0, 0.45)) + [
            rod((x * r * 1.3, y * r * 1.3, 0), (x * r, y * r, 0.6), 0.01) for x, y in circle(3)
        ]
    return parts


def piano(random: Random) -> Parts:
    """A keyboard without legs, or a grand piano."""
    keys, key = int(random.integers(15, 36)), 0.03
    wide, deep = keys * key, random.uniform(0.25, 0.35)
    cells = (np.arange(keys) - (keys - 1) / 2) * key
    parts = [box(key * 0.9, 0.14, 0.012, x, -0.1, 0.05) for x in cells]
    parts += [
        box(key * 0.5, 0.09, 0.02, x + key / 2, -0.075, 0.055) for i, x in enumerate(cells[:-1]) if i % 7 not in (2, 6)
    ]
    parts += [box(wide + 0.1, deep, 0.05, 0, 0), box(wide + 0.1, deep * 0.4, random.uniform(0.06, 0.12), 0, deep * 0.3)]
    if either(random, 0.6):
        return parts
    w = wide / 2 + 0.05
    tail = random.uniform(0.9, 1.5)
    side = np.array(
        [(-w, 0), (w, 0), (w, 0.25), (w * 0.7, 0.5), (w * 0.1, 0.65), (-w * 0.2, 0.95), (-w * 0.75, 1), (-w, 0.9)]
    )
    outline = side * (1, tail)
    body = [loft([level(outline, z) for z in (0, 0.22)])]
    lid = placed(
        [loft([level(np.add(outline, (w, 0)), z) for z in (0, 0.02)])], (-w, 0, 0.23), (0, -random.uniform(0, 0.9), 0)
    )
    legs = [cylinder(0.05, 0.6, x, y) for x, y in ((-w * 0.8, 0), (w * 0.8, 0), (-w * 0.6, tail * 0.8))]
    return [*placed([*parts, *body, *lid], (0, 0, 0.6)), *legs]


def trumpet(random: Random) -> Parts:
    """A tube with a bell: wound with valves, or straight."""
    flare, long = random.uniform(0.05, 0.09), random.uniform(0.35, 0.6)
    cone = [(0.008 + flare * t**6, t * long) for t in np.linspace(0, 1, 14)]
    parts = placed([lathe([*cone, *[(max(r - 0.002, 0.001), z) for r, z in cone[::-1]]], 1)], turn=(0, np.pi / 2, 0))
    if either(random, 0.3):
        return tossed(random, [*parts, sweep([(-long, 0, 0), (0, 0, 0)], 0.008)], 0.4)
    back = [(0, 0, 0), (-0.1, 0, 0), (-0.1, 0, -0.12), (0, 0, -0.12)]
    parts += [sweep(bend(back), 0.008), sweep([(0, 0, -0.12), (long * 0.6, 0, -0.12)], 0.008)]
    parts += [
        sweep(
            bend([(long * 0.6, 0, -0.12), (long * 0.8, 0, -0.12), (long * 0.8, 0.03, 0), (long * 0.5, 0.03, 0)]), 0.008
        )
    ]
    parts += [
        sweep([(long * 0.5, 0.03, 0), (-0.25, 0.03, 0)], 0.007),
        blob((0.02, 0.015, 0.015), (-0.25, 0.03, 0), sections=10),
    ]
    return tossed(random, parts + [cylinder(0.014, 0.17, long * 0.3 + i * 0.034, 0, -0.15) for i in range(3)], 0.4)


GROUPS: Groups = {
    "tools": {"train": (wrench, screwdriver, saw, scissors), "val": (hammer,), "test": (drill, spoon)},
    "instruments": {"test": (guitar, drum, piano, trumpet)},
}
