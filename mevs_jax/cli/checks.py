"""Checks (`mevs check live`, `agent`, `transfer`, `reality`, `frames`, `compile`), and `mevs study instances`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mevs_jax.cli.failure import Unusable
from mevs_jax.cli.parsing import Invocation

if TYPE_CHECKING:
    from eval.checks.compiling import CompileCheck
    from eval.checks.frames import FramesCheck
    from eval.checks.reality import Reality, SceneRow, Stop
    from eval.checks.transfer import Transfer
    from mevs_jax.cli.options import (
        CompileOptions,
        FramesOptions,
        InstancesOptions,
        RealityOptions,
        TransferOptions,
    )
    from train.planning.compile import Compiled


def live(call: Invocation) -> None:
    """Walks with the networks in the loop, beside walks from the view tables."""
    from eval import stages

    for policy, found in stages.check_live(call.settings, call.out).items():
        print(
            f"{policy}: {found.same} of {found.walks} walks are the same live as by table "
            f"(confidences within {found.largest_difference:.1e})"
        )


def agent(call: Invocation) -> None:
    """Measures how often an agent's sure answers are right."""
    from eval import stages

    found = stages.check_agent(call.settings, call.out)
    for policy, walks in found.walks.items():
        print(
            f"{policy}: {walks.same} of {walks.walks} walks are those on view tables (probabilities within "
            f"{walks.largest_difference:.1e})"
        )
        for row in found.stopping.get(policy, []):
            print(
                f"  stops at {row.stop:g}: wrong {100 * row.error:.2f} % (promised {100 * row.promised_error:g} %), "
                f"{100 * row.stopped:.0f} % of walks stop, {row.views:.1f} views"
            )
    for camera in found.camera:
        print(
            f"any camera at {camera.distance:g} radii: overlap {camera.overlap_median:.3f} (5th percentile "
            f"{camera.overlap_low:.3f}), depth within {100 * camera.error_median:.2f} % of the radius, accuracy "
            f"{100 * camera.accuracy:.1f} % (own camera {100 * camera.own_accuracy:.1f} %)"
        )
    time = found.latency_ms
    print(
        f"640×480 image to next pose: {time.p50:.1f} ms (99th percentile {time.p99:.1f}), "
        f"{time.compilations:.0f} compilations"
    )


def transfer(options: TransferOptions) -> None:
    """Measures a trained system on other objects."""
    from data_pipeline.files import write_json
    from eval.checks.transfer import check_transfer
    from mevs_jax.cli.tools import load_system
    from train.results.records import as_json

    if options.max_views < 1 or options.draws < 1:
        raise Unusable("--max-views and --draws must be at least 1")
    if not 0 <= options.metres < math.inf:
        raise Unusable(
            f"--metres must be the metres in one unit of the files, 0.001 for millimetres, got {options.metres}"
        )
    if options.to is not None:
        check_file(options.to)
    system = load_system(options.system)
    if options.metres and not system.description.uses_size:
        raise Unusable(f"{options.system} does not use sizes; leave out --metres")
    found = check_transfer(
        system,
        options.data,
        up=options.up,
        renamed=dict(renamed(options.names)),
        posed=not options.unknown_yaw,
        metres=options.metres or math.nan,
        max_views=options.max_views,
        draws=options.draws,
    )
    if options.to is not None:
        write_json(options.to, as_json(found))
    print(json.dumps(as_json(found)) if options.json else transfer_text(found))


def instances(options: InstancesOptions) -> None:
    """Enrols objects and measures how well they are recognised."""
    import warnings

    from data_pipeline.files import write_json
    from eval.checks.instances import CONDITIONS, instances_text, study_instances
    from mevs_jax.cli.tools import load_system
    from mevs_jax.enrolment import AlikeWarning
    from train.results.records import as_json
    from train.tasks.colours import objects_fitted

    if options.shapes < 40:
        raise Unusable(f"--shapes must be at least 40, got {options.shapes}")
    names = options.conditions or tuple(one.name for one in CONDITIONS)
    if unknown := set(names) - {one.name for one in CONDITIONS}:
        known = ", ".join(f'"{one.name}"' for one in CONDITIONS)
        raise Unusable(f"--conditions knows {known}, not {min(unknown)!r}")
    conditions = [one for one in CONDITIONS if one.name in names]
    system = options.system
    if options.fit:
        objects_fitted(options.shapes).save(options.to / "objects")
        system = str(options.to / "objects")
        print(f"Trained system: {(options.to / 'objects').absolute()}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AlikeWarning)
        settings = {name: getattr(options, name) for name in ("up", "metres", "sizes")}
        found = study_instances(load_system(system), options.data, options.to, conditions=conditions, **settings)
    write_json(options.to / "instances.json", as_json(found))
    print(instances_text(found))


def renamed(names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Pairs of what the data and what the system calls a class, from FOLDER=CLASS."""
    if wrong := next((pair for pair in names if "=" not in pair), None):
        raise Unusable(f"--names {wrong} is not FOLDER=CLASS, as in --names armchair=chair")
    return tuple((pair.partition("=")[0], pair.partition("=")[2]) for pair in names)


def check_file(path: Path) -> None:
    """Raises `Unusable` if a file cannot be written, before anything is measured."""
    if path.is_dir():
        raise Unusable(f"{path} is a folder; name a file to write the figures into")
    there = path.exists()
    try:
        with path.open("a"):
            pass
        if not there:
            path.unlink()
    except OSError as error:
        raise Unusable(f"cannot write {path} ({error.strerror}); choose another file") from error


def transfer_text(found: Transfer) -> str:
    """The figures of `check_transfer`, for a terminal."""
    named = {
        known: [f"{name} ({count})" for name, count in found.classes.items() if (name in found.known_as) == known]
        for known in (True, False)
    }
    lines = [f"{found.known} objects of known classes: {', '.join(named[True])}"] if found.known else []
    if found.strangers:
        lines.append(f"{found.strangers} objects of unknown classes: {', '.join(named[False])}")
    lines += [f"left out: {name}: {reason}" for name, reason in found.left_out.items()]
    lines += [*found.notes, *_known_lines(found), *_promise_lines(found)]
    for seen in found.unknown_objects.after if found.unknown_objects else []:
        lines.append(
            f"unknown objects, {seen.views} random views seen: AUROC {seen.auroc:.3f}; said to be unknown: "
            f"{100 * seen.unknown_found:.0f} % of the unknown, {100 * seen.known_refused:.0f} % of the known"
        )
    return "\n".join(lines)


def _promise_lines(found: Transfer) -> list[str]:
    """What agents would say, at each probability and number of views."""

    def shown(share: float | None) -> str:
        return f"{'–' if share is None else f'{100 * share:.1f} %':>11}"

    titles = "wrong", "sure", "unknown", "sure", "unknown"
    lines = [
        "",
        "Answers of agents by the best policy: wrong among the sure ones of known objects; known objects that end sure,",
    ]
    lines += ["or as unknown objects; objects of unknown classes that end sure, or as unknown objects:"]
    lines.append(f"  {'stop':>5}{'views':>6}" + "".join(f"{title:>11}" for title in titles))
    for row in found.promises:
        shares = row.wrong, row.sure, row.refused, row.strangers_sure, row.strangers_refused
        lines.append(f"  {row.stop:>5g}{row.views:>6}" + "".join(map(shown, shares)))
    return lines


def _known_lines(found: Transfer) -> list[str]:
    """Accuracy and calibration of known objects."""
    if found.single_view is None:
        return []
    lines = ["", *_policy_lines(found)]
    lines += ["", "By class: accuracy of single views, and after 2 and 4 views by the best policy:"]
    for row in found.by_class:
        shares = [row.single, *(row.chosen[count - 1] for count in (2, 4) if count <= len(row.chosen))]
        lines.append(f"  {row.name:20}{row.objects:>5}" + "".join(f"{_percent(share):>9}" for share in shares))
    lines += ["", "Calibration: mean probability less accuracy, in points (above 0: too sure):"]
    for read in found.calibration:
        lines.append(f"  {read.policy:20}{read.views:>3}  {_percent(read.too_sure, read.interval, '+')}")
    for stop in found.stopping:
        error = "none stopped" if stop.error is None else f"wrong {100 * stop.error:.1f} %"
        lines.append(
            f"  stops at {stop.stop:g}: {error} (promised {100 * stop.risk:g} %), "
            f"{100 * stop.sure:.0f} % of walks stop, {stop.views:.1f} views"
        )
    return lines


def reality(options: RealityOptions) -> None:
    """Measures trained systems in scenes as a robot meets them."""
    from data_pipeline.files import write_json
    from data_pipeline.lock import locked
    from eval.checks.reality import RealityConfig, check_reality
    from mevs_jax.cli.tools import load_system
    from train.results.records import as_json

    if options.objects < 0 or options.objects == 1 or options.draws < 1:
        raise Unusable("--objects must be at least 2, or 0 for all, and --draws at least 1")
    if len(set(options.system)) < len(options.system):
        raise Unusable("--system names one system twice; name each once")
    names = renamed(options.names)
    config = RealityConfig(options.conditions, options.objects, names, options.draws, options.seed)
    systems = {name: load_system(name) for name in options.system}
    try:
        options.to.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unusable(f"cannot write to {options.to} ({error.strerror}); choose another --to") from error
    check_file(options.to / "reality.json")
    with locked(options.to, "mevs check reality"):
        found = check_reality(systems, options.data, options.to / "views", config, options.up)
        write_json(options.to / "reality.json", as_json(found))
    print(json.dumps(as_json(found)) if options.json else reality_text(found))


def reality_text(found: Reality) -> str:
    """The figures of `check_reality`, for a terminal."""
    strangers = f", {found.strangers} of classes that the systems do not know are not used" if found.strangers else ""
    lines = [f"{found.objects} objects{strangers}", *found.notes]
    lines += [f"left out: {name}: {why}" for name, why in found.left_out.items()]
    width = max(map(len, found.conditions.values()))
    for name, rows in found.systems.items():
        lines += ["", *_scene_lines(name, rows, found.conditions, width)]
    for name, won in found.won_back.items():
        lines += ["", f"{name} less {next(iter(found.systems))}, in points, on the same images:"]
        for row in won:
            shown = _percent(row.difference, row.interval, "+")
            lines.append(f"{found.conditions[row.condition]:{width}}  {row.policy:8}{row.views:>2}  {shown}")
    return "\n".join(lines)


def _scene_lines(name: str, rows: Sequence[SceneRow], conditions: dict[str, str], width: int) -> list[str]:
    """The table of one system, by number of views."""
    cells = {(row.condition, row.policy, row.views): row for row in rows}
    policies = list(dict.fromkeys(row.policy for row in rows))
    lines = [
        f"{name}: accuracy in %, with 95 % intervals over objects; in brackets the loss against perfect images and all views; "
        "last how often the walks that stop at 95 % are wrong"
    ]
    for count in sorted({row.views for row in rows}):
        heading = f"after {count} view{'s' * (count > 1)}"
        lines.append(f"{heading:{width}}" + "".join(f"{policy:>28}" for policy in policies))
        for condition, title in conditions.items():
            shown = (_cost(cells.get((condition, policy, count))) for policy in policies)
            lines.append(f"{title:{width}}" + "".join(f"{cell:>28}" for cell in shown))
    for condition, title in conditions.items():
        stops = {policy: cells[condition, policy, 1].stop for policy in policies if (condition, policy, 1) in cells}
        said = ", ".join(f"{policy} {_wrong(stop)}" for policy, stop in stops.items())
        lines.append(f"{title:{width}}  wrong when sure: {said}")
    return lines


def _wrong(stop: Stop) -> str:
    if stop.error is None:
        return "– (none is sure)"
    return f"{100 * stop.error:.1f} % of the {100 * stop.stopped:.0f} % that stop"


def _cost(row: SceneRow | None) -> str:
    if row is None:
        return "–"
    lost = f" ({-100 * row.loss:+.1f})" if row.loss else ""
    return _percent(row.accuracy, row.interval) + lost


def _percent(share: float, interval: list[float] | None = None, sign: str = "") -> str:
    ends = f" [{100 * interval[0]:{sign}.1f}, {100 * interval[1]:{sign}.1f}]" if interval else ""
    return f"{100 * share:{sign}.1f}{ends}"


def _policy_lines(found: Transfer) -> list[str]:
    counts = sorted({row.views for row in found.policies})
    cells = {(row.policy, row.views): row for row in found.policies}
    policies = dict.fromkeys(row.policy for row in found.policies)
    width = max(map(len, policies)) + len(" (best)")
    lines = [
        "Accuracy in % after each number of views, from all first views, with 95 % intervals over objects;",
        "below it the difference from random views:",
        " " * width + "".join(f"{count:>23}" for count in counts),
    ]
    for name in policies:
        rows = [cells[name, count] for count in counts]
        mark = " (best)" if name == found.best else ""
        lines.append(f"{name + mark:{width}}" + "".join(f"{_percent(row.accuracy, row.interval):>23}" for row in rows))
        if name != "random":
            lines.append(" " * width + "".join(f"{_percent(row.gain, row.gain_interval, '+'):>23}" for row in rows))
    return lines


def frames(options: FramesOptions) -> None:
    """Looks for faults of a recording."""
    from eval.checks.frames import check_frames, draw_check
    from mevs_jax.cli.tools import check_drawing, read_recording

    if options.draw is not None:
        check_drawing(options.draw)
        check_file(options.draw)
    recording = read_recording(options.path, options)
    found = check_frames(recording, None if options.upward is None else np.array(options.upward))
    if options.draw is not None:
        draw_check(recording, options.draw)
    print(frames_text(found))
    if found.findings:
        raise Unusable(f"{options.path}: " + "; ".join(f"{one.name}: {one.said}" for one in found.findings))


def frames_text(found: FramesCheck) -> str:
    """What `check_frames` found, for a terminal."""
    lines = [
        f"{found.images} images. Pairs of them, from near cameras to those far apart: share of the points of one that the other",
        "measures; median error in % of the distance; share within 2 %; share that the other sees through:",
        "  pairs  turned   moved  measured   error  within  through",
    ]
    for one in found.levels:
        shares = "".join(
            f"{100 * share:>{width}.1f} %" for share, width in ((one.overlap, 8), (one.error, 6), (one.agree, 6))
        )
        lines.append(f"{one.pairs:>7}{one.degrees:>7.1f}°{one.metres:>6.2f} m{shares}{100 * one.through:>7.1f} %")
    lines += [f"Note: {note}" for note in found.notes]
    return "\n".join([*lines, *["No fault was found."] * (not found.findings)])


def compiling(options: CompileOptions) -> None:
    """Compiles programs for devices that are not here, and compares them with earlier ones."""
    from train.planning.targets import Target

    target = Target.of(options.target)  # before anything is imported that takes long
    from data_pipeline.files import write_json
    from eval.checks.compiling import check_compile, chosen_programs, grown, read_check
    from train.results.records import as_json

    chosen_programs(options.only)
    if options.to is not None:
        check_file(options.to)
    before = read_check(options.against) if options.against is not None else None
    found = check_compile(target, options.only)
    if options.to is not None:
        write_json(options.to, as_json(found))
    print(json.dumps(as_json(found)) if options.json else compile_text(found))
    if before is not None and (said := grown(found, before)):
        raise Unusable(f"programs have grown since {options.against}: {'; '.join(said)}")
    if found.refused:
        raise Unusable(f"XLA cannot compile {', '.join(found.refused)} for {found.target}; its reasons are above")


def compile_text(found: CompileCheck) -> str:
    """What became of programs, for a terminal."""
    titles = ("program", "compiled in", "peak memory", "arithmetic", "traffic", "FLOP/B", "at least", "kernels")
    rows = [titles, *(_compiled_row(name, program) for name, program in found.programs.items())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    made_with = ", ".join(f"{package} {version}" for package, version in found.made_with.items())
    lines = [f"{found.target}, {found.devices} device{'s' * (found.devices > 1)}; {made_with}", ""]
    for (name, *cells), program in zip(rows, [None, *found.programs.values()], strict=True):
        shown = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        lines.append("  ".join([name.ljust(widths[0]), *shown]))
        if program is not None and (said := _said_of(program)):
            lines.append(f"    {said}")
    lines += [f"{name} cannot be compiled: {reason}" for name, reason in found.refused.items()]
    return "\n".join(
        [*lines, "", "Figures are XLA's, of one device; the body of a loop counts once (docs/performance.md)."]
    )


def _compiled_row(name: str, program: Compiled) -> tuple[str, ...]:
    from mevs_jax.cli.planning import scaled

    return (
        name,
        f"{program.compile_seconds:.1f} s",
        scaled(program.peak_bytes, "B"),
        scaled(program.flop, "FLOP"),
        scaled(program.contents.traffic_bytes, "B"),
        f"{program.flop_per_byte:.3g}",
        f"{1e3 * program.least_seconds:.3g} ms",
        f"{program.contents.kernels}",
    )


def _said_of(program: Compiled) -> str:
    """What a program sends, calls and repeats."""
    from mevs_jax.cli.planning import scaled

    of = program.contents
    said = [f"{one.count} {kind} ({scaled(one.bytes, 'B')})" for kind, one in of.collectives.items()]
    said += [f"{count} {called}" for called, count in of.custom_calls.items()]
    if of.loops:
        said.append(
            f"{of.loops} loop{'s' * (of.loops > 1)}" + f", {of.open_loops} of unknown length" * (of.open_loops > 0)
        )
    if of.host_transfers:
        said.append(f"{of.host_transfers} transfers from or to the host")
    return "; ".join(said)
