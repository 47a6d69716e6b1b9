"""What was captured is what is in the files now; what no view shows, and depth that does not fit, is said."""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.capture import workers
from data_pipeline.capture.casting import CaptureConfig, check_camera, rig_for
from data_pipeline.dataset.builder import DataConfig, open_objects, open_split, prepare
from data_pipeline.dataset.config import check_same_data
from data_pipeline.dataset.statistics import load_statistics, report_left_out
from data_pipeline.errors import DamagedMesh, DataError
from data_pipeline.objects.names import plain_class
from tests.data_pipeline.objects.making import box, glb, members, off, write, zipped

CAPTURE = CaptureConfig(views=3, resolution=16)


def extents(folder: Path) -> dict[str, list[float]]:
    found = {}
    for split in ("train", "val", "test"):
        source = open_split(folder, split)
        found |= {source[at]["name"].decode(): source[at]["extent"].round(4).tolist() for at in range(len(source))}
    return found


def counted(monkeypatch) -> list[str]:
    """The objects that are read from now on."""
    read: list[str] = []
    real = workers.load_object
    monkeypatch.setattr(workers, "load_object", lambda entry: read.append(entry.name) or real(entry))
    return read


def test_files_repaired_after_a_failed_run_are_captured_and_others_not_again(tmp_path, monkeypatch):
    root = write(tmp_path / "set", members(("mug", "rack")))
    (root / "rack" / "train" / "rack_9.off").write_bytes(off(*box())[:50])
    config = DataConfig(source=str(root), capture=CAPTURE)
    with pytest.raises(DamagedMesh, match=r"rack_9.off is cut short"):
        prepare(config, tmp_path / "data")
    (root / "rack" / "train" / "rack_9.off").write_bytes(off(*box((7, 1, 1))))
    old = root / "mug" / "train" / "mug_0.off"
    status = old.stat()
    old.write_bytes(off(*box((1, 1, 3))))  # of the same size, and dated back
    os.utime(old, ns=(status.st_atime_ns, status.st_mtime_ns))
    read = counted(monkeypatch)
    statistics = prepare(config, tmp_path / "data")
    assert sorted(read) == ["mug/train/mug_0.off", "rack/train/rack_9.off"]
    assert statistics.left_out_count == 0
    assert extents(tmp_path / "data")["rack/train/rack_9.off"] == [7, 1, 1]
    assert extents(tmp_path / "data")["mug/train/mug_0.off"] == [1, 1, 3]


def test_left_out_objects_that_are_repaired_come_in(tmp_path, monkeypatch):
    files = members(("mug", "rack")) | {"mug/train/mug_5.off": off(box()[0], [])}
    config = DataConfig(source=str(write(tmp_path / "set", files)), capture=CAPTURE)
    monkeypatch.setattr(
        "data_pipeline.dataset.builder._write_shards", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        prepare(config, tmp_path / "data")
    monkeypatch.undo()
    write(tmp_path / "set", {"mug/train/mug_5.off": off(*box((5, 5, 5)))})
    assert prepare(config, tmp_path / "data").left_out_count == 0


@pytest.mark.parametrize("kind", ["folder", "zip", "npz"])
def test_a_finished_data_set_says_when_its_source_has_changed(tmp_path, capsys, kind):
    grids, labels = np.ones((4, 3, 3, 3), np.uint8), np.array([0, 1, 0, 1])

    def make(first: float) -> str:
        files = members(("mug", "rack")) | {"mug/train/mug_0.off": off(*box((first, 1, 1)))}
        if kind == "folder":
            one = {"mug/train/mug_0.off": files["mug/train/mug_0.off"]}
            return str(write(tmp_path / "set", files if first == 1 else one))
        if kind == "zip":
            (tmp_path / "set.zip").write_bytes(zipped(files))
            return str(tmp_path / "set.zip")
        grids[0, 0, 0, 0] = first == 1
        np.savez(tmp_path / "set.npz", X_train=grids, y_train=labels, X_test=grids[1:2], y_test=labels[1:2])
        return str(tmp_path / "set.npz")

    config = DataConfig(source=make(1), capture=CAPTURE)
    statistics = prepare(config, tmp_path / "data")
    capsys.readouterr()
    assert prepare(config, tmp_path / "data") == statistics
    assert "has changed" not in capsys.readouterr().err
    make(2)
    assert prepare(config, tmp_path / "data") == statistics
    said = " ".join(capsys.readouterr().err.split())
    assert "has changed since its data set was made (1 changed, such as" in said
    assert "keeps the objects as they were: delete it, or choose another --out" in said
    if kind == "folder":
        write(tmp_path / "set", {"mug/train/new.off": off(*box())})
        (tmp_path / "set" / "rack" / "train" / "rack_0.off").unlink()
        prepare(config, tmp_path / "data")
        assert "(1 changed, 1 new, 1 gone, such as mug/train/mug_0.off)" in " ".join(capsys.readouterr().err.split())
        os.rename(tmp_path / "set", tmp_path / "elsewhere")  # a data set does not need its source any more
        prepare(config, tmp_path / "data")
        assert "has changed" not in capsys.readouterr().err


def test_data_sets_of_before_are_still_found(tmp_path):
    """Settings that came later are not in their configuration, and no note is in their summary."""
    config = DataConfig(source=str(write(tmp_path / "set", members(("mug", "rack")))), capture=CAPTURE)
    statistics = prepare(config, tmp_path / "data")
    stored = json.loads((tmp_path / "data" / "config.json").read_text())
    assert set(asdict(config)) - set(stored) == {"up", "split", "more"}
    assert "notes" not in json.loads((tmp_path / "data" / "summary.json").read_text())
    assert load_statistics(tmp_path / "data").fingerprint == statistics.fingerprint
    for other in ({"up": "y"}, {"split": "0.5"}):
        with pytest.raises(DataError, match=rf"made with other settings \({next(iter(other))} "):
            prepare(replace(config, **other), tmp_path / "data")
    further = write(tmp_path / "two", members(("mug", "rack")))
    with pytest.raises(DataError, match=r"dataset\.more \[\], not"):
        check_same_data(replace(config, more=(str(further),)), tmp_path / "data")


def test_the_summary_says_which_axis_was_up_and_what_is_left_out(tmp_path, capsys):
    files = members(("mug", "rack")) | {"mug/train/m.glb": glb(*box((1, 3, 1))), "other/[x].obj": b""}
    files["mug/train/wire.off"] = off(*box((200, 1e-4, 1e-4)))
    config = DataConfig(source=str(write(tmp_path / "set", files)), capture=CAPTURE)
    statistics = prepare(config, tmp_path / "data")
    assert extents(tmp_path / "data")["mug/train/m.glb"] == [1, 1, 3]
    assert load_statistics(tmp_path / "data") == statistics
    assert statistics.notes[0].startswith("turned to z up from the axis that their format declares: 1 .glb;")
    assert statistics.left_out == {
        "train": {"mug/train/wire.off": "no view shows it: it is thinner than the pixels of 16×16 views"},
        "test": {},
        "other": {"other/[x].obj": "lies in no folder of a class with train, val or test"},
    }
    report_left_out(statistics)
    said = " ".join(capsys.readouterr().err.split())
    assert "left out: other/[x].obj: lies in no folder" in said
    assert "declares: 1 .glb; the other 7 were taken as z up" in said


def test_a_class_without_training_objects_is_named(tmp_path):
    files = members(("mug", "rack")) | {f"mug/train/mug_{at}.off": off(box()[0], []) for at in range(2)}
    config = DataConfig(source=str(write(tmp_path / "set", files)), capture=CAPTURE)
    with pytest.raises(
        DataError, match=r"no training objects of class mug left \(mug/train/mug_0.off: mesh has no faces"
    ):
        prepare(config, tmp_path / "data")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"distance": 8.0, "field_of_view": 14.4},
            "distance 8 is not .* at most 5.55, since depth is stored in 16 bits",
        ),
        ({"distance": 1.0}, "distance 1 is not above 1"),
        ({"distance": float("nan")}, "distance nan"),
        ({"field_of_view": 180.0}, "field-of-view 180 is not between"),
        ({"field_of_view": 0.0}, "field-of-view 0"),
        ({"resolution": 0}, "resolution 0 is not from 1 to 4096"),
        ({"resolution": 10**6}, "resolution 1000000"),
    ],
)
def test_cameras_that_cannot_be_are_refused(tmp_path, change, message):
    with pytest.raises(DataError, match=message) as caught:
        prepare(DataConfig(capture=replace(CAPTURE, **change)), tmp_path)
    assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match=message):
        rig_for(replace(CAPTURE, **change))


def test_the_farthest_camera_still_stores_depth():
    check_camera(replace(CAPTURE, distance=5.55))
    with pytest.raises(DataError, match=r"at most 5\.55"):
        check_camera(replace(CAPTURE, distance=5.56))


def test_several_sources_are_one_data_set(tmp_path, capsys):
    """Classes of one name are one, names of objects stay unique, splits stay as they are, and every file is counted."""
    first = write(tmp_path / "one" / "set", members(("mug", "night_stand")))
    second = write(
        tmp_path / "two" / "set", members(("Night Stands", "rack"), "in/") | {"in/rack/train/bad.off": b"OFF"}
    )
    (tmp_path / "three.zip").write_bytes(zipped(members(("MUG", "rack"))))
    more = (str(second), str(tmp_path / "three.zip"))
    config = DataConfig(source=str(first), more=more, capture=CAPTURE, skip_damaged=True)
    source = open_objects(config)
    assert source.classes == ("mug", "night_stand", "rack")
    names = [entry.name for entry in source.entries]
    assert len(set(names)) == len(names) == len(members(("a", "b"))) * 3 + 1
    alone = open_objects(DataConfig(source=str(first)))
    assert source.entries[: len(alone.entries)] == alone.entries
    labels = {entry.name: source.classes[entry.label] for entry in source.entries}
    assert labels["set 2/Night Stands/train/Night Stands_0.off"] == "night_stand"
    assert labels["three/MUG/test/MUG_2.off"] == "mug"
    splits = Counter((entry.name.split("/")[0], entry.split) for entry in source.entries)
    assert splits["set 2", "test"] == splits["three", "test"]
    statistics = prepare(config, tmp_path / "data")
    assert statistics.source == "set + set + three"
    (left_out,) = (reasons for reasons in statistics.left_out.values() if reasons)
    assert list(left_out) == ["set 2/rack/train/bad.off"]
    assert len(extents(tmp_path / "data")) == len(source.entries) - 1
    capsys.readouterr()
    (tmp_path / "three.zip").write_bytes(zipped(members(("MUG", "rack")) | {"MUG/test/new.off": off(*box())}))
    assert prepare(config, tmp_path / "data") == statistics
    said = " ".join(capsys.readouterr().err.split())
    assert f"(1 new, such as {tmp_path / 'three.zip'}: MUG/test/new.off)" in said
    with pytest.raises(DataError, match=r"dataset\.more"):
        check_same_data(replace(config, more=more[:1]), tmp_path / "data")
    with pytest.raises(DataError, match=r"is given twice, as --data or in --dataset\.more, or lies in"):
        open_objects(replace(config, more=(str(first),)))


def test_sources_that_share_objects_are_refused(tmp_path):
    root = write(tmp_path / "set", members(("mug", "rack")))
    for other in (f"{root}/", str(root / "mug"), str(tmp_path / "set" / ".." / "set"), str(tmp_path)):
        with pytest.raises(
            DataError, match=r"is given twice, as --data or in --dataset\.more, or lies in another of them"
        ):
            open_objects(DataConfig(source=str(root), more=(other,)))
    with pytest.raises(DataError, match="modelnet40 holds the objects of modelnet10"):
        open_objects(DataConfig(source="modelnet10", more=("modelnet40",)))


def test_several_sources_keep_their_splits_and_their_names_apart(tmp_path):
    """A share is for the source without splits; names that would be the same get a number; two spellings are one class."""
    first = write(tmp_path / "one", members(("mug", "rack"), "set/"))
    flat = {
        name.replace("/train/", "/").replace("/test/", "/"): content
        for name, content in members(("mug", "Racks")).items()
    }
    racks = {name.replace("Racks", "rack") + "2.off": mesh for name, mesh in flat.items() if "Racks" in name}
    second = write(tmp_path / "two" / "set", flat | racks)
    config = DataConfig(
        source=str(first), more=(str(second), "furniture10"), split="0.5", train_per_class=2, test_per_class=1
    )
    source = open_objects(config)
    names = [entry.name for entry in source.entries]
    assert len(set(names)) == len(names)
    alone = open_objects(DataConfig(source=str(first)))
    assert source.entries[: len(alone.entries)] == alone.entries  # their split is not divided anew
    assert source.classes[:2] == ("mug", "rack")
    assert len({plain_class(name) for name in source.classes}) == len(source.classes)
    assert any("class Racks was taken as rack" in note for note in source.notes)
    assert {entry.split for entry in source.entries if entry.name.startswith("set")} == {"train", "test"}
