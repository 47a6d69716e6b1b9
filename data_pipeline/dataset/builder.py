"""Creation of a TFDS data set from captures. One example is one object with all its views, in ArrayRecord shards.

Splits are by object, so no object is in two splits. The statistics of the data set (`DatasetStatistics`) are stored next to the
shards; all later stages read them from there.
"""

from __future__ import annotations

import functools
import operator
import pickle
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from data_pipeline.capture.settings import CaptureConfig, check_camera
from data_pipeline.capture.viewpoints import identified, viewpoints_of
from data_pipeline.capture.workers import capture_all, left_out_of
from data_pipeline.dataset.beam import beam_options, capture_by_beam, write_by_beam
from data_pipeline.dataset.config import DataConfig as DataConfig
from data_pipeline.dataset.config import check_viewpoints, identity_of
from data_pipeline.dataset.origin import changes_between, state_of
from data_pipeline.dataset.origin import open_objects as open_objects
from data_pipeline.dataset.proof import CAPTURES, SOURCE_STATE, damage_of_settings, found_in, state_before
from data_pipeline.dataset.proof import open_split as open_split
from data_pipeline.dataset.shards import (
    Part,
    claimed,
    drop_others,
    finish_shards,
    largest_of,
    parts_of,
    tally_of,
    write_part,
)
from data_pipeline.dataset.statistics import SUMMARY, DatasetStatistics, Tally, load_statistics
from data_pipeline.distributed import agreed, by_all, is_first, own_share, wait_for_all
from data_pipeline.errors import DataError
from data_pipeline.files import check_of_file, keep_checks, keep_json, write_bytes
from data_pipeline.objects.mesh import SOURCE_SPLITS, ObjectEntry, ObjectSource
from data_pipeline.progress import console, progress_bar


def split_objects(entries: Sequence[ObjectEntry], validation_share: float, seed: int) -> dict[str, list[ObjectEntry]]:
    """Returns the objects by split: the test objects of the source, and its training objects divided into train and val.

    Every class has at least one object for training and, if it has two or more, at least one for validation. If the source has
    objects for validation of a class, these are used, and all its training objects are for training.
    """
    random = np.random.default_rng(seed)
    split: dict[str, list[ObjectEntry]] = {name: [e for e in entries if e.split == name] for name in ("val", "test")}
    split = {"train": [], **split}
    provided = {entry.label for entry in split["val"]}
    for label in sorted({entry.label for entry in entries}):
        members = [entry for entry in entries if entry.split == "train" and entry.label == label]
        aside = max(min(1, len(members) - 1), round(validation_share * len(members)))
        if label in provided:
            aside = 0
        chosen = set(random.permutation(len(members))[:aside].tolist())
        for index, entry in enumerate(members):
            split["val" if index in chosen else "train"].append(entry)
    return split


@dataclass(frozen=True)
class _Plan:
    """What a data set will hold.

    Attributes:
        source: the source; without its objects where others list them.
        left_out: names of the objects left out with the reasons, by split of the source.
        parts: the shards; without their objects there.
    """

    source: ObjectSource
    left_out: dict[str, dict[str, str]]
    parts: list[Part]


_PLAN = "plan"
"""File of the plan that a worker of a pipeline has made."""


def _planned(config: DataConfig, source: ObjectSource, left_out: dict[str, str]) -> _Plan:
    """Returns the shards of the objects that are not left out."""
    kept = [entry for entry in source.entries if entry.name not in left_out]
    split = split_objects(kept, config.validation_share, config.seed)
    _check_classes(config, source, split, left_out)
    return _Plan(source, _reasons(source, left_out), parts_of(split, config.capture))


def _begin_shards(parts: list[Part], folder: Path) -> None:
    """Removes what belongs to no shard, and whatever a data set that is made again has."""
    damaged = (folder / SUMMARY).exists()
    (folder / SUMMARY).unlink(missing_ok=True)
    drop_others([] if damaged else parts, folder)


def _write_shards(plan: _Plan, config: CaptureConfig, folder: Path) -> Tally:
    """Writes all shards, which the processes share; returns what statistics need, by their indices."""
    written, classes = 0, plan.source.classes
    with progress_bar("objects") as bar:
        task = bar.add_task("Writing shards", total=sum(part.objects for part in plan.parts), note="")
        for part in claimed(plan.parts, folder):
            written += write_part(part, folder, classes, config, folder / CAPTURES)
            bar.advance(task, part.objects)
    objects = len(own_share(len(plan.source.entries)))
    shares = by_all({str(jax.process_index()): f"{objects} objects, {written} shards"})
    if len(shares) > 1:
        said = "; ".join(f"process {number}: {share}" for number, share in shares.items())
        console.print(f"Captured and written by {said}")
    wait_for_all("shards are there")
    largest = max(largest_of(part, folder) for part in plan.parts)
    return functools.reduce(operator.add, (tally_of(part, largest, folder, len(classes)) for part in plan.parts))


def _plan_in_worker(config: DataConfig, folder: Path) -> list[Part]:
    """Returns the shards; stores the plan, without objects, and the state of the source for all others."""
    source = open_objects(config)
    plan = _planned(config, source, left_out_of(source.entries, folder / CAPTURES))
    _begin_shards(plan.parts, folder)
    if (state := state_of(config)) is not None:
        keep_json(folder / SOURCE_STATE, state)
    slim = _Plan(replace(source, entries=()), plan.left_out, [replace(part, entries=()) for part in plan.parts])
    write_bytes(folder / _PLAN, pickle.dumps(slim))
    return plan.parts


def _plan_of(folder: Path) -> _Plan:
    return pickle.loads((folder / _PLAN).read_bytes())


def _write_in_worker(part: Part, config: CaptureConfig, folder: Path) -> Part:
    write_part(part, folder, _plan_of(folder).source.classes, config, folder / CAPTURES)
    return replace(part, entries=())


def _make_by_beam(config: DataConfig, folder: Path, options: Any) -> tuple[_Plan, Tally]:
    """Makes captures and shards by pipelines."""
    captures, capture = folder / CAPTURES, config.capture
    capture_by_beam(functools.partial(_entries_of, config), capture, captures, options, config.skip_damaged)
    tally = write_by_beam(
        functools.partial(_plan_in_worker, config, folder),
        functools.partial(_write_in_worker, config=capture, folder=folder),
        functools.partial(_classes_of, folder),
        folder,
        options,
    )
    plan = _plan_of(folder)
    (folder / _PLAN).unlink()
    return plan, tally


def _entries_of(config: DataConfig) -> Sequence[ObjectEntry]:
    return open_objects(config).entries


def _classes_of(folder: Path) -> int:
    return len(_plan_of(folder).source.classes)


def _finish(plan: _Plan, tally: Tally, config: DataConfig, folder: Path, state: dict[str, str] | None) -> None:
    """Stores what is known of the whole data set, once all shards are there."""
    source, viewpoints = plan.source, viewpoints_of(config.capture)
    checks = finish_shards(plan.parts, folder, source.classes, config.capture)
    statistics = tally.statistics(
        source.classes,
        left_out=plan.left_out,
        viewpoints=viewpoints.points.tolist(),
        neighbours=None if viewpoints.neighbours is None else [list(pair) for pair in viewpoints.neighbours],
        capture=asdict(identified(config.capture)),
        source=source.name,
        notes=source.notes,
    )
    made_with, of_source = folder / "config.json", folder / SOURCE_STATE
    if state is not None:
        keep_json(of_source, state)
    more = [made_with, of_source] if of_source.exists() else [made_with]
    keep_checks(folder, checks | {path.name: check_of_file(path) for path in more}, only=True)
    keep_json(folder / SUMMARY, statistics.content())
    shutil.rmtree(folder / CAPTURES, ignore_errors=True)


def _changes(config: DataConfig, folder: Path) -> str:
    """Returns how the source has changed since the data set in `folder` was made; empty if it has not, or it is not known."""
    before = state_before(folder)
    now = None if before is None else state_of(config)
    return "" if before is None or now is None else changes_between(before, now)


def _say_changes(config: DataConfig, folder: Path) -> None:
    """Prints a sentence if the source has changed since the data set in `folder` was made."""
    if changes := _changes(config, folder):
        console.print(
            f"{config.source} has changed since its data set was made ({changes}); {folder} keeps the objects as they were: "
            f"delete it, or choose another --out, to capture them again",
            style="yellow",
            markup=False,
        )


def _check_classes(
    config: DataConfig, source: ObjectSource, split: dict[str, list[ObjectEntry]], left_out: dict[str, str]
) -> None:
    """Raises DataError if no objects are left for a split, or for the training of a class."""
    for name, members in split.items():
        if not members:
            raise DataError(f"{config.source} has no objects left for {name}; add some (left out: {len(left_out)})")
    trained = {entry.label for entry in split["train"]}
    for label, name in enumerate(source.classes):
        if label not in trained:
            gone = next(entry.name for entry in source.entries if entry.label == label and entry.split == "train")
            reason = left_out.get(gone, "is for validation")
            raise DataError(
                f"{config.source} has no training objects of class {name} left ({gone}: {reason}); add some, or remove "
                f"the class"
            )


def _reasons(source: ObjectSource, left_out: dict[str, str]) -> dict[str, dict[str, str]]:
    """Returns the names of all objects left out with the reasons, by split of the source; always for training and test."""
    reasons = {}
    for name in (*SOURCE_SPLITS, "val", "other"):
        captured = {e.name: left_out[e.name] for e in source.entries if e.split == name and e.name in left_out}
        found = captured | source.left_out.get(name, {})
        if found or name in SOURCE_SPLITS:
            reasons[name] = found
    return reasons


def _check_source(config: DataConfig, folder: Path, damage: str) -> None:
    """Raises DataError if a damaged data set cannot be made again, since its source is gone or has changed."""
    try:
        changes = _changes(config, folder)
        open_objects(config)
    except DataError as error:
        raise DataError(f"{damage}, and the data set cannot be made again: {error}") from error
    if changes:
        raise DataError(
            f"{damage}, and {config.source} has changed since ({changes}); restore either, or delete {folder} to capture the "
            f"objects as they are now, or choose another --out"
        )


def prepare(config: DataConfig, folder: Path, beam: str | None = None) -> DatasetStatistics:
    """Creates the data set in `folder`, unless it exists, and returns its statistics.

    Each step stores its results (captures, then shards, then the summary), so an interrupted run resumes.

    Args:
        beam: options of a Beam pipeline that does the work; the records are the same. None for this machine alone.

    Raises:
        DataError: if the source is not usable, or `folder` has a data set with other settings.
    """
    if config.capture.views < 2:
        raise DataError(f"--views {config.capture.views} is too few: choosing a next view needs at least 2 viewpoints")
    check_camera(config.capture)
    check_viewpoints(config.capture, (folder / SUMMARY).exists())
    if not 0 <= config.validation_share < 1:
        share = f"--dataset.validation-share {config.validation_share:g}"
        raise DataError(f"{share} is not at least 0 and below 1; choose another")
    identity = identity_of(config, folder)
    damage = damage_of_settings(folder, identity)
    if agreed((folder / SUMMARY).exists()):
        found = found_in(folder, damage)
        if isinstance(found, DatasetStatistics):
            if is_first():
                shutil.rmtree(folder / CAPTURES, ignore_errors=True)  # left by a run that was stopped before
            _say_changes(config, folder)
            return found
        _check_source(config, folder, found)
        console.print(f"{found}, so the data set is made again from {config.source}", markup=False)
    return _made(config, folder, identity, None if beam is None else beam_options(beam))


def _made(config: DataConfig, folder: Path, identity: dict[str, Any], beam: Any) -> DatasetStatistics:
    """Makes the data set and returns its statistics. Several processes share the captures, and then the shards."""
    if beam is not None:
        folder.mkdir(parents=True, exist_ok=True)
        keep_json(folder / "config.json", identity)
        _finish(*_make_by_beam(config, folder.absolute(), beam), config, folder, None)
        return load_statistics(folder)
    if not is_first():
        wait_for_all("the source is there")
    source, state = open_objects(config), state_of(config)
    if is_first():  # which has downloaded it, if need be
        wait_for_all("the source is there")
    for sentence in source.said:
        console.print(f"{config.source}: {sentence}", markup=False)
    if is_first():
        folder.mkdir(parents=True, exist_ok=True)
        keep_json(folder / "config.json", identity)
    wait_for_all("captures begin")
    own = [source.entries[index] for index in own_share(len(source.entries))]
    left_out = by_all(capture_all(own, config.capture, folder / CAPTURES, skip_damaged=config.skip_damaged))
    plan = _planned(config, source, left_out)
    if is_first():
        _begin_shards(plan.parts, folder)
    wait_for_all("shards begin")
    tally = _write_shards(plan, config.capture, folder)
    if is_first():
        _finish(plan, tally, config, folder, state)
    wait_for_all("a data set is made")
    return load_statistics(folder)
