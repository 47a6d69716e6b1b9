"""Checks of settings: that work can begin with them, and that a run was made with them. Later stages refuse others."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

from data_pipeline.dataset.config import made_with_other_settings
from data_pipeline.differences import differences, in_words
from data_pipeline.errors import DataError
from eval.run_file import NAME, plain
from eval.settings import Settings
from eval.walks.grid import FIRST_MV, GridConfig
from mevs_jax.models.shapes import ENCODERS
from train.own_code import named
from train.results.identity import config_of
from train.results.records import as_json

MOST_SEEDS = 1000
"""Largest number of seeds of a run."""


def check_output(out: Path) -> None:
    """Raises `DataError` if the directory `out` is not writable, or an address of object storage."""
    if len(out.parts) > 1 and re.fullmatch(r"[a-z][a-z0-9+.-]+:", out.parts[0]):  # `Path` has made one slash of two
        raise DataError(
            f"--out {out.parts[0]}//{'/'.join(out.parts[1:])} is an address, and a run needs a folder whose files can be renamed "
            f"and locked; mount that storage, and give the folder"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(prefix=".probe.", dir=out):
            pass
    except OSError as error:
        raise DataError(f"cannot write to {out} ({error.strerror}); choose another --out") from error


def check_evaluation(config: GridConfig) -> None:
    """Raises `DataError` if the grid has no cells."""
    if config.max_views < FIRST_MV or config.draws < 1:
        raise DataError("--evaluation.max-views must be at least 2 and --evaluation.draws at least 1")


def check_seeds(settings: Settings) -> None:
    """Raises `DataError` for an impossible number of seeds."""
    if not 1 <= settings.seeds <= MOST_SEEDS:
        raise DataError(f"--seeds {settings.seeds} is not from 1 to {MOST_SEEDS}; choose another")


def check_made_with(settings: Settings, out: Path) -> None:
    """Checks the settings of the data set and of both networks against what these were made with.

    Entries that only one of them has, such as those that a later version added, are not compared.

    Raises:
        DataError: names what differs.
    """
    found = made_with_other_settings(settings.dataset, out / "data") | _in_networks(plain(settings), out)
    if found:
        given = f"{out / NAME} says" if (out / NAME).exists() else "the options say"
        raise DataError(
            f"{out} was made with other settings than {given} ({in_words(found)}); repeat mevs run or mevs train with the "
            f"settings that it was made with, or choose another --out"
        )


def check_classifier(settings: Settings, out: Path) -> None:
    """Raises `DataError` if the settings of the classifier are not those that the run's was trained with; names what differs."""
    if found := _in_networks(plain(settings), out, ("classifier",)):
        raise DataError(
            f"{out} has a classifier trained with other settings ({in_words(found)}); leave these options out, or choose another "
            f"--out"
        )


def _in_networks(
    content: dict[str, Any], out: Path, names: tuple[str, ...] = ("classifier", "entropy")
) -> dict[str, tuple[Any, Any]]:
    """The differences of the networks that are there from the content of all settings, under the names of the settings."""
    found: dict[str, tuple[Any, Any]] = {}
    for name in names:
        if (out / name / "config.json").exists():
            found |= _in_network(config_of(out / name)["task"], as_json(content[name]), name)
    return found


def _in_network(was: dict[str, Any], wanted: dict[str, Any], name: str) -> dict[str, tuple[Any, Any]]:
    before, now = was.get("network_config", {}), wanted.pop("network")
    if (encoder := wanted.pop("encoder", "")) in ENCODERS:
        now = {"name": encoder}
    elif encoder:
        now["module"], now["name"] = named(encoder)
    names = [[network.get(part) for part in ("module", "name")] for network in (before, now)]
    if [part is None for part in names[0]] != [part is None for part in names[1]]:
        return {f"{name}.encoder": tuple(":".join(filter(None, parts)) for parts in names)}  # type: ignore[dict-item]
    if "reality" in wanted and not wanted["reality"]["strength"]:
        wanted["reality"] = None
    found = differences({"reality": None, "frozen": False} | was, wanted | {"network_config": now}, name, shared=True)
    return {place.replace(".network_config", ".network"): pair for place, pair in found.items()}
