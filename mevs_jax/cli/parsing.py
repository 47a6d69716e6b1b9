"""From arguments to what a command is to do: options, settings, output directory."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mevs_jax.cli import options as option_classes
from mevs_jax.cli.commands import COMMANDS, Command

if TYPE_CHECKING:
    from data_pipeline.capture.casting import CaptureConfig
    from eval.settings import Settings


@dataclass(frozen=True)
class Invocation:
    """One call of a command.

    Attributes:
        name: of the command.
        options: of the command, one of `mevs_jax.cli.options`.
        settings: all settings, with the options applied.
        preset: whose defaults they started from.
        out: the run directory.
        groups: of settings that are the command's own.
        arguments: as typed, after the command.
    """

    name: str
    options: Any
    settings: Settings
    preset: str
    out: Path
    groups: tuple[str, ...]
    arguments: list[str]


def tool_options(name: str, arguments: list[str]) -> Any:
    """The options of a tool, which has no settings, so that `--help-all` is `--help`.

    Raises:
        SystemExit: for options that tyro refuses, after its message.
    """
    return _parsed(_class_of(COMMANDS[name]), name, arguments)


def _parsed(kind: Any, name: str, arguments: list[str], about: str = "") -> Any:
    """The options that a command is given; ends with their list where it is asked for."""
    arguments = ["--help" if argument == "--help-all" else argument for argument in arguments]
    return tyro.cli(kind, prog=f"mevs {name}", description=f"{COMMANDS[name].title}.{about}", args=arguments)


def show_options(name: str) -> None:
    """Prints the options of a command, without its settings, and exits."""
    command = COMMANDS[name]
    groups = ", ".join(f"--{group}.*" for group in command.settings)
    about = f" Settings (listed by --help-all): {groups}." if groups else ""
    _parsed(_class_of(command), name, ["--help"], about)


def _class_of(command: Command) -> Any:
    return getattr(option_classes, command.options)


def _given(arguments: list[str], flag: str) -> str | None:
    """The value of an option on the command line, which decides the defaults of others."""
    found = None
    for position, argument in enumerate(arguments):
        if argument.startswith(f"{flag}="):
            found = argument.split("=", 1)[1]
        elif argument == flag and position + 1 < len(arguments):
            found = arguments[position + 1]
    return found


def parse(name: str, arguments: list[str]) -> Invocation:
    """What a command is called with. Settings start from the run's own `run.json`, or else from the preset.

    Raises:
        DataError: for an unknown preset, a `run.json` that cannot be read, or options that contradict what the run was made with.
        SystemExit: for options that tyro refuses, after its message.
    """
    from data_pipeline.errors import DataError
    from eval.run_file import load_run
    from eval.settings import PRESETS

    command = COMMANDS[name]
    preset, out = _given(arguments, "--preset"), _given(arguments, "--out")
    if preset is not None and preset not in PRESETS:
        raise DataError(f"unknown preset {preset!r}; it is one of {', '.join(PRESETS)}")
    folder = Path(out or command.out.format(preset=preset or "small"))
    run = load_run(folder)
    groups = list(command.settings)
    if run is None:
        preset = preset or "small"
        base = PRESETS[preset]
    else:  # another preset is one for this command's own settings, not for a data set that is there already
        other = groups if preset not in (None, run.preset) else []
        other = [group for group in other if group != "dataset" or not (folder / "data").exists()]
        base = replace(run.settings, **{group: getattr(PRESETS[preset or "small"], group) for group in other})
        if preset not in (None, run.preset) and not groups:
            raise DataError(
                f"{folder} was made with --preset {run.preset}, not {preset}, which mevs {name} does not change; leave it out"
            )
        preset = preset or run.preset
    made_before_run_json = run is None and (folder / "classifier" / "config.json").exists()
    if made_before_run_json:  # by version 0.1: its settings have to be given again
        groups += [group for group in ("dataset", "classifier", "entropy") if group not in groups]
    others = _other_groups(groups, arguments) if run is not None else []
    shorts = _short_options(command, arguments) if run is not None or made_before_run_json else []
    kind = _options_with_settings(command, {group: getattr(base, group) for group in (*groups, *others)}, shorts)
    options = _parsed(kind, name, arguments)
    settings = settings_of(options, groups, base)
    given = replace(settings, **{group: getattr(options, group) for group in others})
    _check_unchanged(base, given, groups, f"mevs {name}", folder)
    _check_views(arguments, settings.dataset.capture)
    if settings.classifier.encoder:
        _check_no_resnet(arguments, settings.classifier.encoder)
    return Invocation(name, options, settings, preset, folder, tuple(groups), [*name.split(), *arguments])


def _other_groups(groups: list[str], arguments: list[str]) -> list[str]:
    """The groups of settings that arguments name and that are not the command's own."""
    from eval.settings import Settings

    found = (field.name for field in dataclasses.fields(Settings) if field.name not in groups)
    return [group for group in found if any(argument.startswith(f"--{group}.") for argument in arguments)]


_SHORT = ("data", "archive", "views", "encoder")
"""Options that stand for a setting."""


def _short_options(command: Command, arguments: list[str]) -> list[str]:
    """The short options among the arguments that the command does not have."""
    own = {field.name for field in dataclasses.fields(_class_of(command))}
    given = {argument.split("=")[0] for argument in arguments}
    return [name for name in _SHORT if f"--{name}" in given and name not in own]


def _check_unchanged(base: Settings, settings: Settings, groups: list[str], command: str, folder: Path) -> None:
    """Raises `DataError` if options change settings that a command does not use: they are those that the run was made with."""
    from data_pipeline.differences import differences, in_words
    from data_pipeline.errors import DataError

    own = {*groups, "policies", "seeds"}
    was, now = ({n: v for n, v in dataclasses.asdict(all_of).items() if n not in own} for all_of in (base, settings))
    if found := differences(was, now):
        raise DataError(
            f"{folder} was made with other settings ({in_words(found)}), which {command} does not change; leave these options "
            f"out, or make another run with another --out"
        )


def _check_views(arguments: list[str], capture: CaptureConfig) -> None:
    """Raises `DataError` if `--dataset.capture.views` is not the number of viewpoints in a file."""
    from data_pipeline.capture.viewpoints import is_file
    from data_pipeline.errors import DataError

    views = _given(arguments, "--dataset.capture.views") or ""
    if is_file(capture.lattice) and views.isdecimal() and int(views) != capture.views:
        raise DataError(
            f"{capture.lattice} has {capture.views} viewpoints, and --dataset.capture.views is {views}; leave one of them out"
        )


def _check_no_resnet(arguments: list[str], encoder: str) -> None:
    """Raises `DataError` for settings of a ResNet beside another encoder, which has none of them but channels, if it is own."""
    from data_pipeline.errors import DataError
    from mevs_jax.models.shapes import ENCODERS

    prefix = "--classifier.network."
    for argument in arguments:
        name = argument.split("=")[0].replace("_", "-")
        if name.startswith(prefix) and (name != f"{prefix}channels" or encoder in ENCODERS):
            raise DataError(
                f"{name} is a setting of the ResNet, and the classifier is {encoder}; leave one of them out"
            )


def keep_adopted(call: Invocation, settings: Settings) -> None:
    """Makes settings those of the run, in its `run.json`, also where the command only tries them."""
    from eval.run_file import save_run

    save_run(call.out, call.preset, settings, call.arguments)


def keep_settings(call: Invocation) -> None:
    """Makes the command's own settings those of the run, in its `run.json`; all others stay as they are there by now."""
    from eval.run_file import load_run, save_run

    run = load_run(call.out)
    if getattr(call.options, "adopt", False) and run is not None:
        return  # `keep_adopted` has written them
    if run is None:
        save_run(call.out, call.preset, call.settings, call.arguments)
    else:
        made = [folder for folder in COMMANDS[call.name].tries if _is_made(call.out / folder)]
        own = {group: getattr(call.settings, group) for group in call.groups if group not in made}
        settings = replace(run.settings, **own)
        if hasattr(call.options, "policy"):
            settings = replace(settings, policies=call.settings.policies)
        if hasattr(call.options, "seeds") and not {"sweep", "learned"} & set(call.groups):
            settings = replace(settings, seeds=call.settings.seeds)
        save_run(call.out, run.preset, settings, call.arguments)


def _is_made(folder: Path) -> bool:
    return any((folder / file).exists() for file in ("config.json", "metrics.json"))


def _options_with_settings(command: Command, groups: dict[str, Any], shorts: list[str]) -> type:
    """The command's options with groups of settings, and their defaults, beside them, and with short options of others."""
    fields: list = [(group, type(value), dataclasses.field(default=value)) for group, value in groups.items()]
    fields += [(name, int | None if name == "views" else str | None, None) for name in shorts]
    return dataclasses.make_dataclass(command.options, fields, bases=(_class_of(command),), frozen=True)


def settings_of(options: Any, groups: list[str], base: Settings) -> Settings:
    """All settings: these groups as given, the others as they were; short options override."""
    from data_pipeline.capture.viewpoints import is_file
    from train.own_code import absolute

    given = {name: value for name, value in vars(options).items() if value not in (None, ())}
    settings = replace(base, **{group: given[group] for group in groups})
    dataset = settings.dataset
    capture = replace(dataset.capture, views=given.get("views", dataset.capture.views))
    if is_file(capture.lattice) and capture.lattice != base.dataset.capture.lattice:
        capture = _with_own_viewpoints(capture, given, base)
    source, archive = given.get("data", dataset.source), given.get("archive", dataset.archive)
    encoder = absolute(given.get("encoder") or settings.classifier.encoder)
    settings = replace(
        settings,
        dataset=replace(dataset, source=source, archive=archive, capture=capture),
        classifier=replace(settings.classifier, encoder=encoder),
        policies=_policies(given, base),
    )
    settings = _with_seeds(settings, given, groups)
    if "seed" not in given:
        return settings
    seeded = [group for group in groups if group != "dataset"]
    return replace(settings, **{group: with_seed(getattr(settings, group), given["seed"]) for group in seeded})


def _with_seeds(settings: Settings, given: dict[str, Any], groups: list[str]) -> Settings:
    """The settings with the number of seeds of `--seeds`, and the grid of `--grid`, of what the command trains."""
    training = next((group for group in ("sweep", "learned") if group in groups), None)
    if training is None:
        return replace(settings, seeds=given.get("seeds", settings.seeds))
    changed = {name: given[name] for name in ("seeds", "grid") if name in given}
    return replace(settings, **{training: replace(getattr(settings, training), **changed)})


def _with_own_viewpoints(capture: CaptureConfig, given: dict[str, Any], base: Settings) -> CaptureConfig:
    """The capture with as many views as the file of its viewpoints has.

    Raises:
        DataError: if the file cannot be used, or `--views` is another number.
    """
    from data_pipeline.capture.viewpoints import FILE, absolute_lattice, read_viewpoints, viewpoints_of

    capture = replace(capture, lattice=absolute_lattice(capture.lattice))
    if "views" not in given and capture.views == base.dataset.capture.views:
        views = len(read_viewpoints(Path(capture.lattice.removeprefix(FILE))).points)
        return replace(capture, views=views)
    viewpoints_of(capture)
    return capture


def _policies(given: dict[str, Any], base: Settings) -> tuple[str, ...]:
    """The policies of `--policy`: those that are given, or those of the run; `none` is for no policy."""
    from train.own_code import absolute

    if "policy" not in given:
        return base.policies
    return tuple(absolute(one) for one in given["policy"] if one != "none")


def with_seed(settings: Any, seed: int) -> Any:
    """Settings in which every field called `seed` or `data_seed` is this seed."""
    changed = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.name in ("seed", "data_seed"):
            changed[field.name] = seed
        elif dataclasses.is_dataclass(value):
            changed[field.name] = with_seed(value, seed)
    return replace(settings, **changed)
