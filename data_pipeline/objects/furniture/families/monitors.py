"""Monitors and televisions of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.families.parts import (
    CIRCLE,
    bent,
    cushion,
    draws,
    loft,
    moved,
    prism,
    rounded,
    sheet,
    superellipse,
    tube,
    turned,
    upturned,
)
from data_pipeline.objects.furniture.monitors import screen
from data_pipeline.objects.furniture.solids import Parts, Random, box, four_legs, rod, tilt


def _foot(random: Random, reach: float) -> Parts:
    """What stands on the desk: a disc, a plate, a ring, a crescent, a V, or a star of four."""
    kind, r = random.integers(6), random.uniform(0.008, 0.016)
    if kind < 2:
        return [prism((CIRCLE, superellipse(5))[kind], 2 * reach, reach * random.uniform(1.1, 1.8), 0.015, 0, 0.02)]
    if kind == 2:
        return [tube(np.c_[CIRCLE * (reach, reach * 0.6) + (0, 0.02), np.full(28, r)], r)]
    if kind == 3:
        t = np.linspace(0.15, np.pi - 0.15, 11)
        return [
            tube(np.c_[reach * np.cos(t), reach * 0.9 * np.sin(t) - reach * 0.6, np.full(11, r)], r * 1.3),
            box(0.03, reach * 0.3, 0.02, 0, reach * 0.2),
        ]
    if kind == 4:
        return [rod((0, 0.06, 0.02), (s * reach, -reach * 0.6, r), r) for s in (-1, 1)] + [
            rod((0, 0.06, 0.02), (0, 0.14, r), r)
        ]
    return [rod((0, 0.03, 0.04), (s * reach, t * reach * 0.4 + 0.03, r), r) for s in (-1, 1) for t in (-1, 1)]


def _panel(random: Random, width: float, height: float, z: float, thick: float) -> Parts:
    """A screen with a rim; its back is flat, wedge-shaped, or has a box for the electronics."""
    parts, kind = screen(random, width, height, thick, z), random.integers(3)
    if kind == 0:
        return parts
    low, share = random.uniform(0, 0.2) * height, random.uniform(0.4, 0.9)
    deep, h = random.uniform(0.02, 0.07), height * random.uniform(0.4, 0.8)
    levels = [(width * share / 2, h / 2, 0, 0, 0), (width * share * (0.5 if kind == 1 else 0.35), h * 0.42, 0, 0, deep)]
    return [*parts, upturned(loft(superellipse(8), levels), thick, z + low + h / 2)]


def monitor_desktop(random: Random) -> Parts:
    """A screen on a neck and any foot."""
    width = random.uniform(0.38, 0.72)
    height, lift, thick = width * random.uniform(0.54, 0.8), random.uniform(0.05, 0.2), random.uniform(0.015, 0.05)
    lean, neck = draws(random, (-0.05, 0.25), (0.02, 0.06))
    parts = tilt(_panel(random, width, height, lift, thick), lean, (0, 0, lift))
    rise = height * random.uniform(0.25, 0.5)
    y, top = thick + 0.02 + rise * lean, lift + rise
    if random.random() < 0.5:
        parts.append(tube([(0, 0.03, 0.01), (0, y + neck + 0.02, top * 0.4), (0, y + neck, top)], neck))
    else:
        parts += [box(neck * 3, 0.025, top, 0, y + 0.02), box(neck * 2, 0.03, 0.06, 0, y, top - 0.06)]
    return parts + _foot(random, width * random.uniform(0.22, 0.34))


def monitor_television(random: Random) -> Parts:
    """A large flat television on a neck with any foot, or on a wide bar."""
    width = random.uniform(0.75, 1.4)
    height, lift, thick = width * random.uniform(0.54, 0.62), random.uniform(0.03, 0.1), random.uniform(0.02, 0.09)
    parts = [*_panel(random, width, height, lift, thick), box(0.09, 0.03, lift + height * 0.3, 0, thick)]
    if random.random() < 0.4:
        return [
            *parts,
            box(width * random.uniform(0.3, 1.0), 0.25, 0.02, 0, thick),
            box(width * 0.8, 0.05, 0.04, 0, 0, lift - 0.03),
        ]
    return parts + _foot(random, width * random.uniform(0.2, 0.35))


def monitor_curved(random: Random) -> Parts:
    """A wide screen that curves around the viewer."""
    width = random.uniform(0.65, 1.1)
    height, lift, bow = width * random.uniform(0.38, 0.55), random.uniform(0.06, 0.16), random.uniform(0.05, 0.16)
    x = np.linspace(-1, 1, 13)
    grid = np.stack(
        [np.stack([x * width / 2, -bow * width * x**2, np.full(13, z)], axis=1) for z in (lift, lift + height)]
    )
    parts = [
        sheet(grid, random.uniform(0.02, 0.05)),
        box(width * 0.3, 0.05, height * 0.4, 0, 0.03, lift + height * 0.3),
        box(0.07, 0.04, lift + height * 0.5, 0, 0.06),
    ]
    return parts + _foot(random, width * 0.25)


def monitor_all_in_one(random: Random) -> Parts:
    """A computer in a screen: a chin below the screen, on a bent plate, often with a keyboard."""
    width = random.uniform(0.45, 0.65)
    height, lift, chin = width * random.uniform(0.5, 0.65), random.uniform(0.06, 0.13), random.uniform(0.04, 0.1)
    parts = tilt(
        [*_panel(random, width, height, lift + chin, 0.03), box(width, 0.03, chin, 0, 0.015, lift)],
        random.uniform(0, 0.2),
        (0, 0, lift),
    )
    line = [(-0.08, 0.006), (0.1, 0.006), (0.13, 0.03), (0.06, lift + height * 0.35)]
    parts.append(bent(line, random.uniform(0.12, 0.25), 0.01))
    return parts + ([box(0.42, 0.13, 0.018, 0, -0.24)] if random.random() < 0.4 else [])


def monitor_arm(random: Random) -> Parts:
    """One or two screens on a jointed arm with a clamp or a plate."""
    width = random.uniform(0.42, 0.62)
    height, lift, count = width * random.uniform(0.55, 0.65), random.uniform(0.1, 0.25), int(random.integers(1, 3))
    parts: Parts = []
    z = lift + height / 2
    for place in range(count):
        x = (place - (count - 1) / 2) * width * 1.05
        turn = -0.2 * np.sign(x) * random.random()
        parts += moved(_panel(random, width, height, lift, 0.03), x, 0, 0, turn)
        parts.append(tube([(0, 0.22, z - 0.06), (x * 0.5 + 0.1 * (count == 1), 0.18, z), (x, 0.04, z)], 0.02))
    return [*parts, rod((0, 0.22, 0), (0, 0.22, z), 0.018), box(0.12, 0.12, 0.03, 0, 0.2)]


def monitor_portrait(random: Random) -> Parts:
    """A screen turned upright."""
    height = random.uniform(0.42, 0.62)
    width, lift = height * random.uniform(0.55, 0.68), random.uniform(0.04, 0.12)
    parts = tilt(
        _panel(random, width, height, lift, random.uniform(0.02, 0.05)), random.uniform(-0.02, 0.15), (0, 0, lift)
    )
    return [*parts, box(0.06, 0.03, lift + height * 0.5, 0, 0.07), *_foot(random, width * 0.42)]


def monitor_wall(random: Random) -> Parts:
    """A screen on a plate with a bracket for a wall, without a foot."""
    width = random.uniform(0.45, 1.2)
    height, thick, gap = width * random.uniform(0.54, 0.65), random.uniform(0.02, 0.08), random.uniform(0.03, 0.15)
    parts = tilt(_panel(random, width, height, 0, thick), random.uniform(-0.15, 0.02), (0, 0, height / 2))
    plate, z = random.uniform(0.15, 0.3), height / 2
    return [
        *parts,
        box(plate, 0.02, plate, 0, thick + gap, z - plate / 2),
        box(plate * 0.4, gap, plate * 0.4, 0, thick + gap / 2, z - plate * 0.2),
    ]


def monitor_console(random: Random) -> Parts:
    """An old television: a deep box with a bulging screen, knobs or speakers, on legs or with an antenna."""
    width = random.uniform(0.45, 0.8)
    height, depth, legs = (
        width * random.uniform(0.7, 0.9),
        width * random.uniform(0.5, 0.8),
        float(random.choice([0.0, 0.03, random.uniform(0.1, 0.3)])),
    )
    parts = [box(width, depth, height, 0, 0, legs)]
    if legs:
        parts += four_legs(width, depth, legs, 0.03, splay=0.02 if legs > 0.05 else 0)
    parts = moved(parts, 0, depth / 2)
    side = random.uniform(0, 0.3) * width
    parts.append(cushion(width - side - 0.06, 0.08, height * 0.85, -side / 2, 0, legs + height * 0.08))
    if side > 0.06:
        parts += [box(0.03, 0.03, 0.03, (width - side) / 2, -0.01, legs + height * z) for z in (0.3, 0.5, 0.7)]
    if random.random() < 0.4:
        top = legs + height
        parts += [
            rod((0, depth / 2, top), (s * random.uniform(0.1, 0.25), depth / 2, top + random.uniform(0.15, 0.3)), 0.005)
            for s in (-1, 1)
        ]
    return parts


def monitor_tube_swivel(random: Random) -> Parts:
    """A computer's tube monitor: rounded front, a stepped or tapering back, on a swivel foot."""
    width = random.uniform(0.35, 0.48)
    height = width * random.uniform(0.78, 0.92)
    depth = width * random.uniform(0.8, 1.05)
    lift = random.uniform(0.03, 0.07)
    front = random.uniform(0.1, 0.2)
    parts = [
        rounded(box(width, front, height, 0, front / 2, lift), 0.02),
        cushion(width * 0.86, 0.04, height * 0.8, 0, 0, lift + height * 0.12),
    ]
    share = random.uniform(0.5, 0.75)
    levels = [
        (width * 0.48, height * 0.48, 0, 0, front),
        (width * 0.46, height * 0.45, 0, 0, front + depth * 0.3),
        (width * share / 2, height * share / 2, 0, -height * 0.03, depth),
    ]
    back = upturned(loft(superellipse(7), levels), 0, lift + height / 2)
    return [
        *parts,
        back,
        turned(
            [(width * 0.36, 0), (width * 0.34, lift * 0.4), (width * 0.2, lift * 0.5), (width * 0.2, lift * 1.3)],
            0,
            depth * 0.4,
        ),
    ]
