"""The option `--dataset.split`: training and test objects of a source without such folders, by share or by list."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.errors import DataError
from data_pipeline.objects.layout import SPLIT_FOLDERS, Found
from data_pipeline.objects.mesh import Recipe
from data_pipeline.objects.recipes import Turned

_ENOUGH, _LEAST_TURNS = 1000, 8
"""Objects that few are made into by turns, and the least number of turns of each."""
SAME_OBJECTS = (
    "--dataset.split 1: each object is for training, validation and testing, turned otherwise in each; what is measured "
    "says how well these very objects are recognised from other directions, and nothing about others of their classes"
)
_NAME_COLUMNS = ("path", "name", "file", "filename", "object", "model", "modelid", "model_id", "id", "object_id", "uid")


def divide(found: Sequence[Found], option: str, seed: int, where: str) -> list[Found]:
    """Returns the files that have a class with the split that the option gives them.

    Args:
        found: files, with their classes.
        option: a share of training objects such as `0.8`; `1` for training and testing on the same objects; or the path of a
            JSON or CSV list.
        seed: seed of the choice by share.
        where: name of the source for error messages.

    Raises:
        DataError: if the option is neither, or a class has too few objects.
    """
    try:
        share = float(option)
    except ValueError:
        return _by_list(found, Path(option).expanduser())
    if not 0 < share <= 1:
        advice = "give a number between 0 and 1, such as 0.8, or 1 to train and test on the same objects"
        raise DataError(f"--dataset.split {option} is no share of training objects; {advice}")
    return _by_share(found, share, seed, where) if share < 1 else _by_turns(found)


def _by_turns(found: Sequence[Found]) -> list[Found]:
    """Each object for all splits, turned about the vertical axis by another angle in each place: of ten places, one is for
    validation and one for tests."""
    objects = sum(bool(one.class_name and one.recipe) for one in found)
    places = max(_LEAST_TURNS, -(-_ENOUGH // max(objects, 1)))
    splits = ["val" if at % 10 == 3 else "test" if at % 10 == 7 else "train" for at in range(places)]

    def turned(one: Found, recipe: Recipe) -> list[Found]:
        return [
            replace(one, split=split, recipe=Turned(recipe, 2 * np.pi * at / places), identity=(one.identity, at))
            for at, split in enumerate(splits)
        ]

    return [each for one in found for each in (turned(one, one.recipe) if one.class_name and one.recipe else [one])]


def _group(one: Found) -> tuple[str, ...]:
    """Returns what files of one object share: their folder below the class, or their name without suffix in its folder."""
    at = one.parts.index(one.class_name, one.head)
    below = [part for part in one.parts[at + 1 :] if part.lower() not in SPLIT_FOLDERS or part == one.parts[-1]]
    if len(below) == 1:
        return (*one.parts[: at + 1], below[0].rsplit(".", 1)[0])
    return (*one.parts[: at + 1], below[0])


def _by_share(found: Sequence[Found], share: float, seed: int, where: str) -> list[Found]:
    """Divides the objects of each class at random; all files of an object's folder go together."""
    training: set[tuple[str, ...]] = set()
    random = np.random.default_rng(seed)
    for name in sorted({one.class_name for one in found if one.class_name}):
        own = sorted({_group(one) for one in found if one.class_name == name and one.recipe is not None})
        if not own:
            continue
        if len(own) < 2:
            few = f"class {name} has {len(own)} object, and --dataset.split needs 2 or more"
            same = "or give --dataset.split 1 to train and test on the same objects"
            raise DataError(f"{where}: {few}; add some, remove the class, {same}")
        count = min(max(round(share * len(own)), 1), len(own) - 1)
        training |= {own[at] for at in random.permutation(len(own))[:count]}

    def split_of(one: Found) -> str:
        if not one.class_name:
            return ""
        return "train" if _group(one) in training else "test"

    return [replace(one, split=split_of(one)) for one in found]


def _keys(one: Found) -> list[list[str]]:
    """Returns the names by which a list may name a file, in the order in which they are tried."""
    stem = one.parts[-1].rsplit(".", 1)[0]
    below = one.parts[one.head :]
    return [
        [one.path, "/".join(below)],
        [one.path.rsplit(".", 1)[0], "/".join(below).rsplit(".", 1)[0], "/".join(one.parts[:-1]), "/".join(below[:-1])],
        [one.parts[-1]],
        [stem],
        list(one.parts[one.parts.index(one.class_name, one.head) + 1 : -1]),
    ]


def _split_in(listed: Mapping[str, str], one: Found) -> str:
    """Returns the split of a file by the first of its names that are in a list, all with one split; empty if none is."""
    for keys in _keys(one):
        splits = {listed[key] for key in keys if key in listed}
        if len(splits) == 1:
            return splits.pop()
    return ""


def _by_list(found: Sequence[Found], path: Path) -> list[Found]:
    listed = _read_list(path)
    splits = [_split_in(listed, one) if one.class_name else "" for one in found]
    used = Counter(splits)
    if not used["train"] or not used["test"]:
        paths = next((one.path for one in found if one.class_name), "class/object.off")
        names = f"names {used['train']} training and {used['test']} test objects of this source"
        raise DataError(f"{path} {names}; list paths such as {paths}")
    without = f"is not in {path.name}"
    return [
        replace(one, split=split) if split else replace(one, split="", recipe=None, reason=one.reason or without)
        for one, split in zip(found, splits, strict=True)
    ]


def _read_list(path: Path) -> Mapping[str, str]:
    """Returns the split of each name in a JSON or CSV list.

    JSON is `{"train": [names], "test": [names]}` or `{name: split}`; CSV has a column `split` and one with names.
    """
    if path.suffix.lower() not in (".json", ".csv"):
        kinds = "a share such as 0.8 nor a .json or .csv list"
        raise DataError(f"--dataset.split {path} is neither {kinds}; give one of them")
    try:
        text = path.read_text(encoding="utf-8-sig")
        pairs = _json_pairs(json.loads(text)) if path.suffix.lower() == ".json" else _csv_pairs(text)
    except (OSError, ValueError, KeyError, csv.Error, RecursionError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        forms = "a JSON object of lists train and test, or a CSV table with columns name and split"
        raise DataError(f"--dataset.split {path} cannot be read ({reason}); give {forms}") from error
    listed: dict[str, str] = {}
    for name, split in pairs:
        given = SPLIT_FOLDERS.get(str(split).strip().lower())
        if given is None:
            raise DataError(f"{path} has the split {str(split)[:40]!r} for {name!r}; give train, val or test")
        key = str(name).strip().replace("\\", "/").removeprefix("./")
        if listed.setdefault(key, given) != given:
            raise DataError(f"{path} has {key!r} in {listed[key]} and in {given}; keep it in one of them")
    return listed


def _json_pairs(content: Any) -> list[tuple[Any, Any]]:
    if not isinstance(content, dict):
        raise ValueError("it is no object")
    if all(isinstance(names, list) for names in content.values()):
        return [(name, split) for split, names in content.items() for name in names]
    return list(content.items())


def _csv_pairs(text: str) -> list[tuple[Any, Any]]:
    rows = [row for row in csv.reader(text.splitlines()) if row]
    if not rows:
        raise ValueError("it is empty")
    columns = [title.strip().lower() for title in rows[0]]
    names = [title for title in _NAME_COLUMNS if title in columns]
    if "split" not in columns or not names:
        raise ValueError("its first line has no titles name and split")
    title, at = columns.index(names[0]), columns.index("split")
    return [(row[title], row[at]) for row in rows[1:] if len(row) > max(title, at)]
