"""Small things: vessels, packages, electronics."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder, lathe
from data_pipeline.objects.strangers.shapes import (
    FRONT,
    Groups,
    bend,
    blob,
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
)

# ---------------------------------------------------------------------------------------------------------------- vessels


def _ear(x: float, low: float, high: float, reach: float, radius: float) -> Parts:
    """A handle on the right side of a vessel."""
    curve = bend([(x, 0, low), (x + reach * 1.4, 0, low), (x + reach * 1.4, 0, high), (x, 0, high)], 10)
    return [sweep(curve, radius, 8)]


def mug(random: Random) -> Parts:
    """Straight, round or conical."""
    radius, height = random.uniform(0.035, 0.05), random.uniform(0.07, 0.13)
    belly = radius * random.choice([1.0, 1.0, 1.25])
    profile = smooth([(radius * random.uniform(0.75, 1), 0), (belly, height * 0.4), (radius, height)])
    return [
        hollow(profile, 0.004),
        *_ear(radius * 0.95, height * 0.2, height * 0.82, random.uniform(0.02, 0.035), 0.005),
    ]


def teapot(random: Random) -> Parts:
    """A belly with a spout, a lid, and a handle behind or above."""
    r, tall = random.uniform(0.07, 0.1), random.uniform(0.7, 1.5)
    body = smooth(
        [
            (0, 0),
            (r * 0.6, 0),
            (r, r * 0.7 * tall),
            (r * 0.75, r * 1.3 * tall),
            (r * 0.3, r * 1.5 * tall),
            (0, r * 1.5 * tall),
        ]
    )
    top = r * 1.5 * tall
    spout = bend(
        [(-r * 0.7, 0, top * 0.25), (-r * 1.5, 0, top * 0.3), (-r * 1.4, 0, top * 0.8), (-r * 1.9, 0, top * 0.95)], 9
    )
    parts = [
        lathe(body, 1),
        sweep(spout, np.linspace(r * 0.25, r * 0.1, 9)),
        blob((r * 0.15,) * 3, (0, 0, top + r * 0.08), sections=10),
    ]
    if either(random, 0.65):
        return parts + _ear(r * 0.8, top * 0.25, top * 0.8, r * 0.6, r * 0.1)
    hoop = bend([(-r * 0.8, 0, top * 0.8), (-r, 0, top + r * 1.6), (r, 0, top + r * 1.6), (r * 0.8, 0, top * 0.8)])
    return [*parts, sweep(hoop, r * 0.06, 8)]


def jug(random: Random) -> Parts:
    """A pitcher with a lip and a handle."""
    r, height = random.uniform(0.05, 0.08), random.uniform(0.16, 0.28)
    neck = random.uniform(0.55, 0.95)
    profile = smooth([(r * 0.7, 0), (r, height * 0.3), (r * neck, height * 0.75), (r * neck * 1.15, height)])
    body = hollow(profile, 0.005)
    lip = np.clip(body.vertices[:, 2] / height - 0.8, 0, 1) * 5 * np.clip(-body.vertices[:, 0] / r - 0.4, 0, 1)
    body.vertices = body.vertices - np.outer(lip, (0.06, 0, -0.02))
    return [body, *_ear(r * 0.85, height * 0.25, height * 0.85, r * 0.8, 0.008)]


def bucket(random: Random) -> Parts:
    """With a hoop that stands or hangs."""
    r, height = random.uniform(0.1, 0.16), random.uniform(0.2, 0.32)
    top = r * random.uniform(1.1, 1.4)
    lean = random.uniform(-1.9, 1.9)
    hoop = bend([(-top, 0, 0), (-top * 0.9, 0, top * 1.4), (top * 0.9, 0, top * 1.4), (top, 0, 0)])
    parts = placed([sweep(hoop, 0.006, 6)], (0, 0, height * 0.95), (lean, 0, 0))
    return [hollow([(r, 0), (top, height), (top * 1.05, height)], 0.006), *parts]


def can(random: Random) -> Parts:
    """Of food or drink, with rims; or a watering can."""
    r, height = random.uniform(0.03, 0.06), random.uniform(0.07, 0.17)
    if either(random, 0.65):
        inner = [(r * 0.94, height), (r * 0.94, height - 0.005), (0, height - 0.005)]
        profile = [
            (0, 0.003),
            (r * 0.9, 0),
            (r, 0.008),
            (r, height - 0.01),
            (r * random.uniform(0.8, 1), height),
            *inner,
        ]
        return tossed(random, [lathe(profile, 1)], 0.25)
    r, height = r * 2.5, height * 1.6
    parts = [hollow([(r, 0), (r * 0.95, height)], 0.004), *_ear(r * 0.9, height * 0.2, height * 0.9, r * 0.7, 0.008)]
    nose = (-r * random.uniform(2, 3), 0, height * random.uniform(0.9, 1.3))
    return [
        *parts,
        sweep([(-r * 0.9, 0, height * 0.2), nose], [0.018, 0.01]),
        blob((0.02, 0.03, 0.03), nose, sections=10),
    ]


def lidded_box(random: Random) -> Parts:
    """A chest or a carton whose lid is closed, lies across, or stands open."""
    width, depth, height = random.uniform(0.2, 0.6), random.uniform(0.15, 0.4), random.uniform(0.1, 0.35)
    wall, kind = 0.012, int(random.integers(3))
    parts = [box(width, depth, wall)]
    parts += [box(wall, depth, height, s * width / 2) for s in (-1, 1)] + [
        box(width, wall, height, 0, s * depth / 2) for s in (-1, 1)
    ]
    lid = [box(width + 0.03, depth + 0.03, random.uniform(0.02, 0.08))]
    if either(random, 0.4):
        curve = np.stack([np.cos(t := np.linspace(0, np.pi, 12)) * depth / 2, np.sin(t) * depth * 0.3], axis=1)
        lid = placed([slab(curve, width)], turn=(0, 0, np.pi / 2))
    if kind == 0:
        return [*parts, *placed(lid, (0, 0, height))]
    if kind == 1:
        return [
            *parts,
            *placed(lid, (random.uniform(-0.1, 0.1), depth * 0.2, height), (0, 0, random.uniform(-0.6, 0.6))),
        ]
    return [*parts, *placed(placed(lid, (0, -depth / 2, 0)), (0, depth / 2, height), (-random.uniform(1.2, 2), 0, 0))]


# --------------------------------------------------------------------------------------------------------------- packages


def parcel(random: Random) -> Parts:
    """A box with a strap or a bow around it."""
    width, depth, height = random.uniform(0.2, 0.5, 3) * (1, 0.8, 0.7)
    parts = [box(width, depth, height, 0, 0, 0.004), box(0.03, depth + 0.01, height + 0.008)]
    parts += [box(width + 0.01, 0.03, height + 0.008)] * either(random, 0.7)
    if either(random):
        for s in (-1, 1):
            loop = bend([(0, 0, height), (s * 0.16, 0, height), (s * 0.12, 0, height + 0.16), (0, 0, height)], 12)
            parts.append(sweep(loop, 0.01, 6))
    return parts


def open_carton(random: Random) -> Parts:
    """A carton with four flaps."""
    width, depth, height = random.uniform(0.25, 0.5), random.uniform(0.2, 0.4), random.uniform(0.15, 0.4)
    parts = [box(width, depth, 0.006)]
    for turn, across, out in [(i * np.pi / 2, *((width, depth), (depth, width))[i % 2]) for i in range(4)]:
        flap = placed(
            [box(across, 0.005, min(width, depth) / 2)], (0, out / 2, height), (-random.uniform(-0.4, 2.4), 0, 0)
        )
        parts += placed([box(across, 0.005, height, 0, out / 2), *flap], turn=(0, 0, turn))
    return parts


def sack(random: Random) -> Parts:
    """A bag tied at its neck, or a pillow of sand."""
    r, height = random.uniform(0.15, 0.3), random.uniform(0.3, 0.6)
    if either(random, 0.4):
        return [
            blob(
                (r * random.uniform(1.2, 1.8), r, r * random.uniform(0.3, 0.7)), flat=random.uniform(0.6, 1), square=0.4
            )
        ]
    profile = smooth(
        [(0, 0), (r * 0.8, 0), (r, height * 0.3), (r * 0.8, height * 0.7), (r * 0.15, height * 0.85), (r * 0.5, height)]
    )
    folds = 1 + 0.05 * np.cos(circle(28)[:, :1] * 7 + random.uniform(0, 6))
    return [loft([level(circle(28) * folds * (a, a * 0.8), z) for a, z in profile])]


def bottle_crate(random: Random) -> Parts:
    """Rows of bottles in a low box."""
    columns, rows, step = int(random.integers(2, 6)), int(random.integers(2, 4)), 0.08
    width, depth, high = columns * step, rows * step, random.uniform(0.1, 0.26)
    parts = [box(width, depth, 0.01)]
    parts += [box(0.01, depth, high, s * width / 2) for s in (-1, 1)] + [
        box(width, 0.01, high, 0, s * depth / 2) for s in (-1, 1)
    ]
    profile = [(0, 0.01), (0.033, 0.01), (0.033, 0.17), (0.013, 0.22), (0.013, 0.27), (0, 0.27)]
    cells = [((c + 0.5) * step - width / 2, (r + 0.5) * step - depth / 2) for c in range(columns) for r in range(rows)]
    return parts + [loft([level(circle(10) * a, z, x, y) for a, z in profile[1:-1]]) for x, y in cells]


# ------------------------------------------------------------------------------------------------------------ electronics


def camera(random: Random) -> Parts:
    """A body with a lens, a bump and a button, with or without a tripod."""
    width, height, deep, lens = (
        0.14,
        random.uniform(0.07, 0.1),
        random.uniform(0.03, 0.06),
        random.uniform(0.025, 0.035),
    )
    parts = [
        box(width, deep, height),
        box(width * 0.35, deep, 0.025, 0, 0, height),
        cylinder(0.008, 0.012, 0.045, 0, height),
    ]
    parts.append(disc(lens, long := random.uniform(0.03, 0.14), (0, -deep / 2 - long / 2, height * 0.48), FRONT))
    if either(random, 0.35):
        return [*parts, *[rod((0, 0, 0), (x * 0.2, y * 0.2, -0.5), 0.01) for x, y in circle(3)]]
    return parts


def speaker(random: Random) -> Parts:
    """A box with round membranes, or a cylinder."""
    width, depth, height = random.uniform(0.15, 0.35), random.uniform(0.15, 0.35), random.uniform(0.25, 1.0)
    if either(random, 0.25):
        return [
            cylinder(width / 2, height),
            lathe([(0, height), (width * 0.4, height), (width * 0.35, height + 0.02), (0, height + 0.005)], 1),
        ]
    parts, z = [box(width, depth, height)], height * 0.1
    for r in width * np.sort(random.uniform(0.15, 0.42, random.integers(1, 4)))[::-1]:
        if z + 2 * r > height:
            break
        parts += placed(
            [slab(circle(22) * r, 0.03, circle(22) * r * 0.8), blob((r * 0.35, 0.025, r * 0.35))],
            (0, -depth / 2, z + r),
        )
        z += 2.15 * r
    return parts


def computer_keyboard(random: Random) -> Parts:
    columns, rows, key = int(random.integers(8, 16)), int(random.integers(4, 7)), 0.019
    size, wedge = key * random.uniform(0.75, 0.9), random.uniform(0, 0.15)
    parts = [box(columns * key + 0.02, rows * key + 0.02, 0.015)]
    cells = [(c - (columns - 1) / 2, r - (rows - 1) / 2) for c in range(columns) for r in range(1, rows)]
    parts += [box(size, size, 0.008, c * key, r * key, 0.015) for c, r in cells]
    parts.append(box(key * columns * 0.45, size, 0.008, 0, -(rows - 1) / 2 * key, 0.015))
    return placed(parts, turn=(wedge, 0, 0))


def telephone(random: Random) -> Parts:
    """A slab with a camera and keys, or a base with a receiver."""
    if either(random):
        width, height = random.uniform(0.06, 0.08), random.uniform(0.12, 0.17)
        parts = [blob((width / 2, height / 2, 0.006), (0, 0, 0.006), flat=0.2, square=0.15, sections=28)]
        if either(random):
            parts += [
                box(width * 0.2, 0.01, 0.004, x, y, 0.011) for x in (-0.02, 0, 0.02) for y in np.linspace(-0.05, 0, 4)
            ]
        return tossed(random, [*parts, box(0.025, 0.025, 0.004, -width * 0.2, height * 0.33, 0.01)])
    base = slab(np.array([(-0.1, 0), (0.1, 0), (0.1, 0.03), (0, 0.08), (-0.1, 0.09)]), random.uniform(0.14, 0.2))
    parts = [*placed([base], turn=(0, 0, np.pi / 2)), blob((0.1, 0.025, 0.018), (0, 0.06, 0.11), flat=0.6)]
    parts += [blob((0.03, 0.03, 0.025), (s * 0.085, 0.06, 0.1), sections=12) for s in (-1, 1)]
    return [*parts, *placed([cylinder(0.05, 0.012)], (0, -0.03, 0.06), (0.4, 0, 0))]


GROUPS: Groups = {
    "vessels": {"train": (mug, bucket, can, lidded_box), "val": (jug,), "test": (teapot,)},
    "packages": {"train": (parcel, sack, bottle_crate), "test": (open_carton,)},
    "electronics": {"val": (camera, speaker, computer_keyboard, telephone)},
}
