"""Building blocks of the report: HTML tables, embedded figures, formatted numbers."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.tables import ViewTables
from eval.walks.ladder import KNOWS, Knows

STYLE = """
body{font:15px/1.55 system-ui,sans-serif;color:#111827;max-width:60rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.7rem;margin-bottom:.2rem}h2{margin-top:2.4rem;
border-bottom:1px solid #e5e7eb;padding-bottom:.2rem}
table{border-collapse:collapse;margin:1rem 0;font-variant-numeric:tabular-nums}th,td{padding:.25rem .6rem;text-align:right}
th{border-bottom:2px solid #d1d5db;font-weight:600}td{border-bottom:1px solid #f3f4f6}
th:first-child,td:first-child{text-align:left}td[colspan]{padding-top:.9rem}
.lead{font-size:1.1rem}.note{color:#6b7280;font-size:.9rem}.faint{color:#9ca3af}
.warning{border-left:4px solid #d97706;background:#fffbeb;padding:.6rem .9rem}
.figures{display:flex;flex-wrap:wrap;gap:1rem}.figures figure{flex:1 1 45%;margin:0}small{white-space:nowrap}
figure{margin:1rem 0}figcaption{color:#6b7280;font-size:.85rem}img{max-width:100%;height:auto}
code{background:#f3f4f6;padding:.1rem .3rem}
details{margin:1rem 0}summary{cursor:pointer}.wide{overflow-x:auto}.wide td,.wide th{white-space:nowrap}
"""


@dataclass(frozen=True)
class ReportInputs:
    """The results of the earlier stages from which the page is written."""

    statistics: DatasetStatistics
    metrics: dict[str, Any]
    tables: ViewTables
    data: Path
    histories: dict[str, list[dict[str, float]]]
    summaries: dict[str, dict[str, Any]]
    preset: str
    settings: dict[str, Any]
    learned: dict[str, Any] | None = None
    """metrics of `mevs study learned`, if it was run"""
    seeds: dict[str, Any] | None = None
    """metrics over several trainings, if there are any"""


def drawn(figure: Figure, kind: str) -> bytes:
    """Returns the content of an SVG or PNG file with the figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **({"metadata": {"Date": None}} if kind == "svg" else {"dpi": 130}))
    return buffer.getvalue()


def embedded(content: bytes, kind: str, caption: str, name: str = "") -> str:
    """HTML of an embedded image; a name such as "Figure 5" starts the caption and becomes a link target."""
    mime = "svg+xml" if kind == "svg" else kind
    anchor = f' id="{name.lower().replace(" ", "-")}"' if name else ""
    label = f"<b>{html.escape(name)}.</b> " if name else ""
    return (
        f'<figure{anchor}><img alt="{html.escape(caption)}" src="data:image/{mime};base64,{base64.b64encode(content).decode()}">'
        f"<figcaption>{label}{html.escape(caption)}</figcaption></figure>"
    )


def image(figure: Figure, caption: str, kind: str = "svg") -> str:
    content = drawn(figure, kind)
    plt.close(figure)
    return embedded(content, kind, caption)


def document(title: str, body: str) -> str:
    """A complete HTML page that needs no other file."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{title}</title><style>{STYLE}</style><h1>{title}</h1>{body}</html>\n"
    )


def warning(sentence: str | None) -> str:
    """A visible notice at the top of a page, from a sentence in plain text; empty without one."""
    if sentence is None:
        return ""
    return f'<p class="warning" role="alert"><b>Warning:</b> {html.escape(sentence)}.</p>'


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table. Cells are HTML, headings are plain text; a row of one cell spans the table."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>"
        + "".join(f"<td colspan={len(header)}>{cell}</td>" if len(row) == 1 else f"<td>{cell}</td>" for cell in row)
        + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def rows_by_knowledge(rows: Sequence[tuple[Knows, Sequence[str]]]) -> list[Sequence[str]]:
    """Table rows, with a heading row before each change in what the policies know."""
    out: list[Sequence[str]] = []
    for knows, group in groupby(rows, key=lambda row: row[0]):
        out.append([f'<b class="note">Uses {html.escape(KNOWS[knows])}</b>'])
        out.extend(row for _, row in group)
    return out


def percent(value: float) -> str:
    return f"{100 * value:.1f}"


def signed(value: float, digits: int = 1) -> str:
    """A share in percentage points with its sign; a value that rounds to zero has none."""
    text = f"{100 * value:+.{digits}f}".replace("-", "−")
    return text[1:] if float(text[1:]) == 0 else text


def span(interval: Sequence[float]) -> str:
    return f"{100 * interval[0]:.1f}–{100 * interval[1]:.1f}"


def difference(value: float, interval: Sequence[float], digits: int = 1) -> str:
    """A difference of shares in percentage points with its interval, grey if the interval contains zero."""
    low, high = (signed(end, digits) for end in interval)
    text = f"{signed(value, digits)} <small>[{low}, {high}]</small>"
    return f'<span class="faint">{text}</span>' if interval[0] <= 0 <= interval[1] else text
