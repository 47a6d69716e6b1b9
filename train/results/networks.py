"""Folders of trained networks: whether they hold what is wanted, whether a training is finished, and networks trained once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import flax.nnx as nnx
import jax
from jax.experimental import multihost_utils

from data_pipeline.differences import differences, in_words
from data_pipeline.distributed import agreed, is_first, wait_for_all
from data_pipeline.errors import DataError, Unreadable
from data_pipeline.files import checks_in, keep_json, read_json, was_written
from data_pipeline.progress import console
from train.results.identity import IN_A_SUMMARY, why, why_other
from train.results.records import as_json
from train.running.checkpoints import Checkpoints, damage_of, drop_damaged, has_save
from train.running.devices import device_mesh, parameter_sharding, place

Network = TypeVar("Network", bound=nnx.Module)


def trained_once(
    folder: Path, identity: dict[str, Any], like: Network, train: Callable[[], tuple[Network, dict[str, Any]]]
) -> Network:
    """Returns the network stored in `folder`; trains and stores it first unless it was stored under `identity`.

    Of several processes all train it, as they would alone, and share what `train` shares out; the first one's is stored.

    Args:
        like: a network of the same structure, into which stored weights are loaded; shapes are enough (`nnx.eval_shape`).
        train: returns the network and what `summary.json` holds about it.
    """
    path, identity = folder / "summary.json", as_json(identity)
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
    path, identity = folder / "summary.json", as_json(identity)
    return agreed(_is_stored(path, identity))


def _is_stored(path: Path, identity: Any) -> bool:
    """Returns whether a JSON file holds this `"identity"`; False, with a sentence, for a damaged one."""
    if not path.exists():
        return False
    try:
        reason = why_other(read_json(path)["identity"], identity)
    except (Unreadable, KeyError, TypeError) as error:
        console.print(f"{path} cannot be read ({why(error)}), so the network is trained again", markup=False)
        return False
    if reason is not None and is_first():
        console.print(f"The network in {path.parent} is trained anew: {reason}", markup=False)
    return reason is None


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
        # A patience of 0 is no shorter one: its weights are the last, which no longer wait makes the best.
        is_longer = where in longer and isinstance(before, int) and 0 < before < now
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
            if set(summary) >= IN_A_SUMMARY:
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
