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
for name in ["rendering", "agent", "export", "exported", "inputs", "Walk", *mevs_jax.__all__]:
    assert getattr(mevs_jax, name) is not None
import jax, sys
cloud = jax.ShapeDtypeStruct((64, 3), "float32")
jax.eval_shape(lambda points: mevs_jax.farthest_point_sample(points, 8), cloud)
assert jax.default_backend() != "cpu" or "jax.experimental.pallas" not in sys.modules  # which takes half a second
assert None not in (mevs_jax.agent.load_history, mevs_jax.export.export, mevs_jax.exported.load, mevs_jax.trained.save)
"""

DOCUMENTED = """
import importlib, sys
for place in sys.argv[1:]:
    module, name = place.rsplit(".", 1)
    assert getattr(importlib.import_module(module), name) is not None
"""


def in_a_fresh_process(program: str, *arguments: str) -> None:
    ended = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr


def test_public_names_are_reached_by_one_import():
    in_a_fresh_process(REACHED)


def test_documented_names_are_where_the_reference_says():
    pages = "\n".join(page.read_text() for page in sorted((ROOT / "docs").glob("reference*.md")))
    places = re.findall(r"^::: (mevs_jax\.\S+)$", pages, re.MULTILINE)
    assert len(places) > len(mevs_jax.__all__)
    with_extras = tuple(f"mevs_jax.environment.{module}" for module in ("gymnasium", "gymnax", "active_perception"))
    without_extras = [place for place in places if not place.startswith(with_extras)]
    in_a_fresh_process(DOCUMENTED, *without_extras)


def test_the_stub_has_nothing_but_public_names():
    """The package reads its public names from there."""
    stub = ast.parse((ROOT / "mevs_jax" / "__init__.pyi").read_text())
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    assert [(node.module, alias.name, alias.name) for node in imports for alias in node.names] == [
        (mevs_jax._HOMES[alias.asname], alias.asname, alias.name) for node in imports for alias in node.names
    ]
    assert mevs_jax.__all__ == sorted(alias.name for node in imports for alias in node.names)
