"""Computer monitors and televisions."""

from __future__ import annotations

import trimesh

from data_pipeline.objects.furniture.solids import Parts, Random, box, cylinder, tilt


def screen(random: Random, width: float, height: float, thick: float, z: float) -> Parts:
    """A slab whose front has a rim around a recessed panel."""
    rim = random.uniform(0.012, 0.03)
    parts = [box(width, thick, height, 0, thick / 2, z)]
    parts += [box(rim, 0.015, height, side * (width - rim) / 2, -0.0075, z) for side in (-1, 1)]
    return [*parts, box(width, 0.015, rim, 0, -0.0075, z), box(width, 0.015, rim, 0, -0.0075, z + height - rim)]


def monitor_flat(random: Random) -> Parts:
    """A flat screen on a stand with a round or a rectangular base."""
    width = random.uniform(0.4, 0.8)
    height = width * random.uniform(0.5, 0.8)
    thick, lift = random.uniform(0.025, 0.07), random.uniform(0.07, 0.18)
    round_base = random.random() < 0.5
    parts = tilt(screen(random, width, height, thick, lift), random.uniform(-0.02, 0.15), (0, 0, lift))
    parts.append(box(random.uniform(0.04, 0.12), 0.03, lift + height * 0.4, 0, thick + 0.015))
    size = width * random.uniform(0.35, 0.6)
    parts.append(cylinder(size / 2, 0.02, 0, 0.03, sections=28) if round_base else box(size, size * 0.7, 0.02, 0, 0.03))
    return parts


def monitor_tube(random: Random) -> Parts:
    """A cathode-ray tube: as deep as it is wide, tapering to the back."""
    width = random.uniform(0.38, 0.55)
    height, depth = width * random.uniform(0.75, 0.9), width * random.uniform(0.7, 1.0)
    lift = random.uniform(0.03, 0.08)
    parts = screen(random, width, height, 0.12, lift)
    frustum = trimesh.creation.box((width * 0.96, depth - 0.12, height * 0.94))
    back = frustum.vertices[:, 1] > 0
    frustum.vertices[back] = frustum.vertices[back] * (0.55, 1, 0.6)
    frustum.apply_translation((0, 0.12 + (depth - 0.12) / 2, lift + height / 2))
    return [*parts, frustum, cylinder(width * 0.3, lift, 0, depth * 0.35, sections=24)]


def monitor_feet(random: Random) -> Parts:
    """A television on two feet."""
    width = random.uniform(0.7, 1.2)
    height, lift = width * random.uniform(0.52, 0.62), random.uniform(0.04, 0.09)
    parts = screen(random, width, height, random.uniform(0.03, 0.06), lift)
    parts.append(box(width * 0.5, 0.05, height * 0.4, 0, 0.06, lift + 0.05))
    return parts + [box(0.03, 0.22, lift, side * width * random.uniform(0.3, 0.42), 0.02) for side in (-1, 1)]


def monitor_wide(random: Random) -> Parts:
    """One very wide screen, or two screens on one arm."""
    if random.random() < 0.5:
        width, height, lift = random.uniform(0.8, 1.0), random.uniform(0.32, 0.4), 0.14
        parts = screen(random, width, height, 0.04, lift)
    else:
        width, height, lift = random.uniform(0.42, 0.55), random.uniform(0.27, 0.34), 0.14
        parts = []
        for side in (-1, 1):
            panel = screen(random, width, height, 0.03, lift)
            turn = trimesh.transformations.rotation_matrix(side * 0.25, (0, 0, 1), (0, 0, 0))
            for part in panel:
                part.apply_transform(turn)
                part.apply_translation((side * width * 0.51, -0.05, 0))
            parts += panel
    parts += [
        box(width * 0.9, 0.03, 0.05, 0, 0.06, lift + height * 0.45),
        box(0.06, 0.04, lift + height * 0.5, 0, 0.07),
    ]
    return [*parts, box(random.uniform(0.25, 0.4), 0.22, 0.02, 0, 0.05)]


MONITORS = (monitor_flat, monitor_tube, monitor_feet, monitor_wide)
