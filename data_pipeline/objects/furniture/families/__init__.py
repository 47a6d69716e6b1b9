"""furniture10-families: the ten classes of furniture10 in at least ten structural families each, finished in many ways.

A family is a kind of structure, such as a wing chair. Each belongs to one split, so that temperatures can be fitted on
families on which nothing was trained, and systems be measured on yet others. The variants of furniture10 are families for
training. Pieces of every family are finished at random: other legs, rounded edges, mirrored, stretched along each axis.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np

from data_pipeline.objects.furniture import CLASSES, bathroom, seats
from data_pipeline.objects.furniture import beds as plain_beds
from data_pipeline.objects.furniture import cabinets as plain_cabinets
from data_pipeline.objects.furniture import monitors as plain_monitors
from data_pipeline.objects.furniture import tables as plain_tables
from data_pipeline.objects.furniture.families import (
    bathtubs,
    beds,
    cabinets,
    chairs,
    desks,
    monitors,
    sofas,
    tables,
    toilets,
)
from data_pipeline.objects.furniture.families.parts import rounded, tube, turned
from data_pipeline.objects.furniture.solids import Parts, Random, Solid, box, cylinder, joined, rod

Maker = Callable[[Random], Parts]
SPLITS = ("train", "val", "test")


def _families(train: tuple[Maker, ...], val: tuple[Maker, ...], test: tuple[Maker, ...]) -> dict[str, dict[str, Maker]]:
    """The functions by split and name of their family, which is that of the function without the class."""
    by_split = zip(SPLITS, (train, val, test), strict=True)
    return {split: {make.__name__.split("_", 1)[1]: make for make in makers} for split, makers in by_split}


FAMILIES = {
    "bathtub": _families(
        (*bathroom.BATHTUBS, bathtubs.tub_freestanding, bathtubs.tub_alcove, bathtubs.tub_corner, bathtubs.tub_clawed),
        (bathtubs.tub_round, bathtubs.tub_sunken),
        (bathtubs.tub_soaking, bathtubs.tub_hourglass),
    ),
    "bed": _families(
        (*plain_beds.BEDS, beds.bed_made, beds.bed_divan, beds.bed_canopy, beds.bed_crib, beds.bed_futon),
        (beds.bed_drawers, beds.bed_round, beds.bed_loft),
        (beds.bed_sleigh, beds.bed_hospital),
    ),
    "chair": _families(
        (
            *(*seats.CHAIRS, chairs.chair_framed, chairs.chair_carver, chairs.chair_shell, chairs.chair_club),
            *(
                chairs.chair_stool,
                chairs.chair_folding,
                chairs.chair_bentwood,
                chairs.chair_easy,
                chairs.chair_executive,
            ),
        ),
        (chairs.chair_rocking, chairs.chair_bucket, chairs.chair_director, chairs.chair_throne),
        (chairs.chair_wing, chairs.chair_bar, chairs.chair_deck, chairs.chair_lounger, chairs.chair_high),
    ),
    "desk": _families(
        (
            *(*plain_tables.DESKS, desks.desk_trestle, desks.desk_computer, desks.desk_executive),
            *(desks.desk_l_return, desks.desk_standing),
        ),
        (desks.desk_roll_top, desks.desk_school),
        (desks.desk_secretary, desks.desk_corner_wedge),
    ),
    "dresser": _families(
        (
            *(*plain_cabinets.DRESSERS, cabinets.dresser_lowboy, cabinets.dresser_tall_plinth),
            *(cabinets.dresser_bombe, cabinets.dresser_changing),
        ),
        (cabinets.dresser_vanity, cabinets.dresser_open),
        (cabinets.dresser_stepped, cabinets.dresser_armoire),
    ),
    "monitor": _families(
        (
            *(*plain_monitors.MONITORS, monitors.monitor_desktop, monitors.monitor_television),
            *(monitors.monitor_tube_swivel, monitors.monitor_wall),
        ),
        (monitors.monitor_all_in_one, monitors.monitor_portrait),
        (monitors.monitor_curved, monitors.monitor_arm, monitors.monitor_console),
    ),
    "night_stand": _families(
        (
            *(*plain_cabinets.NIGHT_STANDS, cabinets.stand_cube, cabinets.stand_tiers, cabinets.stand_pedestal),
            *(cabinets.stand_cabinet, cabinets.stand_bedside),
        ),
        (cabinets.stand_round, cabinets.stand_rail),
        (cabinets.stand_c_shape, cabinets.stand_hanging),
    ),
    "sofa": _families(
        (
            *(sofas.sofa_square, sofas.sofa_rolled, sofas.sofa_tuxedo, sofas.sofa_armless, seats.sofa_corner),
            *(sofas.sofa_cushioned, sofas.sofa_framed, sofas.sofa_sectional, sofas.sofa_tub, sofas.sofa_bed),
        ),
        (sofas.sofa_chesterfield, sofas.sofa_settee),
        (sofas.sofa_curved, sofas.sofa_chaise, sofas.sofa_camelback),
    ),
    "table": _families(
        (
            *(*plain_tables.TABLES, tables.table_pedestal, tables.table_refectory, tables.table_glass),
            *(tables.table_parsons, tables.table_side, tables.table_lifting),
        ),
        (tables.table_drop_leaf, tables.table_nest, tables.table_console),
        (tables.table_picnic, tables.table_drum, tables.table_conference),
    ),
    "toilet": _families(
        (
            *bathroom.TOILETS,
            toilets.toilet_close_coupled,
            toilets.toilet_skirted,
            toilets.toilet_tankless,
            toilets.toilet_boxed,
        ),
        (toilets.toilet_floating, toilets.toilet_low_tank),
        (toilets.toilet_corner_tank, toilets.toilet_commode),
    ),
}
"""The functions that build the parts of a piece, by class, split and name of the family."""

_SOFT = ("bed", "chair", "sofa")


def family_piece(class_name: str, split: str, family: str, seed: int) -> Solid:
    """Returns one piece of a family as a mesh; equal arguments give equal meshes."""
    random = np.random.default_rng([CLASSES.index(class_name), zlib.crc32(family.encode()), seed])
    return _finished(random, FAMILIES[class_name][split][family](random), class_name in _SOFT)


def _finished(random: Random, parts: Parts, soft: bool) -> Solid:
    """Returns the parts as one mesh that stands on the floor, after a finish of random style."""
    parts = _other_legs(random, parts)
    if random.random() < 0.6:
        limit = random.uniform(0.02, 0.09) if soft else random.uniform(0.004, 0.03)
        boxes = [part for part in parts if len(part.vertices) == 8 and np.ptp(part.vertices, axis=0).min() > 0.018]
        steps, count = (2 if soft and len(boxes) < 12 else 1), sum(len(part.faces) for part in parts)
        chosen = {id(part) for part in boxes[: max(0, 5800 - count) // (288 if steps == 2 else 96)]}
        parts = [rounded(part, limit, steps) if id(part) in chosen else part for part in parts]
    whole = joined(parts)
    vertices = whole.vertices * np.exp(random.uniform(-np.log(1.2), np.log(1.2), 3))
    faces = np.asarray(whole.faces)
    if random.random() < 0.5:
        vertices, faces = vertices * (-1, 1, 1), faces[:, ::-1]
    return Solid(vertices - (0, 0, vertices[:, 2].min()), faces, process=False)


def _is_leg(part: Solid) -> bool:
    """Whether a part is an upright post on the floor."""
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    width, depth, height = high - low
    return bool(
        len(part.vertices) <= 40
        and abs(low[2]) < 0.005
        and max(width, depth) < 0.12
        and height > max(0.05, 1.2 * max(width, depth))
    )


def _other_legs(random: Random, parts: Parts) -> Parts:
    """Gives all legs of a piece one style: as they are, round, tapered, turned, cabriole, splayed, on castors, on sleds, or none.

    Legs are none, or a plinth in their place, only where they are short.
    """
    legs = [part for part in parts if _is_leg(part)]
    style = int(random.integers(11))
    if len(legs) < 3 or style < 2:
        return parts
    others, corners = [part for part in parts if not _is_leg(part)], np.array([leg.bounds for leg in legs])
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    top, middle = float(corners[:, 1, 2].max()), (low + high) / 2
    if style > 8 and top < 0.25:
        size = (high - low) * random.uniform(0.9, 1, 3)
        return others if style == 9 else [*others, box(size[0], size[1], top, middle[0], middle[1])]
    made = [new for leg in legs for new in _other_leg(leg, style, middle)]
    if style == 8 and top < 0.9:
        for side in (low[0], high[0]):
            made.append(box(0.04, high[1] - low[1], 0.03, side + 0.02 * np.sign(middle[0] - side), middle[1]))
    return others + made


def _other_leg(leg: Solid, style: int, middle: np.ndarray) -> Parts:
    """A leg of this style in the place of one, leaning as it does; `middle` is that of all legs of the piece."""
    height = float(np.ptp(leg.bounds[:, 2]))
    upper = leg.vertices[:, 2] > height / 2
    top, foot = (leg.vertices[half, :2].mean(axis=0) for half in (upper, ~upper))
    radius = float(np.sqrt(abs(leg.volume) / height / np.pi))
    parts = _leg(style, top, np.sign(top - middle[:2]), radius, height)
    for part in parts:
        part.vertices[:, :2] += (foot - top) * (1 - part.vertices[:, 2:] / height)
    return parts or [leg]


def _leg(style: int, at: np.ndarray, outwards: np.ndarray, r: float, height: float) -> Parts:
    """An upright leg of this style; none if it is left as it is."""
    (x, y), (sx, sy) = at, outwards
    reach = min(0.08, 0.15 * height)
    if style == 2:
        return [cylinder(r, height, x, y, sections=10)]
    if style == 3:
        return [tube([(x, y, 0), (x, y, height)], (0.5 * r, r), 6)]
    if style == 4:
        profile = [(0.6, 0), (0.9, 0.06), (0.5, 0.12), (1, 0.5), (0.55, 0.72), (1.15, 0.78), (1.15, 1)]
        return [turned([(r * a, height * z) for a, z in profile], x, y)]
    if style == 5 and height < 0.9:
        line = [(0.15, 1), (0.3, 0.85), (0.0, 0.4), (-0.05, 0.12), (0.3, 0)]
        return [
            tube(
                [(x + sx * a * reach, y + sy * a * reach, z * height) for a, z in line],
                np.array([1.2, 1.3, 0.8, 0.6, 0.9]) * r,
            )
        ]
    if style == 6 and height < 0.9:
        return [tube([(x + sx * reach, y + sy * reach, 0), (x, y, height)], (0.6 * r, r))]
    if style == 7 and height < 0.9:
        lift = min(0.05, height / 2)
        return [
            rod((x - 0.015, y, lift / 2), (x + 0.015, y, lift / 2), lift / 2),
            cylinder(r * 0.7, height - lift * 0.9, x, y, lift * 0.9, 10),
        ]
    return []
