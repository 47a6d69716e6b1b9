"""A run from several seeds is the runs of each seed, and means over them."""

from __future__ import annotations

import csv
import json
import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from data_pipeline.errors import DataError
from eval import consistency, seeds, stages
from eval.numbers.metrics import OverTrainings
from eval.run_file import load_run, save_run
from eval.settings import TINY, Settings
from train.results.identity import summary_of
from train.results.records import as_json

SETTINGS = replace(TINY, seeds=2)


def run(settings: Settings, out: Path) -> OverTrainings:
    save_run(out, "tiny", settings, [])
    seeds.train(settings, out, begin=partial(seeds.make_folders, settings, "tiny", out, []))
    return seeds.evaluate(settings, out)


def test_an_address_of_object_storage_is_no_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="--out gs://bucket/run is an address, and a run needs a folder"):
        consistency.check_output(Path("gs://bucket/run"))
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_the_run_of_a_seed_equals_a_run_from_that_seed_alone(whole, tmp_path):
    """The first of two seeds equals `whole`; networks of the second are compared in `tests/train/many/test_seeds.py`."""
    together = tmp_path / "together"
    shutil.copytree(whole / "data", together / "data")
    found = run(SETTINGS, together)
    second = seeds.seed_settings(SETTINGS, 1)
    assert second.classifier.optimiser.seed == second.entropy.optimiser.data_seed == 1
    assert (second.evaluation, second.dataset) == (SETTINGS.evaluation, SETTINGS.dataset)
    metrics = json.loads((whole / "metrics.json").read_text())
    of_seed = json.loads((together / "metrics.json").read_text())
    for name, policy in metrics["policies"].items():
        assert of_seed["policies"][name]["after_views"] == pytest.approx(policy["after_views"], abs=1e-5), name
    of_second = json.loads((together / "seeds" / "1" / "metrics.json").read_text())
    for number, one in enumerate((metrics, of_second)):
        for row in found.rows:
            expected = one["policies"][row.policy]["after_views"][row.views - 1]
            assert row.each[number] == pytest.approx(expected, abs=1e-5)
        assert found.single_view[number] == pytest.approx(one["single_view"]["accuracy"])
    best = [summary_of(out / "entropy")["best_loss"] for out in (together, together / "seeds" / "1")]
    assert best[0] != best[1]
    with (together / "seeds.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(found.rows)

    page = stages.report(SETTINGS, "tiny", together).read_text()
    assert "Over 2 trainings" in page
    kept = load_run(together / "seeds" / "1")
    assert kept is not None
    page = stages.report(kept.settings, "tiny", together / "seeds" / "1").read_text()
    assert "Over 2 trainings" not in page
    before = {path: path.stat().st_mtime_ns for path in together.rglob("*.json")}
    assert as_json(run(SETTINGS, together)) == as_json(found)  # nothing is done again
    assert {path: path.stat().st_mtime_ns for path in together.rglob("*.json")} == before
    more = run(replace(SETTINGS, seeds=3), together)
    assert [row.each[:2].tolist() for row in more.rows] == [row.each.tolist() for row in found.rows]


def test_impossible_numbers_of_seeds_are_refused():
    for count in (0, -1, 10_000):
        with pytest.raises(DataError, match=f"--seeds {count} is not from 1 to 1000"):
            consistency.check_seeds(replace(TINY, seeds=count))


def test_processes_of_one_number_try_a_folder_at_once(tmp_path, monkeypatch):
    """In containers every process is number 1."""
    made = []
    real = os.open
    monkeypatch.setattr(os, "getpid", lambda: 1)
    monkeypatch.setattr(os, "open", lambda path, *rest: made.append(path) or real(path, *rest))
    for _ in range(3):
        consistency.check_output(tmp_path)
    tried = [path for path in made if ".probe." in str(path)]
    assert len(set(tried)) == len(tried) == 3
    assert not list(tmp_path.iterdir())
