"""Imports go in one direction, without circles, and all public names are reachable and the same for people and type checkers."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mevs_jax
from tests.imports import cycles, imported, modules

ROOT = Path(__file__).parents[1]
PACKAGES = ("mevs_jax", "data_pipeline", "train", "eval")  # each may import itself and those before it


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_go_downward(package):
    above = PACKAGES[PACKAGES.index(package) + 1 :]
    assert (ROOT / package / "__init__.py").exists()
    for path in (ROOT / package).rglob("*.py"):
        if "cli" in path.relative_to(ROOT).parts:
            continue  # the command line imports all packages
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            assert not [name for name in names if name.split(".")[0] in above], path


@pytest.fixture(scope="module")
def graph():
    """The modules that each module of the project imports."""
    known = modules(*PACKAGES, "benchmarks")
    return {name: imported(path, known) for name, path in known.items()}


def test_no_modules_import_each_other_in_a_circle(graph):
    assert cycles(graph) == []


def test_no_rooms_of_the_library_import_each_other_in_a_circle(graph):
    """Nor by what only type checkers import, or only a function."""
    library = {name: targets for name, targets in graph.items() if name.startswith("mevs_jax.")}
    rooms = {name: ".".join(name.split(".")[:2]) for name in graph}
    between = {room: set() for room in rooms.values()}
    for name, targets in library.items():
        between[rooms[name]] |= {rooms[target] for target in targets} - {rooms[name]}
    assert cycles(between) == []


def test_one_module_of_the_library_uses_its_public_names(graph):
    """They are imported when they are used, so that this would hide circles: a system makes its agent by the public name."""
    users = {name for name, targets in graph.items() if name.startswith("mevs_jax.") and "mevs_jax" in targets}
    assert {name for name in users if not name.startswith("mevs_jax.cli")} == {"mevs_jax.trained.system"}


REACHED = """
import mevs_jax
for name in [*mevs_jax.__all__, *{names}]:
    value = mevs_jax
    for part in name.split("."):
        value = getattr(value, part)
    assert value is not None
"""


@pytest.mark.parametrize(
    "names",
    [
        ("rendering", "export.export", "exported.load", "inputs.depth_image", "agent.viewing.view"),
        ("Walk", "agent.load_history", "trained.save", "deploy.export.export", "geometry.canonical.convert"),
    ],
)
def test_public_names_are_reached_in_a_fresh_process_by_one_import(names):
    ended = subprocess.run([sys.executable, "-c", REACHED.format(names=names)], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_documented_names_are_reached_in_a_fresh_process_by_one_import():
    pages = "\n".join(page.read_text() for page in sorted((ROOT / "docs").glob("reference*.md")))
    names = re.findall(r"^::: mevs_jax\.(\S+)$", pages, re.MULTILINE)
    assert len(names) > len(mevs_jax.__all__)
    here = [name for name in names if not name.startswith("environment.gymnasium")]  # needs the extra `gym`
    ended = subprocess.run([sys.executable, "-c", REACHED.format(names=here)], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_the_stub_names_what_is_public():
    stub = ast.parse((ROOT / "mevs_jax" / "__init__.pyi").read_text())
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    found = {alias.asname: f"{node.module}" for node in imports for alias in node.names}
    assert found == {name: f"mevs_jax.{module}" for name, module in mevs_jax._HOMES.items()}
    for name in mevs_jax.__all__:
        assert getattr(mevs_jax, name) is not None
