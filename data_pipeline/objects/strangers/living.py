"""Plants, animals and figures."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder
from data_pipeline.objects.strangers.shapes import (
    Groups,
    bend,
    blob,
    capsule,
    circle,
    either,
    hollow,
    level,
    loft,
    placed,
    rod,
    slab,
    sweep,
)


def _pot(random: Random, radius: float) -> Parts:
    height = radius * random.uniform(1.2, 2)
    parts = [hollow([(radius * random.uniform(0.65, 0.95), 0), (radius, height)], radius * 0.1)]
    return [*parts, cylinder(radius * 0.85, height * 0.85)]


def potted_plant(random: Random) -> Parts:
    """A pot with long blades, leaves on stalks, or a bush."""
    parts, kind = _pot(random, 0.1), int(random.integers(3))
    for _ in range(random.integers(7, 18)):
        turn, tall, wide = random.uniform(0, 2 * np.pi), random.uniform(0.2, 0.5), random.uniform(0.06, 0.3)
        tip = np.array([np.cos(turn) * wide, np.sin(turn) * wide, 0.15 + tall])
        if kind == 0:
            curve = bend([(0, 0, 0.12), (tip[0] * 0.3, tip[1] * 0.3, 0.3 + tall), tip * (1.3, 1.3, 0.85)], 8)
            parts.append(sweep(curve, 0.022 * np.sin(np.linspace(0.6, 3.1, 8)), 5))
        elif kind == 1:
            parts.append(rod((0, 0, 0.1), tip, 0.004))
            parts += placed(
                [blob((random.uniform(0.06, 0.12), 0.05, 0.006), (0.05, 0, 0), sections=10)],
                tip,
                (0, random.uniform(-0.9, 0.3), turn),
            )
        else:
            middle = tip * (0.5, 0.5, 0.8)
            parts += [rod((0, 0, 0.1), middle, 0.006), blob(random.uniform(0.05, 0.12, 3), middle, sections=10)]
    return parts


def tree(random: Random) -> Parts:
    """With a round crown, as a fir, or bare with branches."""
    kind, trunk = int(random.integers(3)), random.uniform(0.5, 1.2)
    parts = [sweep([(0, 0, 0), (0, 0, trunk * 1.3)], [0.09, 0.06])]
    if kind == 0:
        size = random.uniform(0.15, 0.45, (int(random.integers(1, 8)), 3)) + 0.1
        return parts + [
            blob(s, (*random.uniform(-0.3, 0.3, 2), trunk + 0.4 + random.uniform(-0.2, 0.4)), sections=14) for s in size
        ]
    if kind == 1:
        for t in np.linspace(0, 1, int(random.integers(1, 6))):
            wide = random.uniform(0.4, 0.55) * (1 - 0.6 * t)
            rings = [level(circle(18) * wide, 0), level(circle(18) * 0.01, 0.9)]
            parts += placed([loft(rings)], (0, 0, trunk * 0.4 + t * random.uniform(0.8, 1.2)))
        return parts
    tips = [(np.array([0, 0, trunk]), np.array([0, 0, 0.4]), 0.055)]
    for _ in range(3):
        grown = []
        for start, way, radius in tips:
            for _ in range(random.integers(2, 4)):
                step = way * 0.85 + random.normal(0, 0.18, 3)
                parts.append(sweep([start, start + step], [radius, radius * 0.6], 6))
                grown.append((start + step, step, radius * 0.6))
        tips = grown
    return parts


def cactus(random: Random) -> Parts:
    """A column with arms, a ball with ribs, or ears upon ears; often in a pot."""
    kind, tall = int(random.integers(3)), random.uniform(0.25, 0.5)
    if kind == 0:
        parts = [capsule((0, 0, 0.1), (0, 0, tall + 0.2), 0.055)]
        for turn in random.uniform(0, 2 * np.pi, random.integers(1, 4)):
            x, y, z = np.cos(turn) * 0.16, np.sin(turn) * 0.16, random.uniform(0.15, tall)
            arm = [(0, 0, z), (x, y, z), (x, y, z + random.uniform(0.08, 0.2))]
            parts += [capsule(arm[0], arm[1], 0.035), capsule(arm[1], arm[2], 0.035)]
    elif kind == 1:
        ribs = circle(48) * (1 + 0.12 * np.cos(np.arange(48) * 2 * np.pi / 48 * 12))[:, None]
        wave = [(np.sin(t), -np.cos(t)) for t in np.linspace(0.1, 3.1, 12)]
        parts = placed([loft([level(ribs * 0.13 * r, z * tall * 0.5) for r, z in wave])], (0, 0, 0.12 + tall * 0.5))
    else:
        parts, ears = [], [(np.array([0, 0, 0.1]), 0.0)]
        for _ in range(3):
            for base, lean in ears:
                parts += placed([blob((0.07, 0.02, 0.11), (0, 0, 0.1), sections=14)], base, (0, lean, 0))
            ears = [
                (b + 0.19 * np.array([np.sin(a), 0, np.cos(a)]), a + random.uniform(-0.8, 0.8)) for b, a in ears * 2
            ][:4]
    return [*parts, *_pot(random, 0.1)] if either(random, 0.75) else parts


# ---------------------------------------------------------------------------------------------------- animals and figures


def quadruped(random: Random) -> Parts:
    """From dachshund to giraffe, with or without horns."""
    long, leg, r = random.uniform(0.4, 0.9), random.uniform(0.15, 0.8), random.uniform(0.09, 0.2)
    z, neck, lean = leg + r * 0.7, random.uniform(0.12, 0.6), random.uniform(0.3, 1.3)
    parts = [capsule((-long / 2, 0, z), (long / 2, 0, z), r, random.uniform(0.8, 1.1))]
    for x in (-0.45, 0.45):
        parts += [
            capsule((x * long, s * r * 0.6, z), (x * long + random.uniform(-0.08, 0.08), s * r * 0.6, 0), r * 0.38, 0.6)
            for s in (-1, 1)
        ]
    head = np.array([-long / 2 - neck * np.cos(lean), 0, z + neck * np.sin(lean)])
    parts += [
        capsule((-long / 2, 0, z), head, r * 0.6, 0.75),
        capsule(head, head - (r * random.uniform(0.8, 2), 0, r * 0.4), r * 0.55, 0.6),
    ]
    out = random.uniform(0.5, 1.6) * r
    parts += [
        sweep(np.add(head, [(0, s * r * 0.3, r * 0.3), (0.02, s * r * 0.5, r * 0.5 + out)]), [r * 0.2, r * 0.05], 8)
        for s in (-1, 1)
    ]
    tail = bend(
        [
            (long / 2, 0, z),
            (long / 2 + r * 2, 0, z + random.uniform(-0.1, 0.3)),
            (long / 2 + r * 2, 0, z - random.uniform(-0.3, 0.3)),
        ],
        8,
    )
    return [*parts, sweep(tail, np.linspace(r * 0.3, r * 0.1, 8), 8)]


def biped(random: Random) -> Parts:
    """A standing or walking figure."""
    high, wide, arm, stride = (
        random.uniform(0.75, 0.95),
        random.uniform(0.16, 0.24),
        random.uniform(0, 2.8),
        random.uniform(-0.4, 0.4),
    )
    parts = [
        capsule((0, 0, high), (0, 0, high + 0.5), 0.13, random.uniform(0.9, 1.3)),
        blob((0.11, 0.12, 0.15), (0, 0, high + 0.85)),
    ]
    for s in (-1, 1):
        hip, step = np.array([s * wide * 0.5, 0, high]), s * stride
        knee = np.add(hip, (0, step * 0.5 - 0.04, -high * 0.5))
        shoulder = np.array([s * wide, 0, high + 0.5])
        lift = arm * random.uniform(0.3, 1)
        elbow = shoulder + np.array([s * np.sin(lift), -0.1, -np.cos(lift)]) * 0.3
        parts += [capsule(hip, knee, 0.085, 0.75), capsule(knee, (hip[0], step + 0.02, 0.05), 0.065, 0.7)]
        parts += [
            capsule(shoulder, elbow, 0.06, 0.8),
            capsule(elbow, elbow + np.array([s * np.sin(lift), -0.9, -np.cos(lift)]) * 0.2, 0.05, 0.8),
        ]
        parts.append(blob((0.05, 0.12, 0.04), (hip[0], step - 0.05, 0.03), sections=10))
    return parts


def bird(random: Random) -> Parts:
    """Sitting, or with spread wings; short or long legs, neck and bill."""
    leg, neck, bill = random.uniform(0.05, 0.4), random.uniform(0.08, 0.35), random.uniform(0.06, 0.2)
    z, fly = leg + 0.1, either(random)
    head = np.array([-0.2 - neck * 0.3, 0, z + 0.05 + neck])
    parts = [
        *placed([blob((0.22, 0.12, 0.13))], (0, 0, z), (0, random.uniform(-0.2, 0.5), 0)),
        blob((0.08, 0.07, 0.07), head),
    ]
    parts += [
        capsule((-0.13, 0, z + 0.03), head, 0.06, 0.7),
        sweep([head, head - (0.07 + bill, 0, 0.03)], [0.03, 0.004]),
    ]
    parts += placed([blob((0.15, 0.06, 0.015))], (0.28, 0, z), (0, random.uniform(-0.5, 0.3), 0))
    for s in (-1, 1):
        parts += [rod((0, s * 0.05, z), (0, s * 0.05, 0), 0.01), box(0.09, 0.05, 0.01, -0.03, s * 0.05)]
        size, turn = (
            ((0.12, 0.35, 0.015), (s * random.uniform(0, 0.7), 0, 0)) if fly else ((0.2, 0.02, 0.09), (0, 0.2, 0))
        )
        parts += placed([blob(size, (0, s * 0.3 * fly, 0))], (0.03, s * 0.1, z + 0.04), turn)
    return parts


def snake(random: Random) -> Parts:
    """A wave, a coil, or with its head raised."""
    r, kind, t = random.uniform(0.02, 0.05), int(random.integers(3)), np.linspace(0, 1, 60)
    turns, size = random.uniform(1.2, 3), random.uniform(0.1, 0.25)
    x, y, z = t * 1.2, size * np.sin(t * turns * 2 * np.pi), 0 * t
    if kind == 1:
        x, y, z = (
            (0.12 + size * t) * np.cos(t * turns * 6),
            (0.12 + size * t) * np.sin(t * turns * 6),
            (1 - t) * r * turns * 1.6,
        )
    elif kind == 2:
        z = np.clip(0.3 - t, 0, None) * random.uniform(0.6, 1.2)
    path = np.stack([x, y, z], axis=1)
    return [sweep(path, r * np.minimum(1, (1 - t) * 3 + 0.1)), blob((r * 1.9, r * 1.5, r), path[0], sections=12)]


def fish(random: Random) -> Parts:
    """A body, high or long, with a tail and fins."""
    long, high, wide = random.uniform(0.3, 0.6), random.uniform(0.06, 0.2), random.uniform(0.03, 0.07)
    tail = np.array([(long * 0.42, 0), (long * 0.65, high * 0.9), (long * 0.58, 0), (long * 0.65, -high * 0.9)])
    top = np.array(
        [(-long * 0.15, 0), (long * 0.25, 0), (long * 0.2, high * random.uniform(1.2, 1.8)), (0, high * 1.4)]
    )
    parts = [blob((long / 2, wide, high)), slab(tail, 0.012), slab(top, 0.012)]
    return parts + [
        p
        for s in (-1, 1)
        for p in placed([blob((0.07, 0.008, 0.03))], (-long * 0.12, s * wide, -high * 0.3), (0, 0, s * 0.6))
    ]


GROUPS: Groups = {
    "plants": {"train": (potted_plant, tree), "test": (cactus,)},
    "animals": {"test": (quadruped, biped, bird, snake, fish)},
}
