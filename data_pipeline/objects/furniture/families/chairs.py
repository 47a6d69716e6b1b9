"""Chairs of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.families.chair_parts import (
    arch,
    arms_of,
    back,
    chair_size,
    legs_of,
    seat_of,
    stretchers,
)
from data_pipeline.objects.furniture.families.parts import (
    CIRCLE,
    HALF_ROUND,
    around,
    bent,
    crested,
    cushion,
    draws,
    loft,
    moved,
    pedestal,
    prism,
    star,
    superellipse,
    tube,
)
from data_pipeline.objects.furniture.solids import Parts, Random, box, four_legs, rod, tilt


def _placed_back(random: Random, width: float, depth: float, seat: float, height: float, lean: float = 0.22) -> Parts:
    y = depth / 2 - 0.03
    return tilt(moved(back(random, width, height), 0, y, seat - 0.03), random.uniform(0.03, lean), (0, y, seat))


def chair_framed(random: Random) -> Parts:
    """A side chair: any seat, legs and back."""
    width, depth, seat, rise = chair_size(random)
    return [
        *seat_of(random, width, depth, seat),
        *legs_of(random, width, depth, seat - 0.03),
        *_placed_back(random, width, depth, seat, rise),
    ]


def chair_carver(random: Random) -> Parts:
    """The same with armrests."""
    width, depth, seat, rise = chair_size(random)
    parts = [*seat_of(random, width + 0.05, depth, seat), *legs_of(random, width + 0.05, depth, seat - 0.03)]
    return [*parts, *_placed_back(random, width + 0.05, depth, seat, rise), *arms_of(random, width + 0.05, depth, seat)]


def chair_bentwood(random: Random) -> Parts:
    """A round seat on thin splayed legs, a hoop as back or as back and arms."""
    width, _, seat, rise = chair_size(random)
    r = random.uniform(0.011, 0.016)
    parts = [prism(CIRCLE, width, width, 0.035, 0, 0, seat - 0.035)]
    parts += four_legs(width * 0.66, width * 0.66, seat, r * 2.2, splay=random.uniform(0.02, 0.07))
    parts.append(tube(np.c_[CIRCLE * width * 0.36, np.full(28, seat * 0.4)], r * 0.7))
    if random.random() < 0.5:  # a hoop around back and sides
        t = np.linspace(-0.5, np.pi + 0.5, 17)
        z = seat + rise * (0.55 + 0.35 * np.clip(np.sin(t), 0, 1))
        hoop = np.c_[width * 0.58 * np.cos(t), width * 0.5 * np.sin(t), z]
        parts.append(tube(hoop, r))
        parts += [rod((x * 0.8, y * 0.8, seat), (x, y, height), r * 0.8) for x, y, height in hoop[[1, 5, 8, 11, 15]]]
        return parts
    for share in (1.0, random.uniform(0.5, 0.75)):
        loop = [
            (-0.4 * share * width, 0, 0),
            *arch(width * 0.84 * share, rise * 0.35 * share, rise * 0.65 * share),
            (0.4 * share * width, 0, 0),
        ]
        parts += tilt(moved([tube(loop, r)], 0, width * 0.42, seat - 0.02), 0.15, (0, width * 0.42, seat))
    return parts


def chair_shell(random: Random) -> Parts:
    """Seat and back are one bent shell, on legs, a sled, a star or a trumpet."""
    width, depth, seat, rise = chair_size(random)
    bow = random.uniform(0.0, 0.09)
    profile = [(-depth / 2, seat - 0.02), (-depth * 0.3, seat), (0.1 * depth, seat - 0.02), (depth * 0.4, seat + 0.02)]
    profile += [(depth * 0.5, seat + rise * 0.25), (depth * 0.58, seat + rise * 0.6), (depth * 0.66, seat + rise)]
    shell = bent(profile, width, random.uniform(0.012, 0.04), -bow, random.uniform(0.75, 1.05))
    base = random.integers(3)
    if base == 0:
        support = pedestal(random, random.uniform(0.22, 0.3), seat - 0.03)
    elif base == 1:
        support = star(random.uniform(0.25, 0.32), seat - 0.02, int(random.integers(4, 6)), random.random() < 0.7)
    else:
        support = legs_of(random, width * 0.9, depth * 0.9, seat - 0.02)
    arms = arms_of(random, width, depth, seat) if random.random() < 0.25 else []
    pad = [cushion(width * 0.85, depth * 0.8, 0.06, 0, -0.02, seat - 0.01)] if random.random() < 0.4 else []
    return [shell, *support, *arms, *pad]


def chair_bucket(random: Random) -> Parts:
    """A bucket whose rim rises from the front to the back, on legs, a trumpet or a star."""
    width, depth, seat, rise = draws(random, (0.55, 0.78), (0.5, 0.65), (0.38, 0.46), (0.32, 0.5))
    wall = around(
        width, depth, rise * random.uniform(0.15, 0.6), rise, random.uniform(0.015, 0.06), random.uniform(0.5, 1.0)
    )
    flare = 1 + random.uniform(0, 0.35) * wall.vertices[:, 2:] / rise
    wall.vertices = wall.vertices * np.c_[flare, flare, np.ones(len(flare))]
    bowl = loft(
        CIRCLE,
        [
            (width * 0.25, depth * 0.25, 0, 0, seat - 0.14),
            (width * 0.45, depth * 0.45, 0, 0, seat - 0.08),
            (width * 0.5, depth * 0.5, 0, 0, seat),
        ],
    )
    parts = [*moved([wall], 0, 0, seat - 0.02), bowl, prism(CIRCLE, width * 0.9, depth * 0.9, 0.06, 0, -0.01, seat)]
    if random.random() < 0.5:
        return parts + pedestal(random, random.uniform(0.22, 0.32), seat - 0.1)
    return parts + four_legs(
        width * 0.56, depth * 0.56, seat - 0.08, random.uniform(0.025, 0.04), splay=random.uniform(0, 0.08)
    )


def chair_club(random: Random) -> Parts:
    """A fat upholstered armchair: arms as rolls, cushions or boxes."""
    width, depth, seat = draws(random, (0.5, 0.65), (0.75, 0.92), (0.38, 0.46))
    rise, arm, feet = draws(random, (0.35, 0.5), (0.13, 0.22), (0.03, 0.14))
    parts = [
        box(width, depth * 0.95, seat - 0.12 - feet, 0, 0, feet),
        *four_legs(width + 2 * arm, depth, feet, 0.05, 0.03),
    ]
    parts.append(cushion(width, depth * 0.8, 0.18, 0, -depth * 0.1, seat - 0.14))
    parts += tilt(
        [cushion(width + arm * random.uniform(0, 1.6), 0.24, rise + 0.1, 0, depth * 0.36, seat - 0.1)],
        random.uniform(0.05, 0.25),
        (0, depth * 0.36, seat),
    )
    style, top = random.integers(3), random.uniform(0.12, 0.24)
    for s in (-1, 1):
        x = s * (width + arm) / 2
        if style == 0:
            parts += [box(arm * 0.8, depth * 0.95, seat + top - feet - arm * 0.3, x, 0, feet)]
            parts.append(
                rod(
                    (x * 1.04, -depth / 2, seat + top - arm * 0.3),
                    (x * 1.04, depth * 0.45, seat + top - arm * 0.3),
                    arm * 0.6,
                )
            )
        elif style == 1:
            parts.append(cushion(arm, depth, seat + top - feet, x, 0, feet))
        else:
            parts.append(box(arm * 0.7, depth, seat + top - feet, x, 0, feet))
    return parts


def chair_wing(random: Random) -> Parts:
    """A high back with wings, upholstered arms and short legs."""
    width, depth, seat, rise = draws(random, (0.52, 0.64), (0.6, 0.78), (0.4, 0.46), (0.6, 0.78))
    feet = random.uniform(0.1, 0.2)
    parts = [box(width, depth, seat - 0.1 - feet, 0, 0, feet), *four_legs(width + 0.1, depth, feet, 0.045, 0.02)]
    parts.append(cushion(width, depth * 0.9, 0.15, 0, -0.05, seat - 0.1))
    upper = [cushion(width, 0.14, rise + 0.05, 0, depth / 2 - 0.07, seat - 0.05)]
    for s in (-1, 1):
        x = s * (width / 2 + 0.03)
        reach = random.uniform(0.2, 0.32)
        upper.append(box(0.07, reach, rise * 0.8, x, depth / 2 - reach / 2, seat + rise * 0.17))
        parts.append(cushion(0.13, depth * 0.9, seat + 0.22 - feet, x * 1.08, -0.02, feet))
    return parts + tilt(upper, random.uniform(0.05, 0.2), (0, depth / 2, seat))


def chair_folding(random: Random) -> Parts:
    """Legs that cross at the sides, flat seat, and a back on one pair of them, or none."""
    width, depth, seat, rise = chair_size(random)
    r, reach = random.uniform(0.009, 0.015), depth * random.uniform(0.42, 0.55)
    parts: Parts = [
        bent([(-depth * 0.45, seat), (0, seat - 0.03 * random.random()), (depth * 0.45, seat)], width * 0.95, 0.02)
    ]
    high = random.random() < 0.7
    for s in (-1, 1):
        x = s * width / 2
        parts.append(rod((x, reach, 0), (x, -depth * 0.45, seat), r))
        top = (x, depth * 0.62, seat + rise) if high else (x, depth * 0.45, seat)
        parts.append(tube([(x, -reach, 0), (x, depth * 0.42, seat), top], r))
    parts += [rod((-width / 2, s * reach, 0.03), (width / 2, s * reach, 0.03), r) for s in (-1, 1)]
    if high:
        y = depth * 0.55
        parts.append(bent([(y, seat + rise * random.uniform(0.4, 0.7)), (y + 0.03, seat + rise)], width, 0.02, 0.02))
    return parts


def chair_director(random: Random) -> Parts:
    """Crossed legs across the front, a sling seat and a sling back, flat arms."""
    width, depth, seat = draws(random, (0.5, 0.6), (0.38, 0.46), (0.42, 0.6))
    rise, r = random.uniform(0.35, 0.45), 0.016
    x, y = width / 2, depth / 2
    parts: Parts = [bent([(-y, seat), (y, seat)], width, 0.012, 0)]
    for s in (-1, 1):
        parts += [rod((-x, s * y, 0), (x, s * y, seat), r), rod((x, s * y, 0), (-x, s * y, seat), r)]
        parts += [box(0.03, depth + 0.08, 0.03, s * x), box(0.055, depth + 0.1, 0.025, s * x, 0, seat + 0.2)]
        parts += [rod((s * x, -y, seat), (s * x, -y, seat + 0.2), r), rod((s * x, y, seat), (s * x, y, seat + rise), r)]
    return [*parts, bent([(y, seat + rise - 0.18), (y, seat + rise)], width, 0.012, 0.04)]


def chair_deck(random: Random) -> Parts:
    """A sling between two frames that lean against each other."""
    width, length, height = draws(random, (0.52, 0.66), (0.9, 1.15), (0.75, 0.95))
    r, sag = draws(random, (0.013, 0.02), (0.06, 0.16))
    low, high = (-length / 2, 0.28), (length / 2, height)
    parts: Parts = []
    for s in (-1, 1):
        x = s * width / 2
        parts += [
            rod((x, -length * 0.5, 0.3), (x, length * 0.35, 0), r),
            rod((x * 0.94, -length * 0.25, 0), (x * 0.94, *high), r),
        ]
        if random.random() < 0.4:
            parts.append(box(0.06, length * 0.55, 0.03, x * 1.08, 0, 0.5))
    t = np.linspace(0, 1, 8)
    line = [
        (low[0] + (high[0] - low[0]) * v, low[1] + (high[1] - low[1]) * v**1.3 - sag * np.sin(np.pi * v)) for v in t
    ]
    return [
        *parts,
        bent(line, width * 0.9, 0.012),
        rod((-width / 2, *high), (width / 2, *high), r),
        rod((-width / 2, *low), (width / 2, *low), r),
    ]


def chair_lounger(random: Random) -> Parts:
    """A reclining seat with a leg rest in one curve, on a frame or a sled."""
    width, length = draws(random, (0.52, 0.7), (1.45, 1.9))
    line = [(-0.5, 0.36), (-0.3, 0.4), (-0.12, 0.46), (0.02, 0.36), (0.12, 0.34), (0.3, 0.5), (0.5, 0.8)]
    profile = [(y * length, z * random.uniform(0.9, 1.05)) for y, z in line]
    parts: Parts = [bent(profile, width, random.uniform(0.03, 0.1))]
    for s in (-1, 1):
        x = s * width * 0.45
        parts += [tube([(x, y, z - 0.03) for y, z in profile], 0.014), box(0.03, length * 0.5, 0.03, x, 0, 0)]
        parts += [rod((x, y * length, 0), (x, y * length, z), 0.014) for y, z in ((-0.2, 0.42), (0.22, 0.4))]
    if random.random() < 0.6:
        parts.append(
            rod(
                (-width * 0.42, profile[-1][0] - 0.05, profile[-1][1]),
                (width * 0.42, profile[-1][0] - 0.05, profile[-1][1]),
                0.06,
            )
        )
    return parts


def chair_easy(random: Random) -> Parts:
    """A low seat and back of slats or sling, in a frame of bent wood or tube whose sides are the arms."""
    width, depth, seat, rise = draws(random, (0.55, 0.68), (0.65, 0.8), (0.34, 0.4), (0.45, 0.6))
    r, y = random.uniform(0.014, 0.026), depth / 2
    parts: Parts = []
    for s in (-1, 1):
        x, arm = s * width * 0.54, seat + random.uniform(0.18, 0.24)
        loop = [(x, y * 0.9, r), (x, -y, r), (x, -y * 1.12, seat * 0.5), (x, -y, arm), (x, 0, arm + 0.02), (x, y, arm)]
        parts += [tube(loop, r), rod((x, y, arm), (x, y * 0.9, 0), r)]
    lean = [(y * 0.55, seat - 0.05), (y * 0.9, seat + rise * 0.5), (y * 1.15, seat + rise)]
    if random.random() < 0.5:
        parts += [bent([(-y, seat + 0.05), (y * 0.4, seat - 0.04), *lean], width, random.uniform(0.015, 0.1))]
    else:
        parts += [
            cushion(width, depth * 0.9, 0.13, 0, -0.05, seat - 0.1),
            *tilt([cushion(width, 0.14, rise, 0, y * 0.75, seat)], 0.3, (0, y * 0.75, seat)),
        ]
    return [
        *parts,
        rod((-width * 0.54, -y, seat * 0.9), (width * 0.54, -y, seat * 0.9), r * 0.8),
        rod((-width * 0.54, y * 0.9, seat * 0.7), (width * 0.54, y * 0.9, seat * 0.7), r * 0.8),
    ]


def _stool_top(random: Random, width: float, seat: float) -> Parts:
    kind = random.integers(4)
    if kind == 3:
        return [cushion(width, width, 0.09, 0, 0, seat - 0.08)]
    outline = (CIRCLE, superellipse(6), HALF_ROUND)[kind]
    return [prism(outline, width, width * random.uniform(0.8, 1), random.uniform(0.03, 0.07), 0, 0, seat - 0.04)]


def chair_stool(random: Random) -> Parts:
    """A stool without back, low or high, on three or four legs with rings of stretchers."""
    width, seat = random.uniform(0.3, 0.42), float(random.choice([random.uniform(0.42, 0.5), random.uniform(0.6, 0.8)]))
    side, splay = width * 0.66, random.uniform(0, 0.09)
    parts = [
        *_stool_top(random, width, seat),
        *four_legs(side, side, seat - 0.02, random.uniform(0.025, 0.045), splay=splay),
    ]
    for z in (0.25, 0.55)[: 1 + int(seat > 0.55)]:
        spread = side + 2 * splay * (1 - z) - 0.03
        parts += stretchers(spread, spread, seat * z)
    return parts


def chair_bar(random: Random) -> Parts:
    """A bar stool on a column with a foot rest, with or without a low back."""
    width, seat = draws(random, (0.33, 0.44), (0.6, 0.8))
    parts = [*_stool_top(random, width, seat), *pedestal(random, random.uniform(0.19, 0.25), seat - 0.03)]
    ring = np.c_[CIRCLE * random.uniform(0.12, 0.18), np.full(28, seat * random.uniform(0.3, 0.45))]
    parts += [tube(ring, 0.011), rod((-0.13, 0, ring[0, 2]), (0.13, 0, ring[0, 2]), 0.01)]
    if random.random() < 0.6:
        low = random.uniform(0.0, 0.08)
        parts.append(
            bent(
                [(width * 0.4, seat + low), (width * 0.5, seat + random.uniform(0.18, 0.32))], width * 0.95, 0.025, 0.08
            )
        )
    return parts


def chair_rocking(random: Random) -> Parts:
    """A chair with arms on two curved runners."""
    width, depth, seat, rise = chair_size(random)
    parts = [
        *seat_of(random, width, depth, seat),
        *_placed_back(random, width, depth, seat, rise * 1.25, 0.35),
        *arms_of(random, width, depth, seat),
    ]
    parts += four_legs(width, depth, seat - 0.02, 0.035, 0.02) + stretchers(width * 0.9, depth * 0.85, seat * 0.5)
    t = np.linspace(-1, 1, 9)
    return parts + [
        tube(np.c_[np.full(9, s * (width / 2 - 0.035)), 0.45 * t + 0.06, 0.1 * t**2 - 0.01], 0.016) for s in (-1, 1)
    ]


def chair_high(random: Random) -> Parts:
    """A child's high chair with a tray and a foot rest."""
    width, depth, seat, rise = draws(random, (0.33, 0.4), (0.3, 0.38), (0.52, 0.62), (0.3, 0.42))
    parts = [*seat_of(random, width, depth, seat), *_placed_back(random, width, depth, seat, rise)]
    parts += four_legs(width, depth, seat, 0.035, splay=random.uniform(0.05, 0.11)) + stretchers(
        width * 1.1, depth * 1.1, seat * 0.35
    )
    parts += [
        rod((s * width / 2, depth * 0.45, seat + 0.19), (s * width / 2, -depth * 0.6, seat + 0.19), 0.014)
        for s in (-1, 1)
    ]
    return [
        *parts,
        prism(HALF_ROUND, width * 1.25, 0.28, 0.025, 0, -depth * 0.8, seat + 0.18),
        box(width * 0.9, 0.11, 0.02, 0, -depth * 0.65, seat * 0.4),
    ]


def chair_executive(random: Random) -> Parts:
    """A swivel chair with a thick high back, a head rest and padded arms on a star with castors."""
    width, depth, seat, rise = draws(random, (0.48, 0.56), (0.46, 0.54), (0.42, 0.52), (0.6, 0.8))
    upper = [
        cushion(width, 0.13, rise * 0.55, 0, 0, 0.06),
        cushion(width * random.uniform(0.6, 1), 0.12, rise * 0.42, 0, 0, rise * 0.58),
    ]
    if random.random() < 0.5:
        upper = [
            bent(
                [(0.02, 0), (-0.02, rise * 0.3), (0.02, rise * 0.7), (0.06, rise)],
                width,
                0.06,
                random.uniform(0.02, 0.1),
                0.85,
            )
        ]
    parts = [cushion(width, depth, 0.12, 0, 0, seat - 0.09), *star(random.uniform(0.28, 0.35), seat - 0.07)]
    parts += tilt(moved(upper, 0, depth * 0.47, seat - 0.02), random.uniform(0.05, 0.2), (0, depth / 2, seat))
    return parts + (arms_of(random, width + 0.06, depth, seat) if random.random() < 0.8 else [])


def chair_throne(random: Random) -> Parts:
    """A heavy chair with closed sides and a tall panel back."""
    width, depth, seat, rise = chair_size(random)
    rise *= random.uniform(1.2, 1.7)
    parts = [box(width, depth, 0.12, 0, 0, seat - 0.12), *four_legs(width + 0.08, depth, seat, 0.06)]
    parts += [cushion(width * 0.95, depth * 0.9, 0.07, 0, 0, seat - 0.02)]
    parts += [box(0.05, depth, 0.24, s * (width / 2 + 0.02), 0, seat) for s in (-1, 1)]
    return [*parts, *moved([crested(width * 1.04, rise, 0.05)], 0, depth / 2, seat)]
