"""What messages advise works: each is followed here after the command that said it has failed."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.capture import workers
from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.builder import DataConfig, open_objects, open_split, prepare
from data_pipeline.dataset.config import made_with_other_settings
from data_pipeline.dataset.proof import SHARDS
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DamagedMesh, DataError
from mevs_jax.cli.parsing import parse
from tests.data_pipeline.objects.making import box, members, off, write

CAPTURE = CaptureConfig(views=3, resolution=16)


@pytest.fixture
def config(tmp_path) -> DataConfig:
    """Of six boxes, to which tests add."""
    return DataConfig(source=str(write(tmp_path / "set", members())), capture=CAPTURE)


def out_of(command: str) -> Path:
    """The run directory of a command that a message names."""
    name, *arguments = command.split()
    return parse(name, arguments).out


def damaged(config: DataConfig, folder: Path) -> Path:
    """A damaged file, after a run that has failed for it."""
    path = Path(config.source) / "rack" / "train" / "rack_9.off"
    path.write_bytes(off(*box())[:50])
    with pytest.raises(DamagedMesh, match=r"cut short.*, or leave such objects out with --dataset.skip-damaged$"):
        prepare(config, folder)
    return path


def test_damaged_files_can_be_left_out_after_the_run_that_found_them(config, tmp_path, monkeypatch):
    damaged(config, tmp_path / "data")
    assert not made_with_other_settings(replace(config, skip_damaged=True), tmp_path / "data")
    read: list[str] = []
    real = workers.load_object
    monkeypatch.setattr(workers, "load_object", lambda entry: read.append(entry.name) or real(entry))
    statistics = prepare(replace(config, skip_damaged=True), tmp_path / "data")
    assert list(statistics.left_out["train"]) == ["rack/train/rack_9.off"]
    assert len(read) < 7  # captures of before are used
    with pytest.raises(DataError, match=r"has a data set made with other settings \(skip_damaged true, not false\)"):
        prepare(config, tmp_path / "data")


def test_damaged_files_can_be_taken_away_or_repaired(config, tmp_path):
    damaged(config, tmp_path / "first").unlink()
    assert prepare(config, tmp_path / "first").left_out_count == 0
    damaged(config, tmp_path / "second").write_bytes(off(*box((7, 1, 1))))
    assert prepare(config, tmp_path / "second").left_out_count == 0


def test_a_run_that_did_not_finish_goes_on_with_the_same_settings_alone(config, tmp_path):
    skipping = replace(config, skip_damaged=True)
    path = damaged(config, tmp_path / "data")
    for other in (
        replace(config, seed=3),
        replace(skipping, seed=3),
        replace(config, capture=CaptureConfig(4, resolution=16)),
    ):
        with pytest.raises(DataError, match=r"captures of a run with other settings that did not finish \(") as caught:
            prepare(other, tmp_path / "data")
        assert "give the same again to go on with it, delete the folder, or choose another --out" in str(caught.value)
    path.unlink()
    shutil.copytree(tmp_path / "data", tmp_path / "again")
    prepare(config, tmp_path / "again")
    shutil.rmtree(tmp_path / "data")
    prepare(other, tmp_path / "data")


def test_another_backend_can_be_used_where_one_cannot_begin(config, tmp_path, monkeypatch):
    def fails(*_):
        raise DataError("the visualizer backend needs a display; … use --dataset.capture.backend raycast")

    monkeypatch.setitem(workers._BACKENDS, "visualizer", fails)
    with pytest.raises(DataError, match="backend raycast"):
        prepare(replace(config, capture=replace(CAPTURE, backend="visualizer")), tmp_path / "data")
    assert prepare(config, tmp_path / "data").views == 3


def test_damaged_shards_are_made_again_once_they_are_deleted(config, tmp_path):
    prepare(config, tmp_path / "data")
    shard = next((tmp_path / "data" / SHARDS).rglob("*test.array_record*"))
    shard.write_bytes(shard.read_bytes()[:-5])
    with pytest.raises(DataError) as caught:
        open_split(tmp_path / "data", "test")
    told = re.search(r"delete (\S+), and make it again with: mevs (data --out \S+)$", str(caught.value))
    shutil.rmtree(told[1])
    assert out_of(told[2]) == tmp_path
    prepare(config, tmp_path / "data")
    assert len(open_split(tmp_path / "data", "test")) == 2


def test_a_missing_data_set_names_the_command_that_makes_it(tmp_path):
    for ask in (load_statistics, lambda folder: open_split(folder, "test")):
        with pytest.raises(DataError) as caught:
            ask(tmp_path / "runs" / "data")
        assert out_of(re.search(r"with: mevs (data --out \S+)$", str(caught.value))[1]) == tmp_path / "runs"


def test_a_folder_without_splits_is_divided_as_advised(tmp_path):
    files = {f"{name}/{at}.off": off(*box((1, 1, 1 + at))) for name in ("mug", "rack") for at in range(5)}
    config = DataConfig(source=str(write(tmp_path / "set", files)), capture=CAPTURE)
    with pytest.raises(DataError, match=r"add --dataset.split 0.8 to train on 80 %") as caught:
        open_objects(config)
    share = re.search(r"--dataset.split (\S+)", str(caught.value))[1]
    splits = [entry.split for entry in open_objects(replace(config, split=share)).entries]
    assert (splits.count("train"), splits.count("test")) == (8, 2)


def test_strangers_are_added_as_advised():
    with pytest.raises(DataError, match=r"give --data others and add --dataset.more strangers"):
        open_objects(DataConfig(source="strangers"))
    assert open_objects(DataConfig(source="furniture10", more=("strangers",))).classes[-1] == "unknown object"


def test_a_class_without_objects_left_can_be_removed(config, tmp_path):
    lamp = Path(config.source) / "lamp"
    write(lamp, {"train/a.off": off(box()[0], []), "test/b.off": off(*box())})
    with pytest.raises(DataError, match=r"no training objects of class lamp left .*; add some, or remove the class"):
        prepare(config, tmp_path / "data")
    shutil.rmtree(lamp)
    assert prepare(config, tmp_path / "data").classes == ["mug", "rack"]


def test_labels_can_be_lowered_by_one_as_advised(tmp_path):
    grids = np.zeros((4, 4, 4, 4), np.uint8)
    grids[:, 1:3, 1:3, 1:3] = 1
    labels = np.array([1, 2, 1, 2])
    np.savez(tmp_path / "set.npz", X_train=grids, y_train=labels, X_test=grids, y_test=labels)
    config = DataConfig(source=str(tmp_path / "set.npz"), capture=CAPTURE)
    with pytest.raises(DataError, match="subtract 1 from all labels"):
        open_objects(config)
    np.savez(tmp_path / "set.npz", X_train=grids, y_train=labels - 1, X_test=grids, y_test=labels - 1)
    assert len(open_objects(config).classes) == 2
