"""Building blocks of the report: HTML tables, embedded figures, formatted numbers."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.numbers.metrics import Metrics, OverTrainings
from eval.report.svg import inline
from eval.tables import ViewTables
from eval.walks.ladder import KNOWS, Knows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE = Path(__file__).with_name("page.css").read_text()
SCRIPT = Path(__file__).with_name("page.js").read_text()
Interval = Sequence[float] | np.ndarray
"""The two ends of an interval."""
MARKS = (
    "<b class='up'>▲ bold</b>: the whole interval is above zero; <b class='down'>▼ bold</b>: the whole interval is below zero; "
    "no mark: it contains zero."
)
"""Explains the marks of `difference`, which do not need colour."""
MANY_CLASSES = 25
"""Beyond so many classes, matrices and pictures of all of them cannot be read: the page has excerpts, and folds tables."""


@dataclass(frozen=True)
class ReportInputs:
    """The results of the earlier stages from which the page is written."""

    statistics: DatasetStatistics
    metrics: Metrics
    tables: ViewTables
    data: Path
    histories: dict[str, list[dict[str, float]]]
    summaries: dict[str, dict[str, Any]]
    preset: str
    settings: dict[str, Any]
    learned: str | None = None
    """section on `mevs study learned`, if it was run"""
    seeds: OverTrainings | None = None
    """metrics over several trainings, if there are any"""
    validation: ViewTables | None = None
    """tables of the validation objects, whose statistics policies know; without them, no single walks are shown"""


def drawn(figure: Figure, kind: str) -> bytes:
    """Returns the content of an SVG or PNG file with the figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **({"metadata": {"Date": None}} if kind == "svg" else {"dpi": 130}))
    return buffer.getvalue()


def embedded(content: bytes, kind: str, caption: str, name: str = "", alt: str = "") -> str:
    """HTML of an embedded image; a name such as "Figure 5" starts the caption and becomes a link target.

    Args:
        content: of the file.
        kind: `svg`, which becomes part of the page, or `png`.
        caption: below the image.
        name: of the figure.
        alt: says what is seen, for those who do not see it; the caption by default.
    """
    anchor = f' id="{name.lower().replace(" ", "-")}"' if name else ""
    label = f"<b>{html.escape(name)}.</b> " if name else ""
    if kind == "svg":
        shown = scrolling(inline(content.decode(), alt or caption), f"Figure: {name or caption}", "figure")
    else:
        shown = f'<img alt="{html.escape(alt or caption)}" src="{data_url(content, kind)}">'
    return f"<figure{anchor}>{shown}<figcaption>{label}{html.escape(caption)}</figcaption></figure>"


def data_url(content: bytes, kind: str = "png") -> str:
    """A file as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def image(figure: Figure, caption: str, alt: str, kind: str = "svg") -> str:
    """HTML of a figure, which is closed.

    Args:
        figure: to be drawn.
        caption: how it is read, below it.
        alt: says what is seen in it, for those who do not see it.
        kind: `svg` or `png`.
    """
    content = drawn(figure, kind)
    import matplotlib.pyplot as plt  # imported late: it takes a quarter of a second

    plt.close(figure)
    return embedded(content, kind, caption, alt=alt)


def picture(pixels: np.ndarray) -> bytes:
    """A grey image (height, width) uint8 as the content of a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "png", optimize=True)
    return buffer.getvalue()


def scrolling(content: str, label: str, what: str) -> str:
    """HTML that scrolls sideways where it is wider than the page, and says so there."""
    return (
        f'<div class="scroll" tabindex="0" role="group" aria-label="{html.escape(label)}">'
        f'<p class="hint" aria-hidden="true">↔ This {what} scrolls sideways.</p>{content}</div>'
    )


def document(title: str, body: str) -> str:
    """A complete HTML page that needs no other file, with links to its sections.

    Args:
        title: HTML, without tags.
        body: HTML, whose sections begin with `<h2>`.
    """
    links: list[str] = []

    def anchored(found: re.Match[str]) -> str:
        name = re.sub(r"[^a-z0-9]+", "-", html.unescape(found.group(1)).lower()).strip("-")
        links.append(f'<li><a href="#{name}">{found.group(1)}</a></li>')
        return f'<h2 id="{name}">{found.group(1)}</h2>'

    content = re.sub(r"<h2>(.*?)</h2>", anchored, body)
    size = len(STYLE) + len(SCRIPT) + len(content.encode())
    contents = f'<nav aria-label="Contents"><ul>{"".join(links)}</ul></nav>' if len(links) > 2 else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{title}</title><link rel="icon" href="data:,"><style>{STYLE}</style></head><body>'
        f'<a class="skip" href="#content">To the content</a><header><h1>{title}</h1>{contents}</header>'
        f'<main id="content">{content}</main><footer><p class="note">This page needs no other file and no network; it has '
        f"{size / 1e6:.1f} MB.</p></footer><script>{SCRIPT}</script></body></html>\n"
    )


def commands(steps: Sequence[tuple[str, str]]) -> str:
    """A list of sentences in plain text, each with the command that it is about."""
    items = (
        f"<li><p>{html.escape(said)}</p><pre><code>{html.escape(command)}</code></pre></li>" for said, command in steps
    )
    return f"<ol>{''.join(items)}</ol>"


def warning(sentence: str | None) -> str:
    """A visible notice at the top of a page, from a sentence in plain text; empty without one."""
    if sentence is None:
        return ""
    return f'<p class="warning" role="alert"><b>Warning:</b> {html.escape(sentence)}.</p>'


def table(header: Sequence[str], rows: Sequence[Sequence[str]], label: str = "") -> str:
    """An HTML table, which scrolls sideways in a narrow window.

    Args:
        header: headings in plain text.
        rows: cells in HTML; the first of a row names it, and a row of one cell spans the table.
        label: what the table is about, for those who do not see it; the first headings by default.
    """
    head = "".join(f'<th scope="col">{html.escape(cell)}</th>' if cell else "<td></td>" for cell in header)
    body = "".join(
        ("</tbody><tbody>" if number and len(row) == 1 else "") + f"<tr>{_cells(row, len(header))}</tr>"
        for number, row in enumerate(rows)
    )
    shown = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    label = label or "; ".join(cell for cell in header if cell)[:90]
    return scrolling(shown, f"Table: {label}", "table")


def _cells(row: Sequence[str], columns: int) -> str:
    if len(row) == 1:
        return f'<th scope="rowgroup" colspan="{columns}"><span class="group">{row[0]}</span></th>'
    return f'<th scope="row">{row[0]}</th>' + "".join(f"<td>{cell}</td>" for cell in row[1:])


def rows_by_knowledge(rows: Sequence[tuple[Knows, Sequence[str]]]) -> list[Sequence[str]]:
    """Table rows, with a heading row before each change in what the policies know."""
    out: list[Sequence[str]] = []
    for knows, group in groupby(rows, key=lambda row: row[0]):
        out.append([f"Uses {html.escape(KNOWS[knows])}"])
        out.extend(row for _, row in group)
    return out


def percent(value: float) -> str:
    return f"{100 * value:.1f}"


def signed(value: float, digits: int = 1) -> str:
    """A share in percentage points with its sign; a value that rounds to zero has none."""
    text = f"{100 * value:+.{digits}f}".replace("-", "−")
    return text[1:] if float(text[1:]) == 0 else text


def span(interval: Interval) -> str:
    return f"{100 * interval[0]:.1f}–{100 * interval[1]:.1f}"


def mark(interval: Interval) -> str:
    """▲ for an interval above zero, ▼ for one below zero, and nothing for one that contains zero."""
    return "▲" if interval[0] > 0 else "▼" if interval[1] < 0 else ""


def with_interval(cell: str, interval: Interval) -> str:
    """A cell of a table with a 95 % interval of shares below it, in percent."""
    return f"{cell}<br><small class='note'>{span(interval)}</small>"


def folded(summary: str, content: str) -> str:
    """HTML that is shown when its summary, in HTML, is clicked."""
    return f"<details><summary>{summary}</summary>{content}</details>"


def difference(value: float, interval: Interval, digits: int = 1) -> str:
    """A difference of shares in percentage points with its interval, marked as `MARKS` explains."""
    low, high = (signed(end, digits) for end in interval)
    text, found = signed(value, digits), mark(interval)
    if found:
        text = f'<b class="{"up" if found == "▲" else "down"}">{found} {text}</b>'
    return f"{text} <small>[{low}, {high}]</small>"
