"""The page of the thesis's reproduction: figures in words, marks, and how it opens."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import eval.thesis.page as thesis_page
from eval.thesis.alts import ALTS
from eval.thesis.figures import FIGURES
from eval.thesis.page import _table_html
from eval.thesis.tables import all_tables
from tests.reference.browser import WAYS


def test_every_figure_is_told_in_words(inputs):
    said = {shown.number: ALTS[shown.number](inputs) for shown in FIGURES}
    assert said.keys() == ALTS.keys()
    assert all(text.endswith(".") and len(text) > 50 for text in said.values())
    assert len(set(said.values())) == len(said)
    accuracies = 100 * np.mean(inputs.results["pipeline"]["10"]["policies"]["random"]["accuracy"], axis=0)
    assert f"Random: {accuracies.min():.1f} to {accuracies.max():.1f} %" in said["20"]
    entropies = inputs.tables[40].entropy[0]
    assert f"to {entropies.max():.2f} (view {entropies.argmax()})" in said["7"]
    assert "training loss from 1.0000 to 0.3333" in said["17"]


def test_gains_are_marked_without_bold_print_or_colour(results):
    """Where the interval excludes zero, and nowhere else."""
    table = next(shown for shown in all_tables(results) if shown.number == 7)
    page = _table_html(table)
    gain = results["pipeline"]["10"]["gain"]["text"]
    for mark, ends in (("▲", [low > 0 for row in gain["interval"] for low, _ in row]),
                       ("▼", [high < 0 for row in gain["interval"] for _, high in row])):  # fmt: skip
        assert page.count(f"<b>{mark} ") == sum(ends)
    for mark, text in re.findall(r"<b>(.) (.)", page):
        assert (mark, text) in {("▲", "+"), ("▼", "−")}


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), WAYS)
def test_the_page_is_sound(inputs, opened, tmp_path, monkeypatch, width, scheme):
    """As a person opens it. The captures are those of another figure."""
    example = next(shown for shown in FIGURES if shown.number == "21")
    drawn = tuple(replace(shown, draw=example.draw) if shown.number == "22" else shown for shown in FIGURES)
    monkeypatch.setattr(thesis_page, "FIGURES", drawn)
    page = thesis_page.write_thesis_report(inputs, "A run that is made up.", tmp_path / "report")
    opened(page, width, scheme).is_sound()
