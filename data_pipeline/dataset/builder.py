"""Creation of a TFDS data set from captures. One example is one object with all its views, in ArrayRecord shards.

Splits are by object, so no object is in two splits. Neither writing nor reading needs TensorFlow. The statistics of the data
set (`DatasetStatistics`) are stored next to the shards; all later stages read them from there.
"""

from __future__ import annotations

import functools
import io
import shutil
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.capture.casting import Capture, Rig, load_capture, rig_for
from data_pipeline.capture.settings import CaptureConfig, check_camera
from data_pipeline.capture.viewpoints import identified, viewpoints_of
from data_pipeline.capture.workers import capture_all, capture_entry, capture_path, left_out_of, say_damaged
from data_pipeline.dataset.beam import beam_options, capture_by_beam, examples_by_beam
from data_pipeline.dataset.config import DataConfig as DataConfig
from data_pipeline.dataset.config import check_viewpoints, identity_of
from data_pipeline.dataset.origin import changes_between, state_of
from data_pipeline.dataset.origin import open_objects as open_objects
from data_pipeline.dataset.proof import (
    CAPTURES,
    SHARDS,
    SOURCE_STATE,
    damage_of_settings,
    found_in,
    keep_checks_of_shards,
    open_split,
    state_before,
)
from data_pipeline.dataset.statistics import SPLITS, SUMMARY, DatasetStatistics, StatisticsCollector, load_statistics
from data_pipeline.distributed import agreed, is_first, own_share, wait_for_all
from data_pipeline.errors import DataError, reason_of
from data_pipeline.files import check_of_file, keep_checks, keep_json
from data_pipeline.objects.mesh import SOURCE_SPLITS, ObjectEntry, ObjectSource
from data_pipeline.progress import console, progress_bar
from mevs_jax.beliefs.entropy import level_entropy


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


@jax.jit
def _entropies(levels: jax.Array) -> jax.Array:
    return jax.vmap(level_entropy)(levels)


def view_entropies(capture: Capture) -> np.ndarray:
    """Returns the depth entropy of each view in bits, (views,), exactly as in the thesis."""
    return np.asarray(_entropies(jnp.asarray(capture.depth // 256, jnp.int32)))


def _features(classes: Sequence[str], config: CaptureConfig) -> dict[str, Any]:
    """Returns the TFDS features of an example."""
    import tensorflow_datasets as tfds

    views, side = config.views, config.resolution
    tensor = tfds.features.Tensor
    return {
        "name": tfds.features.Text(),
        "label": tfds.features.ClassLabel(names=list(classes)),
        "depth": tensor(shape=(views, side, side), dtype=np.uint16, encoding="bytes"),
        "image": tensor(shape=(views, side, side), dtype=np.uint8, encoding="bytes"),
        "pose": tensor(shape=(views, 4, 4), dtype=np.float32),
        "entropy": tensor(shape=(views,), dtype=np.float32),
        "extent": tensor(shape=(3,), dtype=np.float32),
        "radius": tensor(shape=(), dtype=np.float32),
    }


def _spill_without_tensorflow() -> None:
    """Replaces the buckets in which TFDS sorts records beyond 1 GiB on disk, which use TensorFlow to open files."""
    from tensorflow_datasets.core import shuffle

    class Bucket(shuffle._Bucket):
        """A bucket whose file is opened for each record, so that a thousand buckets do not need a thousand open files."""

        def add(self, key: int, data: bytes) -> None:
            path = Path(self._path)
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab") as file:
                file.write(shuffle._hkey_to_bytes(key) + struct.pack("=Q", len(data)) + data)
            self._length += 1
            self._size += len(data)

        def read_values(self) -> Iterator[tuple[int, bytes]]:
            if self._length:
                with Path(self._path).open("rb") as file:
                    while key := file.read(shuffle.HKEY_SIZE_BYTES):
                        yield shuffle._read_hkey(key), file.read(struct.unpack("=Q", file.read(8))[0])

        def del_file(self) -> None:
            Path(self._path).unlink(missing_ok=True)

    shuffle._Bucket = Bucket


def example_of(entry: ObjectEntry, captures: Path, rig: Rig, backend: str) -> tuple[str, dict[str, Any]]:
    """Returns the key and content of an object's record, from its capture in the folder `captures`.

    A damaged capture, which a power failure may leave, is made again.
    """
    path = capture_path(captures, entry)
    try:
        capture = load_capture(path)
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, BadZipFile, zlib.error) as error:
        console.print(f"{path} cannot be read ({reason_of(error)}), so it is made again", markup=False)
        path.unlink(missing_ok=True)
        if (damage := capture_entry(entry, rig, captures, backend, skip_damaged=False)) is not None:
            raise say_damaged(damage) from error
        capture = load_capture(path)
    return entry.name, {
        "name": entry.name,
        "label": entry.label,
        "depth": capture.depth,
        "image": capture.image,
        "pose": rig.poses_around(entry.name),
        "entropy": view_entropies(capture),
        "extent": capture.extent,
        "radius": np.float32(capture.radius),
    }


@functools.cache
def _builder_class() -> type:
    """Returns the TFDS builder. It is defined on first use, since importing TFDS is slow."""
    import tensorflow_datasets as tfds

    tfds.disable_progress_bar()
    _spill_without_tensorflow()

    class Info(tfds.core.DatasetInfo):
        def initialize_from_bucket(self) -> None:
            """Does nothing: TFDS looks for known data sets here, and leaves an empty folder among the temporary files."""

    class MultiViewObjects(tfds.core.GeneratorBasedBuilder):
        """Objects captured from a lattice of viewpoints: depth, shaded image, pose and depth entropy of each view."""

        VERSION = tfds.core.Version("1.0.0")

        def __init__(self, *, source: ObjectSource, split, config_data: DataConfig, captures: Path, on_object, **rest):
            self._source, self._split, self._data = source, split, config_data
            self._on_object = on_object  # None if Beam makes the examples, in other processes
            rig = rig_for(config_data.capture)
            self._example_of = functools.partial(
                example_of, captures=captures.absolute(), rig=rig, backend=config_data.capture.backend
            )
            super().__init__(file_format="array_record", **rest)

        def _info(self):
            features = tfds.features.FeaturesDict(_features(self._source.classes, self._data.capture))
            return Info(builder=self, description=self.__doc__, features=features)

        def _split_generators(self, dl_manager):
            del dl_manager  # nothing to download: the captures are on disk
            if self._on_object is None:
                return {name: examples_by_beam(self._split[name], self._example_of) for name in SPLITS}
            return {name: self._generate_examples(name) for name in SPLITS}

        def _generate_examples(self, split: str) -> Iterator[tuple[str, dict[str, Any]]]:
            for entry in self._split[split]:
                name, example = self._example_of(entry)
                self._on_object(split, name, example)
                yield name, example

    return MultiViewObjects


def _write_shards(
    source: ObjectSource,
    split: dict[str, list[ObjectEntry]],
    left_out: dict[str, dict[str, str]],
    config: DataConfig,
    captures: Path,
    folder: Path,
    beam: Any,
) -> DatasetStatistics:
    """Writes the shards to `folder` and returns the statistics; `beam` are pipeline options or None."""
    import tensorflow_datasets as tfds

    statistics = StatisticsCollector(len(source.classes))
    with progress_bar("objects") as bar:
        task = bar.add_task("Writing shards", total=sum(map(len, split.values())), note="")

        def on_object(name: str, key: str, example: dict[str, Any]) -> None:
            bar.advance(task)
            statistics.add(name, key, example)

        builder = _builder_class()(
            source=source,
            split=split,
            config_data=config,
            captures=captures,
            on_object=on_object if beam is None else None,
            data_dir=str(folder),
        )
        with redirect_stdout(io.StringIO()):  # TFDS prints its output folder, twice
            builder.download_and_prepare(download_config=tfds.download.DownloadConfig(beam_options=beam))
        if beam is not None:
            for name in SPLITS:
                for example in open_split(folder.parent, name):
                    on_object(name, example["name"].decode(), example)
    counts = {
        name: {c: sum(entry.label == i for entry in members) for i, c in enumerate(source.classes)}
        for name, members in split.items()
    }
    viewpoints = viewpoints_of(config.capture)
    return statistics.finish(
        classes=list(source.classes),
        counts=counts,
        left_out=left_out,
        viewpoints=viewpoints.points.tolist(),
        neighbours=None if viewpoints.neighbours is None else [list(pair) for pair in viewpoints.neighbours],
        capture=asdict(identified(config.capture)),
        source=source.name,
        notes=source.notes,
    )


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
    """Makes the data set and returns its statistics. Several processes share the captures; the first writes the shards."""
    captures, made_with, shards = folder / CAPTURES, folder / "config.json", folder / SHARDS
    if not is_first():
        wait_for_all("the source is there")
    source, state = open_objects(config), state_of(config)
    if is_first():  # which has downloaded it, if need be
        wait_for_all("the source is there")
    for sentence in source.said:
        console.print(f"{config.source}: {sentence}", markup=False)
    if is_first():
        folder.mkdir(parents=True, exist_ok=True)
        keep_json(made_with, identity)
    wait_for_all("captures begin")
    if beam is None:  # several processes share the objects
        own = [source.entries[index] for index in own_share(len(source.entries))]
        capture_all(own, config.capture, captures, skip_damaged=config.skip_damaged)
        wait_for_all("captures end")
        left_out = left_out_of(source.entries, captures)
    else:
        left_out = capture_by_beam(source.entries, config.capture, captures, beam, skip_damaged=config.skip_damaged)
    split = split_objects(
        [entry for entry in source.entries if entry.name not in left_out], config.validation_share, config.seed
    )
    _check_classes(config, source, split, left_out)
    if is_first():
        (folder / SUMMARY).unlink(missing_ok=True)  # of shards that are damaged
        keep_checks(folder, {made_with.name: check_of_file(made_with)}, only=True)
        shutil.rmtree(shards, ignore_errors=True)  # incomplete shards of an interrupted run
        statistics = _write_shards(source, split, _reasons(source, left_out), config, captures, shards, beam)
        keep_checks_of_shards(folder)
        if state is not None:
            keep_json(folder / SOURCE_STATE, state)
        keep_json(folder / SUMMARY, statistics.content())
        shutil.rmtree(captures, ignore_errors=True)
    wait_for_all("a data set is made")
    return load_statistics(folder)
