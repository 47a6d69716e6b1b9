"""What the tests of the thesis's tables and of its page share: results of networks that are made up."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="package")
def lattices():
    from tests.reference.made_up_thesis import made_up_lattice
    from train.many.thesis import VIEWS

    return {views: made_up_lattice(views, views) for views in VIEWS}


@pytest.fixture(scope="package")
def statistics(lattices):
    from tests.reference.made_up_thesis import made_up_statistics

    return made_up_statistics(lattices)


@pytest.fixture(scope="package")
def results(lattices, statistics):
    from tests.reference.made_up_thesis import made_up_results

    return made_up_results(lattices, statistics)


@pytest.fixture
def inputs(lattices, statistics, results, tmp_path):
    """What the figures show."""
    from eval.thesis.layout import FigureInputs
    from train.many.thesis import BACKBONES, FRAMES, VIEWS, ThesisFolder

    history = [{"epoch": e, "train/loss": 1 / e, "val/loss": 1.2 / e} for e in (1, 2, 3)]
    names = [backbone.name for backbone in BACKBONES] + [f"entropy_{v}_{frame}" for v in VIEWS for frame in FRAMES]
    return FigureInputs(ThesisFolder(tmp_path), results, statistics, lattices, dict.fromkeys(names, history), 0)
