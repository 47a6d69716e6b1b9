"""Comparison of settings with those that a run was made with. Later stages refuse settings that differ."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from data_pipeline.dataset.config import made_with_other_settings
from data_pipeline.differences import differences, in_words
from data_pipeline.errors import DataError
from data_pipeline.files import as_read
from eval.run_file import NAME, plain
from eval.settings import Settings
from train.own_code import named
from train.results.identity import config_of


def check_made_with(settings: Settings, out: Path) -> None:
    """Checks the settings of the data set and of both networks against what these were made with.

    Entries that only one of them has, such as those that a later version added, are not compared.

    Raises:
        DataError: names what differs.
    """
    found = made_with_other_settings(settings.dataset, out / "data")
    for name, wanted in (("classifier", _classifier(settings)), ("entropy", _entropy(settings))):
        if not (out / name / "config.json").exists():
            continue
        found |= _differences(config_of(out / name)["task"], wanted, name)
    if found:
        given = f"{out / NAME} says" if (out / NAME).exists() else "the options say"
        raise DataError(
            f"{out} was made with other settings than {given} ({in_words(found)}); repeat mevs run or mevs train with the "
            f"settings that it was made with, or choose another --out"
        )


def check_classifier(settings: Settings, out: Path) -> None:
    """Raises `DataError` if the settings of the classifier are not those that the run's was trained with; names what differs."""
    if not (out / "classifier" / "config.json").exists():
        return
    if found := _differences(config_of(out / "classifier")["task"], _classifier(settings), "classifier"):
        raise DataError(
            f"{out} has a classifier trained with other settings ({in_words(found)}); leave these options out, or choose another "
            f"--out"
        )


def check_evaluated_with(settings: Settings, metrics: dict[str, Any], out: Path) -> None:
    """Raises `DataError` if the metrics were made with other settings of the evaluation; names what differs."""
    made = metrics.get("identity", {}).get("evaluation", {})
    if found := differences(made, as_read(asdict(settings.evaluation)), "evaluation", shared=True):
        raise DataError(
            f"{out / 'metrics.json'} was made with other settings ({in_words(found)}); make it again with: mevs eval --out {out}"
        )


def _classifier(settings: Settings) -> dict[str, Any]:
    config = settings.classifier
    wanted = {
        "images": config.images,
        "augmentation": asdict(config.augmentation),
        "optimiser": asdict(config.optimiser),
        "reality": asdict(config.reality) if config.reality.strength else None,
    }
    network = plain(settings)["classifier"]["network"]
    if config.encoder:
        module, name = named(config.encoder)
        network |= {"module": module, "name": name}
    return as_read(wanted | {"network_config": network})


def _entropy(settings: Settings) -> dict[str, Any]:
    config = settings.entropy
    wanted = {"augmentation": asdict(config.augmentation), "optimiser": asdict(config.optimiser)}
    return as_read(wanted | {"network_config": asdict(config.network)})


def _differences(was: dict[str, Any], wanted: dict[str, Any], place: str) -> dict[str, tuple[Any, Any]]:
    """The differences of a network's task, under the names of the settings."""
    before, now = was.get("network_config", {}), wanted["network_config"]
    if ("module" in before) != ("module" in now):
        shown = (f"{network['module']}:{network['name']}" if "module" in network else "" for network in (before, now))
        return {f"{place}.encoder": tuple(shown)}  # type: ignore[dict-item]
    found = differences({"reality": None} | was, wanted, place, shared=True)
    return {name.replace(".network_config", ".network"): pair for name, pair in found.items()}
