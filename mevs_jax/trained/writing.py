"""Writing a trained system into a folder."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mevs_jax.trained.arrays import DESCRIPTION, WEIGHTS, arrays_of
from mevs_jax.trained.card import model_card
from mevs_jax.trained.description import Description
from mevs_jax.trained.parts import Parts

CARD, PROGRAMS = "README.md", "stablehlo"
BEFORE = ".before"
"""Ends the name of a folder that is being replaced."""
Programs = Callable[[Any, Path], object]
"""Writes the compiled programs of a system into a folder, as `mevs_jax.export.export` does."""


def write(
    description: Description, parts: Parts, folder: Path, half: bool, programs: Callable[[Path], object] | None
) -> None:
    """Writes a system and what `programs` writes into a folder; see `TrainedSystem.save`."""
    from safetensors.numpy import save as as_safetensors

    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; choose another folder")
    if folder.is_dir() and set(os.listdir(folder)) - {DESCRIPTION, WEIGHTS, CARD, PROGRAMS}:
        raise FileExistsError(f"{folder} holds other files; choose another folder, or empty it first")
    arrays = {name: np.array(array, order="C") for name, array in arrays_of(parts).items()}
    weights = as_safetensors({name: _halved(name, array) for name, array in arrays.items()} if half else arrays)
    content = json.loads(json.dumps(asdict(description)))
    content["weights"] = {"sha256": hashlib.sha256(weights).hexdigest(), "bytes": len(weights)}
    content["sha256"] = hash_of(content)
    folder = folder.resolve()  # what a link points to is replaced, not the link
    folder.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        made.chmod(0o755)
        _write(made / WEIGHTS, weights)
        if programs is not None:
            programs(made / PROGRAMS)
        _write(made / CARD, model_card(description, len(weights)).encode())
        _write(made / DESCRIPTION, json.dumps(content, indent=1, ensure_ascii=False).encode())
        _put_in_place(made, folder)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _put_in_place(made: Path, folder: Path) -> None:
    """Renames a folder to another name. A folder of this name is removed once the new one stands, and stays if it cannot."""
    before = None
    if folder.is_dir():
        before = made.with_name(made.name + BEFORE)
        folder.rename(before)
    try:
        made.rename(folder)
    except BaseException:
        if before is not None:
            before.rename(folder)
        raise
    if before is not None:
        shutil.rmtree(before, ignore_errors=True)


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


def hash_of(content: dict[str, Any]) -> str:
    """The hash of a description, without the one that it holds."""
    kept = {name: value for name, value in content.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()
