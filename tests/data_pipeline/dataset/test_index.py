"""The index answers what records would, without them; data sets of older versions get one."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.dataset import batches, index
from data_pipeline.dataset.batches import ViewBatches, equally_often
from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.index import INDEX, read_index
from data_pipeline.dataset.statistics import SPLITS
from data_pipeline.files import CHECKS, checks_in, keep_checks

COLUMNS = ("name", "label", "entropy", "extent", "radius")


@pytest.fixture
def copied(data, tmp_path) -> Path:
    return Path(shutil.copytree(data, tmp_path / "data"))


def check(folder: Path, records: Path) -> None:
    for split in SPLITS:
        found, expected = read_index(folder, split, *COLUMNS), list(open_split(records, split))
        assert found["name"] == [example["name"].decode() for example in expected]
        for column in COLUMNS[1:]:
            np.testing.assert_array_equal(found[column], [example[column] for example in expected])


def test_the_index_is_what_the_records_hold(data):
    check(data, data)
    expected = [np.count_nonzero(example["depth"], axis=(1, 2)) for example in open_split(data, "val")]
    np.testing.assert_array_equal(read_index(data, "val", "points")["points"], expected)


@pytest.mark.parametrize("case", ["older version", "missing", "flipped"])
def test_an_index_is_made_again_once(case, data, copied, monkeypatch, capsys):
    if case == "older version":
        shutil.rmtree(copied / INDEX)
        checks = {name: found[-1] for name, found in checks_in(copied).items() if not name.startswith(INDEX)}
        keep_checks(copied, checks, only=True)
    for path in (copied / INDEX).glob("*"):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 4
        path.unlink() if case == "missing" else path.write_bytes(bytes(content))
    check(copied, data)
    assert ("made again" in capsys.readouterr().err) == (case != "older version")
    monkeypatch.setattr(index, "open_split", lambda *given: pytest.fail("records are read"))
    check(copied, data)


def test_an_index_that_cannot_be_kept_is_said(copied, monkeypatch, capsys):
    (copied / CHECKS).unlink()
    shutil.rmtree(copied / INDEX)
    (copied / INDEX).write_text("a file lies here")
    check(copied, copied)
    assert "the index of train is not kept" in capsys.readouterr().err


def test_no_record_is_read_to_know_the_labels(data, monkeypatch):
    """Of balanced training and validation by view, which join two splits."""
    records = [example["label"] for split in ("train", "val") for example in open_split(data, split)]
    config = ViewBatches(8, 2, images="depth", validation_by="view", balanced=True)
    monkeypatch.setattr(
        "data_pipeline.dataset.proof.Objects.__getitem__", lambda *given: pytest.fail("a record is read")
    )
    kept = batches._TrainingObjects(data, config)._kept
    np.testing.assert_array_equal(kept, equally_often(np.arange(len(records)), np.array(records)))
