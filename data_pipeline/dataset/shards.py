"""The shards of a data set: ArrayRecord files of objects with all their views, in the layout of TFDS, and their index.

A shard is a part of the work. Which objects it holds follows from their names and numbers alone. So whichever process writes
it, and however often the work is interrupted, its bytes are the same. Neither writing nor reading needs TensorFlow.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.capture.casting import Capture, Rig, load_capture, rig_for
from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.capture.workers import capture_entry, capture_path, say_damaged
from data_pipeline.dataset.index import INDEX, about_index, index_path, read_parts, write_index
from data_pipeline.dataset.proof import SHARDS
from data_pipeline.dataset.statistics import SPLITS, Tally
from data_pipeline.errors import Diverged, reason_of
from data_pipeline.files import PARTIAL, check_of_file, short_hash
from data_pipeline.objects.mesh import ObjectEntry
from data_pipeline.progress import console
from mevs_jax.beliefs.entropy import level_entropy

_NAME, _VERSION = "multi_view_objects", "1.0.0"
_DESCRIPTION = (
    "Objects captured from a lattice of viewpoints: depth, shaded image, pose and depth entropy of each view."
)
_CLAIMS = "claims"
"""Folder in which processes say on which shards they work."""

_PIXEL_BYTES = 2 << 30
"""Bytes of pixels in a shard; compressed, they are about a tenth."""
_MOST_OBJECTS = 4096
"""The most objects in a shard."""


@dataclass(frozen=True)
class Part:
    """The objects of shard `number` of the `of` shards of a split, in the order of the records.

    Attributes:
        objects: their number, also where `entries` is left out.
    """

    split: str
    number: int
    of: int
    objects: int
    entries: tuple[ObjectEntry, ...]

    @property
    def name(self) -> str:
        """Name of the shard's file."""
        return f"{_NAME}-{self.split}.array_record-{self.number:05d}-of-{self.of:05d}"

    def shard(self, folder: Path) -> Path:
        """Returns the path of the shard of the data set in `folder`."""
        return folder / SHARDS / _NAME / _VERSION / self.name

    def index(self, folder: Path) -> Path:
        """Returns the path of the shard's index."""
        return index_path(folder, self.split, self.number, self.of)


def parts_of(split: dict[str, list[ObjectEntry]], config: CaptureConfig) -> list[Part]:
    """Returns the shards of all splits. Objects are ordered by a hash of their names, which is that of TFDS."""
    most = min(max(1, _PIXEL_BYTES // (3 * config.views * config.resolution**2)), _MOST_OBJECTS)
    parts = []
    for name in SPLITS:
        ordered = sorted(split[name], key=lambda entry: hashlib.md5((name + entry.name).encode()).digest())
        of = -(-len(ordered) // most)
        ends = [len(ordered) * number // of for number in range(of + 1)]
        for at in range(of):
            own = tuple(ordered[ends[at] : ends[at + 1]])
            parts.append(Part(name, at, of, len(own), own))
    return parts


@functools.cache
def _features(classes: tuple[str, ...], config: CaptureConfig) -> Any:
    """Returns the TFDS features of an example."""
    import tensorflow_datasets as tfds

    views, side = config.views, config.resolution
    tensor = tfds.features.Tensor
    return tfds.features.FeaturesDict(
        {
            "name": tfds.features.Text(),
            "label": tfds.features.ClassLabel(names=list(classes)),
            "depth": tensor(shape=(views, side, side), dtype=np.uint16, encoding="bytes"),
            "image": tensor(shape=(views, side, side), dtype=np.uint8, encoding="bytes"),
            "pose": tensor(shape=(views, 4, 4), dtype=np.float32),
            "entropy": tensor(shape=(views,), dtype=np.float32),
            "extent": tensor(shape=(3,), dtype=np.float32),
            "radius": tensor(shape=(), dtype=np.float32),
        }
    )


@jax.jit
def _entropies(levels: jax.Array) -> jax.Array:
    return jax.vmap(level_entropy)(levels)


def view_entropies(capture: Capture) -> np.ndarray:
    """Returns the depth entropy of each view in bits, (views,), exactly as in the thesis."""
    return np.asarray(_entropies(jnp.asarray(capture.depth // 256, jnp.int32)))


def _example_of(entry: ObjectEntry, captures: Path, rig: Rig, backend: str) -> dict[str, Any]:
    """Returns the content of an object's record, from its capture in the folder `captures`.

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
    entropy = view_entropies(capture)
    if not np.isfinite(entropy).all():
        way_out = "leave this object out of the source, or repair its mesh"
        raise Diverged(f"the depth entropies of {entry.name} are not finite; {way_out}")
    return {
        "name": entry.name,
        "label": entry.label,
        "depth": capture.depth,
        "image": capture.image,
        "pose": rig.poses_around(entry.name),
        "entropy": entropy,
        "extent": capture.extent,
        "radius": np.float32(capture.radius),
    }


_rig_for = functools.cache(rig_for)


def write_part(part: Part, folder: Path, classes: tuple[str, ...], config: CaptureConfig, captures: Path) -> bool:
    """Writes a shard and then its index, unless both are there and of the same captures; returns whether it has written.

    Raises:
        Diverged: if the entropies of an object are not finite.
    """
    objects = (f"{entry.label} {capture_path(captures, entry).name}" for entry in part.entries)
    made_of = short_hash("\n".join(objects).encode())
    path = part.shard(folder)
    about = about_index(part.index(folder))
    if about.get("made_of") == made_of and path.exists() and about["check"].startswith(f"{path.stat().st_size}:"):
        return False
    from array_record.python.array_record_module import ArrayRecordWriter
    from tensorflow_datasets.core.example_serializer import ExampleSerializer

    features, columns = _features(classes, config), dict[str, list[Any]]()
    serialiser = ExampleSerializer(features.get_serialized_info())
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        writer = ArrayRecordWriter(str(temporary), "group_size:1")
        for entry in part.entries:
            example = _example_of(entry, captures, _rig_for(config), config.backend)
            record = serialiser.get_tf_example(features.encode_example(example))
            writer.write(record.SerializeToString(deterministic=True))  # else each process has an order of its own
            points = np.count_nonzero(example["depth"], axis=(1, 2)).astype(np.int32)
            row = {name: example[name] for name in ("name", "label", "entropy", "extent", "radius")} | {
                "points": points
            }
            for name, value in row.items():
                columns.setdefault(name, []).append(value)
        writer.close()
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        check = check_of_file(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    whole: dict[str, Any] = {name: values if name == "name" else np.array(values) for name, values in columns.items()}
    write_index(
        part.index(folder), whole | {"label": whole["label"].astype(np.int32)}, {"made_of": made_of, "check": check}
    )
    return True


def claimed(parts: Sequence[Part], folder: Path) -> Iterable[Part]:
    """Yields shards that no other process writes, one after the other, until none is left."""
    claims = folder / _CLAIMS
    claims.mkdir(parents=True, exist_ok=True)
    for part in parts:
        try:
            (claims / part.name).touch(exist_ok=False)
        except FileExistsError:
            continue
        yield part


def drop_others(parts: Sequence[Part], folder: Path) -> None:
    """Removes claims of an interrupted run, and files that belong to no shard of this one."""
    shutil.rmtree(folder / _CLAIMS, ignore_errors=True)
    own = {path for part in parts for path in (part.shard(folder), part.index(folder))}
    for top in (folder / SHARDS, folder / INDEX):
        for path in top.rglob("*"):
            if path not in own and not path.is_dir():
                path.unlink()


def largest_of(part: Part, folder: Path) -> float:
    """Returns the largest entropy of a shard of the training split in bits; 0 for other splits."""
    if part.split != "train":
        return 0.0
    return float(np.max(read_parts([part.index(folder)], "entropy")["entropy"]))


def tally_of(part: Part, largest: float, folder: Path, classes: int) -> Tally:
    """Returns what the statistics need of a shard, by its index."""
    return Tally.of(part.split, read_parts([part.index(folder)], "label", "entropy", "points"), classes, largest)


def finish_shards(
    parts: Sequence[Part], folder: Path, classes: tuple[str, ...], config: CaptureConfig
) -> dict[str, str]:
    """Writes what TFDS has to know of the shards; returns the checks of all files."""
    import tensorflow_datasets as tfds

    shutil.rmtree(folder / _CLAIMS, ignore_errors=True)
    infos = []
    for name in SPLITS:
        members = [part for part in parts if part.split == name]
        size = sum(part.shard(folder).stat().st_size for part in members)
        lengths = [part.objects for part in members]
        infos.append(tfds.core.SplitInfo(name=name, shard_lengths=lengths, num_bytes=size))
    where = parts[0].shard(folder).parent
    tfds.folder_dataset.write_metadata(
        data_dir=str(where),
        features=_features(classes, config),
        split_infos=infos,
        version=_VERSION,
        check_data=False,
        description=_DESCRIPTION,
    )
    checks = {}
    for part in parts:
        checks[part.shard(folder).relative_to(folder).as_posix()] = about_index(part.index(folder))["check"]
    others = [path for path in where.iterdir() if path.suffix in (".json", ".txt")]
    for path in (*others, *(part.index(folder) for part in parts)):
        checks[path.relative_to(folder).as_posix()] = check_of_file(path)
    return checks
