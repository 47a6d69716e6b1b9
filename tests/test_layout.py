"""Imports between packages go in one direction, and the public names are the same for people and for type checkers."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import mevs_jax

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


def test_the_stub_names_what_is_public():
    stub = ast.parse((ROOT / "mevs_jax" / "__init__.pyi").read_text())
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    found = {alias.asname: f"{node.module}" for node in imports for alias in node.names}
    assert found == {name: f"mevs_jax.{module}" for name, module in mevs_jax._HOMES.items()}
    for name in mevs_jax.__all__:
        assert getattr(mevs_jax, name) is not None
