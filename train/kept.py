"""Results stored on disk under an identity, and computed again when the identity has changed.

An identity is whatever the result depends on: settings, the data set, the networks it was computed with.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import flax.nnx as nnx
import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError
from data_pipeline.files import as_read, read_json, write_json, write_npz
from train.checkpoints import Checkpoints

Network = TypeVar("Network", bound=nnx.Module)
Result = TypeVar("Result")


def kept(
    path: Path,
    load: Callable[[Path], Result],
    save: Callable[[Path, Result], None],
    is_current: Callable[[Result], bool],
    compute: Callable[[], Result],
) -> Result:
    """Returns the result stored in `path`; computes and stores it first if it is missing or not current.

    The result is always loaded from the file, so that a first run and a later one return the same.
    """
    if path.exists() and is_current(stored := load(path)):
        return stored
    save(path, compute())
    return load(path)


def kept_json(path: Path, identity: Any, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Returns the content of a JSON file; computes it first unless the file's `"identity"` equals `identity`.

    Args:
        compute: returns the content. The identity is added as the last entry, or replaces an `"identity"` entry in its place.
    """
    identity = as_read(identity)

    def content() -> dict[str, Any]:
        return compute() | {"identity": identity}

    return kept(path, read_json, write_json, lambda stored: stored["identity"] == identity, content)


def kept_array(path: Path, made: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """Returns the array of an `.npz` file; computes it first unless the file's `made_by` equals `made`."""

    def load(path: Path) -> dict[str, np.ndarray]:
        with np.load(path) as stored:
            return dict(stored)

    def content() -> dict[str, np.ndarray]:
        return {"array": compute(), "made_by": np.array(made)}

    def save(path: Path, content: dict[str, np.ndarray]) -> None:
        write_npz(path, **content)

    return kept(path, load, save, lambda stored: str(stored["made_by"]) == made, content)["array"]


def trained_once(
    folder: Path, identity: dict[str, Any], like: Network, train: Callable[[], tuple[Network, dict[str, Any]]]
) -> Network:
    """Returns the network stored in `folder`; trains and stores it first unless it was stored under `identity`.

    Args:
        like: a network of the same structure, into which stored weights are loaded; shapes are enough (`nnx.eval_shape`).
        train: returns the network and what `summary.json` holds about it.
    """
    path, identity = folder / "summary.json", as_read(identity)
    with Checkpoints(folder) as checkpoints:
        if path.exists() and read_json(path)["identity"] == identity:
            restored = checkpoints.restore("best", nnx.state(like, nnx.Param))
            if restored is not None:
                nnx.update(like, restored[0])
                return like
        network, summary = train()
        path.unlink(missing_ok=True)  # so that new weights never lie beside the old identity
        checkpoints.save("best", checkpoints.latest_step("best") + 1, nnx.state(network, nnx.Param), {})
    write_json(path, {"identity": identity, **summary})
    return network


def check_config(folder: Path, identity: dict[str, Any], holds: str) -> None:
    """Raises `DataError` if the `config.json` of a training's folder holds another identity.

    Args:
        holds: what the folder holds, for the message: "a network trained", "a sweep made".
    """
    if (folder / "config.json").exists() and read_json(folder / "config.json") != identity:
        raise DataError(f"{folder} holds {holds} with other settings; choose another --out, or delete that folder")


def made_by(statistics: DatasetStatistics, *networks: Path) -> str:
    """Returns a hash that names a data set and trained networks.

    It changes when one of them is made again with another result; training time does not enter.

    Args:
        networks: their folders.

    Raises:
        DataError: if a network is not fully trained.
    """
    content: list[Any] = [statistics.fingerprint]
    for network in networks:
        if not (network / "summary.json").exists():
            raise DataError(
                f"the network in {network} is not fully trained; finish it with: mevs train --out {network.parent}"
            )
        summary = read_json(network / "summary.json")
        content += [read_json(network / "config.json"), summary["best_epoch"], summary["best"]]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
