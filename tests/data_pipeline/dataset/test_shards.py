"""Shards are parts of the work: whoever writes them, however often it is interrupted, their bytes are the same."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_pipeline.capture import workers
from data_pipeline.capture.workers import capture_path
from data_pipeline.dataset import builder, shards
from data_pipeline.dataset.builder import open_objects, prepare
from data_pipeline.dataset.config import DataConfig
from data_pipeline.dataset.shards import claimed, parts_of
from data_pipeline.errors import Diverged
from data_pipeline.files import files_in
from tests.data_pipeline.dataset.conftest import CONFIG
from tests.data_pipeline.objects.making import members, off, write

SMALL = replace(CONFIG, capture=replace(CONFIG.capture, views=3, resolution=16))


@pytest.fixture(autouse=True)
def _small_shards(monkeypatch):
    monkeypatch.setattr(shards, "_MOST_OBJECTS", 7)


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in files_in(folder)}


class Killed(BaseException):
    """What no code handles, as a signal."""


def fails_at(call: int, function: Any) -> Any:
    """The function, which ends with `Killed` at a call of this number."""
    left = [call]

    def counted(*given: Any, **named: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise Killed
        return function(*given, **named)

    return counted


def test_a_job_that_is_killed_again_and_again_ends_with_the_same_files(tmp_path, monkeypatch, random):
    prepare(SMALL, tmp_path / "whole")
    expected = contents(tmp_path / "whole")
    assert sum("train" in name for name in expected) == 12  # six shards and their indices
    places = [(shards, "load_capture"), (shards, "write_index"), (shards.os, "replace"), (workers, "load_object")]
    captured: list[str] = []
    real = workers.save_capture
    monkeypatch.setattr(workers, "save_capture", lambda path, seen: captured.append(path.name) or real(path, seen))
    kills = 0
    while kills < 20:
        where, name = places[random.integers(len(places))]
        with monkeypatch.context() as patch:
            patch.setattr(where, name, fails_at(int(random.integers(0, 40)), getattr(where, name)))
            try:
                prepare(SMALL, tmp_path / "data")
            except Killed:
                kills += 1
                continue
            break
    assert kills >= 4
    prepare(SMALL, tmp_path / "data")
    assert contents(tmp_path / "data") == expected
    assert len(captured) <= len(set(captured)) + kills


def test_shards_that_are_done_are_not_written_again(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(builder, "_finish", fails_at(0, builder._finish))
        with pytest.raises(Killed):
            prepare(SMALL, tmp_path / "data")
    monkeypatch.setattr(shards, "load_capture", lambda path: pytest.fail("a shard is written again"))
    prepare(SMALL, tmp_path / "data")


def test_processes_share_the_shards(tmp_path):
    """Each takes the next one that is free, and none is left."""
    source = open_objects(SMALL)
    parts = parts_of(builder.split_objects(source.entries, 0.2, 0), SMALL.capture)
    one, other = claimed(parts, tmp_path), claimed(parts, tmp_path)
    taken = [[next(one), next(one)], [next(other)]]  # type: ignore[call-overload]
    taken[1] += list(other)
    taken[0] += list(one)
    assert {part.name for part in taken[0]}.isdisjoint(part.name for part in taken[1])
    assert sorted(part.name for own in taken for part in own) == sorted(part.name for part in parts)
    assert sorted(entry.name for part in parts for entry in part.entries) == sorted(e.name for e in source.entries)


def test_captures_are_of_the_content_of_files(tmp_path):
    """Not of their times, which differ between copies; and they lie in folders of bounded size."""
    found = []
    for name in ("one", "two"):
        root = write(tmp_path / name / "set", members(("mug", "rack")))
        os.utime(root / "mug" / "train" / "mug_0.off", ns=(7, 7))
        entries = open_objects(DataConfig(source=str(root))).entries
        found.append({entry.name: capture_path(Path("x"), entry) for entry in entries})
    assert found[0] == found[1]
    (tmp_path / "two" / "set" / "mug" / "train" / "mug_0.off").write_bytes(off(*_flat()))
    entries = open_objects(DataConfig(source=str(tmp_path / "two" / "set"))).entries
    changed = {entry.name for entry in entries if capture_path(Path("x"), entry) != found[0][entry.name]}
    assert changed == {"mug/train/mug_0.off"}
    many = (replace(entries[0], name=f"{at}") for at in range(20_000))
    folders = np.unique([capture_path(Path("x"), entry).parent.name for entry in many], return_counts=True)[1]
    assert len(folders) == 256
    assert folders.max() < 2 * 20_000 / 256


def _flat() -> tuple[np.ndarray, np.ndarray]:
    return np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float), np.array([[0, 1, 2]])


def test_entropies_that_are_not_finite_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "view_entropies", lambda capture: np.array([1.0, np.nan, 1.0], np.float32))
    with pytest.raises(Diverged, match=r"the depth entropies of \w+ are not finite; leave this object out"):
        prepare(SMALL, tmp_path / "data")
    shutil.rmtree(tmp_path)
