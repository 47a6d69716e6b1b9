"""Runs the scripts beside this file and writes them as notebooks with their outputs.

    python -m examples.notebooks.execute [NAME ...]

A script is in percent format: a line `# %% [markdown]` begins text, which is commented out, and `# %%` begins code. What a
cell prints and the figures that it leaves open are its outputs. The site shows the notebooks (`docs/site.py`).
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
SCRIPTS = ("look_at_one_object", "write_a_policy", "thesis_main_table")
DOTS_PER_INCH = 96

Cell = tuple[str, str]
"""Kind (`markdown` or `code`) and source."""


def cells_of(script: str) -> list[Cell]:
    """Divides a script in percent format into cells."""
    cells = []
    for part in re.split(r"^# %%", script, flags=re.MULTILINE)[1:]:
        mark, _, body = part.partition("\n")
        if mark.strip() == "[markdown]":
            lines = [line.removeprefix("#").removeprefix(" ") for line in body.strip().splitlines()]
            cells.append(("markdown", "\n".join(lines)))
        else:
            cells.append(("code", body.strip()))
    return cells


def run_cell(source: str, names: dict[str, Any], title: str) -> list[dict[str, Any]]:
    """Runs a cell of code; returns its outputs in the form of a notebook."""
    import matplotlib.pyplot as plt

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(source, title, "exec"), names)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        outputs.append(
            {"name": "stdout", "output_type": "stream", "text": printed.getvalue().splitlines(keepends=True)}
        )
    for number in plt.get_fignums():
        content = io.BytesIO()
        plt.figure(number).savefig(content, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})
        image = base64.b64encode(content.getvalue()).decode()
        outputs.append({"data": {"image/png": image}, "metadata": {}, "output_type": "display_data"})
        plt.close(number)
    return outputs


def notebook_of(name: str) -> dict[str, Any]:
    """Runs a script; returns it as a notebook."""
    import matplotlib

    matplotlib.use("Agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    cells: list[dict[str, Any]] = []
    count = 0
    for number, (kind, source) in enumerate(cells_of((HERE / f"{name}.py").read_text())):
        cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
        cell["source"] = source.splitlines(keepends=True)
        if kind == "code":
            count += 1
            cell |= {"execution_count": count, "outputs": run_cell(source, names, f"{name}.py, cell {number}")}
        cells.append(cell)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    about = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": about, "nbformat": 4, "nbformat_minor": 5}


def main() -> None:
    for name in sys.argv[1:] or SCRIPTS:
        notebook = notebook_of(name)
        (HERE / f"{name}.ipynb").write_text(json.dumps(notebook, ensure_ascii=False, indent=1) + "\n")
        print(f"{name}.ipynb")


if __name__ == "__main__":
    main()
