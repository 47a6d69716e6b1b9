"""The notebooks have outputs, their links lead somewhere, and their code runs."""

from __future__ import annotations

import ast
import base64
import json
import re
from importlib import import_module
from typing import Any

import pytest

from examples.notebooks.execute import HERE, NOTEBOOKS, run_cell

LARGEST = 300_000


def stored(name: str) -> dict[str, Any]:
    return json.loads((HERE / f"{name}.ipynb").read_text())


def test_every_notebook_is_listed():
    assert {path.stem for path in HERE.glob("*.ipynb")} == {*NOTEBOOKS}


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_has_outputs_and_pictures_and_is_small(name):
    assert (HERE / f"{name}.ipynb").stat().st_size < LARGEST
    outputs = [output for cell in stored(name)["cells"] for output in cell.get("outputs", [])]
    pictures = [output["data"]["image/png"] for output in outputs if output["output_type"] == "display_data"]
    assert len(pictures) >= 2
    assert all(base64.b64decode(picture).startswith(b"\x89PNG") for picture in pictures)
    printed = "".join("".join(output["text"]) for output in outputs if output["output_type"] == "stream")
    assert printed
    assert not re.search(r"\b(nan|inf)\b", printed)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_links_of_a_notebook_lead_somewhere(name):
    texts = ("".join(cell["source"]) for cell in stored(name)["cells"] if cell["cell_type"] == "markdown")
    for target in re.findall(r"\]\(([^)\s]+)\)", "\n".join(texts)):
        assert (HERE / target).resolve().exists(), target


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_what_a_notebook_imports_exists(name):
    """The slow test runs the cells; this one notices a name that is gone."""
    cells = ("".join(cell["source"]) for cell in stored(name)["cells"] if cell["cell_type"] == "code")
    imports = [node for cell in cells for node in ast.walk(ast.parse(cell)) if isinstance(node, ast.ImportFrom)]
    assert imports
    for node in imports:
        for alias in node.names:
            assert hasattr(import_module(str(node.module)), alias.name)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_prints_as_stored(name, fully_compiled):
    """Every cell runs. Words of what it prints are those of the notebook; digits may differ between machines."""
    import matplotlib

    matplotlib.use("Agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(stored(name)["cells"]):
        if cell["cell_type"] == "code":
            outputs = run_cell("".join(cell["source"]), names, f"{name}, cell {number}")
            assert [words(output) for output in outputs] == [words(output) for output in cell["outputs"]]


def words(output: dict[str, Any]) -> list[str]:
    return re.findall(r"[A-Za-z]{3,}", "".join(output["text"])) if output["output_type"] == "stream" else ["picture"]
