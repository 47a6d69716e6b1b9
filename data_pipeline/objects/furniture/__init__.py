"""furniture10: procedural meshes for the ten classes of ModelNet10, unlimited and seeded.

It stands in for ModelNet10 where that cannot be downloaded, and is hard in the same way. Desks are tables but for drawers
and panels that face one side; dressers and night stands share their fronts and overlap in proportions once the size is
lost; from behind, all four are plain boards. So which view comes next matters.

Units are metres, z is up, the floor is z = 0 and the front of a piece faces −y. Every class has at least four structural
variants, and every length is drawn anew for each piece.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import trimesh

CLASSES = ("bathtub", "bed", "chair", "desk", "dresser", "monitor", "night_stand", "sofa", "table", "toilet")

Solid = trimesh.Trimesh
Parts = list[Solid]
Random = np.random.Generator


def furniture(class_name: str, seed: int) -> Solid:
    """One piece of furniture; the same class and seed give the same mesh.

    Raises:
        ValueError: for a class that is not one of `CLASSES`.
    """
    if class_name not in CLASSES:
        raise ValueError(f"furniture10 has no class {class_name!r}; it has {', '.join(CLASSES)}")
    random = np.random.default_rng([CLASSES.index(class_name), seed])
    variants = VARIANTS[class_name]
    return joined(variants[random.integers(len(variants))](random))


def joined(parts: Parts) -> Solid:
    """All parts as one mesh."""
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


# ---------------------------------------------------------------------------------------------------------------- solids


def _box(width: float, depth: float, height: float, x: float = 0, y: float = 0, z: float = 0) -> Solid:
    """Box with the centre of its base at (x, y, z)."""
    solid = trimesh.creation.box((width, depth, height))
    solid.apply_translation((x, y, z + height / 2))
    return solid


def _cylinder(radius: float, height: float, x: float = 0, y: float = 0, z: float = 0, sections: int = 20) -> Solid:
    """Upright cylinder with the centre of its base at (x, y, z)."""
    solid = trimesh.creation.cylinder(radius, height, sections=sections)
    solid.apply_translation((x, y, z + height / 2))
    return solid


def _rod(start: Sequence[float], end: Sequence[float], radius: float) -> Solid:
    return trimesh.creation.cylinder(radius, segment=np.array([start, end], float), sections=10)


def _lathe(profile: Sequence[tuple[float, float]], stretch_x: float = 1, stretch_y: float = 1) -> Solid:
    """Surface of revolution of (radius, height) pairs about z, stretched to an ellipse."""
    solid = trimesh.creation.revolve(np.array(profile, float), sections=28)
    solid.apply_scale((stretch_x, stretch_y, 1))
    return solid


def _tilt(parts: Parts, angle: float, pivot: Sequence[float]) -> Parts:
    """Turned about the x axis through `pivot`; positive leans the top backwards (+y)."""
    matrix = trimesh.transformations.rotation_matrix(-angle, (1, 0, 0), pivot)
    for part in parts:
        part.apply_transform(matrix)
    return parts


def _four_legs(
    width: float,
    depth: float,
    height: float,
    thickness: float,
    inset: float = 0,
    round_legs: bool = False,
    splay: float = 0,
) -> Parts:
    legs: Parts = []
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (width / 2 - thickness / 2 - inset), sy * (depth / 2 - thickness / 2 - inset)
            if splay:
                legs.append(_rod((x + sx * splay, y + sy * splay, 0), (x, y, height), thickness / 2))
            elif round_legs:
                legs.append(_cylinder(thickness / 2, height, x, y, sections=12))
            else:
                legs.append(_box(thickness, thickness, height, x, y))
    return legs


def _handle(random: Random, kind: int, width: float, x: float, y: float, z: float) -> Parts:
    """A knob, a bar or none, in front of a panel at y."""
    if kind == 0:
        return [trimesh.creation.icosphere(1, 0.022).apply_translation((x, y - 0.015, z))]
    if kind == 1:
        return [_box(width * 0.35, 0.03, 0.02, x, y - 0.015, z - 0.01)]
    return []


def _drawers(
    random: Random,
    width: float,
    height: float,
    rows: int,
    columns: int,
    x: float,
    front: float,
    z: float,
    relief: float = 0.03,
) -> Parts:
    """Drawer fronts standing `relief` before the plane y = front, with gaps between them and handles on them."""
    kind = int(random.integers(3))
    gap = 0.025
    heights = np.full(rows, 1.0) if random.random() < 0.6 else np.linspace(0.7, 1.3, rows)[::-1]
    heights = heights / heights.sum() * height
    parts: Parts = []
    bottom = z
    for row in heights:
        for column in range(columns):
            cell = width / columns
            centre = x - width / 2 + cell * (column + 0.5)
            parts.append(_box(cell - gap, relief, row - gap, centre, front - relief / 2, bottom + gap / 2))
            parts += _handle(random, kind, cell, centre, front - relief, bottom + row / 2)
        bottom += row
    return parts


def _doors(random: Random, width: float, height: float, doors: int, x: float, front: float, z: float) -> Parts:
    gap, relief = 0.02, 0.03
    parts: Parts = []
    for door in range(doors):
        cell = width / doors
        centre = x - width / 2 + cell * (door + 0.5)
        parts.append(_box(cell - gap, relief, height - gap, centre, front - relief / 2, z + gap / 2))
        side = 1 if door < doors / 2 else -1
        parts.append(
            _box(0.02, 0.03, height * 0.2, centre + side * cell * 0.36, front - relief - 0.015, z + height * 0.45)
        )
    return parts


# --------------------------------------------------------------------------------------------------------------- bathtub


def _tub_box(random: Random) -> Parts:
    width, depth, height = random.uniform(1.4, 1.9), random.uniform(0.65, 0.9), random.uniform(0.4, 0.62)
    wall, floor = random.uniform(0.05, 0.11), random.uniform(0.06, 0.15)
    rim = random.uniform(0.0, 0.06)
    parts = [_box(width, depth, floor)]
    for side in (-1, 1):
        parts.append(_box(wall, depth, height, side * (width - wall) / 2))
        parts.append(_box(width, wall, height, 0, side * (depth - wall) / 2))
        parts.append(_box(width + rim, wall + rim, 0.03, 0, side * (depth - wall) / 2, height))
        parts.append(_box(wall + rim, depth + rim, 0.03, side * (width - wall) / 2, 0, height))
    return parts + _tap(random, width, height)


def _tap(random: Random, width: float, height: float) -> Parts:
    if random.random() < 0.4:
        return []
    x = -width / 2 + 0.05
    rise = random.uniform(0.1, 0.2)
    return [_cylinder(0.02, rise, x, 0, height, 10), _rod((x, 0, height + rise), (x + 0.16, 0, height + rise), 0.018)]


def _tub_oval(random: Random, feet: bool = False, slipper: bool = False) -> Parts:
    length, height = random.uniform(1.4, 1.8), random.uniform(0.42, 0.6)
    ratio = random.uniform(0.42, 0.56)
    base = random.uniform(0.62, 0.85)
    wall = 0.05
    r = length / 2
    profile = [(0, 0.04), (base * r, 0.0), (r, height), (r + 0.03, height + 0.02), (r - wall, height + 0.02)]
    profile += [(r - wall - 0.02, height), (base * r - wall, 0.08), (0, 0.08)]
    tub = _lathe(profile, 1, ratio)
    if slipper:  # one end higher than the other
        vertices = tub.vertices.copy()
        vertices[:, 2] *= 1 + 0.45 * np.clip(vertices[:, 0] / r, 0, 1) ** 2
        tub.vertices = vertices
    parts = [tub]
    if feet:
        lift = random.uniform(0.1, 0.16)
        tub.apply_translation((0, 0, lift))
        for sx in (-1, 1):
            for sy in (-1, 1):
                parts.append(_box(0.08, 0.08, lift + 0.08, sx * base * r * 0.7, sy * base * r * ratio * 0.7))
    return parts + (_tap(random, length * 0.9, height) if not slipper else [])


def _tub_clawfoot(random: Random) -> Parts:
    return _tub_oval(random, feet=True, slipper=random.random() < 0.5)


def _tub_panelled(random: Random) -> Parts:
    """An oval basin sunk into a box: walls outside, an ellipse inside."""
    width, depth, height = random.uniform(1.5, 1.9), random.uniform(0.75, 1.1), random.uniform(0.42, 0.6)
    r = width / 2
    ratio = depth / width
    rim = random.uniform(0.74, 0.88)
    basin = _lathe([(0, 0.12), (r * rim * 0.75, 0.1), (r * rim, height), (r * rim * 1.02, height)], 1, ratio)
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
        parts.append(_box(0.02, depth, height, side * (width / 2 - 0.01)))
        parts.append(_box(width, 0.02, height, 0, side * (depth / 2 - 0.01)))
    return parts + _tap(random, width, height)


# ------------------------------------------------------------------------------------------------------------------- bed


def _mattress(random: Random, width: float, length: float, base: float, thickness: float) -> Parts:
    parts = [_box(width * 0.97, length * 0.97, thickness, 0, 0, base)]
    pillows = 2 if width > 1.2 else 1
    for pillow in range(pillows):
        x = (pillow - (pillows - 1) / 2) * width * 0.46
        parts.append(_box(width * (0.4 if pillows == 2 else 0.7), 0.35, 0.1, x, length / 2 - 0.28, base + thickness))
    if random.random() < 0.4:
        parts.append(_box(width * 1.01, length * 0.55, 0.04, 0, -length * 0.2, base + thickness))
    return parts


def _bed_size(random: Random) -> tuple[float, float, float, float]:
    width = random.choice([random.uniform(0.85, 1.1), random.uniform(1.35, 1.9)])
    return width, random.uniform(1.9, 2.15), random.uniform(0.2, 0.4), random.uniform(0.15, 0.28)


def _bed_platform(random: Random) -> Parts:
    width, length, base, thickness = _bed_size(random)
    head = random.uniform(0.0, 0.6)
    parts = [
        _box(width + 0.1, length + 0.1, base * 0.6, 0, 0, base * 0.4),
        *_mattress(random, width, length, base, thickness),
    ]
    parts += _four_legs(width, length, base * 0.4, 0.1, 0.05)
    if head > 0.15:
        parts.append(_box(width + 0.1, 0.07, base + thickness + head, 0, length / 2 + 0.06))
    return parts


def _bed_boards(random: Random) -> Parts:
    width, length, base, thickness = _bed_size(random)
    head, foot = random.uniform(0.3, 0.8), random.uniform(0.05, 0.35)
    parts = [_box(width, length, 0.12, 0, 0, base - 0.12), *_mattress(random, width, length, base, thickness)]
    for y, rise in ((length / 2 + 0.03, head), (-length / 2 - 0.03, foot)):
        top = base + thickness + rise
        if random.random() < 0.5:
            parts.append(_box(width, 0.06, top - base * 0.5, 0, y, base * 0.5))
        else:  # rails and spindles
            parts.append(_box(width, 0.05, 0.07, 0, y, top - 0.07))
            parts += [_box(0.03, 0.03, top - base, x, y, base) for x in np.linspace(-width / 2, width / 2, 9)]
        parts += [_box(0.07, 0.07, top, sx * width / 2, y) for sx in (-1, 1)]
    return parts


def _bed_four_poster(random: Random) -> Parts:
    width, length, base, thickness = _bed_size(random)
    height = random.uniform(1.6, 2.1)
    parts = [_box(width, length, 0.14, 0, 0, base - 0.14), *_mattress(random, width, length, base, thickness)]
    parts += _four_legs(width + 0.1, length + 0.1, height, random.uniform(0.06, 0.1))
    if random.random() < 0.7:
        for side in (-1, 1):
            parts.append(_box(0.05, length, 0.05, side * width / 2, 0, height - 0.05))
            parts.append(_box(width, 0.05, 0.05, 0, side * length / 2, height - 0.05))
    parts.append(_box(width, 0.05, 0.6, 0, length / 2, base))
    return parts


def _bed_bunk(random: Random) -> Parts:
    width, length = random.uniform(0.9, 1.1), random.uniform(1.9, 2.1)
    lower, upper = random.uniform(0.25, 0.4), random.uniform(1.2, 1.5)
    parts = _four_legs(width + 0.1, length + 0.1, upper + 0.55, 0.08)
    for base in (lower, upper):
        parts += [_box(width, length, 0.1, 0, 0, base - 0.1), *_mattress(random, width, length, base, 0.15)]
    for side in (-1, 1):
        parts.append(_box(0.04, length, 0.12, side * width / 2, 0, upper + 0.28))
        parts.append(_box(width, 0.04, 0.12, 0, side * length / 2, upper + 0.28))
    y = -length / 2 + 0.25
    parts += [_box(0.03, 0.35, 0.03, -width / 2 - 0.06, y, z) for z in np.linspace(0.3, upper + 0.2, 5)]
    return parts


def _bed_day(random: Random) -> Parts:
    width, length, base, thickness = random.uniform(0.85, 1.05), random.uniform(1.9, 2.1), 0.35, 0.2
    rise = random.uniform(0.35, 0.55)
    parts = [_box(width, length, 0.2, 0, 0, base - 0.2), *_mattress(random, width, length, base, thickness)]
    parts.append(_box(0.06, length, base + thickness + rise, width / 2 + 0.03))
    for side in (-1, 1):
        parts.append(_box(width, 0.06, base + thickness + rise * 0.7, 0, side * (length / 2 + 0.03)))
    return parts


# ----------------------------------------------------------------------------------------------------------------- chair


def _chair_size(random: Random) -> tuple[float, float, float, float]:
    """Width, depth, seat height, height of the back above the seat."""
    return random.uniform(0.4, 0.52), random.uniform(0.4, 0.52), random.uniform(0.4, 0.5), random.uniform(0.35, 0.65)


def _chair_back(random: Random, width: float, depth: float, seat: float, back: float) -> Parts:
    y = depth / 2 - 0.025
    style = random.integers(4)
    parts: Parts = []
    if style == 0:
        parts.append(_box(width * 0.95, 0.03, back, 0, y, seat))
    elif style == 1:  # vertical slats
        parts.append(_box(width, 0.03, 0.07, 0, y, seat + back - 0.07))
        parts += [_box(0.025, 0.025, back, x, y, seat) for x in np.linspace(-width / 2 + 0.02, width / 2 - 0.02, 6)]
    elif style == 2:  # ladder
        parts += [_box(0.035, 0.035, back, sx * (width / 2 - 0.02), y, seat) for sx in (-1, 1)]
        parts += [_box(width, 0.02, 0.06, 0, y, seat + back * t) for t in (0.3, 0.6, 0.88)]
    else:  # panel on two posts
        parts += [_box(0.035, 0.035, back, sx * (width / 2 - 0.06), y, seat) for sx in (-1, 1)]
        parts.append(_box(width, 0.035, back * 0.45, 0, y, seat + back * 0.55))
    return _tilt(parts, random.uniform(0, 0.25), (0, y, seat))


def _chair_arms(width: float, depth: float, seat: float, rise: float) -> Parts:
    parts: Parts = []
    for side in (-1, 1):
        parts.append(_box(0.05, depth * 0.9, 0.035, side * width / 2, 0, seat + rise))
        parts.append(_box(0.035, 0.035, rise, side * width / 2, -depth * 0.38, seat))
    return parts


def _chair_dining(random: Random) -> Parts:
    width, depth, seat, back = _chair_size(random)
    splay = random.uniform(0.02, 0.08) if random.random() < 0.4 else 0
    parts = [_box(width, depth, random.uniform(0.03, 0.08), 0, 0, seat - 0.04)]
    parts += _four_legs(width, depth, seat - 0.03, random.uniform(0.03, 0.05), 0.01, round_legs=True, splay=splay)
    parts += _chair_back(random, width, depth, seat, back)
    return parts + (_chair_arms(width, depth, seat, 0.22) if random.random() < 0.35 else [])


def _chair_office(random: Random) -> Parts:
    width, depth, seat, back = _chair_size(random)
    arms = 5
    parts = [_box(width, depth, 0.09, 0, 0, seat - 0.05), _cylinder(0.03, seat - 0.08, 0, 0, 0.06)]
    for arm in range(arms):
        angle = 2 * np.pi * arm / arms
        tip = (0.3 * np.cos(angle), 0.3 * np.sin(angle))
        parts += [
            _rod((0, 0, 0.11), (*tip, 0.07), 0.025),
            trimesh.creation.icosphere(1, 0.035).apply_translation((*tip, 0.035)),
        ]
    backrest = [
        _box(width * 0.9, 0.06, back * 0.8, 0, depth / 2, seat + back * 0.2),
        _box(0.06, 0.03, back * 0.3, 0, depth / 2, seat),
    ]
    parts += _tilt(backrest, random.uniform(0, 0.2), (0, depth / 2, seat))
    return parts + (_chair_arms(width * 1.15, depth, seat, 0.2) if random.random() < 0.6 else [])


def _chair_cantilever(random: Random) -> Parts:
    width, depth, seat, back = _chair_size(random)
    r = 0.016
    parts = [_box(width, depth, 0.05, 0, 0, seat - 0.02)]
    for side in (-1, 1):
        x = side * width / 2
        parts += [_rod((x, depth / 2, r), (x, -depth / 2, r), r), _rod((x, -depth / 2, r), (x, -depth / 2, seat), r)]
        parts += [
            _rod((x, -depth / 2, seat), (x, depth / 2, seat), r),
            _rod((x, depth / 2, seat), (x, depth / 2 + 0.06, seat + back), r),
        ]
    parts.append(_rod((-width / 2, depth / 2, r), (width / 2, depth / 2, r), r))
    parts.append(_box(width, 0.03, back * 0.55, 0, depth / 2 + 0.04, seat + back * 0.42))
    return parts


def _chair_tub(random: Random) -> Parts:
    width, depth = random.uniform(0.6, 0.8), random.uniform(0.6, 0.75)
    seat, back, wall = random.uniform(0.36, 0.44), random.uniform(0.35, 0.55), random.uniform(0.09, 0.15)
    parts = [_box(width, depth, seat - 0.1, 0, 0, 0.1), *_four_legs(width, depth, 0.1, 0.05, 0.04)]
    parts.append(_box(width, wall, back + 0.05, 0, depth / 2 - wall / 2, seat - 0.05))
    rise = back * random.uniform(0.4, 1.0)
    parts += [_box(wall, depth, rise, side * (width - wall) / 2, 0, seat - 0.02) for side in (-1, 1)]
    return parts


def _chair_stool_back(random: Random) -> Parts:
    radius, seat, back = random.uniform(0.17, 0.23), random.uniform(0.5, 0.75), random.uniform(0.2, 0.4)
    parts = [_cylinder(radius, 0.05, 0, 0, seat)]
    parts += _four_legs(radius * 1.5, radius * 1.5, seat, 0.035, splay=0.07)
    z = seat * 0.35
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        parts.append(
            _rod((ax * radius * 0.85, ay * radius * 0.85, z), (bx * radius * 0.85, by * radius * 0.85, z), 0.012)
        )
    y = radius * 0.8
    parts += [_rod((sx * radius * 0.5, y, seat), (sx * radius * 0.6, y + 0.05, seat + back), 0.014) for sx in (-1, 1)]
    return [*parts, _box(radius * 1.7, 0.03, 0.1, 0, y + 0.05, seat + back - 0.06)]


# -------------------------------------------------------------------------------------------------------- table and desk


def _board(random: Random) -> tuple[float, float, float, float]:
    """Width, depth, height and thickness of a top: one distribution for tables and desks, so that a top tells nothing."""
    return random.uniform(1.1, 1.8), random.uniform(0.55, 0.9), random.uniform(0.68, 0.8), random.uniform(0.025, 0.06)


def _top(width: float, depth: float, height: float, thickness: float) -> Solid:
    return _box(width, depth, thickness, 0, 0, height - thickness)


def _table_four_legs(random: Random) -> Parts:
    width, depth, height, thick = _board(random)
    leg, inset = random.uniform(0.04, 0.09), random.uniform(0, 0.08)
    parts = [
        _top(width, depth, height, thick),
        *_four_legs(width, depth, height - thick, leg, inset, random.random() < 0.4),
    ]
    if random.random() < 0.6:  # apron all round
        drop = random.uniform(0.06, 0.13)
        for side in (-1, 1):
            parts.append(
                _box(width - 2 * inset, 0.025, drop, 0, side * (depth / 2 - inset - leg / 2), height - thick - drop)
            )
            parts.append(
                _box(0.025, depth - 2 * inset, drop, side * (width / 2 - inset - leg / 2), 0, height - thick - drop)
            )
    return parts


def _table_panel_ends(random: Random) -> Parts:
    width, depth, height, thick = _board(random)
    inset = random.uniform(0, 0.2)
    parts = [_top(width, depth, height, thick)]
    parts += [_box(thick, depth * 0.95, height - thick, side * (width / 2 - thick / 2 - inset)) for side in (-1, 1)]
    if random.random() < 0.6:
        parts.append(_box(width - 2 * inset, 0.03, random.uniform(0.1, 0.2), 0, 0, height * random.uniform(0.25, 0.6)))
    return parts


def _table_round(random: Random) -> Parts:
    radius, height, thick = random.uniform(0.4, 0.7), random.uniform(0.55, 0.8), random.uniform(0.025, 0.06)
    stretch = random.uniform(1.0, 1.5)
    top = _cylinder(radius, thick, 0, 0, height - thick, 36)
    top.apply_scale((stretch, 1, 1))
    if random.random() < 0.5:
        return [top, _cylinder(random.uniform(0.04, 0.09), height - thick), _cylinder(radius * 0.55, 0.04, sections=28)]
    return [top, *_four_legs(radius * 1.3 * stretch, radius * 1.3, height - thick, 0.06, splay=random.uniform(0, 0.08))]


def _table_trestle(random: Random) -> Parts:
    width, depth, height, thick = _board(random)
    parts = [_top(width, depth, height, thick), _box(width * 0.7, 0.04, 0.1, 0, 0, height * 0.3)]
    for side in (-1, 1):
        x = side * width * 0.36
        parts += [_rod((x, -depth * 0.42, 0), (x, depth * 0.2, height - thick), 0.03)]
        parts += [_rod((x, depth * 0.42, 0), (x, -depth * 0.2, height - thick), 0.03)]
    return parts


def _table_coffee(random: Random) -> Parts:
    width, depth, height = random.uniform(0.8, 1.3), random.uniform(0.5, 0.8), random.uniform(0.35, 0.5)
    leg = random.uniform(0.04, 0.09)
    parts = [_top(width, depth, height, 0.04), *_four_legs(width, depth, height - 0.04, leg)]
    if random.random() < 0.7:
        parts.append(_box(width - leg, depth - leg, 0.03, 0, 0, height * 0.3))
    return parts


def _modesty(random: Random, width: float, depth: float, height: float, thick: float, inset: float = 0.05) -> Parts:
    """The panel at the back of a desk."""
    drop = (height - thick) * random.uniform(0.3, 0.95)
    return [_box(width - 2 * inset, 0.02, drop, 0, depth / 2 - inset, height - thick - drop)]


def _pedestal(random: Random, width: float, depth: float, height: float, x: float) -> Parts:
    rows = int(random.integers(2, 5))
    front = -depth / 2 + 0.03
    return [_box(width, depth - 0.03, height, x, 0.015), *_drawers(random, width, height, rows, 1, x, front, 0)]


def _desk_one_pedestal(random: Random) -> Parts:
    width, depth, height, thick = _board(random)
    body, side = random.uniform(0.32, 0.45), random.choice([-1, 1])
    parts = [_top(width, depth, height, thick)]
    parts += _pedestal(random, body, depth * 0.95, height - thick, side * (width - body) / 2)
    if random.random() < 0.5:
        parts.append(_box(0.04, depth * 0.95, height - thick, -side * (width / 2 - 0.02)))
    else:
        parts += [
            _box(0.05, 0.05, height - thick, -side * (width / 2 - 0.04), sy * (depth / 2 - 0.05)) for sy in (-1, 1)
        ]
    return parts + (_modesty(random, width, depth, height, thick) if random.random() < 0.5 else [])


def _desk_two_pedestals(random: Random) -> Parts:
    width, depth, height, thick = _board(random)
    width = max(width, 1.25)
    body = random.uniform(0.3, 0.42)
    state = int(random.integers(2**31))
    parts = [_top(width, depth, height, thick)]
    for side in (-1, 1):  # both pedestals alike
        parts += _pedestal(np.random.default_rng(state), body, depth * 0.95, height - thick, side * (width - body) / 2)
    return parts + (_modesty(random, width, depth, height, thick) if random.random() < 0.6 else [])


def _desk_corner(random: Random) -> Parts:
    width, depth, height, thick = _board(random)
    side, reach, wing = random.choice([-1, 1]), random.uniform(0.5, 0.9), random.uniform(0.45, 0.6)
    x, y = side * (width - wing) / 2, -depth / 2 - reach / 2
    parts = [_top(width, depth, height, thick), _box(wing, reach, thick, x, y, height - thick)]
    parts += [_box(0.04, depth * 0.95, height - thick, -side * (width / 2 - 0.02))]
    parts += [_box(wing * 0.95, 0.04, height - thick, x, -depth / 2 - reach + 0.03)]
    parts += [_box(width, 0.02, (height - thick) * random.uniform(0.3, 0.8), 0, depth / 2 - 0.02, height * 0.2)]
    if random.random() < 0.6:
        parts += _pedestal(random, 0.38, depth * 0.9, height - thick, -side * (width / 2 - 0.24))
    else:
        parts += [_box(0.05, 0.05, height - thick, side * (width / 2 - 0.04), depth / 2 - 0.05)]
    return parts


def _desk_writing(random: Random) -> Parts:
    """A table but for the drawers under its top, which show only from the front."""
    width, depth, height, thick = _board(random)
    drop, leg = random.uniform(0.1, 0.16), random.uniform(0.04, 0.07)
    parts = [
        _top(width, depth, height, thick),
        *_four_legs(width, depth, height - thick, leg, round_legs=random.random() < 0.3),
    ]
    parts.append(_box(width - leg, depth - leg, drop, 0, 0.01, height - thick - drop))
    front = -depth / 2 + leg / 2 + 0.01
    parts += _drawers(random, width - leg * 2, drop, 1, int(random.integers(1, 4)), 0, front, height - thick - drop)
    return parts


def _desk_hutch(random: Random) -> Parts:
    parts = (_desk_writing if random.random() < 0.4 else _desk_one_pedestal)(random)
    low, high = joined(parts).bounds
    width, rise, depth = high[0] - low[0], random.uniform(0.25, 0.6), random.uniform(0.2, 0.3)
    y, z = high[1] - depth / 2, high[2]
    parts += [_box(0.03, depth, rise, side * (width / 2 - 0.015), y, z) for side in (-1, 1)]
    parts += [_box(width, depth, 0.03, 0, y, z + rise), _box(width, 0.02, rise, 0, high[1] - 0.01, z)]
    return parts


# ----------------------------------------------------------------------------------------------- dresser and night stand


def _carcass(random: Random, width: float, depth: float, height: float, feet: float) -> Parts:
    overhang = random.choice([0, random.uniform(0.01, 0.04)])
    parts = [_box(width, depth, height - feet - 0.03, 0, 0, feet)]
    parts.append(_box(width + 2 * overhang, depth + 2 * overhang, 0.03, 0, 0, height - 0.03))
    if feet > 0.02:
        parts += _four_legs(width, depth, feet, random.uniform(0.04, 0.07), 0.01)
    return parts


def _dresser_wide(random: Random) -> Parts:
    width, depth, height = random.uniform(0.95, 1.7), random.uniform(0.42, 0.58), random.uniform(0.7, 0.95)
    feet = random.choice([0.0, random.uniform(0.05, 0.2)])
    rows, columns = int(random.integers(2, 5)), int(random.integers(2, 4))
    parts = _carcass(random, width, depth, height, feet)
    return parts + _drawers(random, width * 0.96, height - feet - 0.05, rows, columns, 0, -depth / 2, feet + 0.01)


def _dresser_chest(random: Random) -> Parts:
    """Tall and narrow; its lower end overlaps a night stand's proportions."""
    width, depth, height = random.uniform(0.6, 0.95), random.uniform(0.42, 0.58), random.uniform(0.75, 1.35)
    feet = random.choice([0.0, random.uniform(0.04, 0.15)])
    parts = _carcass(random, width, depth, height, feet)
    rows = int(random.integers(3, 7))
    return parts + _drawers(random, width * 0.96, height - feet - 0.05, rows, 1, 0, -depth / 2, feet + 0.01)


def _dresser_mirror(random: Random) -> Parts:
    parts = _dresser_wide(random)
    low, high = joined(parts).bounds
    width, rise = (high[0] - low[0]) * random.uniform(0.5, 0.9), random.uniform(0.5, 0.9)
    y = high[1] - 0.06
    parts += [_box(width, 0.03, rise, 0, y, high[2] + 0.04), _box(width * 0.6, 0.06, 0.05, 0, y, high[2])]
    parts += [_box(0.05, 0.06, rise + 0.08, side * width / 2, y, high[2]) for side in (-1, 1)]
    return parts


def _dresser_doors(random: Random) -> Parts:
    width, depth, height = random.uniform(0.9, 1.6), random.uniform(0.42, 0.58), random.uniform(0.75, 1.0)
    feet = random.choice([0.0, random.uniform(0.05, 0.2)])
    parts = _carcass(random, width, depth, height, feet)
    inside, bottom = height - feet - 0.05, feet + 0.01
    share = random.uniform(0.35, 0.6) * width
    parts += _doors(random, share, inside, 1 if share < 0.55 else 2, -width * 0.48 + share / 2, -depth / 2, bottom)
    rest = width * 0.96 - share
    return parts + _drawers(
        random, rest, inside, int(random.integers(2, 5)), 1, width * 0.48 - rest / 2, -depth / 2, bottom
    )


def _stand_size(random: Random) -> tuple[float, float, float, float]:
    """Width, depth, height, feet."""
    feet = random.choice([0.0, random.uniform(0.04, 0.25)])
    return random.uniform(0.4, 0.65), random.uniform(0.35, 0.5), random.uniform(0.5, 0.75), feet


def _stand_drawers(random: Random) -> Parts:
    width, depth, height, feet = _stand_size(random)
    parts = _carcass(random, width, depth, height, feet)
    rows = int(random.integers(2, 4))
    return parts + _drawers(random, width * 0.95, height - feet - 0.05, rows, 1, 0, -depth / 2, feet + 0.01)


def _open_shelf(width: float, depth: float, bottom: float, top: float) -> Parts:
    """Two sides, a back and a floor."""
    rise = top - bottom
    parts = [_box(0.025, depth, rise, side * (width / 2 - 0.0125), 0, bottom) for side in (-1, 1)]
    return [*parts, _box(width, 0.02, rise, 0, depth / 2 - 0.01, bottom), _box(width, depth, 0.025, 0, 0, bottom)]


def _stand_shelf(random: Random) -> Parts:
    """A drawer above an open compartment."""
    width, depth, height, feet = _stand_size(random)
    split = feet + (height - feet) * random.uniform(0.45, 0.65)
    parts = [*_open_shelf(width, depth, feet, split), _box(width, depth, height - split, 0, 0, split)]
    if feet > 0.02:
        parts += _four_legs(width, depth, feet, 0.045)
    return parts + _drawers(random, width * 0.94, height - split - 0.03, 1, 1, 0, -depth / 2, split + 0.01)


def _stand_door(random: Random) -> Parts:
    width, depth, height, feet = _stand_size(random)
    parts = _carcass(random, width, depth, height, feet)
    inside, bottom = height - feet - 0.05, feet + 0.01
    drawer = inside * random.uniform(0.25, 0.4)
    parts += _doors(random, width * 0.94, inside - drawer, 1, 0, -depth / 2, bottom)
    return parts + _drawers(random, width * 0.94, drawer, 1, 1, 0, -depth / 2, bottom + inside - drawer)


def _stand_legs(random: Random) -> Parts:
    """A drawer on long legs, sometimes with a shelf: a small writing desk's build at another scale."""
    width, depth, height, _ = _stand_size(random)
    drop, leg = random.uniform(0.13, 0.24), random.uniform(0.035, 0.05)
    parts = [_top(width + 0.03, depth + 0.03, height, 0.025), *_four_legs(width, depth, height - 0.02, leg)]
    parts.append(_box(width - leg / 2, depth - leg / 2, drop, 0, 0.01, height - 0.025 - drop))
    if random.random() < 0.6:
        parts.append(_box(width - leg, depth - leg, 0.025, 0, 0, height * random.uniform(0.15, 0.3)))
    return parts + _drawers(random, width - leg * 2, drop, 1, 1, 0, -depth / 2 + 0.02, height - 0.025 - drop)


# --------------------------------------------------------------------------------------------------------------- monitor


def _screen(random: Random, width: float, height: float, thick: float, z: float) -> Parts:
    """A slab whose front has a rim around a recessed panel."""
    rim = random.uniform(0.012, 0.03)
    parts = [_box(width, thick, height, 0, thick / 2, z)]
    parts += [_box(rim, 0.015, height, side * (width - rim) / 2, -0.0075, z) for side in (-1, 1)]
    return [*parts, _box(width, 0.015, rim, 0, -0.0075, z), _box(width, 0.015, rim, 0, -0.0075, z + height - rim)]


def _monitor_flat(random: Random, round_base: bool | None = None) -> Parts:
    width = random.uniform(0.4, 0.8)
    height = width * random.uniform(0.5, 0.8)
    thick, lift = random.uniform(0.025, 0.07), random.uniform(0.07, 0.18)
    round_base = bool(random.random() < 0.5) if round_base is None else round_base
    parts = _tilt(_screen(random, width, height, thick, lift), random.uniform(-0.02, 0.15), (0, 0, lift))
    parts.append(_box(random.uniform(0.04, 0.12), 0.03, lift + height * 0.4, 0, thick + 0.015))
    size = width * random.uniform(0.35, 0.6)
    parts.append(
        _cylinder(size / 2, 0.02, 0, 0.03, sections=28) if round_base else _box(size, size * 0.7, 0.02, 0, 0.03)
    )
    return parts


def _monitor_tube(random: Random) -> Parts:
    """A cathode-ray tube: as deep as it is wide, tapering to the back."""
    width = random.uniform(0.38, 0.55)
    height, depth = width * random.uniform(0.75, 0.9), width * random.uniform(0.7, 1.0)
    lift = random.uniform(0.03, 0.08)
    parts = _screen(random, width, height, 0.12, lift)
    frustum = trimesh.creation.box((width * 0.96, depth - 0.12, height * 0.94))
    back = frustum.vertices[:, 1] > 0
    frustum.vertices[back] = frustum.vertices[back] * (0.55, 1, 0.6)
    frustum.apply_translation((0, 0.12 + (depth - 0.12) / 2, lift + height / 2))
    return [*parts, frustum, _cylinder(width * 0.3, lift, 0, depth * 0.35, sections=24)]


def _monitor_feet(random: Random) -> Parts:
    """A television on two feet."""
    width = random.uniform(0.7, 1.2)
    height, lift = width * random.uniform(0.52, 0.62), random.uniform(0.04, 0.09)
    parts = _screen(random, width, height, random.uniform(0.03, 0.06), lift)
    parts.append(_box(width * 0.5, 0.05, height * 0.4, 0, 0.06, lift + 0.05))
    return parts + [_box(0.03, 0.22, lift, side * width * random.uniform(0.3, 0.42), 0.02) for side in (-1, 1)]


def _monitor_wide(random: Random) -> Parts:
    """Two screens on one arm, or one very wide."""
    if random.random() < 0.5:
        width, height, lift = random.uniform(0.8, 1.0), random.uniform(0.32, 0.4), 0.14
        parts = _screen(random, width, height, 0.04, lift)
    else:
        width, height, lift = random.uniform(0.42, 0.55), random.uniform(0.27, 0.34), 0.14
        parts = []
        for side in (-1, 1):
            panel = _screen(random, width, height, 0.03, lift)
            turn = trimesh.transformations.rotation_matrix(side * 0.25, (0, 0, 1), (0, 0, 0))
            for part in panel:
                part.apply_transform(turn)
                part.apply_translation((side * width * 0.51, -0.05, 0))
            parts += panel
    parts += [
        _box(width * 0.9, 0.03, 0.05, 0, 0.06, lift + height * 0.45),
        _box(0.06, 0.04, lift + height * 0.5, 0, 0.07),
    ]
    return [*parts, _box(random.uniform(0.25, 0.4), 0.22, 0.02, 0, 0.05)]


# ------------------------------------------------------------------------------------------------------------------ sofa


def _sofa_body(
    random: Random, seats: int, *, arms: bool = True, arm_rise: float | None = None, round_arms: bool = False
) -> tuple[Parts, float, float, float]:
    """Seat, cushions, back and arms; also its width, depth and seat height."""
    width, depth = seats * random.uniform(0.58, 0.75), random.uniform(0.75, 0.95)
    seat, back = random.uniform(0.36, 0.46), random.uniform(0.32, 0.5)
    thick, arm = random.uniform(0.16, 0.24), random.uniform(0.12, 0.22)
    feet = random.choice([0.0, random.uniform(0.05, 0.14)])
    parts = [_box(width, depth, seat - 0.12 - feet, 0, 0, feet)]
    if feet:
        parts += _four_legs(width, depth, feet, 0.05, 0.03)
    cushion = width / seats
    for index in range(seats):
        x = -width / 2 + cushion * (index + 0.5)
        parts.append(_box(cushion - 0.02, depth - thick, 0.14, x, -thick / 2, seat - 0.12))
        if random.random() < 0.9:
            parts += _tilt(
                [_box(cushion - 0.03, 0.14, back * 0.85, x, depth / 2 - thick, seat)],
                0.15,
                (x, depth / 2 - thick, seat),
            )
    parts.append(_box(width, thick, seat + back - feet, 0, depth / 2 - thick / 2, feet))
    if arms:
        rise = back * random.uniform(0.35, 0.7) if arm_rise is None else arm_rise * back
        for side in (-1, 1):
            x = side * (width + arm) / 2
            parts.append(_box(arm, depth, seat + rise - feet, x, 0, feet))
            if round_arms:
                parts.append(_rod((x, -depth / 2, seat + rise), (x, depth / 2, seat + rise), arm * 0.6))
    return parts, width, depth, seat


def _sofa_plain(random: Random) -> Parts:
    return _sofa_body(random, int(random.integers(2, 4)))[0]


def _sofa_round_arms(random: Random) -> Parts:
    return _sofa_body(random, int(random.integers(2, 4)), round_arms=True)[0]


def _sofa_even(random: Random) -> Parts:
    """Arms as high as the back."""
    return _sofa_body(random, int(random.integers(2, 4)), arm_rise=1.0)[0]


def _sofa_armless(random: Random) -> Parts:
    return _sofa_body(random, int(random.integers(2, 4)), arms=False)[0]


def _sofa_corner(random: Random) -> Parts:
    """L-shaped: a chaise, or a second wing with its own back."""
    parts, width, depth, seat = _sofa_body(random, 3)
    side, reach, wing = random.choice([-1, 1]), random.uniform(0.6, 1.3), random.uniform(0.6, 0.8)
    x, y = side * (width / 2 - wing / 2), -depth / 2 - reach / 2
    parts += [_box(wing, reach, seat - 0.13, x, y), _box(wing - 0.02, reach, 0.14, x, y, seat - 0.12)]
    if random.random() < 0.6:
        parts.append(_box(0.18, reach, seat + 0.35, side * (width / 2 + 0.09), y))
    return parts


# ---------------------------------------------------------------------------------------------------------------- toilet


def _bowl(random: Random, height: float, foot: float) -> tuple[Parts, float, float]:
    """Bowl with seat; also the half width and the y of its back."""
    r, stretch = random.uniform(0.17, 0.21), random.uniform(1.2, 1.45)
    profile = [(0, 0.0), (foot * r, 0.0), (foot * r * 0.85, height * 0.4), (r, height * 0.85), (r, height)]
    profile += [(r * 0.72, height), (r * 0.55, height * 0.7), (r * 0.25, height * 0.5), (0, height * 0.48)]
    parts = [_lathe(profile, 1, stretch)]
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
            _lathe(
                [(0, height + 0.02), (r * 1.04, height + 0.02), (r * 1.04, height + 0.05), (0, height + 0.055)],
                1,
                stretch,
            )
        )
    else:  # seat with a hole, lid up
        parts.append(_lathe(ring, 1, stretch))
        lid = np.stack([r * np.cos(angles), np.zeros(29), r * stretch * np.sin(angles)], axis=1)
        vertices = np.concatenate([[(0, 0, 0)], lid, [(0, 0.02, 0)], lid + np.array([0, 0.02, 0])])
        i = np.arange(1, 29)
        faces = np.concatenate([np.c_[np.zeros(28, int), i, i + 1], np.c_[np.full(28, 30), i + 31, i + 30]])
        up = trimesh.Trimesh(vertices, faces, process=False)
        up.apply_translation((0, r * stretch * 0.8, height + r * stretch))
        parts.append(up)
    return parts, r, r * stretch


def _toilet_tank(random: Random, r: float, back: float, base: float) -> Parts:
    width, depth, height = r * random.uniform(2.0, 2.7), random.uniform(0.15, 0.22), random.uniform(0.3, 0.42)
    y = back + depth / 2 - 0.02
    parts = [_box(width, depth, height, 0, y, base), _box(width + 0.03, depth + 0.03, 0.03, 0, y, base + height)]
    if random.random() < 0.6:
        parts.append(_box(0.06, 0.03, 0.02, -width * 0.35, y - depth / 2 - 0.015, base + height * 0.8))
    return parts


def _toilet_two_piece(random: Random) -> Parts:
    height = random.uniform(0.36, 0.44)
    parts, r, back = _bowl(random, height, random.uniform(0.6, 0.8))
    parts.append(_box(r * 1.1, back * 0.8, height * 0.9, 0, back * 0.7))
    return parts + _toilet_tank(random, r, back, height - 0.02)


def _toilet_one_piece(random: Random) -> Parts:
    """Skirted: the sides fall straight to the floor, the tank grows out of the bowl."""
    height = random.uniform(0.34, 0.42)
    parts, r, back = _bowl(random, height, random.uniform(0.85, 1.0))
    parts.append(_box(r * 1.9, back * 0.9, height, 0, back * 0.75))
    width, rise = r * random.uniform(1.9, 2.2), random.uniform(0.22, 0.34)
    return [*parts, _box(width, 0.2, height + rise, 0, back + 0.08)]


def _toilet_wall_hung(random: Random) -> Parts:
    height, lift = random.uniform(0.28, 0.34), random.uniform(0.06, 0.12)
    parts, r, back = _bowl(random, height, random.uniform(0.25, 0.45))
    for part in parts:
        part.apply_translation((0, 0, lift))
    parts.append(_box(r * 1.6, 0.16, height * 0.8, 0, back * 0.9, lift + height * 0.2))
    return [*parts, _box(r * 2.6, 0.06, random.uniform(0.7, 1.1), 0, back + 0.08)]


def _toilet_high_tank(random: Random) -> Parts:
    height = random.uniform(0.36, 0.42)
    parts, r, back = _bowl(random, height, random.uniform(0.55, 0.75))
    tank = random.uniform(0.9, 1.3)
    parts.append(_rod((0, back + 0.08, height * 0.5), (0, back + 0.08, tank), 0.025))
    parts.append(_box(r * 1.1, back * 0.6, height * 0.9, 0, back * 0.6))
    return parts + _toilet_tank(random, r, back, tank)


VARIANTS: dict[str, tuple[Callable[[Random], Parts], ...]] = {
    "bathtub": (_tub_box, _tub_oval, _tub_clawfoot, _tub_panelled),
    "bed": (_bed_platform, _bed_boards, _bed_four_poster, _bed_bunk, _bed_day),
    "chair": (_chair_dining, _chair_office, _chair_cantilever, _chair_tub, _chair_stool_back),
    "desk": (_desk_one_pedestal, _desk_two_pedestals, _desk_corner, _desk_writing, _desk_hutch),
    "dresser": (_dresser_wide, _dresser_chest, _dresser_mirror, _dresser_doors),
    "monitor": (_monitor_flat, _monitor_tube, _monitor_feet, _monitor_wide),
    "night_stand": (_stand_drawers, _stand_shelf, _stand_door, _stand_legs),
    "sofa": (_sofa_plain, _sofa_round_arms, _sofa_even, _sofa_armless, _sofa_corner),
    "table": (_table_four_legs, _table_panel_ends, _table_round, _table_trestle, _table_coffee),
    "toilet": (_toilet_two_piece, _toilet_one_piece, _toilet_wall_hung, _toilet_high_tank),
}
