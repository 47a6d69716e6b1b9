"""Beds of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.beds import bed_size
from data_pipeline.objects.furniture.families.parts import (
    around,
    bent,
    crested,
    cushion,
    draws,
    moved,
    rounded,
    sheet,
    tube,
    turned,
)
from data_pipeline.objects.furniture.solids import Parts, Random, box, drawers, four_legs, rod, tilt


def _made(random: Random, width: float, length: float, base: float, thick: float) -> Parts:
    """A soft mattress with pillows, and a blanket that hangs over its sides, is turned down, folded, or absent."""
    top = base + thick
    parts = [rounded(box(width * 0.97, length * 0.97, thick, 0, 0, base), random.uniform(0.02, 0.09))]
    count, style = (2 if width > 1.2 else 1), random.integers(4)
    for _ in range(int(random.integers(1, 3))):
        y = length / 2 - random.uniform(0.2, 0.45)
        xs = (np.arange(count) - (count - 1) / 2) * width * 0.46
        parts += tilt(
            [cushion(min(0.65, width * 0.8), random.uniform(0.35, 0.45), 0.15, x, y, top - 0.03) for x in xs],
            random.uniform(-0.9, 0),
            (0, y, top),
        )
    if style == 0:
        drop, cover = random.uniform(0.1, 0.9) * base, length * random.uniform(0.5, 0.8)
        parts.append(rounded(box(width * 1.04, cover, thick + drop + 0.03, 0, (cover - length) / 2, base - drop), 0.04))
    elif style == 1:
        parts.append(cushion(width, length * 0.25, 0.14, 0, -length * 0.3, top - 0.02))
    elif style == 2:
        along, across = np.linspace(-0.5, 0.28, 9) * length, np.linspace(-0.5, 0.5, 9) * width * 1.03
        v, u = np.meshgrid(along, across, indexing="ij")
        folds = random.uniform(0.0, 0.025) * np.sin(u * random.uniform(3, 9) + v * random.uniform(3, 9))
        parts.append(sheet(np.stack([u, v, top + 0.03 + folds], axis=-1), 0.03))
    return parts


def _end(random: Random, width: float, height: float) -> Parts:
    """A head or foot board from the floor upwards, in one of seven styles."""
    style, r = random.integers(7), random.uniform(0.015, 0.03)
    posts = [
        turned([(r * 1.6, 0), (r * 1.4, height * 0.9), (r * 2, height * 0.95), (r, height * 1.03)], s * width / 2)
        for s in (-1, 1)
    ]
    if style == 0:  # rounded frame of metal bars
        t = np.linspace(0, np.pi, 11)
        curve = np.c_[-width / 2 * np.cos(t), np.zeros(11), height * (0.75 + 0.25 * np.sin(t))]
        xs = np.linspace(-0.42, 0.42, int(random.integers(5, 10))) * width
        bars = [
            rod((x, 0, height * 0.35), (x, 0, height * (0.75 + 0.25 * np.sqrt(1 - (2 * x / width) ** 2))), r * 0.5)
            for x in xs
        ]
        return [
            tube(np.r_[[(-width / 2, 0, 0)], curve, [(width / 2, 0, 0)]], r),
            *bars,
            rod((-width / 2, 0, height * 0.35), (width / 2, 0, height * 0.35), r * 0.7),
        ]
    if style == 1:
        return [crested(width, height, random.uniform(0.03, 0.06), random.uniform(0.15, 0.4)), *posts]
    if style == 2:  # upholstered in squares
        columns, rows = int(random.integers(2, 6)), int(random.integers(1, 4))
        w, h = width / columns, height * 0.6 / rows
        pads = [
            rounded(box(w, 0.1, h, (c - (columns - 1) / 2) * w, -0.04, height * 0.4 + row * h), 0.045)
            for c in range(columns)
            for row in range(rows)
        ]
        return [box(width, 0.05, height), *pads]
    if style == 3:  # horizontal bars
        return [
            *posts,
            *[
                rod((-width / 2, 0, z), (width / 2, 0, z), r * 0.7)
                for z in np.linspace(0.4, 0.95, int(random.integers(2, 6))) * height
            ],
        ]
    if style == 4:  # frame and panels
        panels, rail = int(random.integers(1, 4)), 0.09
        parts = [box(width, 0.05, rail, 0, 0, z) for z in (height * 0.3, height - rail)]
        xs = np.linspace(-width / 2, width / 2, panels + 1)
        return [*parts, box(width, 0.02, height * 0.65, 0, 0, height * 0.32), *[box(0.07, 0.05, height, x) for x in xs]]
    if style == 5:  # spindles
        xs = np.linspace(-0.47, 0.47, int(random.integers(7, 13))) * width
        return [
            *posts,
            *[box(0.025, 0.02, height * 0.6, x, 0, height * 0.35) for x in xs],
            *[box(width, 0.045, 0.06, 0, 0, z) for z in (height * 0.3, height * 0.92)],
        ]
    return [box(width * random.uniform(1, 1.15), random.uniform(0.04, 0.14), height)]


def _frame(width: float, length: float, base: float, thick: float = 0.14) -> Parts:
    return [
        box(width, length, 0.06, 0, 0, base - 0.06),
        *[box(0.03, length, thick, s * width / 2, 0, base - thick + 0.03) for s in (-1, 1)],
    ]


def bed_made(random: Random) -> Parts:
    """A made bed between two boards of one or of two styles, or with a head board alone."""
    width, length, base, thick = bed_size(random)
    head, state = base + thick + random.uniform(0.2, 0.75), int(random.integers(2**31))
    parts = [*_frame(width, length, base), *_made(random, width, length, base, thick)]
    parts += moved(_end(np.random.default_rng(state), width + 0.06, head), 0, length / 2 + 0.03)
    if random.random() < 0.65:
        foot = base + thick * random.uniform(0, 1) + random.uniform(0.05, 0.3)
        return parts + moved(_end(np.random.default_rng(state), width + 0.06, foot), 0, -length / 2 - 0.03)
    return parts + four_legs(width, length, base, 0.06)


def bed_divan(random: Random) -> Parts:
    """A closed base on the floor with a thick mattress, a blanket and mostly a head board that may be wider."""
    width, length, base, thick = bed_size(random)
    base = random.uniform(0.15, 0.38)
    parts = [rounded(box(width, length, base), 0.03), *_made(random, width, length, base, thick)]
    if random.random() < 0.75:
        wide, head = width * random.uniform(1, 1.3), base + thick + random.uniform(0.15, 0.7)
        parts += moved(_end(random, wide, head), 0, length / 2 + 0.05)
        if wide > width * 1.2 and random.random() < 0.5:
            parts += [box(0.4, 0.35, base + 0.05, s * (width / 2 + 0.22), length / 2 - 0.15) for s in (-1, 1)]
    return parts


def bed_sleigh(random: Random) -> Parts:
    """Head and foot roll outwards like those of a sleigh."""
    width, length, base, thick = bed_size(random)
    parts = [*_frame(width, length, base, 0.22), *_made(random, width, length, base, thick)]
    for s, rise in ((1, random.uniform(0.3, 0.6)), (-1, random.uniform(0.05, 0.35))):
        top, y = base + thick + rise, length / 2
        line = [
            (s * (y + d), z * top)
            for d, z in ((0.02, 0), (0.02, 0.5), (0.06, 0.75), (0.14, 0.93), (0.22, 1), (0.27, 0.94))
        ]
        parts.append(bent(line, width + 0.06, 0.05))
    return parts


def bed_canopy(random: Random) -> Parts:
    """Posts with a roof, flat or curved, or half a roof on the side of the head."""
    width, length, base, thick = bed_size(random)
    height, r = draws(random, (1.8, 2.2), (0.02, 0.04))
    parts = [
        *_frame(width, length, base),
        *_made(random, width, length, base, thick),
        *moved(_end(random, width, base + thick + 0.5), 0, length / 2 + 0.03),
    ]
    share = float(random.choice([1.0, random.uniform(0.35, 0.6)]))
    y = np.linspace(0.5 - share, 0.5, 7) * length
    roof = bent([(v, height + 0.15 * (share == 1) * np.sin(np.pi * (v / length + 0.5))) for v in y], width + 0.1, 0.03)
    parts += [roof, *[rod((s * width / 2, length / 2, 0), (s * width / 2, length / 2, height), r) for s in (-1, 1)]]
    foot = height if share == 1 else base + thick + 0.2
    return parts + [rod((s * width / 2, -length / 2, 0), (s * width / 2, -length / 2, foot), r) for s in (-1, 1)]


def bed_crib(random: Random) -> Parts:
    """A cot with bars on all sides, on legs, castors or rockers, with or without closed ends."""
    width, length, rise = draws(random, (0.55, 0.75), (0.85, 1.4), (0.45, 0.6))
    base, ends_closed = random.uniform(0.25, 0.45), random.random() < 0.5
    top, count, rocking = base + rise, int(random.integers(7, 15)), random.random() < 0.4
    parts = [
        box(width, length, 0.03, 0, 0, base),
        cushion(width * 0.95, length * 0.95, 0.1, 0, 0, base + 0.02),
        *four_legs(width + 0.04, length + 0.04, top + 0.03, 0.05),
    ]
    for s in (-1, 1):
        x, y = s * width / 2, s * length / 2
        parts += [box(0.03, length, 0.04, x, 0, z) for z in (base - 0.03, top - 0.04)]
        parts += [rod((x, v, base), (x, v, top - 0.02), 0.008) for v in np.linspace(-0.46, 0.46, count) * length]
        if ends_closed:
            parts += moved([crested(width, top + 0.1 - base, 0.03)], 0, y, base - 0.04)
        else:
            parts += [box(width, 0.03, 0.04, 0, y, z) for z in (base - 0.03, top - 0.04)]
            parts += [rod((v, y, base), (v, y, top - 0.02), 0.008) for v in np.linspace(-0.4, 0.4, count // 2) * width]
        if rocking:
            t = np.linspace(-1, 1, 7)
            parts.append(tube(np.c_[0.48 * t * 1.1, np.full(7, y), 0.1 * t**2 - 0.05], 0.018))
    return parts


def bed_futon(random: Random) -> Parts:
    """A thick mat on the floor or on slats, with or without a low backrest at the head."""
    width, length = draws(random, (0.9, 1.8), (1.85, 2.1))
    base = float(random.choice([0.02, random.uniform(0.08, 0.2)]))
    parts = (
        [box(width * 1.05, 0.07, 0.03, 0, y, base - 0.02) for y in np.linspace(-0.46, 0.46, 9) * length]
        if base > 0.05
        else []
    )
    parts += [
        *_made(random, width, length, base, random.uniform(0.12, 0.22)),
        *[box(0.07, length, base, x) for x in (-0.4 * width, 0.4 * width)],
    ]
    if random.random() < 0.3:
        parts += moved(_end(random, width * 1.1, random.uniform(0.4, 0.7)), 0, length / 2 + 0.05)
    return parts


def bed_drawers(random: Random) -> Parts:
    """A captain's bed: drawers along its sides, a head board with shelves or none."""
    width, length, base, thick = bed_size(random)
    base = random.uniform(0.35, 0.55)
    parts = [box(width, length, base), *_made(random, width, length, base, thick)]
    for s in (-1, 1):
        parts += moved(
            drawers(
                random,
                length * 0.9,
                base - 0.06,
                int(random.integers(1, 3)),
                int(random.integers(2, 4)),
                0,
                -width / 2,
                0.03,
            ),
            turn=s * np.pi / 2,
        )
    if random.random() < 0.7:
        head = base + thick + random.uniform(0.3, 0.6)
        parts += [
            box(width, 0.02, head, 0, length / 2 + 0.25),
            *[box(0.03, 0.25, head, x, length / 2 + 0.13) for x in (-width / 2, 0, width / 2)],
        ]
        parts += [box(width, 0.25, 0.03, 0, length / 2 + 0.13, z) for z in (head, base + thick)]
    return parts


def bed_hospital(random: Random) -> Parts:
    """A mattress in three parts, the head raised, on a lifting frame with castors and side rails."""
    width, base = draws(random, (0.85, 1.0), (0.45, 0.65))
    lift, knee = draws(random, (0, 0.9), (0, 0.35))
    lengths, line = (0.75, 0.5, 0.75), [(-1.0, base)]
    for length, angle in zip(lengths, (-knee * 0.6, knee, lift), strict=True):
        y, z = line[-1]
        line.append((y + length * np.cos(angle), max(z + length * np.sin(angle), base)))
    parts = [
        bent(line, width, 0.15),
        cushion(width * 0.7, 0.4, 0.1, 0, line[-1][0] - 0.25, line[-1][1] - 0.1 * (lift > 0.4) + 0.05),
    ]
    parts += [box(0.04, 1.95, 0.06, s * width * 0.45, 0, base - 0.2) for s in (-1, 1)]
    parts += [
        turned([(0.03, 0), (0.05, 0.02), (0.05, 0.1), (0.02, 0.12), (0.02, base - 0.15)], s * width * 0.42, t * 0.85)
        for s in (-1, 1)
        for t in (-1, 1)
    ]
    for y, height in ((1.02, base + 0.5), (-1.02, base + 0.35)):
        parts.append(rounded(box(width, 0.04, height - base * 0.6, 0, y, base * 0.6), 0.018))
    for s in (-1, 1):
        if random.random() < 0.7:
            x = s * (width / 2 + 0.03)
            parts += [rod((x, -0.4, base + z), (x, 0.6, base + z), 0.014) for z in (0.15, 0.28, 0.4)]
            parts += [rod((x, y, base - 0.1), (x, y, base + 0.4), 0.014) for y in (-0.4, 0.1, 0.6)]
    return parts


def bed_loft(random: Random) -> Parts:
    """A bed on high legs with rails, a ladder, and sometimes a desk below."""
    width, length, base = draws(random, (0.85, 1.1), (1.9, 2.05), (1.2, 1.6))
    parts = [
        *_frame(width, length, base),
        *_made(random, width, length, base, 0.14),
        *four_legs(width + 0.08, length + 0.08, base + 0.4, 0.07),
    ]
    for s in (-1, 1):
        parts += [
            box(0.03, length * (1 if s > 0 else 0.7), 0.08, s * width / 2, 0.15 * length * (s < 0), base + z)
            for z in (0.16, 0.32)
        ]
        parts.append(box(width, 0.03, 0.25, 0, s * length / 2, base + 0.14))
    x, slope = -width / 2 - 0.03, random.uniform(0, 0.35)
    parts += [rod((x - slope, y, 0), (x, y, base + 0.3), 0.02) for y in (-length * 0.45, -length * 0.27)]
    parts += [
        rod((x - slope * (1 - z / base), -length * 0.45, z), (x - slope * (1 - z / base), -length * 0.27, z), 0.015)
        for z in np.arange(0.25, base, 0.27)
    ]
    return parts + ([box(width * 0.6, length, 0.03, width * 0.2, 0, 0.72)] if random.random() < 0.4 else [])


def bed_round(random: Random) -> Parts:
    """A round or oval bed, with a curved head board."""
    width, base, thick = draws(random, (1.7, 2.2), (0.2, 0.32), (0.18, 0.26))
    parts = [
        turned([(width * 0.45, 0), (width * 0.5, base)]),
        turned([(width * 0.48, base), (width * 0.49, base + thick * 0.8), (width * 0.45, base + thick)]),
    ]
    parts += [cushion(0.6, 0.4, 0.15, x, width * 0.27, base + thick - 0.03) for x in (-0.34, 0.34)]
    if random.random() < 0.7:
        low = random.uniform(0.05, 0.9)
        parts.append(
            around(
                width * 1.06,
                width * 1.06,
                (base + thick) * low,
                base + thick + random.uniform(0.2, 0.5),
                0.07,
                random.uniform(0.9, 1.9),
            )
        )
    return parts
