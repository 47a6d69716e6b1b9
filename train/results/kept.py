"""Results stored on disk under an identity, and computed again when the identity has changed or the file is damaged.

An identity is whatever the result depends on: settings, the data set, the networks it was computed with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import flax.nnx as nnx
import jax
import numpy as np
from jax.experimental import multihost_utils

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.differences import differences, in_words
from data_pipeline.distributed import agreed, is_first, wait_for_all
from data_pipeline.errors import DataError, Unreadable, reason_of
from data_pipeline.files import (
    as_read,
    check_of,
    checks_in,
    damage_in,
    digest_of,
    keep_checks,
    keep_json,
    read_json,
    was_written,
    write_bytes,
    write_npz,
)
from data_pipeline.progress import console
from train.running.checkpoints import Checkpoints, damage_of, drop_damaged, has_save
from train.running.devices import device_mesh, parameter_sharding, place

Network = TypeVar("Network", bound=nnx.Module)
Result = TypeVar("Result")


def content_of(task: Any) -> dict[str, Any]:
    """Returns a task as JSON keeps it; what was added since version 0.1 and is off is left out, as it was then."""
    content = as_read(asdict(task))
    return {name: value for name, value in content.items() if value or name not in ("reality", "size", "azimuths")}


def kept(
    path: Path,
    load: Callable[[Path], Result],
    save: Callable[[Path, Result], None],
    is_current: Callable[[Result], bool],
    compute: Callable[[], Result],
) -> Result:
    """Returns the result stored in `path`; computes and stores it first if it is missing, damaged or not current.

    The result is always loaded from the file, so that a first run and a later one return the same. Of several processes, which
    all call this, the first one decides and stores; all compute, since they may share that work.

    Raises:
        Unreadable: if `path` is a folder.
    """
    if path.is_dir():
        raise Unreadable(path, "it is a folder", "remove it, and the same command goes on")
    stored = None
    if path.exists():
        try:
            stored = load(path)
            if not is_current(stored):
                stored = None
        except Exception as error:  # the content of a damaged file decides which
            console.print(f"{path} cannot be read ({why(error)}), so it is made again", markup=False)
            stored = None
    if agreed(stored is not None):
        return load(path) if stored is None else stored
    result = compute()
    if is_first():
        save(path, result)
    wait_for_all(f"kept {path.name}")
    return load(path)


def why(error: Exception) -> str:
    """Returns why a stored file cannot be read, in a few words."""
    if isinstance(error, Unreadable):
        return error.reason
    if isinstance(error, KeyError | TypeError | AttributeError | IndexError):
        return "its content has another form"
    return reason_of(error)[:120]


def kept_json(path: Path, identity: Any, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Returns the content of a JSON file; computes it first unless the file's `"identity"` equals `identity`.

    Args:
        compute: returns the content. The identity is added as the last entry, or replaces an `"identity"` entry in its place.
    """
    identity = as_read(identity)

    def content() -> dict[str, Any]:
        return compute() | {"identity": identity}

    return kept(path, read_json, keep_json, lambda stored: stored["identity"] == identity, content)


def keep_beside(path: Path, content: bytes) -> None:
    """Writes a file whose content follows from another file, unless it holds this content already.

    Raises:
        Unreadable: if `path` is a folder.
    """
    if path.is_dir():
        raise Unreadable(path, "it is a folder", "remove it, and the same command goes on")
    if path.exists():
        if damage_in(path.parent, [path.name]) is not None:
            console.print(f"{path} is not as it was written, so it is made again", markup=False)
        elif path.read_bytes() == content:
            return
    if not is_first():
        return
    keep_checks(path.parent, {path.name: check_of(content)})
    write_bytes(path, content)


def kept_array(path: Path, made: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """Returns the array of an `.npz` file; computes it first unless the file's `made_by` equals `made`."""

    def load(path: Path) -> dict[str, np.ndarray]:
        with np.load(path) as stored:
            return {name: stored[name] for name in ("array", "made_by")}

    def content() -> dict[str, np.ndarray]:
        return {"array": compute(), "made_by": np.array(made)}

    def save(path: Path, content: dict[str, np.ndarray]) -> None:
        write_npz(path, **content)

    return kept(path, load, save, lambda stored: str(stored["made_by"]) == made, content)["array"]


def trained_once(
    folder: Path, identity: dict[str, Any], like: Network, train: Callable[[], tuple[Network, dict[str, Any]]]
) -> Network:
    """Returns the network stored in `folder`; trains and stores it first unless it was stored under `identity`.

    Of several processes all train it, as they would alone, and share what `train` shares out; the first one's is stored.

    Args:
        like: a network of the same structure, into which stored weights are loaded; shapes are enough (`nnx.eval_shape`).
        train: returns the network and what `summary.json` holds about it.
    """
    path, identity = folder / "summary.json", as_read(identity)
    current = is_stored(folder, identity)
    drop_damaged(folder, "so the network is trained again")
    with Checkpoints(folder) as checkpoints:
        if current:
            try:
                restored = checkpoints.restore("best", nnx.state(like, nnx.Param))
            except Unreadable as error:
                console.print(f"{error.path} cannot be read ({error.reason}), so it is trained again", markup=False)
                checkpoints.drop("best")
                restored = None
            if restored is not None:
                nnx.update(like, restored[0])
                return like
        network, summary = train()
        if jax.process_count() > 1:  # machines of other kinds may round otherwise
            nnx.update(network, multihost_utils.broadcast_one_to_all(nnx.state(network, nnx.Param)))
        weights, mesh = nnx.state(network, nnx.Param), device_mesh()
        if is_first():
            path.unlink(missing_ok=True)  # so that new weights never lie beside the old identity
        wait_for_all("a network is trained")
        whole = place(weights, parameter_sharding(mesh, weights)) if jax.process_count() > 1 else weights
        checkpoints.save("best", checkpoints.latest_step("best") + 1, whole, {})
    if is_first():
        keep_json(path, {"identity": identity, **summary})
    wait_for_all("a network is stored")
    return network


def is_stored(folder: Path, identity: dict[str, Any]) -> bool:
    """Returns whether `trained_once` has stored a network under this identity; the same in all processes."""
    path, identity = folder / "summary.json", as_read(identity)
    return agreed(_is_stored(path, identity))


def _is_stored(path: Path, identity: Any) -> bool:
    """Returns whether a JSON file holds this `"identity"`; False, with a sentence, for a damaged one."""
    if not path.exists():
        return False
    try:
        return read_json(path)["identity"] == identity
    except (Unreadable, KeyError, TypeError) as error:
        console.print(f"{path} cannot be read ({why(error)}), so the network is trained again", markup=False)
        return False


def check_config(folder: Path, identity: dict[str, Any], holds: str) -> None:
    """Raises `DataError` if the `config.json` of a training's folder holds another identity.

    A missing or damaged one is written again if its check proves that it held this identity.

    Args:
        holds: what the folder holds, for the message: "a network trained", "a sweep made".
    """
    path = folder / "config.json"
    other = DataError(f"{folder} holds {holds} with other settings; choose another --out, or delete that folder")
    try:
        was = read_json(path)
        if was != identity:
            raise _other(folder, holds, was, identity)
        return
    except FileNotFoundError:
        if not any((folder / name).exists() for name in ("latest", "best", "summary.json")):
            return
        problem = Unreadable(path, "it is missing", f"delete {folder}, and the same command trains again")
    except Unreadable as error:
        problem = Unreadable(path, error.reason, f"delete {folder}, and the same command trains again")
    if not was_written(path, identity):
        raise other if path.name in checks_in(folder) else problem
    if is_first():
        console.print(f"{path} cannot be read ({problem.reason}), so it is written again", markup=False)
        keep_json(path, identity)


def goes_on_with(folder: Path, identity: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Returns the settings in which an interrupted or finished training differs from `identity`, if it may go on with these.

    More epochs (unless the learning rate falls with them, as by a cosine) and more patience lengthen a training. `parts` and the
    precision of the computation change rounding and batch norm alone, so that an interrupted training may move to a smaller
    device. There are none if something else differs, or nothing does.
    """
    try:
        was = read_json(folder / "config.json")
    except (FileNotFoundError, Unreadable):
        return {}
    found, done = differences(was, identity), (folder / "summary.json").exists()
    longer = {"task.optimiser.patience"}
    if identity["task"]["optimiser"]["schedule"] != "cosine":
        longer.add("task.optimiser.epochs")
    for where, (before, now) in found.items():
        is_longer = where in longer and isinstance(before, int) and before < now
        if not is_longer and (done or where not in ("task.optimiser.parts", "task.optimiser.compute")):
            return {}
    return found if has_save(folder / "latest") else {}


def _other(folder: Path, holds: str, was: Any, identity: dict[str, Any]) -> DataError:
    """The refusal of a folder that holds something else, which names what differs."""
    found = differences(was, identity)
    if list(found) == ["task.network_config.source"]:
        config = identity["task"]["network_config"]
        return DataError(
            f"{folder} holds {holds} with {config['module']}:{config['name']} as it was before it was edited; restore that file, "
            f"choose another --out, or delete that folder"
        )
    return DataError(
        f"{folder} holds {holds} with other settings ({in_words(found)}); choose another --out, or delete that folder"
    )


_IN_A_SUMMARY = {"epoch", "best_loss", "best_epoch", "best", "seconds", "steps", "start"}


def finished(folder: Path) -> dict[str, Any] | None:
    """Returns the summary of a finished training, or None if training has to begin or to go on.

    A damaged summary, or one whose weights are damaged, is removed with a sentence: training then goes on from what is sound.
    """
    path = folder / "summary.json"
    if not path.exists():
        return None
    damage = damage_of(folder / "best")
    if damage is None:
        try:
            summary = read_json(path)
            if set(summary) >= _IN_A_SUMMARY:
                return summary
            damage = f"{path} cannot be read (its content has another form)"
        except FileNotFoundError:  # another process has removed it
            return None
        except (Unreadable, TypeError) as error:
            damage = f"{path} cannot be read ({why(error)})"
    if path.is_dir():
        raise Unreadable(path, "it is a folder", "remove it, and the same command goes on")
    if is_first():
        console.print(f"{damage}; training goes on from what is sound", markup=False)
        path.unlink()
    return None


def config_of(folder: Path) -> dict[str, Any]:
    """Returns the `config.json` of a trained network; raises `DataError` if it is damaged."""
    return _of_a_network(folder, "config.json", {"task"})


def summary_of(folder: Path) -> dict[str, Any]:
    """Returns the `summary.json` of a trained network; raises `DataError` if it is damaged."""
    return _of_a_network(folder, "summary.json", _IN_A_SUMMARY)


def _of_a_network(folder: Path, name: str, entries: set[str]) -> dict[str, Any]:
    try:
        content = read_json(folder / name)
        if entries <= set(content):
            return content
        reason = "its content has another form"
    except FileNotFoundError:
        reason = "it is missing"
    except (Unreadable, TypeError) as error:
        reason = why(error)
    raise Unreadable(folder / name, reason, "repeat the command that trained this network, such as mevs train")


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
        summary = _of_a_network(network, "summary.json", {"best_epoch", "best"})
        content += [config_of(network), summary["best_epoch"], summary["best"]]
    return digest_of(content)
