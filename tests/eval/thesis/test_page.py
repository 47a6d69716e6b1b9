"""The page of the thesis's reproduction, as a person opens it."""

from __future__ import annotations

from dataclasses import replace

import pytest

import eval.thesis.page as thesis_page
from eval.thesis.figures import FIGURES
from tests.reference.browser import WAYS


@pytest.mark.slow
def test_the_page_is_sound(inputs, opened, tmp_path, monkeypatch):
    """The captures are those of another figure."""
    example = next(shown for shown in FIGURES if shown.number == 21)
    drawn = tuple(replace(shown, draw=example.draw) if shown.number == 22 else shown for shown in FIGURES)
    monkeypatch.setattr(thesis_page, "FIGURES", drawn)
    page = thesis_page.write_thesis_report(inputs, "A run that is made up.", tmp_path / "report")
    shown = opened(page, 1200)
    for width, scheme in WAYS:
        shown.see(width, scheme)
        shown.is_sound()
