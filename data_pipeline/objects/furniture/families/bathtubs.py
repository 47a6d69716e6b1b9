"""Bathtubs of further families."""

from __future__ import annotations

import numpy as np

from data_pipeline.objects.furniture.families.parts import (
    CORNER,
    Outline,
    draws,
    loft,
    moved,
    prism,
    sheet,
    superellipse,
    tube,
    turned,
)
from data_pipeline.objects.furniture.solids import Parts, Random, Solid, box


def _vessel(
    random: Random,
    outline: Outline,
    width: float,
    depth: float,
    height: float,
    base: float = 0.8,
    wall: float = 0.05,
    shift: float = 0,
) -> Solid:
    """A tub of this outline: its outer side, a rolled or flat rim, and its inner side.

    Args:
        base: size of its foot as a share of that of its rim.
        shift: how far the foot lies from the middle along x, as a share of the width.
    """
    x, y, lip, deep = width / 2, depth / 2, random.uniform(0, 0.04), random.uniform(0.08, 0.16)
    middle = base + (1 - base) * random.uniform(0.5, 0.95)
    levels = [
        (x * base, y * base, shift * width, 0, 0),
        (x * middle, y * middle, shift * width / 2, 0, height * 0.5),
        (x, y, 0, 0, height),
    ]
    levels += [
        (x + lip, y + lip, 0, 0, height + 0.01),
        (x + lip, y + lip, 0, 0, height + 0.03),
        (x - wall, y - wall, 0, 0, height + 0.03),
    ]
    levels += [
        (x - wall, y - wall, 0, 0, height - 0.02),
        (x * middle - wall, y * middle - wall, shift * width / 2, 0, height * 0.55),
    ]
    inner = (x * base - wall) * random.uniform(0.75, 0.95), (y * base - wall) * random.uniform(0.75, 0.95)
    return loft(outline, [*levels, (*inner, shift * width, 0, deep)])


def _tub_size(random: Random) -> tuple[float, float, float]:
    return random.uniform(1.4, 1.85), random.uniform(0.68, 0.88), random.uniform(0.45, 0.62)


def _spout(random: Random, x: float, y: float, z: float, inward: tuple[float, float]) -> Parts:
    """A tap: a bent spout with two handles, or a mixer that stands on the floor, or nothing."""
    kind, (dx, dy) = random.integers(3), inward
    if kind == 0:
        return []
    rise = random.uniform(0.12, 0.28)
    curve = [
        (x, y, 0 if kind == 2 else z),
        (x, y, z + rise * 0.7),
        (x + dx * 0.06, y + dy * 0.06, z + rise),
        (x + dx * 0.17, y + dy * 0.17, z + rise * 0.8),
    ]
    return [
        tube(curve, 0.014),
        *[
            turned([(0.02, z), (0.015, z + 0.05), (0.028, z + 0.07)], x + s * 0.1 * dy, y + s * 0.1 * dx)
            for s in (-1, 1)
        ],
    ]


def tub_freestanding(random: Random) -> Parts:
    """An oval or rounded tub that stands on its own foot, its ends straight or raised."""
    width, depth, height = _tub_size(random)
    tub = _vessel(
        random,
        superellipse(random.uniform(2, 4.5)),
        width,
        depth,
        height,
        random.uniform(0.7, 0.95),
        random.uniform(0.025, 0.06),
    )
    rise = random.uniform(0, 0.35) if random.random() < 0.5 else 0
    tub.vertices = (
        tub.vertices * np.c_[np.ones((len(tub.vertices), 2)), 1 + rise * (2 * tub.vertices[:, 0] / width) ** 2]
    )
    return [tub, *_spout(random, 0, depth / 2 + 0.03, height, (0, -1))]


def tub_alcove(random: Random) -> Parts:
    """A built-in tub: a deck wider than the basin, a panel in front, tiles or a ledge at a side."""
    width, depth, height = _tub_size(random)
    power, ledge = draws(random, (3, 30), (0.05, 0.16))
    parts: Parts = [
        _vessel(random, superellipse(float(power)), width, depth, height, random.uniform(0.85, 0.95), ledge)
    ]
    parts += [
        box(width, 0.02, height, 0, -depth / 2 + 0.01),
        box(0.02, depth, height, width / 2 - 0.01),
        box(0.02, depth, height, -width / 2 + 0.01),
    ]
    parts.append(box(width, 0.02, height, 0, depth / 2 - 0.01))
    parts += [box(width, 0.04, 0.035, 0, s * (depth / 2), height) for s in (-1, 1)] + [
        box(0.04, depth, 0.035, s * width / 2, 0, height) for s in (-1, 1)
    ]
    if random.random() < 0.4:
        parts.append(box(random.uniform(0.1, 0.3), depth, height + 0.03, width / 2 + 0.1))
    return parts + _spout(random, -width / 2 + ledge / 2, 0, height, (1, 0))


def tub_corner(random: Random) -> Parts:
    """A tub for a corner of the room, with a seat, jets or a step."""
    side, height = draws(random, (1.2, 1.6), (0.48, 0.62))
    wall, rim = random.uniform(0.05, 0.16), np.repeat(CORNER, 2, axis=0)
    rim[1::2] = (CORNER + np.roll(CORNER, -1, axis=0)) / 2
    if random.random() < 0.5:  # a round front
        t = np.linspace(0, np.pi / 2, 11)
        rim = np.concatenate([[[1.0, 1.0]], [[-1.0, 1.0]], np.c_[1 - 2 * np.cos(t), 1 - 2 * np.sin(t)]])
    parts: Parts = [_vessel(random, rim, side, side, height, random.uniform(0.85, 0.98), wall)]
    if random.random() < 0.4:
        parts += [prism(rim, side * 1.25, side * 1.25, height * 0.4, -side * 0.125, -side * 0.125)]
    return parts + _spout(random, side * 0.4, side * 0.4, height, (-0.7, -0.7))


def tub_round(random: Random) -> Parts:
    """A round or nearly square tub, with or without a ring of panels and a step."""
    width, height = draws(random, (1.2, 1.7), (0.5, 0.75))
    outline = superellipse(float(random.choice([2.0, 2.0, 5.0])))
    parts: Parts = [
        _vessel(
            random,
            outline,
            width,
            width * random.uniform(0.85, 1),
            height,
            random.uniform(0.75, 1),
            random.uniform(0.04, 0.15),
        )
    ]
    if random.random() < 0.5:
        parts += [box(width * 0.5, 0.3, height * z, 0, -width / 2 - y) for z, y in ((0.6, 0.1), (0.3, 0.35))]
    return parts + _spout(random, 0, width / 2 - 0.03, height, (0, -1))


def tub_soaking(random: Random) -> Parts:
    """A short deep tub with straight walls, of wood with hoops or of stone, with a bench."""
    width, depth, height = draws(random, (0.9, 1.25), (0.7, 0.95), (0.62, 0.85))
    outline = superellipse(float(random.choice([2.0, 4.0, 40.0])))
    parts: Parts = [_vessel(random, outline, width, depth, height, random.uniform(0.85, 1), random.uniform(0.03, 0.06))]
    for z in (0.25, 0.75) if random.random() < 0.5 else ():
        parts.append(prism(outline, width * 1.01, depth * 1.01, 0.03, 0, 0, z * height))
    if random.random() < 0.5:
        parts.append(box(0.3, depth * 0.8, height * 0.4, width / 2 - 0.2))
    return parts + _spout(random, -width / 2 + 0.03, 0, height, (1, 0))


def tub_clawed(random: Random) -> Parts:
    """A rolled rim, one or both ends raised, on four cabriole feet or blocks."""
    width, depth, height = _tub_size(random)
    lift, raised = random.uniform(0.1, 0.18), random.integers(3)
    tub = _vessel(
        random,
        superellipse(random.uniform(2, 2.8)),
        width,
        depth,
        height,
        random.uniform(0.6, 0.8),
        0.03,
        shift=-0.04 * (raised == 1),
    )
    share = tub.vertices[:, 0] * 2 / width
    tub.vertices = (
        tub.vertices
        * np.c_[
            np.ones((len(share), 2)),
            1 + 0.5 * random.random() * ((raised == 1) * np.clip(share, 0, 1) ** 2 + (raised == 2) * share**2),
        ]
    )
    parts = moved([tub], 0, 0, lift)
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * width * 0.27, sy * depth * 0.24
            curve = [
                (x * 0.8, y * 0.8, lift + 0.08),
                (x * 1.1, y * 1.1, lift),
                (x * 1.0, y * 1.0, lift * 0.4),
                (x * 1.15, y * 1.15, 0.015),
            ]
            parts.append(tube(curve, (0.05, 0.04, 0.025, 0.03)))
    return parts + _spout(random, -width / 2 - 0.02, 0, height + lift, (1, 0))


def tub_sunken(random: Random) -> Parts:
    """A basin in a platform with steps, or with a broad deck."""
    width, depth, height = _tub_size(random)
    deck = random.uniform(0.12, 0.35)
    outline = superellipse(float(random.choice([2.0, 3.0, 20.0])))
    tub = _vessel(random, outline, width, depth, height, 0.9, 0.04)
    w, d = width + 2 * deck, depth + 2 * deck
    angles = np.arctan2(outline[:, 1] * depth, outline[:, 0] * width)
    reach = np.minimum(
        w / 2 / np.maximum(np.abs(np.cos(angles)), 1e-6), d / 2 / np.maximum(np.abs(np.sin(angles)), 1e-6)
    )
    outer = np.stack([reach * np.cos(angles), reach * np.sin(angles)], axis=1)
    inner = outline * (width / 2 - 0.01, depth / 2 - 0.01)
    rings = [np.c_[ring, np.full(len(ring), height - 0.015)] for ring in (inner, outer)]
    grid = np.stack([np.concatenate([ring, ring[:1]]) for ring in rings])
    parts: Parts = [
        tub,
        sheet(grid, 0.03),
        *[box(0.02, d, height, s * w / 2) for s in (-1, 1)],
        *[box(w, 0.02, height, 0, s * d / 2) for s in (-1, 1)],
    ]
    steps = int(random.integers(0, 3))
    parts += [
        box(w * random.uniform(0.4, 1), 0.28, height * (steps - k) / (steps + 1), 0, -d / 2 - 0.14 - 0.28 * k)
        for k in range(steps)
    ]
    return parts + _spout(random, -w / 2 + deck / 2, 0, height, (1, 0))


def tub_hourglass(random: Random) -> Parts:
    """A tub whose sides narrow to the middle, or with one end broader than the other."""
    width, depth, height = _tub_size(random)
    outline = superellipse(random.uniform(3, 8), 40)
    waist = (
        1 - random.uniform(0.08, 0.25) * (1 - outline[:, :1] ** 2)
        if random.random() < 0.5
        else 1 - random.uniform(0.1, 0.25) * (outline[:, :1] + 1) / 2
    )
    tub = _vessel(
        random,
        outline * np.c_[np.ones(len(outline)), waist[:, 0]],
        width,
        depth,
        height,
        random.uniform(0.8, 0.97),
        random.uniform(0.04, 0.09),
    )
    return [tub, *_spout(random, -width / 2 + 0.03, 0, height, (1, 0))]
