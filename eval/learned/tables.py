"""Tables that several parts of the page of learned view selection share."""

from __future__ import annotations

import html
from typing import Any

from eval.learned.comparison import BASELINES
from eval.report.html import MARKS, difference, percent, rows_by_knowledge, signed, span, table

METHOD = "learned"
"""The policy that the page is about."""
_SHOWN = (0, 1, 2, 3, 5, 7)
"""Steps of a walk that the tables show; 0 is the first view."""


def accuracy(share: float, interval: list[float]) -> str:
    """A cell with an accuracy in percent and its interval."""
    return f"{percent(share)}<br><small class='note'>{span(interval)}</small>"


def _closed(found: dict[str, Any], name: str) -> list[str]:
    """Shares of the gap that a policy closes, in percent, with their intervals where they have one."""
    cells = []
    shares = found["gap_closed"].get(name, ())
    intervals = found.get("gap_closed_interval", {}).get(name) or [None] * len(shares)
    for share, interval in zip(shares, intervals, strict=True):
        cell = "–" if share is None else signed(share, 0).lstrip("+")
        if share is not None and interval is not None:
            cell += f" <small class='note'>[{', '.join(signed(end, 0).lstrip('+') for end in interval)}]</small>"
        cells.append(cell)
    return [f"<span class='whole'>{cell}{' /' * (number < len(cells))}</span>" for number, cell in enumerate(cells, 1)]


def ladder(found: dict[str, Any]) -> str:
    """The accuracy of all policies by number of views, and the share of the gap that each closes."""
    rows, with_gap = [], bool(found["gap_closed"])
    steps = [step for step in _SHOWN if step < len(found["policies"]["random"]["after_views"])]
    for name, policy in found["policies"].items():
        cells = [accuracy(*cell) for cell in zip(policy["after_views"], policy["interval"], strict=True)]
        closed = _closed(found, name)
        row = [
            html.escape(policy["title"]),
            *(cells[step] if step < len(cells) else "" for step in steps),
            *[" ".join(closed)] * with_gap,
        ]
        rows.append((policy["knows"], row))
    header = ["next view chosen by", *(str(step + 1) for step in steps), *["gap closed (%)"] * with_gap]
    note = "Accuracy (%) after exactly the given number of views, with 95 % intervals over objects."
    if with_gap:
        note += (
            " Gap closed: gain over random, in percent of the gain of the label-free oracle, after 2 / 3 / 4 views. The oracles "
            f"try every view and walk from {found['trying_starts']} of the {found['views']} start views; the gap is computed on "
            "these. The label oracle also finds views that are right by chance."
        )
    return table(header, rows_by_knowledge(rows)) + f"<p class='note'>{note}</p>"


def against(found: dict[str, Any], bases: tuple[str, ...] = BASELINES) -> str:
    """Paired differences in accuracy and in the log-probability of the true class."""
    rows, steps = [], (1, 2, 3)
    for base in bases:
        if base not in found["policies"]:
            continue
        rows.append([f"Difference from “{html.escape(found['policies'][base]['title'])}”"])
        for name, policy in found["policies"].items():
            if name not in found["against"][base] or policy["knows"] in ("nothing", "truth"):
                continue
            gain = found["against"][base][name]
            rows.append([html.escape(policy["title"])])
            for of in (gain, gain["likelihood"]):
                known = zip(of["difference"], of["interval"], strict=True)
                cells = [difference(*cell) for cell in known][1 : len(steps) + 1]
                rows[-1] += cells + [""] * (len(steps) - len(cells))
    header = [f"{step + 1} views{unit}" for unit in ("", ", nat/100") for step in steps]
    return table(["next view chosen by", *header], rows) + (
        "<p class='note'>Left: differences in accuracy, in percentage points. Right: differences in the log-probability of "
        "the true class, in hundredths of a nat; they resolve smaller differences. With 95 % intervals over objects. "
        f"{MARKS}</p>"
    )


def gain_of_two(gains: dict[str, Any], method: str = METHOD) -> str:
    """The gain of a policy after two views, of its gains over another one."""
    gain = gains[method]
    return difference(gain["difference"][1], gain["interval"][1])
