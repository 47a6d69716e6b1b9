"""Markdown tables, for results that are kept as text."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], rule: str = "---") -> str:
    """Returns the lines of a table, without a newline at the end; `rule` fills the cells of the line below the header."""
    heading = markdown_row(header).replace("|  |", "| |")
    return "\n".join([heading, "|" + f"{rule}|" * len(header), *map(markdown_row, rows)])
