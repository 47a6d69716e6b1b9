"""A trained system in one folder: `trained.json`, `weights.safetensors` and a model card, `README.md`.

Nothing in a folder is executed, and nothing is allocated before the shapes in the file agree with those of the networks that
`trained.json` describes.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mevs_jax.gallery.grid import SIDE
from mevs_jax.models.shapes import EncoderShape
from mevs_jax.plain import from_plain
from mevs_jax.policies.registry import POLICIES
from mevs_jax.trained.arrays import DESCRIPTION, WEIGHTS, parts_of
from mevs_jax.trained.description import FORM, Description
from mevs_jax.trained.system import EXPECTED_VIEWS, TrainedSystem
from mevs_jax.trained.writing import BEFORE, CARD, hash_of

SHIPPED = Path(__file__).parents[1] / "systems"
"""Folder of the systems that come with the package, by name."""
LARGEST = 2**31
"""Largest size of a file of weights in bytes."""
LARGEST_DESCRIPTION = 2**24
LARGEST_SIZE, MOST_LAYERS = 2**16, 64
"""Largest number in the shape of a network, and of its layers."""
MOST_PIXELS, MOST_POINTS, MOST_CLASSES = 1024, 2**16, 2048
"""Largest resolution of the camera, number of points of a cloud, and of classes; weights do not bound them."""
MOST_NUMBERS = 2**27
"""Largest number of outputs of a layer for one view (0.5 GB)."""
HUB = "hf://"
"""Begins the name of a model on the Hugging Face hub."""
_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")


class UnreadableSystem(ValueError):
    """A folder that is no trained system of this version, or a damaged one."""


def _unreadable(problem: str) -> UnreadableSystem:
    return UnreadableSystem(f"{problem}; export the system again, or enrol its objects again")


def load(path: str | Path) -> TrainedSystem:
    """Returns a trained system.

    Args:
        path: the name of a system that comes with the package, as `furniture10`, also if there is a folder of this name (which
            is `./furniture10`); a folder that `mevs run`, `mevs study learned` or `mevs export` wrote; a run's folder; or
            `hf://owner/name`, a model on the Hugging Face hub, which is asked for nothing else.

    Raises:
        FileNotFoundError: if there is no such folder or name.
        UnreadableSystem: for a folder that is damaged or was written by another version.
        ImportError: for a name on the hub, without the package huggingface_hub.
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path must be a name or a folder, got {path!r:.80}")
    folder = _folder_of(path)
    try:
        return _read(folder, str(path))
    except UnreadableSystem:
        raise
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise _unreadable(f"{error.filename or folder} cannot be read ({reason})") from error


def _folder_of(path: str | Path) -> Path:
    shipped = sorted(place.parent.name for place in SHIPPED.glob(f"*/{DESCRIPTION}"))
    if isinstance(path, str) and path in shipped:
        return SHIPPED / path
    if isinstance(path, str) and path.startswith(HUB):
        return _from_hub(path.removeprefix(HUB))
    folder = Path(path)
    # A computer that stopped while a system was replaced may have left the old one alone, under another name.
    kept = [] if folder.exists() else sorted(folder.parent.glob(f".{glob.escape(folder.name)}.*{BEFORE}"))
    for place in (folder, folder / "system", folder / "learned" / "system", *kept):
        if (place / DESCRIPTION).exists():
            return place
    if (folder / "run.json").exists():
        raise FileNotFoundError(
            f"the run in {folder} has no trained system yet; finish it with: mevs run --out {folder}"
        )
    if folder.exists():
        raise FileNotFoundError(f"{folder} has no {DESCRIPTION}: it is no trained system; write one with mevs export")
    if str(path) in shipped:
        return SHIPPED / path
    hub = f"; a model on the Hugging Face hub is {HUB}{path}" if _HUB_ID.fullmatch(str(path)) else ""
    raise FileNotFoundError(
        f"there is no folder {path}, and no system of this name; those that come with the package: "
        f"{', '.join(shipped) or 'none'}{hub}"
    )


def from_pretrained(name: str, revision: str | None = None) -> TrainedSystem:
    """Returns a trained system from the Hugging Face hub, downloaded once into its cache.

    Args:
        name: `owner/name`, with or without `hf://`.
        revision: branch, tag or commit.

    Raises:
        ImportError: without the package huggingface_hub.
        FileNotFoundError: if it cannot be downloaded.
        UnreadableSystem: as of `load`.
    """
    return _read(_from_hub(name.removeprefix(HUB), revision), name)


def _from_hub(name: str, revision: str | None = None) -> Path:
    if not _HUB_ID.fullmatch(name):
        raise FileNotFoundError(f"a model on the Hugging Face hub is owner/name, got {name!r:.80}")
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ImportError(
            f"to get {name} from the Hugging Face hub, install huggingface_hub: pip install mevs-jax[hub]"
        ) from error
    try:
        return Path(snapshot_download(name, revision=revision, allow_patterns=[DESCRIPTION, WEIGHTS, CARD]))
    except Exception as error:  # of the hub, of its client and of the network: many kinds, one meaning
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise FileNotFoundError(f"the Hugging Face hub did not give a model of the name {name} ({reason})") from error


def verify(folder: str | Path) -> Description:
    """Returns the description of the system in a folder, whose weights are as they were written; quicker than `load`.

    Raises:
        FileNotFoundError: if there is none.
        UnreadableSystem: if it is damaged, or of another version.
    """
    folder = Path(folder)
    description, of_weights = _read_description(folder)
    _read_weights(folder / WEIGHTS, of_weights)
    return description


def _read(folder: Path, name: str) -> TrainedSystem:
    from safetensors import SafetensorError
    from safetensors.numpy import load as from_safetensors

    description, of_weights = _read_description(folder)
    content = _read_weights(folder / WEIGHTS, of_weights)
    try:
        arrays = from_safetensors(content)
    except (SafetensorError, ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise _unreadable(f"{folder / WEIGHTS} is no safetensors file") from error
    with _sound(folder):
        return TrainedSystem(description, parts_of(description, arrays), name)


@contextmanager
def _sound(folder: Path) -> Iterator[None]:
    """Turns the errors of content of another form into `UnreadableSystem`."""
    try:
        yield
    except UnreadableSystem:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError, MemoryError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise _unreadable(f"{folder} is not a trained system that can be read ({reason})") from error


def _read_description(folder: Path) -> tuple[Description, Any]:
    """The checked description, and what it says about the file of weights."""
    path = folder / DESCRIPTION
    bad = f"{path} cannot be read"
    if path.stat().st_size > LARGEST_DESCRIPTION:
        raise _unreadable(f"{bad}: it is larger than {LARGEST_DESCRIPTION >> 20} MB")
    try:
        content = json.loads(path.read_bytes().decode())
    except (ValueError, RecursionError) as error:
        raise _unreadable(f"{bad}: it is no JSON file") from error
    if not isinstance(content, dict):
        raise _unreadable(f"{bad}: it holds no object")
    if content.get("form") != FORM:
        form = f"{content.get('form')!r:.20}"
        raise _unreadable(f"{bad}: its form is {form}, this version reads {FORM}")
    if content.get("sha256") != hash_of(content):
        raise _unreadable(f"{bad}: it was changed or damaged, since its hash differs")
    of_weights = content.pop("weights", None)
    del content["sha256"]
    with _sound(folder):
        description = from_plain(Description, content, DESCRIPTION)
        check(description)
    return description, of_weights


def check(description: Description) -> None:
    """Raises `ValueError` if a description contradicts itself."""
    of, camera, classes, size = description, description.camera, description.classes, description.size
    gallery = of.kind == "gallery"
    own = {*of.view_policies, *[EXPECTED_VIEWS] * (of.fusion is not None)}
    unknown = [name for name in (of.best, of.best_unposed) if name not in POLICIES and name not in own]
    sound = {
        "the camera is impossible": 1 <= camera.resolution <= MOST_PIXELS
        and 0 < camera.field_of_view < 180
        and 1 < camera.distance < 1e3,
        "there are fewer than two classes, or two of one name": 2 - gallery <= len(set(classes)) == len(classes),
        "a gallery has an unknown object as its last class": not gallery or of.unknown_class == len(classes) - 1,
        "a gallery has no networks": not gallery
        or not (of.encoder or of.fusion or of.pose or of.entropy or of.view_policies),
        "a system has an encoder, or is a gallery": gallery == (of.encoder is None),
        "the camera's resolution is no multiple of that of a gallery": not gallery or camera.resolution % SIDE == 0,
        "nothing but a gallery compares colours": gallery or not of.colour,
        f"there are more than {MOST_CLASSES} classes": len(classes) <= MOST_CLASSES,
        "depth and normals have 4 or 5 channels": of.image.content != "depth_and_normals"
        or of.image.channels in (4, 5),
        "mirror images are of depth and normals": not of.image.mirrored or of.image.content == "depth_and_normals",
        "the encoder is for images of another size": not isinstance(of.encoder, EncoderShape)
        or of.encoder.resolution == camera.resolution,
        "encoder and image differ in their channels": of.encoder is None or of.encoder.channels == of.image.channels,
        "the size is impossible, or used by another kind than a recogniser": size is None
        or (of.fusion is not None and 0 < size.smallest < size.largest < 1e9 and 2 <= size.steps <= 1000),
        "nothing but a recogniser finds poses": of.pose is None or of.fusion is not None,
        "an entropy predictor and its cloud belong together": (of.entropy is None) == (of.cloud is None),
        "the number of points of a cloud is impossible": of.cloud is None or 1 <= of.cloud.points <= MOST_POINTS,
        "a recogniser, and nothing else, has a fusion": (of.kind == "recogniser") == (of.fusion is not None),
        f"it has no policy {next(iter(unknown), '')!r:.40}": not unknown,
    }
    for problem, right in sound.items():
        if not right:
            raise ValueError(problem)
    for shape in (of.encoder, of.fusion, of.pose, of.entropy, *of.view_policies.values()):
        if shape is not None:
            _check_sizes(asdict(shape))
    largest = [camera.resolution**2 * of.image.channels, of.encoder.outputs(camera.resolution) if of.encoder else 1]
    if of.entropy is not None:
        largest += [level.centres * level.samples * max(level.layers, default=1) for level in of.entropy.abstractions]
    if of.pose is not None:
        largest.append(of.pose.poses * len(classes) ** 2)
    if max(largest) > MOST_NUMBERS:
        raise ValueError(f"a network has {max(largest):,} outputs of one layer, and at most {MOST_NUMBERS:,} are read")


def _check_sizes(shape: Any, least: int = 1) -> None:
    """Raises `ValueError` for numbers that no network has, before anything is made from them."""
    if isinstance(shape, dict | list | tuple):
        if len(shape) > MOST_LAYERS:
            raise ValueError(f"a network has {len(shape)} layers")
        for name, part in shape.items() if isinstance(shape, dict) else enumerate(shape):
            _check_sizes(part, least=0 if name == "blocks" else 1)  # a fusion may have none
    elif isinstance(shape, bool) or not isinstance(shape, int | float):
        return
    elif not (0 if isinstance(shape, float) else least) <= shape <= LARGEST_SIZE:
        raise ValueError(f"a network has the size {shape!r:.20}")


def _read_weights(path: Path, expected: Any) -> bytes:
    """The content of the file of weights, which is as it was written."""
    if not isinstance(expected, dict) or set(expected) != {"sha256", "bytes"}:
        raise _unreadable(f"{path.parent / DESCRIPTION} does not say what {WEIGHTS} holds")
    if not path.is_file():
        raise _unreadable(f"{path} is missing")
    size = path.stat().st_size
    if size != expected["bytes"] or size > LARGEST:
        raise _unreadable(f"{path} has {size} bytes instead of {expected['bytes']!r:.20}")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != expected["sha256"]:
        raise _unreadable(f"{path} is damaged, since its hash differs")
    return content
