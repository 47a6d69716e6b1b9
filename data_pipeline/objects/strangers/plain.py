"""Plain shapes: primitives, superquadrics, surfaces of revolution, extruded outlines, and random assemblies."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from data_pipeline.objects.furniture import solids
from data_pipeline.objects.furniture.solids import Parts, Random
from data_pipeline.objects.strangers.shapes import (
    Groups,
    bend,
    blob,
    capsule,
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
    upright,
)

# ------------------------------------------------------------------------------------------------------------- primitives


def sphere(random: Random) -> Parts:
    radius = random.uniform(0.05, 0.5)
    return [blob((radius, radius, radius), sections=int(random.integers(16, 32)))]


def ellipsoid(random: Random) -> Parts:
    return [blob(random.uniform(0.1, 0.5, 3))]


def cylinder(random: Random) -> Parts:
    """From a coin to a pole."""
    radius = random.uniform(0.05, 0.3)
    height = radius * np.exp(random.uniform(np.log(0.2), np.log(10)))
    return tossed(random, [solids.cylinder(radius, height, sections=24)])


def cone(random: Random) -> Parts:
    """A cone, or its lower part."""
    radius, height = random.uniform(0.1, 0.4), random.uniform(0.2, 0.9)
    tip = random.uniform(0.3, 0.7) if either(random) else 0.02
    return tossed(random, [loft([level(circle(24) * radius, 0), level(circle(24) * radius * tip, height)])])


def torus(random: Random) -> Parts:
    radius = random.uniform(0.2, 0.4)
    thick = radius * random.uniform(0.1, 0.6)
    rows = [
        np.column_stack([(radius + thick * c) * circle(28), np.full(28, thick * s)])
        for c, s in circle(15)[[*range(15), 0]]
    ]
    return tossed(random, [loft(rows, caps=False)], 0.5)


def cube(random: Random) -> Parts:
    return [solids.box(*random.uniform(0.3, 0.5) * random.uniform(0.9, 1.1, 3))]


def flat_plate(random: Random) -> Parts:
    """A rectangle or an ellipse that lies."""
    width, depth, height = random.uniform(0.3, 1.0), random.uniform(0.3, 1.0), random.uniform(0.01, 0.06)
    if either(random):
        return [solids.box(width, depth, height)]
    return [loft([level(circle(28) * (width / 2, depth / 2), z) for z in (0, height)])]


def upright_plate(random: Random) -> Parts:
    """A plate without a stand."""
    return [solids.box(random.uniform(0.3, 0.9), random.uniform(0.01, 0.07), random.uniform(0.3, 0.9))]


def tall_box(random: Random) -> Parts:
    return [solids.box(random.uniform(0.2, 0.4), random.uniform(0.2, 0.4), random.uniform(0.8, 1.8))]


def bar(random: Random) -> Parts:
    """A long box that lies."""
    return [solids.box(random.uniform(0.8, 1.6), random.uniform(0.04, 0.25), random.uniform(0.04, 0.25))]


def prism(random: Random) -> Parts:
    """Of three, five, six or eight sides."""
    outline = circle(int(random.choice([3, 5, 6, 8])), random.uniform(0, 2)) * random.uniform(0.15, 0.4, 2)
    return tossed(random, [loft([level(outline, z) for z in (0, random.uniform(0.1, 0.9))])])


def pyramid(random: Random) -> Parts:
    """Of three to six sides; whole, cut, or double."""
    outline, height = circle(int(random.integers(3, 7)), random.uniform(0, 2)) * 0.4, random.uniform(0.3, 0.8)
    rows = [level(outline, 0), level(outline * random.choice([0.0, random.uniform(0.2, 0.5)]), height)]
    if either(random, 0.25):
        rows = [level(outline * 0, -height * random.uniform(0.3, 1)), *rows]
    return [loft(rows)]


def wedge(random: Random) -> Parts:
    """A ramp, a roof or a cheese."""
    width, height, depth = random.uniform(0.3, 0.8), random.uniform(0.15, 0.5), random.uniform(0.2, 0.8)
    peak = random.choice([0.0, random.uniform(0.2, 0.8)])
    rest = height * random.choice([0.0, random.uniform(0.1, 0.4)])
    outline = np.array([(0, 0), (width, 0), (width, rest), (peak * width, height), (0, rest)])
    return placed([slab(outline, depth)], turn=(0, 0, random.uniform(0, 2 * np.pi)))


def pill(random: Random) -> Parts:
    radius = random.uniform(0.06, 0.2)
    solid = capsule((0, 0, 0), (0, 0, random.uniform(0.15, 0.7)), radius, random.uniform(0.6, 1))
    return tossed(random, [solid], 0.5)


def hemisphere(random: Random) -> Parts:
    """A dome, a part of it, or either upside down."""
    radius, cut = random.uniform(0.2, 0.5), random.uniform(0, 0.8)
    rows = [level(circle(26) * radius * np.cos(t), radius * np.sin(t)) for t in np.linspace(cut, np.pi / 2, 9)]
    return placed([loft(rows)], turn=(np.pi * either(random), 0, 0))


# ---------------------------------------------------------------------------------------------------------- superquadrics


def superellipsoid(random: Random) -> Parts:
    """From pillows to diamonds."""
    flat, square = random.choice([0.2, 0.5, 1.8, 2.4], 2) * random.uniform(0.8, 1.2, 2)
    return [blob(random.uniform(0.2, 0.5, 3), flat=flat, square=square, sections=28)]


def supertoroid(random: Random) -> Parts:
    """A ring, square inside, around, or both."""
    thick, exponents = random.uniform(0.1, 0.3), random.choice([0.25, 1, 2], 2)
    around, tube = (np.sign(c) * np.abs(c) ** e for c, e in zip((circle(32), circle(16)), exponents, strict=True))
    rows = [np.column_stack([(1 + thick * c) * around, np.full(32, thick * s)]) for c, s in tube[[*range(16), 0]]]
    return tossed(random, placed([loft(np.array(rows) * (*random.uniform(0.2, 0.4, 2), 0.5), caps=False)]), 0.5)


def twisted_column(random: Random) -> Parts:
    """A polygon that turns and shrinks on its way up."""
    sides, height, turn = int(random.integers(3, 7)), random.uniform(0.5, 1.2), random.uniform(0.6, 3)
    radius, tip = random.uniform(0.15, 0.35), random.uniform(0.3, 1.1)
    rows = [level(circle(sides, t * turn) * radius * (1 - t + t * tip), t * height) for t in np.linspace(0, 1, 17)]
    return tossed(random, [loft(rows)], 0.2)


# ------------------------------------------------------------------------------------------------- surfaces of revolution


def _turned(random: Random, profile: list[tuple[float, float]], spread: float = 0.15) -> list[tuple[float, float]]:
    """Returns a profile of radii and heights whose radii are multiplied at random, and whose height is stretched."""
    tall = random.uniform(0.75, 1.3)
    return [(r * random.uniform(1 - spread, 1 + spread), z * tall) for r, z in profile]


def vase(random: Random) -> Parts:
    """A belly with a neck, a tulip, or an urn with handles."""
    belly = [(0.07, 0), (0.14, 0.1), (0.16, 0.2), (0.1, 0.33), (0.06, 0.4), (0.09, 0.47)]
    tulip = [(0.08, 0), (0.06, 0.06), (0.08, 0.2), (0.11, 0.33), (0.15, 0.42)]
    parts = [hollow(smooth(_turned(random, belly if either(random, 0.6) else tulip, 0.25)), 0.01)]
    if either(random, 0.3):
        parts += [
            sweep(bend([(s * 0.1, 0, 0.15), (s * 0.28, 0, 0.2), (s * 0.25, 0, 0.4), (s * 0.04, 0, 0.35)]), 0.012)
            for s in (-1, 1)
        ]
    return parts


def bottle(random: Random) -> Parts:
    """Of wine, of milk, or square; some lie."""
    body, neck, shoulder = random.uniform(0.03, 0.05), random.uniform(0.012, 0.02), random.uniform(0.14, 0.22)
    rise, top = random.uniform(0.02, 0.06), random.uniform(0.05, 0.1)
    profile = [(body, 0), (body, shoulder), (neck, shoulder + rise), (neck, shoulder + rise + top)]
    profile += [(neck * 1.2, shoulder + rise + top), (neck * 1.2, shoulder + rise + top + 0.015)]
    if either(random, 0.3):
        corners = np.sign(circle(24)) * np.abs(circle(24)) ** 0.35
        return tossed(random, [loft([level(corners * r, z) for r, z in profile])], 0.2)
    return tossed(random, [solids.lathe([(0, 0), *profile, (0, profile[-1][1])], 1)], 0.2)


def bowl(random: Random) -> Parts:
    """Round or flared, with or without a foot."""
    foot, radius, height = random.uniform(0.03, 0.06), random.uniform(0.1, 0.2), random.uniform(0.05, 0.12)
    power = random.uniform(0.4, 1.1)
    profile = [(foot + (radius - foot) * t**power, 0.02 + height * t) for t in np.linspace(0, 1, 8)]
    return [hollow([(foot * 1.1, 0), *profile] if either(random) else profile, 0.006)]


def goblet(random: Random) -> Parts:
    """A glass on a stem: a bowl, a flute or a cone."""
    stem, cup, radius = random.uniform(0.05, 0.1), random.uniform(0.06, 0.14), random.uniform(0.025, 0.06)
    power = random.choice([0.35, 0.6, 1.0])
    glass = [(0.006 + (radius - 0.006) * t**power, stem + cup * t) for t in np.linspace(0, 1, 8)]
    inner = [(max(r - 0.003, 0), z) for r, z in glass[:0:-1]]
    foot = random.uniform(0.03, 0.045)
    return [solids.lathe([(0, 0), (foot, 0), (foot, 0.004), (0.006, 0.012), *glass, *inner, (0, stem + 0.01)], 1)]


def bell(random: Random) -> Parts:
    profile = [(0.2, 0), (0.17, 0.05), (0.13, 0.14), (0.12, 0.22), (0.08, 0.27), (0.0, 0.28)]
    shape = smooth(_turned(random, profile, 0.1))
    top = shape[-1][1]
    parts = [solids.lathe([*shape, *[(r * 0.9, z * 0.92) for r, z in shape[::-1]]], 1), blob((0.03, 0.03, 0.03))]
    if either(random):
        return [*parts, solids.cylinder(0.02, random.uniform(0.08, 0.2), 0, 0, top)]
    return [*parts, sweep([(0.05, 0, top - 0.02), (0, 0, top + 0.08), (-0.05, 0, top - 0.02)], 0.012)]


def spinning_top(random: Random) -> Parts:
    profile = [(0, 0), (0.01, 0.02), (0.06, 0.06), (0.1, 0.1), (0.09, 0.12), (0.02, 0.14), (0.012, 0.2), (0, 0.2)]
    return placed([solids.lathe(smooth(_turned(random, profile, 0.35)), 1)], turn=(random.uniform(0, 0.6), 0, 0))


def wheel(random: Random) -> Parts:
    """A tyre with spokes or a disc; it stands or lies."""
    radius, width = random.uniform(0.25, 0.4), random.uniform(0.04, 0.2)
    rim, spokes = radius * random.uniform(0.6, 0.85), int(random.integers(3, 11))
    parts = [slab(circle(32) * radius, width, circle(32) * rim), disc(radius * 0.15, width * 1.1, (0, 0, 0), (0, 1, 0))]
    if either(random, 0.3):
        parts.append(disc(rim, width * 0.3, (0, 0, 0), (0, 1, 0)))
    else:
        ends = circle(spokes, 0.3) * rim
        parts += [rod((0, 0, 0), (x, 0, z), radius * random.uniform(0.04, 0.07)) for x, z in ends]
    return tossed(random, parts)


def lamp(random: Random) -> Parts:
    """A shade on a stem: for a table, for the floor, or hanging from a cord."""
    stem, shade = float(random.choice([random.uniform(0.15, 0.35), random.uniform(1, 1.4)])), random.uniform(0.1, 0.22)
    top, rise = shade * random.uniform(0.3, 0.95), random.uniform(0.12, 0.25)
    parts = [solids.lathe([(shade, stem), (top, stem + rise), (top * 0.97, stem + rise), (shade * 0.97, stem)], 1)]
    parts.append(solids.cylinder(0.01, stem + rise * 0.7))
    if either(random, 0.25):
        return placed(parts, (0, 0, 0), (0, np.pi * (stem < 0.5), 0))
    return [*parts, solids.lathe([(0, 0), (shade * 0.8, 0), (shade * 0.7, 0.02), (0.02, 0.05), (0, 0.05)], 1)]


def pan(random: Random) -> Parts:
    """A frying pan with a handle, or a pot with two, with or without a lid."""
    radius, wall = random.uniform(0.1, 0.16), random.uniform(0.03, 0.06)
    if either(random):
        tip = (radius + random.uniform(0.12, 0.2), 0, wall + random.uniform(0, 0.05))
        return [hollow([(radius * 0.85, 0), (radius, wall)], 0.004), capsule((radius, 0, wall * 0.8), tip, 0.012)]
    wall *= random.uniform(2, 3.5)
    parts = [hollow([(radius, 0), (radius, wall)], 0.005)]
    parts += [solids.box(0.05, 0.08, 0.012, s * (radius + 0.02), 0, wall * 0.8) for s in (-1, 1)]
    if either(random):
        parts += [solids.lathe([(radius * 1.03, wall), (radius * 0.5, wall + 0.02), (0, wall + 0.025)], 1)]
        parts += [blob((0.015, 0.015, 0.012), (0, 0, wall + 0.035), sections=10)]
    return parts


# ----------------------------------------------------------------------------------------------------- extruded outlines


def polygon(random: Random) -> Parts:
    """An irregular outline with a thickness; stands or lies."""
    n = int(random.integers(5, 12))
    outline = circle(n) * random.uniform(0.25, 0.6, (n, 1))
    return tossed(random, [slab(outline, random.uniform(0.05, 0.5))], 0.5)


def star(random: Random) -> Parts:
    """Of four to nine points, flat or swollen."""
    n = int(random.integers(4, 10))
    outline = circle(2 * n, np.pi / 2) * np.where(np.arange(2 * n) % 2, random.uniform(0.3, 0.7), 1)[:, None] * 0.4
    if either(random):
        return tossed(random, [slab(outline, random.uniform(0.05, 0.3))])
    peak = random.uniform(0.05, 0.2)
    return tossed(random, [loft([upright(outline * 0, -peak), upright(outline, 0), upright(outline * 0, peak)])])


def gear(random: Random) -> Parts:
    """Teeth around a hole; stands or lies, with or without a shaft."""
    n, thick, deep = int(random.integers(8, 20)), random.uniform(0.03, 0.15), random.uniform(0.75, 0.9)
    teeth = np.where(np.arange(4 * n) % 4 < 2, 1, deep)[:, None]
    hole = random.uniform(0.15, 0.65)
    parts = [slab(circle(4 * n) * teeth * 0.3, thick, circle(4 * n) * 0.3 * hole)]
    if either(random, 0.4):
        parts.append(disc(0.3 * hole, random.uniform(0.2, 0.6), (0, 0, 0), (0, 1, 0)))
    return tossed(random, parts, 0.5)


_STROKES = {
    "L": ((0, 0, 1, 5), (1, 0, 3, 1)),
    "T": ((0, 4, 4, 5), (1.5, 0, 2.5, 4)),
    "U": ((0, 0, 1, 5), (3, 0, 4, 5), (1, 0, 3, 1)),
    "E": ((0, 0, 1, 5), (1, 0, 3, 1), (1, 2, 2.6, 3), (1, 4, 3, 5)),
    "F": ((0, 0, 1, 5), (1, 2, 2.6, 3), (1, 4, 3, 5)),
    "H": ((0, 0, 1, 5), (3, 0, 4, 5), (1, 2, 3, 3)),
    "Z": ((0, 4, 3, 5), (1, 1, 2, 4), (0, 0, 3, 1)),
    "+": ((0, 1.5, 4, 2.5), (1.5, 0, 2.5, 1.5), (1.5, 2.5, 2.5, 4)),
}
"""Rectangles (left, bottom, right, top) of letters."""


def letter(random: Random) -> Parts:
    """A capital that stands or lies, thin or as deep as a beam."""
    name = str(random.choice(list(_STROKES)))
    wide, tall = random.uniform(0.06, 0.14, 2)
    deep = random.uniform(0.05, 0.15 if name == "T" else 0.8)  # a deep T would be a table
    bars = [
        solids.box((c - a) * wide, deep, (d - b) * tall, (a + c) / 2 * wide, 0, b * tall)
        for a, b, c, d in _STROKES[name]
    ]
    return tossed(random, bars)


def bracket(random: Random) -> Parts:
    """Two plates at an angle with ribs or a strut."""
    width, reach, rise, thick = random.uniform(0.05, 0.4), *random.uniform(0.2, 0.5, 2), random.uniform(0.015, 0.05)
    parts = [solids.box(width, reach, thick, 0, -reach / 2), solids.box(width, thick, rise, 0, 0)]
    if either(random):
        for x in (-width / 2, width / 2):
            rib = slab(np.array([(0, 0), (reach * 0.8, 0), (0, rise * 0.8)]), 0.01)
            parts += placed([rib], (x, 0, 0), (0, 0, -np.pi / 2))
    elif either(random):
        parts.append(rod((0, -reach * 0.85, thick), (0, 0, rise * 0.85), thick * 0.5))
    return parts


def arch(random: Random) -> Parts:
    """Half a ring on posts, or without posts as a bridge."""
    radius, thick, deep = random.uniform(0.3, 0.6), random.uniform(0.06, 0.2), random.uniform(0.1, 0.6)
    angles = np.linspace(0, np.pi, 20)
    half = np.stack([np.cos(angles), np.sin(angles) * random.uniform(0.5, 1.3)], axis=1)
    post = random.uniform(0.2, 0.9) if either(random, 0.7) else 0
    profile = [np.concatenate([half * (radius + t), [(-radius - t, -post), (radius + t, -post)]]) for t in (thick, 0)]
    return [slab(profile[0], deep, profile[1])]


# ------------------------------------------------------------------------------------------------------ random assemblies


def _piece(random: Random, size: float) -> Parts:
    """A primitive of about `size` in any pose."""
    make = (cube, sphere, cylinder, cone, pill, torus, prism, tall_box)[random.integers(8)]
    parts = make(random)
    scale = size / solids.joined(parts).extents.max()
    for part in parts:
        part.apply_scale(scale)
    return placed(parts, turn=random.uniform(0, 2 * np.pi, 3))


def box_cluster(random: Random) -> Parts:
    """Three to twelve boxes close together, upright or in any pose."""
    loose, parts = either(random), []
    for _ in range(random.integers(3, 13)):
        turn = random.uniform(0, 2 * np.pi, 3) if loose else (0, 0, 0)
        parts += placed([solids.box(*random.uniform(0.1, 0.5, 3))], random.uniform(-0.3, 0.3, 3), turn)
    return parts


def mixed_cluster(random: Random) -> Parts:
    """Three to twelve primitives close together."""
    parts: Parts = []
    for _ in range(random.integers(3, 11)):
        parts += placed(_piece(random, random.uniform(0.25, 0.6)), random.uniform(-0.2, 0.2, 3))
    return parts


def box_tree(random: Random) -> Parts:
    """Boxes, each of which begins on a face of one before."""
    sizes, centres = [random.uniform(0.1, 0.5, 3)], [np.zeros(3)]
    for _ in range(random.integers(3, 12)):
        on, axis, size = int(random.integers(len(sizes))), int(random.integers(3)), random.uniform(0.06, 0.5, 3)
        step = random.uniform(-0.4, 0.4, 3) * sizes[on]
        step[axis] = random.choice([-1, 1]) * (sizes[on][axis] + size[axis]) / 2
        sizes.append(size)
        centres.append(centres[on] + step)
    return [solids.box(w, d, h, x, y, z - h / 2) for (w, d, h), (x, y, z) in zip(sizes, centres, strict=True)]


def stack(random: Random) -> Parts:
    """Pieces one upon another: boxes, or discs."""
    boxes, z, parts = either(random), 0.0, []
    for _ in range(random.integers(3, 8)):
        size, high = random.uniform(0.15, 0.5, 2), random.uniform(0.05, 0.25)
        piece = solids.box(size[0], size[1], high) if boxes else solids.cylinder(size[0] / 2, high)
        parts += placed([piece], (*random.uniform(-0.04, 0.04, 2), z), (0, 0, random.uniform(-0.5, 0.5)))
        z += high
    return parts


def tube_walk(random: Random) -> Parts:
    """A pipe with corners along the axes, or a wire that bends anywhere."""
    count, radius = int(random.integers(5, 14)), random.uniform(0.02, 0.06)
    if either(random):
        points = np.cumsum(np.eye(3)[random.integers(3, size=count)] * random.uniform(-0.4, 0.4, (count, 1)), axis=0)
        return [capsule(a, b, radius) for a, b in pairwise(points)]
    steps = np.cumsum(random.normal(0, 0.4, (count * 3, 3)), axis=0)
    return [sweep(np.cumsum(steps / np.linalg.norm(steps, axis=1, keepdims=True) * 0.08, axis=0), radius * 0.6)]


def voxel_blob(random: Random) -> Parts:
    """Unit cubes grown face to face."""
    cells: set[tuple[int, ...]] = {(0, 0, 0)}
    for _ in range(random.integers(8, 40)):
        cell = np.array(sorted(cells)[random.integers(len(cells))])
        cell[random.integers(3)] += random.choice([-1, 1])
        cells.add(tuple(int(c) for c in cell))
    return [solids.box(0.1, 0.1, 0.1, *np.array(cell) * 0.1) for cell in sorted(cells)]


GROUPS: Groups = {
    "primitives": {
        "train": (sphere, cylinder, cube, flat_plate, tall_box, prism, pill, hemisphere),
        "val": (cone, upright_plate, pyramid),
        "test": (ellipsoid, torus, bar, wedge),
    },
    "superquadrics": {"train": (superellipsoid,), "val": (twisted_column,), "test": (supertoroid,)},
    "turned": {"train": (vase, goblet, bell, wheel, lamp), "val": (bowl,), "test": (bottle, spinning_top, pan)},
    "extruded": {"train": (polygon, letter, gear, arch), "val": (bracket,), "test": (star,)},
    "assemblies": {"train": (box_cluster, mixed_cluster, box_tree, tube_walk), "val": (stack,), "test": (voxel_blob,)},
}
