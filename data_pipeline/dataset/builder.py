"""Captures become a TFDS data set: one example is one object with all its views, in ArrayRecord shards.

An object is never on both sides of a split, whatever a later reader draws. Writing and reading need no TensorFlow. Beside
the shards lie the statistics of the data set (`DatasetStatistics`), which everything that follows reads from there.
"""

from __future__ import annotations

import functools
import hashlib
import io
import json
import os
import shutil
import struct
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.capture.casting import DEPTH_SCALE, Capture, CaptureConfig, Rig, load_capture, rig_for
from data_pipeline.capture.workers import capture_all, capture_path
from data_pipeline.dataset.beam import beam_options, capture_by_beam, examples_by_beam
from data_pipeline.errors import DataError
from data_pipeline.files import read_json, write_json
from data_pipeline.objects.archives import ARCHIVES, download, download_folder, local
from data_pipeline.objects.mesh import SOURCE_SPLITS, ObjectEntry, ObjectSource
from data_pipeline.objects.sources import mesh_zip, open_source
from data_pipeline.progress import console, progress_bar
from mevs_jax.entropy import level_entropy
from mevs_jax.viewpoints import viewpoint_lattice

SPLITS = ("train", "val", "test")
_SUMMARY = "summary.json"


@dataclass(frozen=True)
class DataConfig:
    """Which objects, and how they are looked at."""

    source: str = "furniture10"
    """furniture10, modelnet10 or modelnet40 (downloaded), a folder of <class>/{train,test}/ meshes, a zip of the same
    layout, or an .npz of voxel grids"""
    archive: str = ""
    """ModelNet10.zip or ModelNet40.zip where it is here already, in place of the download"""
    train_per_class: int = 60
    """training objects a class, for furniture10 (validation is taken from them)"""
    test_per_class: int = 20
    """test objects a class, for furniture10"""
    validation_share: float = 0.2
    """of the training objects, taken by class"""
    seed: int = 0
    """of the split into training and validation"""
    skip_damaged: bool = False
    """leave damaged files out instead of stopping at the first"""
    capture: CaptureConfig = CaptureConfig()


@dataclass(frozen=True)
class DatasetStatistics:
    """What is known of a data set once it is made; everything is over the training split unless said otherwise.

    Attributes:
        classes: names, by label.
        counts: objects by split and class.
        left_out: name and reason of every object that could not be captured, by the source's split.
        entropy_max: the largest depth entropy in bits: the normaliser of the network's targets (5.46 in the thesis).
        entropy_mean, entropy_std: of the normalised entropies (0.329 and 0.156 in the thesis).
        entropy_histograms: by split, counts of normalised entropies in 50 bins over [0, 1]; beyond 1 in the last bin.
        mean_map: (views,) mean normalised entropy of each view.
        class_mean_maps: (classes, views) the same by class.
        points_mean, points_std: points seen per view.
        points_by_class: by class, the 5th, 25th, 50th, 75th and 95th percentiles of points seen per view.
        viewpoints: (views, 3) unit vectors.
        capture: the `CaptureConfig`, as a dictionary.
        source: what the objects are.
    """

    classes: list[str]
    counts: dict[str, dict[str, int]]
    left_out: dict[str, dict[str, str]]
    entropy_max: float
    entropy_mean: float
    entropy_std: float
    entropy_histograms: dict[str, list[int]]
    mean_map: list[float]
    class_mean_maps: list[list[float]]
    points_mean: float
    points_std: float
    points_by_class: list[list[float]]
    viewpoints: list[list[float]]
    capture: dict[str, Any]
    source: str

    @property
    def views(self) -> int:
        return len(self.viewpoints)

    def objects_of(self, splits: Sequence[str]) -> int:
        """How many objects some splits hold."""
        return sum(sum(self.counts[split].values()) for split in splits)

    @property
    def fingerprint(self) -> str:
        """Changes with the objects, the views or their order."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:16]

    @property
    def left_out_count(self) -> int:
        return sum(map(len, self.left_out.values()))

    @property
    def camera(self) -> CaptureConfig:
        return CaptureConfig(**self.capture)


def split_objects(entries: Sequence[ObjectEntry], validation_share: float, seed: int) -> dict[str, list[ObjectEntry]]:
    """Objects by split: the source's test objects, and its training objects with a share of each class put aside.

    Every class keeps at least one object for training and, where it has two, one for validation.
    """
    random = np.random.default_rng(seed)
    split: dict[str, list[ObjectEntry]] = {"train": [], "val": [], "test": [e for e in entries if e.split == "test"]}
    for label in sorted({entry.label for entry in entries}):
        members = [entry for entry in entries if entry.split == "train" and entry.label == label]
        aside = max(min(1, len(members) - 1), round(validation_share * len(members)))
        chosen = set(random.permutation(len(members))[:aside].tolist())
        for index, entry in enumerate(members):
            split["val" if index in chosen else "train"].append(entry)
    return split


@jax.jit
def _entropies(levels: jax.Array) -> jax.Array:
    return jax.vmap(level_entropy)(levels)


def view_entropies(capture: Capture) -> np.ndarray:
    """Thesis-exact depth entropy of each view in bits, (views,)."""
    return np.asarray(_entropies(jnp.asarray(capture.depth // 256, jnp.int32)))


class _Statistics:
    """What is kept of each object while the shards are being written."""

    def __init__(self, classes: int):
        self.classes = classes
        self.objects: dict[str, dict[str, tuple[int, np.ndarray, np.ndarray]]] = {split: {} for split in SPLITS}

    def add(self, split: str, name: str, example: dict[str, Any]) -> None:
        """`example` as in the shards, of the object `name`."""
        points = np.count_nonzero(example["depth"], axis=(1, 2))
        self.objects[split][name] = int(example["label"]), example["entropy"], points

    def finish(self, **rest: Any) -> DatasetStatistics:
        # In the order of names, so that sums are the same in whatever order objects came.
        ordered = {split: [members[name] for name in sorted(members)] for split, members in self.objects.items()}
        labels = np.array([label for label, _, _ in ordered["train"]])
        points = np.stack([points for _, _, points in ordered["train"]])
        entropies = {split: np.stack([entropy for _, entropy, _ in members]) for split, members in ordered.items()}
        largest = float(np.max(entropies["train"])) or 1.0
        normalised = {split: members / largest for split, members in entropies.items()}
        train = normalised["train"]
        members = [labels == label for label in range(self.classes)]
        return DatasetStatistics(
            entropy_max=largest,
            entropy_mean=float(train.mean()),
            entropy_std=float(train.std()),
            entropy_histograms={
                split: np.histogram(np.minimum(values, 1), 50, (0, 1))[0].tolist()
                for split, values in normalised.items()
            },
            mean_map=train.mean(axis=0).tolist(),
            class_mean_maps=[
                train[own].mean(axis=0).tolist() if own.any() else [0.0] * train.shape[1] for own in members
            ],
            points_mean=float(points.mean()),
            points_std=float(points.std()),
            points_by_class=[
                np.percentile(points[own], (5, 25, 50, 75, 95)).tolist() if own.any() else [0.0] * 5 for own in members
            ],
            **rest,
        )


def _features(classes: Sequence[str], config: CaptureConfig) -> dict[str, Any]:
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
    }


def _spill_without_tensorflow() -> None:
    """Lets TFDS sort more than its 1 GiB of records without TensorFlow, which it uses there only to open files."""
    from tensorflow_datasets.core import shuffle

    class Bucket(shuffle._Bucket):
        """Opened for each record, so that TFDS's thousand buckets need no thousand open files."""

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


def example_of(entry: ObjectEntry, captures: Path, rig: Rig) -> tuple[str, dict[str, Any]]:
    """Key and content of an object's record."""
    capture = load_capture(capture_path(captures, entry))
    return entry.name, {
        "name": entry.name,
        "label": entry.label,
        "depth": capture.depth,
        "image": capture.image,
        "pose": rig.poses_around(entry.name),
        "entropy": view_entropies(capture),
        "extent": capture.extent,
    }


@functools.cache
def _builder_class() -> type:
    """The TFDS builder; made on first use, so that importing this module stays quick."""
    import tensorflow_datasets as tfds

    tfds.disable_progress_bar()
    _spill_without_tensorflow()

    class MultiViewObjects(tfds.core.GeneratorBasedBuilder):
        """Objects captured from a lattice of viewpoints: depth, shaded image, pose and depth entropy of each view."""

        VERSION = tfds.core.Version("1.0.0")

        def __init__(self, *, source: ObjectSource, split, config_data: DataConfig, captures: Path, on_object, **rest):
            self._source, self._split, self._data = source, split, config_data
            self._on_object = on_object  # None where Beam makes the examples, elsewhere
            rig = rig_for(config_data.capture)
            self._example_of = functools.partial(example_of, captures=captures.absolute(), rig=rig)
            super().__init__(file_format="array_record", **rest)

        def _info(self):
            features = tfds.features.FeaturesDict(_features(self._source.classes, self._data.capture))
            return tfds.core.DatasetInfo(builder=self, description=self.__doc__, features=features)

        def _split_generators(self, dl_manager):
            del dl_manager  # the captures are on disk already
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
    import tensorflow_datasets as tfds

    statistics = _Statistics(len(source.classes))
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
        with redirect_stdout(io.StringIO()):  # TFDS prints where it writes, twice
            builder.download_and_prepare(download_config=tfds.download.DownloadConfig(beam_options=beam))
        if beam is not None:
            for name in SPLITS:
                for example in open_split(folder.parent, name):
                    on_object(name, example["name"].decode(), example)
    counts = {
        name: {c: sum(entry.label == i for entry in members) for i, c in enumerate(source.classes)}
        for name, members in split.items()
    }
    return statistics.finish(
        classes=list(source.classes),
        counts=counts,
        left_out=left_out,
        viewpoints=viewpoint_lattice(config.capture.views, config.capture.lattice).tolist(),
        capture=asdict(config.capture),
        source=source.name,
    )


def open_objects(config: DataConfig) -> ObjectSource:
    """The source of objects; official archives are downloaded, or taken from `config.archive`."""
    official = ARCHIVES.get(config.source)
    if official is None:
        if config.archive:
            raise DataError(f"--archive goes with --data {' or '.join(ARCHIVES)}, not with {config.source}")
        return open_source(config.source, train_per_class=config.train_per_class, test_per_class=config.test_per_class)
    if config.archive:
        path = local(official, Path(config.archive).expanduser().resolve())
    else:
        path = download(official, download_folder())
    source = mesh_zip(path)
    counts = {split: sum(entry.split == split for entry in source.entries) for split in SOURCE_SPLITS}
    if (len(source.classes), counts["train"], counts["test"]) != (official.classes, official.train, official.test):
        console.print(
            f"{path} holds {len(source.classes)} classes, {counts['train']} training and {counts['test']} test objects; "
            f"{official.name} has {official.classes}, {official.train} and {official.test}"
        )
    return replace(source, name=official.name)


def prepare(config: DataConfig, folder: Path, beam: str | None = None) -> DatasetStatistics:
    """Makes the data set in `folder`, or finds it there.

    The steps leave their results behind (captures, then shards, then the summary), so an interrupted run goes on. With `beam`,
    the options of a Beam pipeline, Beam does the work; the records are the same.

    Raises:
        DataError: unusable source, or a folder that holds a data set made otherwise.
    """
    if config.capture.views < 2:
        raise DataError(f"--views {config.capture.views} is too few: choosing a next view takes at least 2 viewpoints")
    try:
        viewpoint_lattice(config.capture.views, config.capture.lattice)
    except ValueError as error:
        raise DataError(f"{error}; choose another --views or --dataset.capture.lattice") from error
    identity = asdict(config)
    made_with = folder / "config.json"
    if made_with.exists() and read_json(made_with) != identity:
        was = read_json(made_with)
        differs = ", ".join(sorted(key for key in identity if was.get(key) != identity[key]))
        raise DataError(
            f"{folder} holds a data set made with other settings ({differs}); choose another --out, or delete it"
        )
    captures = folder / "captures"
    if (folder / _SUMMARY).exists():
        shutil.rmtree(captures, ignore_errors=True)  # of a run that was stopped between the two
        return load_statistics(folder)
    options = None if beam is None else beam_options(beam)
    source = open_objects(config)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(made_with, identity)
    if options is None:
        left_out = capture_all(source.entries, config.capture, captures, skip_damaged=config.skip_damaged)
    else:
        left_out = capture_by_beam(source.entries, config.capture, captures, options, skip_damaged=config.skip_damaged)
    kept = [entry for entry in source.entries if entry.name not in left_out]
    split = split_objects(kept, config.validation_share, config.seed)
    for name, members in split.items():
        if not members:
            raise DataError(f"{config.source} leaves no objects for {name}; add some (left out: {len(left_out)})")
    reasons = {
        name: {
            entry.name: left_out[entry.name]
            for entry in source.entries
            if entry.split == name and entry.name in left_out
        }
        for name in SOURCE_SPLITS
    }
    shards = folder / "shards"
    shutil.rmtree(shards, ignore_errors=True)  # half-written ones
    statistics = _write_shards(source, split, reasons, config, captures, shards, options)
    write_json(folder / _SUMMARY, asdict(statistics))
    shutil.rmtree(captures, ignore_errors=True)
    return statistics


def load_statistics(folder: Path) -> DatasetStatistics:
    """The summary of a data set; raises `DataError` where there is none."""
    path = folder / _SUMMARY
    if not path.exists():
        raise DataError(f"no data set in {folder}; make one with: mevs data --out {os.path.dirname(folder) or '.'}")
    try:
        return DatasetStatistics(**read_json(path))
    except TypeError as error:
        raise DataError(
            f"{folder} was made by another version of mevs_jax; choose another --out, or delete it"
        ) from error


def open_split(folder: Path, split: str) -> Any:
    """Random access to the objects of one split: `source[i]` is a dictionary of NumPy arrays."""
    import tensorflow_datasets as tfds

    found = sorted((folder / "shards").glob("*/*/features.json"))
    if not found:
        raise DataError(f"no shards in {folder}; make them with: mevs data --out {os.path.dirname(folder) or '.'}")
    return tfds.builder_from_directory(str(found[-1].parent)).as_data_source(split=split)


def report_left_out(statistics: DatasetStatistics) -> None:
    """Says which objects are missing and why; silence would be a lie about the data."""
    objects = sum(sum(by_class.values()) for by_class in statistics.counts.values())
    sizes = ", ".join(f"{sum(by_class.values())} {split}" for split, by_class in statistics.counts.items())
    console.print(
        f"Data set: {objects} objects ({sizes}), {statistics.views} views each, {statistics.left_out_count} left out"
    )
    for by_name in statistics.left_out.values():
        for name, reason in by_name.items():
            console.print(f"  left out: {name}: {reason}", style="dim", soft_wrap=True)


def metric_depth(stored: jax.Array | np.ndarray) -> jax.Array:
    """Stored depth to metric depth; 0 stays 0."""
    return jnp.asarray(stored, jnp.float32) / DEPTH_SCALE
