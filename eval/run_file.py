"""`run.json`: what a run directory was made with. Later stages of the run start from these settings."""

from __future__ import annotations

import platform
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from data_pipeline.errors import DataError, Unreadable
from data_pipeline.files import CHECKS, as_read, checks_in, keep_json, read_json
from eval.settings import PRESETS, Settings
from mevs_jax.plain import from_plain

NAME = "run.json"


@dataclass(frozen=True)
class RunFile:
    """What `run.json` holds.

    Attributes:
        preset: whose defaults the settings started from.
        settings: all settings, as the stages so far were run with.
    """

    preset: str
    settings: Settings


def load_run(out: Path) -> RunFile | None:
    """What the run directory `out` was made with; None where it has no `run.json`.

    Raises:
        DataError: for a file that is no `run.json` of this version.
    """
    path = out / NAME
    if not path.exists():
        return None
    try:
        content = read_json(path)
        if content["preset"] not in PRESETS:
            raise ValueError(f"preset is {content['preset']!r}, not one of {', '.join(PRESETS)}")
        return RunFile(content["preset"], from_plain(Settings, content["settings"], "settings"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = error.reason if isinstance(error, Unreadable) else error
        raise DataError(
            f"{path} cannot be read ({reason}); delete it, and give the options of the run again, or choose another --out"
            + (f"; if you edited it, delete {CHECKS} beside it instead" if path.name in checks_in(out) else "")
        ) from error


def save_run(out: Path, preset: str, settings: Settings, arguments: list[str]) -> None:
    """Writes `run.json`; a file that holds the same settings, and was written by the same versions, is left as it is."""
    content, path = as_read(configuration(preset, settings) | {"made_with": _made_with()}), out / NAME
    if own := settings.classifier.own:
        content["encoder"] = _encoder(out, own)
    if path.exists() and {name: value for name, value in read_json(path).items() if name in content} == content:
        return
    keep_json(path, content | {"arguments": arguments})


def configuration(preset: str, settings: Settings) -> dict[str, Any]:
    """The resolved configuration, as `run.json` has it and `--print-config` prints it."""
    return {"preset": preset, "settings": plain(settings)}


def plain(settings: Settings) -> dict[str, Any]:
    """All settings as nested dictionaries. With another encoder, those of the ResNet that it replaces are left out."""
    content = asdict(settings)
    if settings.classifier.encoder:
        content["classifier"]["network"] = {"channels": settings.classifier.network.channels}
    return content


def _encoder(out: Path, reference: str) -> dict[str, Any]:
    """What identifies the user's encoder: as the classifier was trained with it, or as it is now."""
    try:
        trained = read_json(out / "classifier" / "config.json")["task"]["network_config"]
    except (OSError, Unreadable, KeyError, TypeError):
        trained = {}
    if {"module", "name", "source"} <= set(trained):
        return trained
    from train.own_code import load_own

    return load_own(reference, "--encoder").identity


def _made_with() -> dict[str, Any]:
    import jax  # late, since parsing options does not need it

    device = jax.devices()[0]
    devices = {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()}
    return {**versions_of("mevs-jax", "jax", "flax", "optax", "numpy"), "devices": devices}


def versions_of(*packages: str) -> dict[str, str]:
    """Versions of Python and of some packages."""
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}
