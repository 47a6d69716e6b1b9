"""Beds."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.solids import Parts, Random, box, four_legs


def _mattress(random: Random, width: float, length: float, base: float, thickness: float) -> Parts:
    """A mattress with pillows and, with probability 0.4, a blanket; `base` is the height of its lower side."""
    parts = [box(width * 0.97, length * 0.97, thickness, 0, 0, base)]
    pillows = 2 if width > 1.2 else 1
    for pillow in range(pillows):
        x = (pillow - (pillows - 1) / 2) * width * 0.46
        parts.append(box(width * (0.4 if pillows == 2 else 0.7), 0.35, 0.1, x, length / 2 - 0.28, base + thickness))
    if random.random() < 0.4:
        parts.append(box(width * 1.01, length * 0.55, 0.04, 0, -length * 0.2, base + thickness))
    return parts


def bed_size(random: Random) -> tuple[float, float, float, float]:
    """Draws the width (single or double), the length, the height of the mattress's lower side, and its thickness."""
    width = float(random.choice([random.uniform(0.85, 1.1), random.uniform(1.35, 1.9)]))
    return width, random.uniform(1.9, 2.15), random.uniform(0.2, 0.4), random.uniform(0.15, 0.28)


def bed_platform(random: Random) -> Parts:
    """A platform on short legs, with or without a headboard."""
    width, length, base, thickness = bed_size(random)
    head = random.uniform(0.0, 0.6)
    parts = [
        box(width + 0.1, length + 0.1, base * 0.6, 0, 0, base * 0.4),
        *_mattress(random, width, length, base, thickness),
    ]
    parts += four_legs(width, length, base * 0.4, 0.1, 0.05)
    if head > 0.15:
        parts.append(box(width + 0.1, 0.07, base + thickness + head, 0, length / 2 + 0.06))
    return parts


def bed_boards(random: Random) -> Parts:
    """A bed with a head and a foot board, each a panel or a rail with spindles."""
    width, length, base, thickness = bed_size(random)
    head, foot = random.uniform(0.3, 0.8), random.uniform(0.05, 0.35)
    parts = [box(width, length, 0.12, 0, 0, base - 0.12), *_mattress(random, width, length, base, thickness)]
    for y, rise in ((length / 2 + 0.03, head), (-length / 2 - 0.03, foot)):
        top = base + thickness + rise
        if random.random() < 0.5:
            parts.append(box(width, 0.06, top - base * 0.5, 0, y, base * 0.5))
        else:  # rails and spindles
            parts.append(box(width, 0.05, 0.07, 0, y, top - 0.07))
            parts += [box(0.03, 0.03, top - base, x, y, base) for x in np.linspace(-width / 2, width / 2, 9)]
        parts += [box(0.07, 0.07, top, sx * width / 2, y) for sx in (-1, 1)]
    return parts


def bed_four_poster(random: Random) -> Parts:
    """Four high posts, usually with rails between their tops."""
    width, length, base, thickness = bed_size(random)
    height = random.uniform(1.6, 2.1)
    parts = [box(width, length, 0.14, 0, 0, base - 0.14), *_mattress(random, width, length, base, thickness)]
    parts += four_legs(width + 0.1, length + 0.1, height, random.uniform(0.06, 0.1))
    if random.random() < 0.7:
        for side in (-1, 1):
            parts.append(box(0.05, length, 0.05, side * width / 2, 0, height - 0.05))
            parts.append(box(width, 0.05, 0.05, 0, side * length / 2, height - 0.05))
    parts.append(box(width, 0.05, 0.6, 0, length / 2, base))
    return parts


def bed_bunk(random: Random) -> Parts:
    """Two beds above each other with a ladder."""
    width, length = random.uniform(0.9, 1.1), random.uniform(1.9, 2.1)
    lower, upper = random.uniform(0.25, 0.4), random.uniform(1.2, 1.5)
    parts = four_legs(width + 0.1, length + 0.1, upper + 0.55, 0.08)
    for base in (lower, upper):
        parts += [box(width, length, 0.1, 0, 0, base - 0.1), *_mattress(random, width, length, base, 0.15)]
    for side in (-1, 1):
        parts.append(box(0.04, length, 0.12, side * width / 2, 0, upper + 0.28))
        parts.append(box(width, 0.04, 0.12, 0, side * length / 2, upper + 0.28))
    y = -length / 2 + 0.25
    parts += [box(0.03, 0.35, 0.03, -width / 2 - 0.06, y, z) for z in np.linspace(0.3, upper + 0.2, 5)]
    return parts


def bed_day(random: Random) -> Parts:
    """A day bed: boards on both ends and along one side."""
    width, length, base, thickness = random.uniform(0.85, 1.05), random.uniform(1.9, 2.1), 0.35, 0.2
    rise = random.uniform(0.35, 0.55)
    parts = [box(width, length, 0.2, 0, 0, base - 0.2), *_mattress(random, width, length, base, thickness)]
    parts.append(box(0.06, length, base + thickness + rise, width / 2 + 0.03))
    for side in (-1, 1):
        parts.append(box(width, 0.06, base + thickness + rise * 0.7, 0, side * (length / 2 + 0.03)))
    return parts


BEDS = (bed_platform, bed_boards, bed_four_poster, bed_bunk, bed_day)
