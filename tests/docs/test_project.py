"""The version is in one place, and the changelog is dated."""

from __future__ import annotations

import re
from pathlib import Path

import mevs_jax

ROOT = Path(__file__).resolve().parents[2]


def test_the_changelog_is_dated_and_ends_with_this_version():
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)", heading) for heading in headings)
    assert headings[0].split()[0] == re.sub(r"\.dev\d+$", "", mevs_jax.__version__)
    assert headings == sorted(headings, reverse=True)


def test_the_version_is_in_one_place():
    assert 'dynamic = ["version"]' in (ROOT / "pyproject.toml").read_text()
    assert not re.search(r"^version:", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
