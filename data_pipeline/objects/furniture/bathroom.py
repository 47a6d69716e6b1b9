"""Bathtubs and toilets."""

from __future__ import annotations

import numpy as np
import trimesh

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder, lathe, rod


def tub_box(random: Random) -> Parts:
    """A rectangular tub with a rim."""
    width, depth, height = random.uniform(1.4, 1.9), random.uniform(0.65, 0.9), random.uniform(0.4, 0.62)
    wall, floor = random.uniform(0.05, 0.11), random.uniform(0.06, 0.15)
    rim = random.uniform(0.0, 0.06)
    parts = [box(width, depth, floor)]
    for side in (-1, 1):
        parts.append(box(wall, depth, height, side * (width - wall) / 2))
        parts.append(box(width, wall, height, 0, side * (depth - wall) / 2))
        parts.append(box(width + rim, wall + rim, 0.03, 0, side * (depth - wall) / 2, height))
        parts.append(box(wall + rim, depth + rim, 0.03, side * (width - wall) / 2, 0, height))
    return parts + _tap(random, width, height)


def _tap(random: Random, width: float, height: float) -> Parts:
    """A tap at the left end of a tub, or nothing with probability 0.4."""
    if random.random() < 0.4:
        return []
    x = -width / 2 + 0.05
    rise = random.uniform(0.1, 0.2)
    return [cylinder(0.02, rise, x, 0, height, 10), rod((x, 0, height + rise), (x + 0.16, 0, height + rise), 0.018)]


def tub_oval(random: Random, feet: bool = False, slipper: bool = False) -> Parts:
    """A free-standing oval tub.

    Args:
        feet: raise it on four feet.
        slipper: make one end higher than the other.
    """
    length, height = random.uniform(1.4, 1.8), random.uniform(0.42, 0.6)
    ratio = random.uniform(0.42, 0.56)
    base = random.uniform(0.62, 0.85)
    wall = 0.05
    r = length / 2
    profile = [(0, 0.04), (base * r, 0.0), (r, height), (r + 0.03, height + 0.02), (r - wall, height + 0.02)]
    profile += [(r - wall - 0.02, height), (base * r - wall, 0.08), (0, 0.08)]
    tub = lathe(profile, ratio)
    if slipper:
        vertices = tub.vertices.copy()
        vertices[:, 2] *= 1 + 0.45 * np.clip(vertices[:, 0] / r, 0, 1) ** 2
        tub.vertices = vertices
    parts = [tub]
    if feet:
        lift = random.uniform(0.1, 0.16)
        tub.apply_translation((0, 0, lift))
        for sx in (-1, 1):
            for sy in (-1, 1):
                parts.append(box(0.08, 0.08, lift + 0.08, sx * base * r * 0.7, sy * base * r * ratio * 0.7))
    return parts + (_tap(random, length * 0.9, height) if not slipper else [])


def tub_clawfoot(random: Random) -> Parts:
    """An oval tub on feet."""
    return tub_oval(random, feet=True, slipper=random.random() < 0.5)


def tub_panelled(random: Random) -> Parts:
    """An oval basin sunk into a box: a rectangle outside, an ellipse inside."""
    width, depth, height = random.uniform(1.5, 1.9), random.uniform(0.75, 1.1), random.uniform(0.42, 0.6)
    r = width / 2
    ratio = depth / width
    rim = random.uniform(0.74, 0.88)
    basin = lathe([(0, 0.12), (r * rim * 0.75, 0.1), (r * rim, height), (r * rim * 1.02, height)], ratio)
    angles = np.linspace(0, 2 * np.pi, 57)
    inner = np.stack([r * rim * np.cos(angles), r * rim * ratio * np.sin(angles)], axis=1)
    reach = np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    outer = np.stack([r * np.cos(angles) / reach, r * ratio * np.sin(angles) / reach], axis=1)
    ring = np.concatenate([np.c_[inner, np.full(57, height)], np.c_[outer, np.full(57, height)]])
    i = np.arange(56)
    faces = np.concatenate([np.c_[i, i + 57, i + 58], np.c_[i, i + 58, i + 1]])
    deck = trimesh.Trimesh(ring, faces, process=False)
    parts = [basin, deck]
    for side in (-1, 1):
        parts.append(box(0.02, depth, height, side * (width / 2 - 0.01)))
        parts.append(box(width, 0.02, height, 0, side * (depth / 2 - 0.01)))
    return parts + _tap(random, width, height)


def _bowl(random: Random, height: float, foot: float) -> tuple[Parts, float, float]:
    """Returns the bowl with its seat, its half width, and the y coordinate of its back."""
    r, stretch = random.uniform(0.17, 0.21), random.uniform(1.2, 1.45)
    profile = [(0, 0.0), (foot * r, 0.0), (foot * r * 0.85, height * 0.4), (r, height * 0.85), (r, height)]
    profile += [(r * 0.72, height), (r * 0.55, height * 0.7), (r * 0.25, height * 0.5), (0, height * 0.48)]
    parts = [lathe(profile, stretch)]
    angles = np.linspace(0, 2 * np.pi, 29)
    ring = [
        (r * 0.72, height),
        (r * 1.04, height),
        (r * 1.04, height + 0.025),
        (r * 0.72, height + 0.025),
        (r * 0.72, height),
    ]
    if random.random() < 0.5:  # lid down
        parts.append(
            lathe(
                [(0, height + 0.02), (r * 1.04, height + 0.02), (r * 1.04, height + 0.05), (0, height + 0.055)], stretch
            )
        )
    else:  # seat with a hole, lid up
        parts.append(lathe(ring, stretch))
        lid = np.stack([r * np.cos(angles), np.zeros(29), r * stretch * np.sin(angles)], axis=1)
        vertices = np.concatenate([[(0, 0, 0)], lid, [(0, 0.02, 0)], lid + np.array([0, 0.02, 0])])
        i = np.arange(1, 29)
        faces = np.concatenate([np.c_[np.zeros(28, int), i, i + 1], np.c_[np.full(28, 30), i + 31, i + 30]])
        up = trimesh.Trimesh(vertices, faces, process=False)
        up.apply_translation((0, r * stretch * 0.8, height + r * stretch))
        parts.append(up)
    return parts, r, r * stretch


def _toilet_tank(random: Random, r: float, back: float, base: float) -> Parts:
    """A tank behind the bowl, with its lower side at `base`; `r` is the half width of the bowl and `back` the y of its back."""
    width, depth, height = r * random.uniform(2.0, 2.7), random.uniform(0.15, 0.22), random.uniform(0.3, 0.42)
    y = back + depth / 2 - 0.02
    parts = [box(width, depth, height, 0, y, base), box(width + 0.03, depth + 0.03, 0.03, 0, y, base + height)]
    if random.random() < 0.6:
        parts.append(box(0.06, 0.03, 0.02, -width * 0.35, y - depth / 2 - 0.015, base + height * 0.8))
    return parts


def toilet_two_piece(random: Random) -> Parts:
    """A bowl on a foot with a separate tank."""
    height = random.uniform(0.36, 0.44)
    parts, r, back = _bowl(random, height, random.uniform(0.6, 0.8))
    parts.append(box(r * 1.1, back * 0.8, height * 0.9, 0, back * 0.7))
    return parts + _toilet_tank(random, r, back, height - 0.02)


def toilet_one_piece(random: Random) -> Parts:
    """A skirted toilet: its sides fall straight to the floor, and the tank is part of the body."""
    height = random.uniform(0.34, 0.42)
    parts, r, back = _bowl(random, height, random.uniform(0.85, 1.0))
    parts.append(box(r * 1.9, back * 0.9, height, 0, back * 0.75))
    width, rise = r * random.uniform(1.9, 2.2), random.uniform(0.22, 0.34)
    return [*parts, box(width, 0.2, height + rise, 0, back + 0.08)]


def toilet_wall_hung(random: Random) -> Parts:
    """A bowl above the floor, mounted on a panel."""
    height, lift = random.uniform(0.28, 0.34), random.uniform(0.06, 0.12)
    parts, r, back = _bowl(random, height, random.uniform(0.25, 0.45))
    for part in parts:
        part.apply_translation((0, 0, lift))
    parts.append(box(r * 1.6, 0.16, height * 0.8, 0, back * 0.9, lift + height * 0.2))
    return [*parts, box(r * 2.6, 0.06, random.uniform(0.7, 1.1), 0, back + 0.08)]


def toilet_high_tank(random: Random) -> Parts:
    """A bowl with its tank high above it, joined by a pipe."""
    height = random.uniform(0.36, 0.42)
    parts, r, back = _bowl(random, height, random.uniform(0.55, 0.75))
    tank = random.uniform(0.9, 1.3)
    parts.append(rod((0, back + 0.08, height * 0.5), (0, back + 0.08, tank), 0.025))
    parts.append(box(r * 1.1, back * 0.6, height * 0.9, 0, back * 0.6))
    return parts + _toilet_tank(random, r, back, tank)


BATHTUBS = (tub_box, tub_oval, tub_clawfoot, tub_panelled)
TOILETS = (toilet_two_piece, toilet_one_piece, toilet_wall_hung, toilet_high_tank)
