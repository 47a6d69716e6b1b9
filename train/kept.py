"""Results that are kept on disk under an identity, and computed anew when the identity is another."""

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


def trained_once(
    folder: Path, identity: dict[str, Any], like: Network, train: Callable[[], tuple[Network, dict[str, Any]]]
) -> Network:
    """The network that is kept in the folder under this identity, shaped as `like`, whose weights need not be drawn; else the
    trained one, which is kept with what is told of it."""
    path, identity = folder / "summary.json", as_read(identity)
    with Checkpoints(folder) as checkpoints:
        if path.exists() and read_json(path)["identity"] == identity:
            restored = checkpoints.restore("best", nnx.state(like, nnx.Param))
            if restored is not None:
                nnx.update(like, restored[0])
                return like
        network, summary = train()
        path.unlink(missing_ok=True)  # the weights are never under another's identity
        checkpoints.save("best", checkpoints.latest_step("best") + 1, nnx.state(network, nnx.Param), {})
    write_json(path, {"identity": identity, **summary})
    return network


def kept_array(path: Path, made: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """The array in `path`, computed anew where it is not there or was made by other networks."""
    if path.exists():
        with np.load(path) as stored:
            if str(stored["made_by"]) == made:
                return stored["array"]
    array = compute()
    write_npz(path, array=array, made_by=np.array(made))
    return array


def made_by(statistics: DatasetStatistics, *networks: Path) -> str:
    """Names a data set and trained networks; changes when any is made anew, but not with the time it took.

    Raises:
        DataError: where one is not fully trained.
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
