"""What a table of the thesis is: rows of our cells beside its own, and its numbers as printed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

Cell = str | float | None


@dataclass(frozen=True)
class Row:
    """One row: our cells and those of the thesis, None if missing. `bold` marks our cells whose interval excludes zero."""

    name: str
    ours: Sequence[Cell]
    thesis: Sequence[Cell] = ()
    bold: Sequence[bool] = ()


@dataclass(frozen=True)
class ThesisTable:
    """A table of the report; numbers have `digits` decimals, and a sign if `signed`. Number 0: not one of the thesis."""

    number: int
    title: str
    columns: Sequence[str]
    rows: Sequence[Row]
    note: str
    digits: int = 2
    signed: bool = False

    @property
    def heading(self) -> str:
        return f"Table {self.number}. {self.title}" if self.number else self.title

    @property
    def remark(self) -> str:
        return f"{self.note} In parentheses: the thesis." if self.number else self.note


@cache
def thesis_numbers() -> dict[str, Any]:
    """The tables as printed in the thesis; see `numbers.json`."""
    return json.loads(Path(__file__).with_name("numbers.json").read_text())
