"""Classes, splits and names of objects, from the paths of their files.

Two layouts have folders of splits: `<class>/<train|val|test>/…` as ModelNet has it, and `<train|val|test>/<class>/…`. Between
the folder that comes last of the two and the file may lie more folders, such as one for each object. A layout without folders of
splits, `<class>/…` as ShapeNet has it, needs the option `--dataset.split`.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace

from data_pipeline.objects.mesh import Recipe

SPLIT_FOLDERS = {
    "train": "train",
    "training": "train",
    "test": "test",
    "testing": "test",
    "val": "val",
    "valid": "val",
    "validation": "val",
}
"""Names of folders, in lower case, and the splits that they hold."""


@dataclass(frozen=True)
class Found:
    """A file that is a mesh by its name.

    Attributes:
        parts: its path in the source, shown as `names.shown` does.
        recipe: how it is read, or None if it is left out.
        identity: equal for two paths of one file.
        linked: whether its path has a symbolic link.
        reason: why it is left out.
        class_name, split: where it belongs; empty if unknown.
        head: number of folders before those of class and split.
    """

    parts: tuple[str, ...]
    recipe: Recipe | None
    identity: Hashable
    linked: bool = False
    reason: str = ""
    class_name: str = ""
    split: str = ""
    head: int = 0

    @property
    def path(self) -> str:
        """The path in the source, with slashes."""
        return "/".join(self.parts)


@dataclass(frozen=True)
class Listing:
    """The files of a source, numbers of files ignored by rule, by kind, and sentences on what was found."""

    found: tuple[Found, ...]
    ignored: Counter[str] = field(default_factory=Counter)
    notes: tuple[str, ...] = ()


def _split_at(parts: Sequence[str]) -> int | None:
    """Returns the place of the last folder in a path that is named like a split."""
    places = [at for at, part in enumerate(parts[:-1]) if part.lower() in SPLIT_FOLDERS]
    return places[-1] if places else None


def has_split_folders(found: Sequence[Found]) -> bool:
    """Returns whether any file lies in a folder that is named like a split."""
    return any(_split_at(one.parts) is not None for one in found)


def by_split_folders(found: Sequence[Found]) -> list[Found]:
    """Returns the files with class and split where their path has both."""
    places = [(one.parts, _split_at(one.parts)) for one in found if one.recipe is not None]
    follows = _class_follows([(parts, at) for parts, at in places if at is not None])

    def placed(one: Found) -> Found:
        at = _split_at(one.parts)
        if at is None or not 0 <= (class_at := at + 1 if follows else at - 1) < len(one.parts) - 1:
            return one
        split = SPLIT_FOLDERS[one.parts[at].lower()]
        return replace(one, class_name=one.parts[class_at], split=split, head=min(at, class_at))

    return [placed(one) for one in found]


def _class_follows(places: list[tuple[tuple[str, ...], int]]) -> bool:
    """Returns whether the folder of the class lies in that of the split, from paths and the places of their splits.

    It does if no path has a folder before its split, and any has one after it. It also does if all paths have a folder after
    their split, the folders of training and test have mostly the same names, as classes have and single objects have not, and
    there would be one class otherwise or the folders hold several meshes.
    """
    nested = [at + 2 < len(parts) for parts, at in places]
    if not any(at for _, at in places):
        return any(nested)
    if not all(nested):
        return False
    inside: dict[str, set[str]] = {"train": set(), "test": set()}
    for parts, at in places:
        inside.setdefault(SPLIT_FOLDERS[parts[at].lower()], set()).add(parts[at + 1])
    both, either = inside["train"] & inside["test"], inside["train"] | inside["test"]
    if len(both) < 2 or 2 * len(both) < len(either):
        return False
    sizes = Counter(parts[: at + 2] for parts, at in places)
    return len({parts[at - 1] for parts, at in places if at}) == 1 or statistics.median(sizes.values()) >= 2


def by_class_folders(found: Sequence[Found]) -> list[Found]:
    """Returns the files with the class where they lie in a folder, for a layout without splits.

    The classes are the folders of the first level that has more than one.
    """
    depth, inside = 0, [one for one in found if len(one.parts) > 1]
    while (
        inside and len({one.parts[depth] for one in inside}) == 1 and any(len(one.parts) > depth + 2 for one in inside)
    ):
        depth += 1
        inside = [one for one in inside if len(one.parts) > depth + 1]
    lies = depth + 1
    return [replace(one, class_name=one.parts[depth], head=depth) if len(one.parts) > lies else one for one in found]


def without_copies(found: Sequence[Found]) -> list[Found]:
    """Returns the files with every file once: of several paths of one file the others are left out.

    The path that is kept is one with class and split, and without links, if there is such a path. Paths without class or split
    of a file that is kept are dropped.
    """
    best: dict[Hashable, Found] = {}
    for one in sorted(found, key=lambda one: (not (one.class_name and one.split), one.linked, one.parts)):
        best.setdefault(one.identity, one)
    kept = []
    for one in found:
        first = best[one.identity]
        if first is one:
            kept.append(one)
        elif one.class_name and one.split:
            kept.append(replace(one, recipe=None, reason=f"is the same file as {first.path}"))
    return kept


def names_of(found: Sequence[Found]) -> list[str]:
    """Returns a unique name for every file: its path, without the folders before class and split that all objects share."""
    heads = [one.parts[: one.head] for one in found if one.class_name]
    shared = 0
    while all(len(head) > shared for head in heads) and len({head[shared] for head in heads}) == 1:
        shared += 1
    prefix = heads[0][:shared] if heads else ()
    names: dict[str, None] = {}
    for one in found:
        name = plain = "/".join(one.parts[shared:] if one.parts[:shared] == prefix else one.parts)
        number = 1
        while name in names:  # names that differ only in bytes that cannot be shown
            number += 1
            name = f"{plain}~{number}"
        names[name] = None
    return list(names)
