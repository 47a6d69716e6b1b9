"""furniture10: procedural meshes for the ten classes of ModelNet10, seeded and unlimited in number.

The data set stands in for ModelNet10 where that cannot be downloaded, and is difficult in the same way. Desks differ from
tables only by drawers and panels, which face one side. Dressers and night stands have the same kinds of front, and their
proportions overlap once the size is normalised. From behind, all four look like plain boards. The choice of the next view
therefore matters.

Lengths are in metres. z points up, the floor is z = 0, and the front of a piece faces −y. Every class has at least four
structural variants, and every length is drawn anew for each piece.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_pipeline.objects.furniture.bathroom import BATHTUBS, TOILETS
from data_pipeline.objects.furniture.beds import BEDS
from data_pipeline.objects.furniture.cabinets import DRESSERS, NIGHT_STANDS
from data_pipeline.objects.furniture.monitors import MONITORS
from data_pipeline.objects.furniture.seats import CHAIRS, SOFAS
from data_pipeline.objects.furniture.solids import Parts, Random, Solid, joined
from data_pipeline.objects.furniture.tables import DESKS, TABLES

__all__ = ["CLASSES", "VARIANTS", "furniture", "joined"]

VARIANTS: dict[str, tuple[Callable[[Random], Parts], ...]] = {
    "bathtub": BATHTUBS,
    "bed": BEDS,
    "chair": CHAIRS,
    "desk": DESKS,
    "dresser": DRESSERS,
    "monitor": MONITORS,
    "night_stand": NIGHT_STANDS,
    "sofa": SOFAS,
    "table": TABLES,
    "toilet": TOILETS,
}
"""The functions that build the parts of a piece, by class."""

CLASSES = tuple(VARIANTS)
"""Those of ModelNet10, in the order of the labels."""


def furniture(class_name: str, seed: int) -> Solid:
    """Returns one piece of furniture as a mesh; equal arguments give equal meshes.

    Raises:
        ValueError: if `class_name` is not in `CLASSES`.
    """
    if class_name not in CLASSES:
        raise ValueError(f"furniture10 has no class {class_name!r}; choose one of {', '.join(CLASSES)}")
    random = np.random.default_rng([CLASSES.index(class_name), seed])
    variants = VARIANTS[class_name]
    return joined(variants[random.integers(len(variants))](random))
