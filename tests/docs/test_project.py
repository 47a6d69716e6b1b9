"""The version is set in one place, and what else names it agrees; the reference lists every public name."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest
import yaml

import mevs_jax

ROOT = Path(__file__).resolve().parents[2]
RELEASED = re.sub(r"\.dev\d+$", "", mevs_jax.__version__)
"""The version without `.dev0`, which it has between two releases."""


def test_the_changelog_is_dated_and_begins_with_this_version():
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)", heading) for heading in headings)
    assert headings[0].split()[0] == RELEASED
    assert headings == sorted(headings, reverse=True)


def test_the_package_takes_its_version_from_the_code():
    assert 'dynamic = ["version"]' in (ROOT / "pyproject.toml").read_text()
    command = [sys.executable, "-m", "mevs_jax", "--version"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == mevs_jax.__version__


def test_the_citation_names_this_version_and_its_date():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert f"## {cited['version']} ({cited['date-released']})" in (ROOT / "CHANGELOG.md").read_text()
    assert cited["version"] == RELEASED


@pytest.mark.parametrize("file", ["mevs_interfaces/package.xml", "mevs_ros/package.xml", "mevs_ros/setup.py"])
def test_the_packages_for_ros_have_this_version(file):
    text = (ROOT / "examples" / "ros2" / file).read_text()
    named = re.search(r'(?:<version>|^ *version=")([\d.]+)', text, re.MULTILINE)
    assert named is not None
    assert named[1] == RELEASED


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 110


def test_the_reference_lists_every_public_name_once():
    pages = "\n".join(page.read_text() for page in (ROOT / "docs").glob("reference*.md"))
    listed = re.findall(r"^::: (\S+)$", pages, re.MULTILINE)
    assert [path for path, times in Counter(listed).items() if times > 1] == []
    named = [path.rsplit(".", 1)[-1] for path in listed]
    assert set(mevs_jax.__all__) - set(named) == set()


def test_names_of_the_reference_exist():
    for page in (ROOT / "docs").glob("reference*.md"):
        for path in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE):
            module, _, name = path.rpartition(".")
            if module.rpartition(".")[0] != "mevs_jax.environment" or module.endswith("pure"):  # others need extras
                assert hasattr(import_module(module), name), path
