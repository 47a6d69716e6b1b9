"""What messages advise exists: every option, command and extra that a string of the source names.

`python -m tests.cli.test_advice` prints the list. Tests of each package follow the advice, most of it in `test_advice.py` of
`data_pipeline`.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from eval.settings import PRESETS
from mevs_jax.cli import options as classes
from mevs_jax.cli.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
_OPTION = re.compile(r"(?<![\w…(-])--[a-z][\w.-]*\w")
_COMMAND = re.compile(r"\bmevs ((?:check |study )?[a-z][a-z-]*)")
_EXTRA = re.compile(r"pip install [^ ]*\[([\w-]+)\]")
_OF_OTHERS = {"--system-site-packages"}


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
                    if " " in text and any(pattern.search(text) for pattern in (_OPTION, _COMMAND, _EXTRA)):
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


def test_options_that_messages_name_exist():
    assert len(advice()) > 150
    wrong = [
        (where, name)
        for where, text in advice()
        for name in _OPTION.findall(text)
        if name not in options() | _OF_OTHERS
    ]
    assert wrong == []


def test_commands_that_messages_name_exist():
    wrong = [(where, name) for where, text in advice() for name in _COMMAND.findall(text)
             if not any(name == known or name.split()[0] == known for known in COMMANDS)]  # fmt: skip
    assert wrong == []


def test_extras_that_messages_name_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {extra for _, text in advice() for extra in _EXTRA.findall(text)}
    assert named
    assert named <= set(extras)


if __name__ == "__main__":
    print("\n".join(f"{where}: {text}" for where, text in advice()))
