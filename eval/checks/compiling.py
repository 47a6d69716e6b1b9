"""Compiles the programs of `eval.checks.programs` for devices that are not here, and compares them with earlier ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

from data_pipeline.errors import DataError, reason_of
from data_pipeline.files import read_json
from data_pipeline.progress import console
from eval.checks.programs import PROGRAMS
from train.planning.compile import Compiled, compile_for
from train.planning.targets import Target, mesh_of
from train.results.records import from_json

GROWTH = 1.25
"""The most that a program's bytes may grow, by which a comparison passes."""
_PACKAGES = ("jax", "jaxlib", "libtpu", "jax-cuda13-plugin", "nvidia-cudnn-cu13")


@dataclass(frozen=True)
class CompileCheck:
    """Programs that were compiled for a target.

    Attributes:
        target: its name.
        devices: their number.
        made_with: versions of the packages that decide what is compiled.
        programs: what became of each, by name.
        refused: why others could not be compiled, by name.
    """

    target: str
    devices: int
    made_with: dict[str, str]
    programs: dict[str, Compiled]
    refused: dict[str, str]


def check_compile(target: Target, only: Sequence[str] = ()) -> CompileCheck:
    """Compiles programs for a target.

    Args:
        only: names of programs, or what they begin with; none for all.

    Raises:
        DataError: if no program has such a name, or there is no such target.
    """
    chosen = chosen_programs(only)
    devices = target.devices()
    mesh, programs, refused = mesh_of(devices), dict[str, Compiled](), dict[str, str]()
    for name in chosen:
        with console.status(f"Compiling {name} for {target.name}"):
            try:
                programs[name] = compile_for(target, PROGRAMS[name](mesh))
            except jax.errors.JaxRuntimeError as error:
                refused[name] = reason_of(error)
    return CompileCheck(target.name, len(devices), _versions(), programs, refused)


def chosen_programs(only: Sequence[str]) -> list[str]:
    """Returns the names of the programs that are asked for.

    Raises:
        DataError: if nothing has one of these names.
    """
    for asked in only:
        if not any(name.startswith(asked) for name in PROGRAMS):
            raise DataError(f"--only {asked}: there is no such program; they are {', '.join(PROGRAMS)}")
    return [name for name in PROGRAMS if not only or name.startswith(tuple(only))]


def read_check(path: Path) -> CompileCheck:
    """Returns what `--to` wrote.

    Raises:
        DataError: if it cannot be read.
    """
    try:
        return from_json(CompileCheck, read_json(path), str(path))
    except FileNotFoundError as error:
        raise DataError(f"--against {path}: there is no such file; write one with --to {path}") from error


def grown(now: CompileCheck, before: CompileCheck) -> list[str]:
    """Returns sentences on the programs that move or hold more bytes than before, by more than a quarter, or compile no more.

    Raises:
        DataError: if they are of other targets.
    """
    if now.target != before.target:
        raise DataError(f"the figures to compare with are of {before.target}, not of {now.target}; name their --target")
    said = []
    for name, old in before.programs.items():
        if name in now.refused:
            said.append(f"{name} was compiled before, and is not now ({now.refused[name]})")
        elif name in now.programs:
            new = now.programs[name]
            compared = (
                ("moves", old.contents.traffic_bytes, new.contents.traffic_bytes),
                ("holds", old.peak_bytes, new.peak_bytes),
            )
            said += [
                f"{name} {does} {after:.3g} bytes instead of {earlier:.3g} ({after / earlier - 1:+.0%})"
                for does, earlier, after in compared
                if after > GROWTH * earlier > 0
            ]
    return said


def _versions() -> dict[str, str]:
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # of another target
            continue
    return found
