"""The plan of a launch: `mevs train --plan`."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mevs_jax.cli.failure import Unusable
from mevs_jax.cli.parsing import Invocation
from mevs_jax.cli.stages import weights_of

if TYPE_CHECKING:
    from train.running.devices import Layout


_OPTIONS = ("plan_devices", "plan_target", "plan_processes", "plan_objects")


def is_asked(options: Any) -> bool:
    """Whether options of `mevs train` ask for a plan.

    Raises:
        Unusable: if they are those of a plan, without `--plan`.
    """
    given = [name for name in _OPTIONS if getattr(options, name) is not None]
    given += ["json"] * options.json
    if given and not options.plan:
        raise Unusable(f"--{given[0].replace('_', '-')} is for a plan; add --plan, or leave it out")
    return options.plan


def plan(call: Invocation) -> None:
    """Prints what `mevs train` would do with these options."""
    options = call.options
    if options.plan_devices is not None:  # the devices that are here may wait for others, or be in use
        import jax

        jax.config.update("jax_platforms", "cpu")
    from eval import training

    if call.settings.seeds != 1:
        raise Unusable(
            f"a plan is of one training, and --seeds is {call.settings.seeds}; add --seeds 1 to plan for each"
        )
    target = None
    if options.plan_target is not None:
        from train.planning.targets import Target

        target = Target.of(options.plan_target)
        if options.plan_devices not in (None, number := len(target.devices())):
            raise Unusable(
                f"{target.name} has {number} devices, and --plan-devices is {options.plan_devices}; leave that out"
            )
        options = replace(options, plan_devices=number)
    layout = layout_of(options)
    found = training.plan_training(call.settings, call.out, weights_of(call), layout, options.plan_objects, target)
    print(json.dumps(found) if options.json else plan_text(found))


def layout_of(options: Any) -> Layout:
    """The devices and processes that options of `mevs train` plan for.

    Raises:
        DataError: if they cannot train together.
    """
    from train.running.devices import Layout

    processes = 1 if options.plan_processes is None else options.plan_processes
    if options.distributed and None in (options.plan_devices, options.plan_processes):
        raise Unusable(
            "a plan of --distributed waits for no other process; say how many devices and processes there will be: "
            "--plan-devices N --plan-processes N"
        )
    if processes > 1 and not options.distributed:
        raise Unusable(f"{processes} processes train together with --distributed alone; add it, here and to the launch")
    devices = options.plan_devices
    if devices is None:
        import jax

        devices = jax.device_count()
    return Layout.of(devices, processes, options.model_devices)


def plan_text(found: dict[str, Any]) -> str:
    """A plan, for a terminal."""
    layout, data, networks = found["layout"], found["data"], found["networks"]
    lines = [
        f"{_count(layout['devices'], 'device')} ({layout['data']} data × {layout['model']} model) of "
        f"{_count(layout['processes'], 'process', 'es')}",
        f"data set{'' if data['made'] else ', not made yet'}: {_count(data['objects']['train'], 'object')} to train on, "
        f"{data['objects']['val']:,} for validation, {data['classes']} classes, {data['views']} views of "
        f"{data['resolution']}×{data['resolution']}",
        "",
    ]
    if not networks:
        return "\n".join([*lines, "All networks are trained already."])
    rows = [("", *(network["network"] for network in networks))]
    asked = networks[0]["compiled_bytes"] is not None
    rows += [(title, *(show(network) for network in networks)) for title, show in _rows(data["made"], asked)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines += ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines += ["", "Memory is counted from shapes, and is of one device; operations are XLA's count (docs/scaling.md)."]
    return "\n".join([*lines, *(f"Note: {note}." for note in found["notes"])])


def _rows(measured: bool, compiled: bool) -> list[tuple[str, Any]]:
    return [
        ("batch", lambda n: _views(n["batch_views"], n["batch_objects"])),
        ("  of a process", lambda n: _views(n["process_views"], n["process_objects"])),
        ("  of a device", lambda n: _views(n["device_views"], n["device_objects"])),
        ("  in parts", lambda n: f"{n['parts']}"),
        ("steps", lambda n: f"{n['epoch_steps']:,} an epoch, {n['steps']:,} in {n['epochs']} epochs"),
        *[("memory of a device, compiled", lambda n: _bytes(n["compiled_bytes"]))] * compiled,
        ("memory of a device", lambda n: _bytes(n["device_bytes"])),
        ("  weights, moments", lambda n: f"{_bytes(n['state_bytes'])} (weights {_bytes(n['weights_bytes'])})"),
        ("  gradients", lambda n: _bytes(n["gradients_bytes"])),
        ("  views", lambda n: _bytes(n["inputs_bytes"])),
        (
            "  activations",
            lambda n: f"{_bytes(n['activations_bytes'])} ({_bytes(n['view_activations_bytes'])} a view)",
        ),
        ("operations of a step", lambda n: f"{_flop(n['step_flop'])} ({_flop(n['device_flop'])} a device)"),
        (
            "read in an epoch",
            lambda n: f"{_bytes(n['epoch_bytes'])} ({_bytes(n['process_epoch_bytes'])} a process)",
        ),
        ("  of an object", lambda n: f"{_bytes(n['record_bytes'])}, {'measured' if measured else 'estimated'}"),
        (
            "validation in a process",
            lambda n: f"{n['validation_views']:,} views, {_bytes(n['validation_bytes'])}",
        ),
    ]


def _count(number: int, what: str, plural: str = "s") -> str:
    return f"{number:,} {what}{plural * (number != 1)}"


def _views(views: int, objects: float) -> str:
    return f"{_count(views, 'view')} of {objects:,g} object{'s' * (objects != 1)}"


def _bytes(number: float) -> str:
    return scaled(number, "B")


def _flop(number: float) -> str:
    return scaled(number, "FLOP") if number else "not counted"


def scaled(number: float, unit: str) -> str:
    """A number with three digits and a prefix, such as 44.7 MB."""
    prefixes = iter("kMGTPE")
    prefix = ""
    while number >= 999.5:
        number, prefix = number / 1000, next(prefixes)
    return f"{number:.3g} {prefix}{unit}"
