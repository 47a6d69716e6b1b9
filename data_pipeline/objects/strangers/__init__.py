"""strangers: procedural shapes of every kind that is none of the ten classes of `furniture`, seeded and unlimited in number.

They are what a recogniser of furniture must call unknown. Each kind belongs to one split: kinds of `train` may be shown in
training, kinds of `val` calibrate, and kinds of `test` were seen by neither. Some groups are in one split as a whole.

Left out is what one could reasonably call one of the classes: stools, benches, cabinets with fronts, screens on a stand.
Lengths are in metres where a kind has a natural size. z points up, the floor is z = 0.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from data_pipeline.objects.furniture.solids import Solid, joined
from data_pipeline.objects.strangers import household, living, outdoors, plain, small, tools
from data_pipeline.objects.strangers.shapes import Builder

__all__ = ["KINDS", "SPLITS", "Kind", "stranger"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Kind:
    """A kind of stranger: what builds the parts of one, its group, and the one split that it belongs to."""

    build: Builder
    group: str
    split: str


KINDS: dict[str, Kind] = {
    build.__name__: Kind(build, group, split)
    for module in (plain, household, small, tools, outdoors, living)
    for group, splits in module.GROUPS.items()
    for split, builders in splits.items()
    for build in builders
}
"""All kinds by name."""


def stranger(kind: str, seed: int) -> Solid:
    """Returns one shape of a kind, which stands on z = 0; equal arguments give equal meshes.

    Raises:
        ValueError: if `kind` is not in `KINDS`.
    """
    if kind not in KINDS:
        raise ValueError(f"there is no stranger {kind!r}; choose one of {', '.join(KINDS)}")
    # The name, not a number of the kind: other kinds may come without changing this one.
    solid = joined(KINDS[kind].build(np.random.default_rng([zlib.crc32(kind.encode()), seed])))
    return solid.apply_translation((0, 0, -solid.bounds[0, 2]))
