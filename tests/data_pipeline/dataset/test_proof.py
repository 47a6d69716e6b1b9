"""A damaged data set is made again where its source is, and named where it is only read."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.capture import workers
from data_pipeline.dataset import builder, proof
from data_pipeline.dataset.builder import open_split, prepare
from data_pipeline.dataset.proof import damage_of_shards
from data_pipeline.dataset.statistics import SUMMARY
from data_pipeline.errors import DataError
from data_pipeline.files import CHECKS, read_json
from eval.settings import TINY


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "data"
    prepare(CONFIG, folder)
    return folder


CONFIG = replace(
    TINY.dataset,
    train_per_class=2,
    test_per_class=1,
    capture=replace(TINY.dataset.capture, views=4, resolution=16),
)


@pytest.fixture
def damaged(small, tmp_path) -> Path:
    return Path(shutil.copytree(small, tmp_path / "data"))


def shard(folder: Path, split: str) -> Path:
    return next((folder / "shards").glob(f"*/*/*-{split}.array_record*"))


def flip(path: Path) -> None:
    """Flips a bit of what is not padding."""
    content = bytearray(path.read_bytes())
    used = np.flatnonzero(np.frombuffer(bytes(content), np.uint8))
    content[used[len(used) // 2]] ^= 4
    path.write_bytes(bytes(content))


CASES = {
    "folder": lambda data: shutil.rmtree(data / "shards"),
    "missing": lambda data: shard(data, "train").unlink(),
    "empty": lambda data: shard(data, "val").write_bytes(b""),
    "half": lambda data: shard(data, "test").write_bytes(shard(data, "test").read_bytes()[:40000]),
    "flipped": lambda data: flip(shard(data, "test")),
    "foreign": lambda data: shard(data, "test").write_bytes(b"{}" * 70000),
    "features": lambda data: next(data.glob("shards/*/*/features.json")).write_text(""),
    "info": lambda data: flip(next(data.glob("shards/*/*/dataset_info.json"))),
    "statistics flipped": lambda data: flip(data / SUMMARY),
    "settings": lambda data: (data / "config.json").write_text(""),
    "settings missing": lambda data: (data / "config.json").unlink(),
}


@pytest.mark.parametrize("case", ["folder", "flipped", "info", "statistics flipped", "settings", "settings missing"])
def test_what_is_damaged_is_made_again(case, small, damaged, capsys):
    CASES[case](damaged)
    assert prepare(CONFIG, damaged).content() == read_json(small / SUMMARY)
    assert "again" in capsys.readouterr().err
    for path in small.rglob("*"):
        if path.is_file() and path.name not in (CHECKS, "dataset_info.json"):
            assert (damaged / path.relative_to(small)).read_bytes() == path.read_bytes(), path
    prepare(CONFIG, damaged)
    assert "again" not in capsys.readouterr().err


def test_a_sound_data_set_is_left_alone(damaged, monkeypatch):
    def not_again(*args, **kwargs):
        raise AssertionError

    monkeypatch.setattr(builder, "open_objects", not_again)
    prepare(CONFIG, damaged)
    (damaged / CHECKS).unlink()  # made by an older version
    prepare(CONFIG, damaged)
    monkeypatch.setattr(proof, "_LARGE", 0)
    assert damage_of_shards(damaged) is None


@pytest.mark.parametrize("case", ["folder", "missing", "empty", "half", "flipped", "foreign", "features"])
def test_damaged_shards_are_named_where_they_are_read(case, damaged):
    CASES[case](damaged)
    assert str(damaged / "shards") in (damage_of_shards(damaged) or "")
    for checked in (True, False):
        if not checked:
            (damaged / CHECKS).unlink()
        with pytest.raises(DataError, match=f"mevs data --out {damaged.parent}"):
            _ = [list(open_split(damaged, split)) for split in ("train", "val", "test")]


def test_a_data_set_whose_source_is_gone_or_changed_is_named(damaged, tmp_path, monkeypatch):
    shard(damaged, "train").unlink()

    def gone(config):
        raise DataError("there is no such folder")

    monkeypatch.setattr(builder, "open_objects", gone)
    with pytest.raises(DataError, match="missing, and the data set cannot be made again: there is no such folder"):
        prepare(CONFIG, damaged)
    monkeypatch.undo()
    (damaged / proof.SOURCE_STATE).write_text('{"a": "1"}')
    monkeypatch.setattr(builder, "state_of", lambda config: {"a": "2"})
    with pytest.raises(DataError, match=r"has changed since \(1 changed, such as a\); restore either"):
        prepare(CONFIG, damaged)
    assert (damaged / SUMMARY).exists()


def test_a_damaged_capture_is_made_again(small, tmp_path, capsys):
    source = builder.open_objects(CONFIG)
    captures = tmp_path / "data" / "captures"
    workers.capture_all(source.entries, CONFIG.capture, captures)
    paths = sorted(captures.glob("*/*"))
    paths[0].write_bytes(b"")
    flip(paths[1])
    paths[2].write_bytes(paths[2].read_bytes()[:100])
    paths[3].write_bytes(paths[4].read_bytes()[:-5] + b"12345")
    paths[5].with_suffix(".left_out").write_text("")
    prepare(CONFIG, tmp_path / "data")
    np.testing.assert_equal(read_json(tmp_path / "data" / SUMMARY), read_json(small / SUMMARY))
    assert capsys.readouterr().err.count("so it is made again") == 3
