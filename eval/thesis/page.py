"""The report of the thesis's reproduction: an HTML page, the same in Markdown, and every figure as PNG and SVG."""

from __future__ import annotations

import html
from pathlib import Path

import matplotlib.pyplot as plt

from data_pipeline.files import write_bytes, write_text
from eval.report.html import commands, document, drawn, embedded, table
from eval.thesis.figures import FIGURES
from eval.thesis.layout import FigureInputs, ThesisFigure, ThesisTable
from eval.thesis.tables import all_tables, markdown, shown_cells

CHAPTERS = (
    ("The data (§4.1)", ("F5", "F6", "F7", "F8", "F9", "F10", "F11")),
    ("Computation time (§5.3.1)", ("T1", "T2", "T3")),
    ("Entropy learning (§5.3.2)", ("F17", "T4")),
    ("Classification (§5.3.3)", ("T5", "F18", "F19", "T6", "T7", "T8", "F20")),
    ("Memory (§5.3.4)", ("T9",)),
    ("Appendices", ("F21", "F22", "F23", "F24", "T10", "F25", "T11", "T12", "T13", "T14", "T15")),
)
"""Tables and figures in the order of the thesis."""

_TERMS = (
    "<p><i>The thesis</i> is Learning Optimal View Selection for Multi-View Object Representation. A <dfn>view</dfn> is one "
    "depth image of an object, from one of 10 or 40 directions around it. A classifier, the <dfn>backbone</dfn>, gives one "
    "number for each class and view, the <dfn>logits</dfn>; those of all views seen are added. A <dfn>policy</dfn> chooses "
    "the next view: <dfn>random</dfn>, or <dfn>PointNet++</dfn> (pcd), a network that predicts the depth entropies of all "
    "views from the points of one; the local maxima of its prediction are visited. The <dfn>depth entropy</dfn> of a view "
    "says how varied its depths are. The <dfn>oracle</dfn> is given the true entropies. A walk stops when its confidence "
    "reaches a <dfn>confidence threshold</dfn> (CT), or at a <dfn>limit on views</dfn> (MV). Points are percentage points. A "
    "<dfn>95 % interval</dfn> is computed by drawing the test objects again, with repetition. <b>▲</b> and <b>▼</b>: the "
    "interval of a gain is above, or below, zero.</p>"
)


def _next(over: ThesisTable | None) -> str:
    """The end of the page: commands that continue this run."""
    steps = [
        (
            "Compare all policies of the project on the same data, with a 3-D view of single objects:",
            "mevs run --data DATA --out OTHER",
        ),
        (
            "See what each change of the thesis's published code does to its gain:",
            "mevs study published-code --out OTHER",
        ),
    ]
    if over is None:
        steps.insert(
            0,
            (
                "The intervals are for these networks alone. To know whether the results hold for other trainings:",
                "mevs study thesis --out RUN --seeds 3",
            ),
        )
    return (
        "<h2>What to do next</h2><p><code>RUN</code> stands for the folder of this run, in which <code>report/index.html</code> "
        "is this page. Beside it, <code>thesis.md</code> has the same tables, and <code>figures/</code> has every figure.</p>"
        f"{commands(steps)}"
    )


def _table_html(shown: ThesisTable) -> str:
    rows = []
    for row in shown.rows:
        cells = [html.escape(row.name)]
        for ours, bold, theirs in shown_cells(row, shown):
            text = f"<b class='up'>{_mark(ours)} {html.escape(ours)}</b>" if bold else html.escape(ours)
            cells.append(text + (f' <small class="note">({html.escape(theirs)})</small>' if theirs else ""))
        rows.append(cells)
    return (
        f'<h3 id="table-{shown.number}">{html.escape(shown.heading)}</h3>'
        f"{table(['', *shown.columns], rows, shown.heading)}"
        f'<p class="note">{html.escape(shown.remark)}</p>'
    )


def _mark(gain: str) -> str:
    """The mark of a gain whose interval excludes zero; it does not need bold print or colour."""
    return "▼" if gain.startswith("−") else "▲"


def _save_figure(shown: ThesisFigure, inputs: FigureInputs, folder: Path) -> str:
    """Draws a figure, saves it as PNG and SVG, and returns its HTML."""
    figure, alt = shown.draw(inputs)
    files = {kind: drawn(figure, kind) for kind in ("png", "svg")}
    plt.close(figure)
    for kind, content in files.items():
        write_bytes(folder / f"figure_{shown.number:02d}.{kind}", content)
    return embedded(files["svg"], "svg", shown.caption, f"Figure {shown.number}", alt)


def write_thesis_report(inputs: FigureInputs, lead: str, folder: Path, over: ThesisTable | None = None) -> Path:
    """Writes `index.html`, `thesis.md` and `figures/` into `folder`; returns the path of the page.

    Args:
        inputs: the results from which tables and figures are made.
        lead: a sentence that describes the run.
        folder: the folder of the report.
        over: numbers over several trainings, which come first.
    """
    tables = {f"T{shown.number}": shown for shown in all_tables(inputs.results)}
    pictures = {f"F{shown.number}": shown for shown in FIGURES}
    page, text = [], []
    if over is not None:
        page.append(f"<h2>Several trainings</h2>{_table_html(over)}")
        text.append(f"## Several trainings\n\n{markdown(over)}")
    for chapter, names in CHAPTERS:
        page.append(f"<h2>{html.escape(chapter)}</h2>")
        text.append(f"## {chapter}\n")
        for name in names:
            if name in tables:
                page.append(_table_html(tables[name]))
                text.append(markdown(tables[name]))
            else:
                shown = pictures[name]
                page.append(_save_figure(shown, inputs, folder / "figures"))
                text.append(
                    f"![Figure {shown.number}](figures/figure_{shown.number:02d}.png)\n\n"
                    f"**Figure {shown.number}.** {shown.caption}\n"
                )
    title = "Reproduction of the thesis"
    write_text(folder / "thesis.md", f"# {title}\n\n{lead}\n\n" + "\n".join(text))
    path = folder / "index.html"
    write_text(path, document(title, f'<p class="lead">{html.escape(lead)}</p>{_TERMS}{"".join(page)}{_next(over)}'))
    return path
