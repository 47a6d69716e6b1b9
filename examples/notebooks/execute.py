"""Runs the notebooks beside this file, and writes them with their outputs.

    python -m examples.notebooks.execute [NAME ...]

What a cell prints and the figures that it leaves open are its outputs. The site shows the notebooks (`docs/site.py`).
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
NOTEBOOKS = ("look_at_one_object", "write_a_policy", "enrol_five_objects", "thesis_main_table")
DOTS_PER_INCH = 96


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


def execute(name: str) -> None:
    """Runs a notebook, and writes it with its outputs."""
    import matplotlib

    matplotlib.use("Agg")
    path, names = HERE / f"{name}.ipynb", {"__name__": "__main__"}
    notebook = json.loads(path.read_text())
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            cell["outputs"] = run_cell("".join(cell["source"]), names, f"{path.name}, cell {number}")
    path.write_text(json.dumps(notebook, ensure_ascii=False, indent=1) + "\n")
    print(path.name)


if __name__ == "__main__":
    if unknown := [name for name in sys.argv[1:] if name not in NOTEBOOKS]:
        print(f"no notebook {unknown[0]}; there are {', '.join(NOTEBOOKS)}", file=sys.stderr)
        sys.exit(2)
    for name in sys.argv[1:] or NOTEBOOKS:
        execute(name)
