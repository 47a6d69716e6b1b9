"""What a kept result was made from: the version of its kind, its settings, and the data and networks that made its inputs.

Results are computed again when their identity changes. A run that was made by an earlier version of the project therefore keeps
what still means the same, and only that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.differences import differences, in_words
from data_pipeline.errors import DataError, Unreadable, reason_of
from data_pipeline.files import as_read, digest_of, read_json
from train.results.records import as_json

VERSIONS = {
    "tables": 1,
    "metrics": 2,
    "seeds": 2,
    "system": 2,
    "outputs": 1,
    "rendering": 1,
    "timing": 1,
    "thesis": 2,
    "features": 1,
    "network": 1,
    "walks": 2,
    "decision": 1,
    "instances": 1,
    "targets": 1,
    "future": 1,
}
"""The version of each kind of kept result: raised by one when its numbers change their meaning or are computed in another way.
Results of before there were versions are of version 1."""


def identity_of(kind: str, **content: Any) -> dict[str, Any]:
    """Returns the identity of a kept result, as JSON has it.

    Args:
        kind: of result, in `VERSIONS`.
        content: the settings, as records or plain values, and `made_by` for the data and networks that made the inputs.
    """
    return {"version": VERSIONS[kind], **as_json(content)}


def stamp_of(kind: str, made: str) -> str:
    """Returns what names the origin of arrays that are kept without JSON: what made them, and the version of their kind."""
    return made if VERSIONS[kind] == 1 else f"{made}@{VERSIONS[kind]}"


def why_other_stamp(was: str, now: str) -> str | None:
    """Returns why arrays with one stamp are not those of another, in a few words; None if they are the same."""
    (made_before, _, before), (made_now, _, version) = was.partition("@"), now.partition("@")
    return why_other(
        {"version": int(before or 1), "made_by": made_before}, {"version": int(version or 1), "made_by": made_now}
    )


def why_other(was: Any, now: Any) -> str | None:
    """Returns why a result that was kept under one identity is not that of another, in a few words; None if they are the same."""
    if isinstance(was, Mapping) and isinstance(now, Mapping) and "version" in now:
        was = {"version": 1} | dict(was)
        if was["version"] != now["version"]:
            return f"it is of version {was['version']} of such results, and this program has version {now['version']}"
    if was == now:
        return None
    if not isinstance(was, Mapping):
        return "it was made by an earlier version of this program"
    found = differences(was, now)
    made_from = ("made_by", "tables_made_by", "by_view")
    if settings := {place: pair for place, pair in found.items() if place.split(".")[0] not in made_from}:
        return f"its settings were others: {in_words(settings)}" if all(settings) else "its settings were others"
    return "the data, networks or results that it was made from are others now"


def why(error: Exception) -> str:
    """Returns why a stored file cannot be read, in a few words."""
    if isinstance(error, Unreadable):
        return error.reason
    if isinstance(error, KeyError | TypeError | AttributeError | IndexError):
        return "its content has another form"
    return reason_of(error)[:120]


# -------------------------------------------------------------------------------------------------------- trained networks

IN_A_SUMMARY = {"epoch", "best_loss", "best_epoch", "best", "seconds", "steps", "start"}
"""Entries of `summary.json` of every trained network."""


def content_of(task: Any) -> dict[str, Any]:
    """Returns a task as JSON keeps it; what was added since version 0.1 and is off is left out, as it was then.

    So are `epoch_steps`, which matters for few objects alone (see `train.loop.content_on`), and `checkpoint_steps` and
    `reading_workers`, which change no weight.
    """
    content = as_read(asdict(task))
    for name in ("epoch_steps", "checkpoint_steps", "reading_workers"):
        content["optimiser"].pop(name)
    return {
        name: value
        for name, value in content.items()
        if value or name not in ("reality", "frozen", "size", "azimuths", "mirrored")
    }


def config_of(folder: Path) -> dict[str, Any]:
    """Returns the `config.json` of a trained network; raises `DataError` if it is damaged."""
    return _of_a_network(folder, "config.json", {"task"})


def summary_of(folder: Path) -> dict[str, Any]:
    """Returns the `summary.json` of a trained network; raises `DataError` if it is damaged."""
    return _of_a_network(folder, "summary.json", IN_A_SUMMARY)


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
