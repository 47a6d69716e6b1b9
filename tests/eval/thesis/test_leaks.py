"""What the study of the thesis chooses on validation objects does not depend on the test objects."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import eval.numbers.study as study
import eval.thesis.run as thesis_run
from eval.machine import machine
from eval.settings import TINY
from eval.thesis.results import LatticeTables, ThesisResults, entropy_learning
from eval.thesis.tables import best_table
from eval.thesis.timing import AscentTimes, LatticeTimes, MaximaTimes, Measured, Timing
from eval.walks.grid import GridConfig
from tests.reference.evaluation import CLASSES, OBJECTS, VIEWS, some_statistics, some_tables
from tests.reference.leaks import (
    CHANGES,
    check_fitted,
    check_tested,
    differing,
    other_labels,
    other_statistics,
    walk_grid_anyhow,
    without_bootstrap,
)
from train.many.thesis import FRAMES, PIPELINE, ThesisFolder
from train.many.thesis import VIEWS as LATTICES
from train.tasks.entropy import EntropyTask

SETTINGS = replace(TINY, evaluation=GridConfig(max_views=5, draws=1))
STATISTICS = replace(some_statistics(some_tables()), capture={"resolution": 32, "views": VIEWS})
"""Of both lattices, which have as many views here."""
_TIMES = LatticeTimes({}, MaximaTimes(1.0, 1.0))
MEASURED = Measured(machine(), Timing(1, _TIMES, _TIMES), {}, AscentTimes(1, 2, 8, "not here"))


def drawn(*names: Any) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(" ".join(map(str, names)).encode()))


def results_with(change: str | None, out: Path) -> ThesisResults:
    """The results of the study, with networks whose outputs are made up."""

    def labels_of(split: str) -> np.ndarray:
        return drawn(split).integers(0, CLASSES, OBJECTS).astype(np.int32)

    def objects_of(data, split, statistics):
        labels, entropy = labels_of(split), drawn(data.parent.name, split).uniform(0.1, 0.9, (OBJECTS, VIEWS))
        if split == "test" and change == "labels":
            labels = other_labels(labels, CLASSES)
        if split == "test" and change == "outputs":
            entropy = 1 - entropy
        return [f"o{number}" for number in range(OBJECTS)], labels, entropy.astype(np.float32)

    def network_outputs(data, split, task, network):
        random = drawn(data.parent.name, split, task.name, change if split == "test" and change == "outputs" else "")
        if isinstance(task, EntropyTask):
            return random.uniform(0, 1, (OBJECTS, VIEWS, VIEWS)).astype(np.float32)
        logits = random.normal(0, 1.2, (OBJECTS, VIEWS, CLASSES))
        return (logits + np.eye(CLASSES)[labels_of(split)][:, None]).astype(np.float32)

    statistics = other_statistics(STATISTICS) if change else STATISTICS
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ThesisFolder, "statistics", lambda self, views: statistics)
        without_bootstrap(patch)
        patch.setattr(study, "run_grid", walk_grid_anyhow)
        patch.setattr(thesis_run, "objects_of", objects_of)
        patch.setattr(thesis_run, "network_outputs", network_outputs)
        patch.setattr(thesis_run, "load_best", lambda task, folder: None)
        patch.setattr(thesis_run, "made_by", lambda statistics, *networks: str(networks))
        patch.setattr(thesis_run, "read_history", lambda folder: [{"epoch": 1}])
        patch.setattr(thesis_run, "measure", lambda settings, folder, tables: MEASURED)
        patch.setattr(thesis_run, "_training", lambda folder, histories: ({}, {}))
        return thesis_run.evaluate_thesis(SETTINGS, ThesisFolder(out)).results


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> dict[str | None, ThesisResults]:
    return {change: results_with(change, tmp_path_factory.mktemp("thesis")) for change in (None, *CHANGES)}


def cells(results: ThesisResults, chosen_on: str) -> dict[str, Any]:
    """The cells of Table 8 that were chosen, by lattice and classifier."""
    return {
        f"{views} {backbone.name}": [
            getattr(results.pipeline[views].best[backbone.name][chosen_on], name) for name in ("max_views", "threshold")
        ]
        for views in LATTICES
        for backbone in PIPELINE
    }


@pytest.mark.parametrize("change", CHANGES)
def test_cells_chosen_on_validation_objects_are_the_same(change, results):
    one, other = results[None], results[change]
    check_fitted(cells(one, "validation"), cells(other, "validation"))
    # Their accuracies on test objects are others, and so are the cells that are chosen on these, as in the thesis.
    accuracies = [
        {name: best["validation"].accuracy for name, best in found.pipeline[40].best.items()} for found in (one, other)
    ]
    check_tested(*accuracies)
    assert differing(cells(one, "test"), cells(other, "test"))


@pytest.mark.parametrize("change", CHANGES)
def test_table_8_shows_the_cells_chosen_on_validation_objects(change, results):
    table = best_table(results[change])
    chosen = cells(results[None], "validation")
    shown = [str(row.ours[table.columns.index("cell", 3)]) for row in table.rows]
    expected = [chosen[f"{views} {backbone.name}"] for backbone in PIPELINE for views in LATTICES]
    assert shown == [f"MV {max_views}, CT {threshold:g}" for max_views, threshold in expected]
    assert [float(row.ours[3]) for row in table.rows] == pytest.approx(
        [
            100 * results[change].pipeline[views].best[backbone.name]["validation"].accuracy
            for backbone in PIPELINE
            for views in LATTICES
        ]
    )


def test_maps_that_receive_no_view_are_of_training_objects():
    """Mean entropies of the training objects, which are not those of the test objects."""
    tables = some_tables()
    random = np.random.default_rng(5)
    statistics = replace(
        STATISTICS,
        mean_map=random.random(VIEWS).tolist(),
        class_mean_maps=random.random((CLASSES, VIEWS)).tolist(),
    )
    predicted = {frame: tables.predicted_entropy for frame in FRAMES}
    found = entropy_learning(LatticeTables(tables.names, tables.labels, tables.entropy, {}, predicted), statistics)
    assert found.mean_map["all"][0] == pytest.approx(np.square(statistics.mean_map - tables.entropy).mean())
    of_classes = np.array(statistics.class_mean_maps)[tables.labels]
    assert found.class_mean_map["all"][0] == pytest.approx(np.square(of_classes - tables.entropy).mean())
