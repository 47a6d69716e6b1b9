"""What a table of the thesis is, rows of our cells beside its own, and what a figure is; its numbers as printed."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.thesis.results import LatticeTables, ThesisResults
from mevs_jax.geometry.viewpoints import ViewGraph
from train.many.thesis import ThesisFolder

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


@dataclass(frozen=True)
class FigureInputs:
    """The data that the figures show.

    Attributes:
        folder: folder of the run.
        results: all numbers.
        statistics, tables: by number of views; the tables are of the test objects.
        histories: training history of each network, by the name of its folder.
        example: index of the test object that is shown as an example.
    """

    folder: ThesisFolder
    results: ThesisResults
    statistics: dict[int, DatasetStatistics]
    tables: dict[int, LatticeTables]
    histories: dict[str, list[dict[str, float]]]
    example: int

    def graph(self, views: int) -> ViewGraph:
        return self.statistics[views].graph

    @property
    def entropies(self) -> np.ndarray:
        """(40,) true entropies of the views of the example."""
        return self.tables[40].entropy[self.example]

    @property
    def example_name(self) -> str:
        return self.tables[40].names[self.example]


Drawn = tuple[Figure, str]
"""A figure, and what it shows in words, for those who do not see it."""


@dataclass(frozen=True)
class ThesisFigure:
    """A figure of the thesis: its number, its caption, and the function that draws it."""

    number: int
    caption: str
    draw: Callable[[FigureInputs], Drawn]


def extremes(values: Sequence[float] | np.ndarray, names: Sequence[str], form: str = "{:.0f}") -> str:
    """The lowest and the highest value in words, with their names."""
    low, high = int(np.argmin(values)), int(np.argmax(values))
    return f"from {form.format(values[low])} ({names[low]}) to {form.format(values[high])} ({names[high]})"
