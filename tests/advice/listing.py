"""Messages that give advice, as they stand in the source: `python -m tests.advice.listing` prints them."""

from __future__ import annotations

import ast
import dataclasses
import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from eval.settings import PRESETS
from mevs_jax.cli import options as classes

ROOT = Path(__file__).resolve().parents[2]
OPTION = re.compile(r"(?<![\w…(-])--[a-z][\w.-]*\w")
COMMAND = re.compile(r"\bmevs ((?:check |study )?[a-z][a-z-]*)")
EXTRA = re.compile(r"pip install (?:-e )?[^ ]*\[([\w-]+)\]")


def _text(node: ast.expr) -> str:
    """A string as it stands in the source, with … for what is filled in."""
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) if isinstance(part, ast.Constant) else "…" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


@cache
def advice() -> list[tuple[str, str]]:
    """Every string that names an option, a command or an extra, without docstrings, and where it stands."""
    found = []
    for package in ("mevs_jax", "data_pipeline", "train", "eval"):
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            nodes = list(ast.walk(tree))
            apart = {node.value for node in nodes if isinstance(node, ast.Expr)}
            apart |= {part for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
            for node in nodes:
                if isinstance(node, ast.Constant | ast.JoinedStr) and node not in apart:
                    text = _text(node)
                    if " " in text and any(pattern.search(text) for pattern in (OPTION, COMMAND, EXTRA)):
                        found.append((f"{path.relative_to(ROOT)}:{node.lineno}", text))
    return found


def _settings(value: Any, prefix: str) -> Iterator[str]:
    yield f"--{prefix}"
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _settings(getattr(value, field.name), f"{prefix}.{field.name}".replace("_", "-"))


@cache
def options() -> set[str]:
    """Of all commands: their own options, and the settings."""
    own = {field.name for kind in vars(classes).values() if isinstance(kind, type) and dataclasses.is_dataclass(kind)
           for field in dataclasses.fields(kind)}  # fmt: skip
    known = {f"--{name.replace('_', '-')}" for name in {*own, "views", "data", "archive", "encoder"}} | {
        "--help",
        "--help-all",
    }
    for preset in PRESETS.values():
        for field in dataclasses.fields(preset):
            known |= set(_settings(getattr(preset, field.name), field.name.replace("_", "-")))
    return known | {"--up" if name == "--dataset.up" else name for name in known}


def matched(told: str, said: str) -> re.Match[str] | None:
    """Where a message is said that stands so in the source; the groups are what is filled in."""
    pattern = re.escape(told).replace("…", "(.+?)") + r"(?=[;,)]?(?: |$))" * told.endswith("…")
    return re.search(pattern, " ".join(said.split()))


def found(told: str, result: subprocess.CompletedProcess) -> re.Match[str] | None:
    """As `matched`, in all that a command prints."""
    return matched(told, result.stdout + result.stderr)


if __name__ == "__main__":
    print("\n".join(f"{where}: {text}" for where, text in advice()))
