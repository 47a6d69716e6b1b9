"""A trained system in one folder: `trained.json`, `weights.safetensors` and a model card, `README.md`.

Nothing in a folder is executed, and nothing is allocated before the shapes in the file agree with those of the networks that
`trained.json` describes.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mevs_jax.plain import from_plain
from mevs_jax.policies.registry import POLICIES
from mevs_jax.trained.arrays import DESCRIPTION, WEIGHTS, arrays_of, parts_of
from mevs_jax.trained.card import model_card
from mevs_jax.trained.description import FORM, Description
from mevs_jax.trained.system import EXPECTED_VIEWS, TrainedSystem

CARD, PROGRAMS = "README.md", "stablehlo"
SHIPPED = Path(__file__).parents[1] / "systems"
"""Folder of the systems that come with the package, by name."""
LARGEST = 2**31
"""Largest size of a file of weights in bytes."""
LARGEST_DESCRIPTION = 2**24
LARGEST_SIZE, MOST_LAYERS = 2**16, 64
"""Largest number in the shape of a network, and of its layers."""
_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")


class UnreadableSystem(ValueError):
    """A folder that is no trained system of this version, or a damaged one."""


def load(path: str | Path) -> TrainedSystem:
    """Returns a trained system.

    Args:
        path: a folder that `mevs run`, `mevs study learned` or `mevs export` wrote; a run's folder; the name of a system that
            comes with the package, as `furniture10`; or `owner/name` of a model on the Hugging Face hub.

    Raises:
        FileNotFoundError: if there is no such folder or name.
        UnreadableSystem: for a folder that is damaged or was written by another version.
        ImportError: for a name on the hub, without the package huggingface_hub.
    """
    folder = _folder_of(path)
    try:
        return _read(folder, str(path))
    except UnreadableSystem:
        raise
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise UnreadableSystem(
            f"{error.filename or folder} cannot be read ({reason}); export the system again"
        ) from error


def _folder_of(path: str | Path) -> Path:
    folder = Path(path)
    for place in (folder, folder / "system", folder / "learned" / "system"):
        if (place / DESCRIPTION).exists():
            return place
    if (folder / "run.json").exists():
        raise FileNotFoundError(
            f"the run in {folder} has no trained system yet; finish it with: mevs run --out {folder}"
        )
    if folder.exists():
        raise FileNotFoundError(f"{folder} has no {DESCRIPTION}: it is no trained system; write one with mevs export")
    if (SHIPPED / str(path) / DESCRIPTION).exists() and "/" not in str(path):
        return SHIPPED / str(path)
    if isinstance(path, str) and _HUB_ID.fullmatch(path) and not folder.parent.exists():
        return _from_hub(path)
    shipped = ", ".join(sorted(found.name for found in SHIPPED.glob("*/"))) if SHIPPED.is_dir() else "none"
    raise FileNotFoundError(
        f"there is no folder {path}, and no system of this name; those that come with the package: {shipped}"
    )


def from_pretrained(name: str, revision: str | None = None) -> TrainedSystem:
    """Returns a trained system from the Hugging Face hub, downloaded once into its cache.

    Args:
        name: `owner/name`.
        revision: branch, tag or commit.

    Raises:
        ImportError: without the package huggingface_hub.
        FileNotFoundError: if it cannot be downloaded.
        UnreadableSystem: as of `load`.
    """
    return _read(_from_hub(name, revision), name)


def _from_hub(name: str, revision: str | None = None) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ImportError(
            f"there is no folder {name}; to get it from the Hugging Face hub, install huggingface_hub: pip install mevs-jax[hub]"
        ) from error
    try:
        return Path(snapshot_download(name, revision=revision, allow_patterns=[DESCRIPTION, WEIGHTS, CARD]))
    except Exception as error:  # of the hub, of its client and of the network: many kinds, one meaning
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise FileNotFoundError(
            f"there is no folder {name}, and the Hugging Face hub did not give a model of this name ({reason})"
        ) from error


def save(system: TrainedSystem, folder: str | Path, *, half: bool = False, stablehlo: bool = False) -> None:
    """Writes a trained system into a folder; an existing one is replaced as a whole.

    Args:
        system: the system.
        folder: where to; a folder that holds anything but a trained system is refused.
        half: whether networks are stored in float16, which halves the file. They compute in float32 all the same.
        stablehlo: whether the compiled programs of `mevs_jax.deploy.export` are written too.

    Raises:
        FileExistsError: for a folder that holds something else.
    """
    from safetensors.numpy import save as as_safetensors

    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; choose another folder")
    if folder.is_dir() and set(os.listdir(folder)) - {DESCRIPTION, WEIGHTS, CARD, PROGRAMS}:
        raise FileExistsError(f"{folder} holds other files; choose another folder, or empty it first")
    arrays = {name: np.asarray(array) for name, array in arrays_of(system.parts).items()}
    if half:
        arrays = {name: _halved(name, array) for name, array in arrays.items()}
    weights = as_safetensors({name: np.array(array, order="C") for name, array in arrays.items()})
    content = json.loads(json.dumps(asdict(system.description)))
    content["weights"] = {"sha256": hashlib.sha256(weights).hexdigest(), "bytes": len(weights)}
    content["sha256"] = _hash_of(content)
    folder.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        made.chmod(0o755)
        _write(made / WEIGHTS, weights)
        if stablehlo:
            from mevs_jax.deploy.export import export

            export(system, made / PROGRAMS)
        _write(made / CARD, model_card(system.description, len(weights)).encode())
        _write(made / DESCRIPTION, json.dumps(content, indent=1, ensure_ascii=False).encode())
        if folder.is_dir():
            shutil.rmtree(folder)
        made.rename(folder)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _halved(name: str, array: np.ndarray) -> np.ndarray:
    """Weights of networks in float16, unless they would overflow; everything else is kept as it is."""
    networks = name.split(".")[0] in ("encoder", "entropy", "fusion", "pose", "view_policies")
    if not networks or array.dtype != np.float32 or array.ndim < 2 or np.abs(array).max(initial=0) > 60_000:
        return array
    return array.astype(np.float16)


def _hash_of(content: dict[str, Any]) -> str:
    kept = {name: value for name, value in content.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


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
    description, of_weights = _read_description(folder)
    content = _read_weights(folder / WEIGHTS, of_weights)
    with _sound(folder):
        return TrainedSystem(description, parts_of(description, _arrays_in(content, folder / WEIGHTS)), name)


@contextmanager
def _sound(folder: Path) -> Iterator[None]:
    """Turns the errors of content of another form into `UnreadableSystem`."""
    try:
        yield
    except UnreadableSystem:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError, MemoryError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise UnreadableSystem(
            f"{folder} is not a trained system that can be read ({reason}); export the system again"
        ) from error


def _read_description(folder: Path) -> tuple[Description, Any]:
    """The checked description, and what it says about the file of weights."""
    path = folder / DESCRIPTION
    bad = f"{path} cannot be read"
    if path.stat().st_size > LARGEST_DESCRIPTION:
        raise UnreadableSystem(f"{bad}: it is larger than {LARGEST_DESCRIPTION >> 20} MB; export the system again")
    try:
        content = json.loads(path.read_bytes().decode())
    except (ValueError, RecursionError) as error:
        raise UnreadableSystem(f"{bad}: it is no JSON file; export the system again") from error
    if not isinstance(content, dict):
        raise UnreadableSystem(f"{bad}: it holds no object; export the system again")
    if content.get("form") != FORM:
        form = f"{content.get('form')!r:.20}"
        raise UnreadableSystem(f"{bad}: its form is {form}, this version reads {FORM}; export the system again")
    if content.get("sha256") != _hash_of(content):
        raise UnreadableSystem(f"{bad}: it was changed or damaged, since its hash differs; export the system again")
    of_weights = content.pop("weights", None)
    del content["sha256"]
    with _sound(folder):
        description = from_plain(Description, content, DESCRIPTION)
        check(description)
    return description, of_weights


def check(description: Description) -> None:
    """Raises `ValueError` if a description contradicts itself."""
    camera, classes = description.camera, description.classes
    if not 1 <= camera.resolution <= 4096 or not 0 < camera.field_of_view < 180 or not 1 < camera.distance < 1e3:
        raise ValueError("the camera is impossible")
    if len(classes) < 2 or len(set(classes)) < len(classes):
        raise ValueError("there are fewer than two classes, or two of one name")
    if description.image.content == "depth_and_normals" and description.image.channels != 4:
        raise ValueError("depth and normals have 4 channels")
    if description.encoder.channels != description.image.channels:
        raise ValueError("encoder and image differ in their channels")
    if (size := description.size) is not None and not (
        description.fusion is not None and 0 < size.smallest < size.largest < 1e9 and 2 <= size.steps <= 1000
    ):
        raise ValueError("the size is impossible, or used by another kind than a recogniser")
    if description.pose is not None and description.fusion is None:
        raise ValueError("nothing but a recogniser finds poses")
    if (description.entropy is None) != (description.cloud is None):
        raise ValueError("an entropy predictor and its cloud belong together")
    if description.cloud is not None and not 1 <= description.cloud.points <= 2**20:
        raise ValueError("the number of points of a cloud is impossible")
    if (description.kind == "recogniser") != (description.fusion is not None):
        raise ValueError("a recogniser, and nothing else, has a fusion")
    of = description
    shapes = (of.encoder, of.fusion, of.pose, of.entropy, *of.view_policies.values())
    for shape in shapes:
        if shape is not None:
            _check_sizes(asdict(shape))
    own = {*description.view_policies, *[EXPECTED_VIEWS] * (description.fusion is not None)}
    for name in (description.best, description.best_unposed):
        if name not in POLICIES and name not in own:
            raise ValueError(f"it has no policy {name!r:.40}")


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
        raise UnreadableSystem(
            f"{path.parent / DESCRIPTION} does not say what {WEIGHTS} holds; export the system again"
        )
    if not path.is_file():
        raise UnreadableSystem(f"{path} is missing; export the system again")
    size = path.stat().st_size
    if size != expected["bytes"] or size > LARGEST:
        raise UnreadableSystem(f"{path} has {size} bytes instead of {expected['bytes']!r:.20}; export the system again")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != expected["sha256"]:
        raise UnreadableSystem(f"{path} is damaged, since its hash differs; export the system again")
    return content


def _arrays_in(content: bytes, path: Path) -> dict[str, np.ndarray]:
    from safetensors import SafetensorError
    from safetensors.numpy import load as from_safetensors

    try:
        return from_safetensors(content)
    except (SafetensorError, ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise UnreadableSystem(f"{path} is no safetensors file; export the system again") from error
