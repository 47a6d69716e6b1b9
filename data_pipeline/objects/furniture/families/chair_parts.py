"""Backs, seats, bases and armrests of chairs, which are combined at random within a family."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.families.parts import CIRCLE, bent, cushion, prism, superellipse, tube
from data_pipeline.objects.furniture.solids import Parts, Random, box, four_legs, rod


def chair_size(random: Random) -> tuple[float, float, float, float]:
    """Draws the width, the depth, the height of the seat, and the height of the back above the seat."""
    return random.uniform(0.4, 0.55), random.uniform(0.4, 0.52), random.uniform(0.41, 0.49), random.uniform(0.38, 0.62)


def arch(width: float, rise: float, z: float, points: int = 9) -> list[tuple[float, float, float]]:
    """An arch along x between two points of height z."""
    t = np.linspace(0, np.pi, points)
    return [(-width / 2 * np.cos(a), 0.0, z + rise * np.sin(a)) for a in t]


def back(random: Random, width: float, height: float) -> Parts:
    """A back whose foot is at the origin, in one of ten styles."""
    style, r = random.integers(10), random.uniform(0.012, 0.02)
    posts = [rod((s * width * 0.46, 0, 0), (s * width * 0.48, 0, height), r) for s in (-1, 1)]
    if style == 0:  # spindles below an arch
        xs = np.linspace(-0.38, 0.38, int(random.integers(4, 8))) * width
        curve = [(-width * 0.44, 0, 0), *arch(width * 0.96, height * 0.25, height * 0.75), (width * 0.44, 0, 0)]
        tops = [height * (0.75 + 0.25 * np.sqrt(1 - (2 * x / width) ** 2)) for x in xs]
        return [tube(curve, r), *[rod((x * 0.8, 0, 0), (x, 0, z), r * 0.6) for x, z in zip(xs, tops, strict=True)]]
    if style == 1:  # an oval medallion on two short posts
        low = height * random.uniform(0.15, 0.3)
        pad = prism(CIRCLE, width * 0.9, height - low, 0.05)
        posts = [rod((s * width * 0.3, 0, 0), (s * width * 0.3, 0, low * 1.5), r) for s in (-1, 1)]
        return [*_upright(pad, (height + low) / 2), *posts]
    if style == 2:  # a cross
        z = height * 0.15
        bars = [rod((s * width * 0.45, 0, z), (-s * width * 0.45, 0, height * 0.85), r * 0.8) for s in (-1, 1)]
        return [*posts, *bars, box(width, 0.025, 0.06, 0, 0, height - 0.06), box(width * 0.9, 0.02, 0.03, 0, 0, z)]
    if style == 3:  # bowed ladder
        rails = int(random.integers(2, 5))
        steps = [
            bent([(0.02, z), (0.02, z + 0.06)], width, 0.018, 0.03) for z in np.linspace(0.3, 0.88, rails) * height
        ]
        return [*posts, *steps]
    if style == 4:  # a bowed panel, round at its upper end
        line = [(0, height * t) for t in np.linspace(0.02, 1, 6)]
        return [bent(line, width * 0.95, 0.03, random.uniform(0.02, 0.08), random.uniform(0.7, 1.05))]
    if style == 5:  # upholstered
        low = height * random.uniform(0.0, 0.3)
        return [cushion(width * 0.96, random.uniform(0.06, 0.11), height - low, 0, 0, low), *posts]
    if style == 6:  # a splat below a crest
        splat = bent([(0, 0), (0.01, height * 0.5), (0, height * 0.92)], width * random.uniform(0.2, 0.4), 0.018)
        return [
            *posts,
            splat,
            tube([(-width * 0.52, 0, height * 0.95), (0, 0, height), (width * 0.52, 0, height * 0.95)], 0.022),
        ]
    if style == 7:  # woven bands
        rows = [box(width * 0.92, 0.012, 0.035, 0, 0, z) for z in np.linspace(0.12, 0.92, 5) * height]
        columns = [box(0.035, 0.012, height * 0.9, x, 0, height * 0.08) for x in np.linspace(-0.36, 0.36, 4) * width]
        return [*posts, *rows, *columns, box(width, 0.025, 0.03, 0, 0, height - 0.03)]
    if style == 8:  # half height pad on a frame of tube
        frame = tube(
            [(-width * 0.46, 0, 0), *arch(width * 0.92, height * 0.12, height * 0.86), (width * 0.46, 0, 0)], r
        )
        return [frame, bent([(-0.01, height * 0.45), (-0.01, height * 0.9)], width * 0.9, 0.035, 0.03)]
    return [*posts, *[box(width * 0.9, 0.016, 0.09, 0, 0, z) for z in np.arange(0.05, height - 0.09, 0.13)]]  # boards


def _upright(pad, z: float) -> Parts:
    """A flat part turned upright, with its middle at height z."""
    pad.vertices = np.stack([pad.vertices[:, 0], pad.vertices[:, 2] - 0.025, pad.vertices[:, 1] + z], axis=1)
    pad.invert()
    return [pad]


def seat_of(random: Random, width: float, depth: float, seat: float) -> Parts:
    """A seat whose upper side is at about `seat`: flat, round, waisted, soft, or hollow."""
    style, thick = random.integers(5), random.uniform(0.025, 0.06)
    if style == 0:
        return [prism(superellipse(random.uniform(2, 5)), width, depth, thick, 0, 0, seat - thick)]
    if style == 1:
        outline = superellipse(5) * np.where(superellipse(5)[:, 1:] > 0, (random.uniform(0.75, 0.95), 1), (1, 1))
        return [prism(outline, width, depth, thick, 0, 0, seat - thick)]
    if style == 2:
        return [
            box(width, depth, 0.04, 0, 0, seat - 0.07),
            cushion(width * 0.97, depth * 0.97, 0.08, 0, 0, seat - 0.05),
        ]
    if style == 3:
        y = np.linspace(-depth / 2, depth / 2, 6)
        return [bent([(v, seat - 0.02 * np.sin(3 * v / depth + 1)) for v in y], width, 0.02, 0)]
    return [box(width, depth, thick, 0, 0, seat - thick)]


def arms_of(random: Random, width: float, depth: float, seat: float) -> Parts:
    """Two armrests: boards on posts, loops of tube, padded bars, or closed sides."""
    style, rise, r = random.integers(4), random.uniform(0.17, 0.26), 0.014
    parts: Parts = []
    for s in (-1, 1):
        x, front, rear, z = s * (width / 2 + 0.02), -depth * 0.4, depth * 0.48, seat + rise
        if style == 0:
            parts += [box(0.06, depth * 0.95, 0.03, x, 0, z), rod((x, front, seat - 0.03), (x, front * 0.9, z), r)]
        elif style == 1:
            parts.append(
                tube([(x, front, seat - 0.02), (x, front * 1.1, z - 0.05), (x, front * 0.8, z), (x, rear, z + 0.02)], r)
            )
        elif style == 2:
            parts += [cushion(0.06, depth * 0.6, 0.045, x, -0.03, z), rod((x * 0.9, 0, seat - 0.03), (x, 0, z), 0.02)]
        else:
            parts.append(box(0.035, depth * 0.9, rise + 0.05, x, 0.02, seat - 0.04))
    return parts


def legs_of(random: Random, width: float, depth: float, seat: float) -> Parts:
    """Four legs, splayed legs with or without stretchers, a sled of tube, or bent legs of tube."""
    style, thick = random.integers(5), random.uniform(0.025, 0.05)
    if style == 0:
        return four_legs(width, depth, seat, thick, 0.01)
    if style == 1:
        legs = four_legs(width, depth, seat, thick, 0.02, splay=random.uniform(0.02, 0.1))
        return legs + stretchers(width * 0.95, depth * 0.95, seat * random.uniform(0.25, 0.5))
    if style == 2:
        r, w, d = random.uniform(0.009, 0.014), width * 0.46, depth * 0.5
        line = [(d * 0.8, seat), (d, r), (-d, r), (-d * 0.8, seat)]
        return [tube([(s * w, y, z) for y, z in line], r) for s in (-1, 1)] + [
            box(2 * w, 0.02, 0.02, 0, d * 0.85, seat - 0.03)
        ]
    if style == 3:
        return four_legs(width, depth, seat, random.uniform(0.018, 0.028), 0.02, splay=random.uniform(0.01, 0.06))
    legs = four_legs(width, depth, seat, thick, 0.01)
    return legs + stretchers(width * 0.9, depth * 0.9, seat * random.uniform(0.2, 0.5))


def stretchers(width: float, depth: float, z: float, r: float = 0.011) -> Parts:
    """Bars between four legs."""
    x, y = width / 2, depth / 2
    return [rod((s * x, -y, z), (s * x, y, z), r) for s in (-1, 1)] + [
        rod((-x, s * y, z * 1.15), (x, s * y, z * 1.15), r) for s in (-1, 1)
    ]
