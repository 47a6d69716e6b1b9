"""Results of benchmarks: printed row by row while they are measured, kept as JSON and as a page of Markdown."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import jax

from data_pipeline.files import write_json, write_text
from mevs_jax.markdown import markdown_row, markdown_table

RESULTS = Path(__file__).parent / "results"
Row = dict[str, Any]
"""One measurement, as it is kept in JSON."""


@dataclass(frozen=True)
class Table:
    """How rows are shown.

    Attributes:
        header: the headings, with ` | ` between them.
        form: as `header`, a format of a row's values for each column, such as `{views:,}`.
    """

    header: str
    form: str

    def cells(self, row: Row) -> list[str]:
        return [form.format_map(row) for form in self.form.split(" | ")]

    def markdown(self, rows: Iterable[Row] = ()) -> str:
        return markdown_table(self.header.split(" | "), [self.cells(row) for row in rows])

    def show(self, rows: Iterable[Row]) -> list[Row]:
        """Prints each row once it is measured, and returns all."""
        print(f"\n{self.markdown()}")
        measured = []
        for row in rows:
            measured.append(row)
            print(markdown_row(self.cells(row)), flush=True)
        return measured


def machine_name() -> str:
    return f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, JAX {jax.__version__}"


def refuse(reason: str) -> NoReturn:
    """Ends the program as `mevs` does when it was asked for what it cannot do."""
    print(reason, file=sys.stderr)
    sys.exit(2)


def keep(path: Path, results: dict[str, Any], *parts: str) -> None:
    """Writes results as JSON to `path`, and beside it, if there are any, the parts of a page. Both begin with the machine."""
    machine = machine_name()
    write_json(path, {"machine": machine, **results})
    if parts:
        write_text(path.with_suffix(".md"), "\n\n".join([f"{machine}. {parts[0]}".strip(), *parts[1:]]) + "\n")
