"""Folders: every file is an object or named with its reason, whatever the folders look like."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.dataset.builder import split_objects
from data_pipeline.errors import DamagedMesh, DataError
from data_pipeline.files import npz_of
from data_pipeline.objects.sources import load_object
from tests.data_pipeline.objects.making import box, glb, members, obj, off, opened, ply, stl, write

BOX = box()


def of_split(source, split: str) -> list[str]:
    return [entry.name for entry in source.entries if entry.split == split]


# ------------------------------------------------------------------------------------------------------------------- links


def test_links_to_folders_and_files_are_followed(tmp_path):
    write(tmp_path / "elsewhere", members(("lamp",)))
    write(tmp_path / "set", members(("mug", "rack")))
    (tmp_path / "set" / "lamp").symlink_to("../elsewhere/lamp")
    (tmp_path / "set" / "mug" / "train" / "more.off").symlink_to(
        tmp_path / "elsewhere" / "lamp" / "test" / "lamp_2.off"
    )
    source = opened(tmp_path / "set")
    assert source.classes == ("lamp", "mug", "rack")
    # The linked file is a lamp too: by its own name, and once.
    assert len(source.entries) == 9
    assert len({os.path.realpath(entry.recipe.path) for entry in source.entries}) == 9
    assert sum(map(len, source.left_out.values())) == 1


def test_links_that_lead_in_circles_end(tmp_path):
    root = write(tmp_path / "set", members(("mug", "rack")))
    for name in "abcdefgh":
        (root / "mug" / name).symlink_to("..")
        (root / f"loop_{name}").symlink_to(root)
    assert len(opened(root).entries) == 6
    for here in "abcdefgh":  # n! paths
        (root / "rack" / here).mkdir()
        for there in "abcdefgh":
            (root / "rack" / here / there).symlink_to(f"../{there}")
    (root / "self").symlink_to("self")
    source = opened(root)
    assert len(source.entries) == 6
    assert "is a link to self, which does not exist" in source.left_out["other"]["self"]


def test_a_pool_of_files_with_splits_of_links(tmp_path):
    root = write(tmp_path / "set", {f"pool/{at}.off": off(*box((1, 1, at + 1))) for at in range(6)})
    for at in range(6):
        link = root / ("mug", "rack")[at % 2] / ("train", "train", "test")[at // 2] / f"{at}.off"
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(root / "pool" / f"{at}.off")
    source = opened(root)
    assert len(source.entries) == 6
    assert not source.left_out  # the files of the pool are objects by their other names


def test_one_file_is_never_in_two_splits(tmp_path):
    root = write(tmp_path / "set", members(("mug", "rack")))
    (root / "mug" / "test" / "again.off").symlink_to("../train/mug_0.off")
    os.link(root / "rack" / "test" / "rack_2.off", root / "rack" / "train" / "hard.off")
    source = opened(root)
    assert len(source.entries) == 6
    assert source.left_out == {
        "test": {"mug/test/again.off": "is the same file as mug/train/mug_0.off"},
        "train": {"rack/train/hard.off": "is the same file as rack/test/rack_2.off"},
    }


def test_links_without_a_target_are_named(tmp_path):
    root = write(tmp_path / "set", members(("mug", "rack")))
    (root / "mug" / "train" / "mug_9.off").symlink_to("../../.git/annex/objects/x.off")
    (root / "lamp").symlink_to("/nowhere/lamp")
    source = opened(root)
    broken = next(entry for entry in source.entries if entry.name == "mug/train/mug_9.off")
    with pytest.raises(DamagedMesh, match=r"mug_9.off is a link to .*x.off, which does not exist; fetch its content"):
        load_object(broken)
    assert source.left_out == {"other": {"lamp": "is a link to /nowhere/lamp, which does not exist"}}


# ------------------------------------------------------------------------------------------------------------------ splits


def test_folders_of_splits_have_many_names(tmp_path):
    files = members(("mug", "rack"))
    renamed = {name.replace("train", "Training").replace("test", "TEST"): content for name, content in files.items()}
    assert len(opened(write(tmp_path / "a", renamed)).entries) == 6
    validation = {f"{name}/{folder}/v.off": off(*BOX) for name, folder in (("mug", "val"), ("rack", "Validation"))}
    source = opened(write(tmp_path / "b", files | validation))
    assert of_split(source, "val") == ["mug/val/v.off", "rack/Validation/v.off"]


def test_objects_for_validation_are_used_for_it(tmp_path):
    files = members(("mug", "rack")) | {f"mug/val/v{at}.off": off(*BOX) for at in range(3)}
    source = opened(write(tmp_path / "set", files))
    split = split_objects(source.entries, 0.5, seed=0)
    named = {name: sorted(entry.name for entry in entries) for name, entries in split.items()}
    assert named["val"][:3] == [f"mug/val/v{at}.off" for at in range(3)]
    assert len(named["val"]) == 4  # and one of the rack's training objects, which has no others
    assert {"mug/train/mug_0.off", "mug/train/mug_1.off"} < set(named["train"])


def test_the_folder_of_the_split_may_come_first(tmp_path):
    files = {f"data/{split}/{name}/{at}.off": off(*box((1, 1, at + 1)))
             for split in ("train", "test") for name in ("mug", "rack") for at in range(2)}  # fmt: skip
    for root in (write(tmp_path / "a", files), tmp_path / "a" / "data"):
        source = opened(root)
        assert source.classes == ("mug", "rack")
        assert not source.left_out
        assert of_split(source, "test") == ["test/mug/0.off", "test/mug/1.off", "test/rack/0.off", "test/rack/1.off"]


def test_files_beside_the_classes_of_a_split_are_named(tmp_path):
    files = {
        f"{split}/{name}/{at}.off": off(*BOX) for split in ("train", "test") for name in ("a", "b") for at in range(2)
    }
    source = opened(write(tmp_path / "set", files | {"train/stray.off": off(*BOX), "train/notes.fbx": b""}))
    assert len(source.entries) == 8
    assert sorted(source.left_out["other"]) == ["train/notes.fbx", "train/stray.off"]


def test_folders_of_objects_below_the_split(tmp_path):
    files = members(("mug", "rack"))
    files |= {f"rack/train/obj_{at}/models/model_normalized.obj": obj(*box((1, 1, at + 1))) for at in range(3)}
    files |= {f"rack/train/obj_{at}/models/model_normalized.mtl": b"" for at in range(3)}
    source = opened(write(tmp_path / "set", files))
    assert len(source.entries) == 9
    assert "rack/train/obj_2/models/model_normalized.obj" in of_split(source, "train")
    every = {f"{name}/{split}/{split}_{at}/model.obj": obj(*BOX)
             for name in ("mug", "rack") for split in ("train", "test") for at in range(2)}  # fmt: skip
    assert opened(write(tmp_path / "every", every)).classes == ("mug", "rack")


def shapenet(root: Path, per_class: int = 5, prefix: str = "") -> Path:
    return write(
        root,
        {
            f"{prefix}0{name}/{name}a{at}/models/model.{suffix}": obj(*box((1, name, at + 1)))
            for name in (1, 2) for at in range(per_class) for suffix in ("obj", "mtl")
        },
    )  # fmt: skip


def test_without_folders_of_splits_one_sentence_offers_the_option(tmp_path):
    root = shapenet(tmp_path / "set")
    with pytest.raises(DataError, match=r"10 meshes in 2 class folders .* add --dataset.split 0.8") as caught:
        opened(root)
    assert "\n" not in str(caught.value)
    source = opened(root, split="0.8")
    assert source.classes == ("01", "02")
    assert (len(of_split(source, "train")), len(of_split(source, "test"))) == (8, 2)
    assert "01/1a0/models/model.obj" in {entry.name for entry in source.entries}
    assert opened(root, split="0.8").entries == source.entries
    assert opened(root, split="0.8", seed=1).entries != source.entries
    wrapped = opened(shapenet(tmp_path / "wrapped", prefix="ShapeNetCore.v2/"), split="0.8")
    assert [(entry.name, entry.split) for entry in wrapped.entries] == [
        (entry.name, entry.split) for entry in source.entries
    ]


def test_files_of_one_object_go_to_one_split(tmp_path):
    files = {
        f"{name}/{at}/{part}.stl": stl(*box((1, at + 1, 2)))
        for name in ("mug", "rack")
        for at in range(6)
        for part in "ab"
    }
    files |= {f"mug/flat_{at}.{suffix}": b"" for at in range(6) for suffix in ("obj", "ply")}
    source = opened(write(tmp_path / "set", files), split="0.5")
    for entry in source.entries:
        group = entry.name.rsplit("/", 1)[0] if "flat" not in entry.name else entry.name.rsplit(".", 1)[0]
        assert {
            other.split
            for other in source.entries
            if other.name.startswith(f"{group}/") or other.name.startswith(f"{group}.")
        } == {entry.split}


def test_lists_of_splits(tmp_path):
    root = shapenet(tmp_path / "set")
    by_id = tmp_path / "all.csv"
    rows = [
        f"{at},0{name},{name}a{at},{'test' if at == 4 else 'val' if at == 3 else 'train'}"
        for name in (1, 2)
        for at in range(5)
    ]
    by_id.write_text("\n".join(["id,synsetId,modelId,split", *rows]))
    source = opened(root, split=str(by_id))
    assert of_split(source, "test") == ["01/1a4/models/model.obj", "02/2a4/models/model.obj"]
    assert len(of_split(source, "val")) == 2
    by_path = tmp_path / "lists.json"
    names = {"train": ["01/1a0/models/model.obj", "02/2a0/models/model"], "test": ["1a1", "2a1", "not/here.obj"]}
    by_path.write_text(json.dumps(names))
    source = opened(root, split=str(by_path))
    assert len(source.entries) == 4
    assert len(source.left_out["other"]) == 6
    assert set(source.left_out["other"].values()) == {"is not in lists.json"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"train": ["1a0"], "test": ["1a0"]}', "'1a0' in train and in test"),
        ('{"train": ["a"], "test": ["b"]}', "names 0 training and 0 test objects .* such as 01/1a0/models/model.obj"),
        ('{"learn": ["1a0"]}', "the split 'learn'"),
        ("[1, 2]", "cannot be read"),
        ("{", "cannot be read"),
    ],
)
def test_wrong_lists_are_described(tmp_path, content, message):
    root = shapenet(tmp_path / "set")
    (tmp_path / "list.json").write_text(content)
    with pytest.raises(DataError, match=message) as caught:
        opened(root, split=str(tmp_path / "list.json"))
    assert "\n" not in str(caught.value)


def test_one_object_a_class_is_trained_and_tested_on_from_other_directions(tmp_path):
    root = write(tmp_path / "set", {f"{name}/{name}.off": off(*box((3, 1, 2))) for name in ("mug", "rack")})
    with pytest.raises(DataError, match=r"class mug has 1 object, .* give --dataset.split 1 to") as caught:
        opened(root, split="0.8")
    source = opened(root, split=re.search(r"give --dataset.split (\S+)", str(caught.value))[1])
    assert [len(of_split(source, split)) for split in ("train", "val", "test")] == [800, 100, 100]
    assert len({entry.name for entry in source.entries}) == 1000
    assert "these very objects" in source.notes[0]
    assert not source.left_out
    mugs = [entry for entry in source.entries if entry.label == 0]
    assert len({entry.recipe.stamp for entry in mugs}) == 500  # of which captures are kept apart
    angles = sorted(entry.recipe.angle for entry in mugs)
    np.testing.assert_allclose(angles, 2 * np.pi * np.arange(500) / 500)
    test = next(entry.recipe for entry in mugs if entry.split == "test")
    first, last = test.recipe.load()[0], test.load()[0]
    for before, after in zip(first, last, strict=True):
        turned = (before[0] + 1j * before[1]) * np.exp(1j * test.angle)
        np.testing.assert_allclose(after, [turned.real, turned.imag, before[2]], atol=1e-9)


@pytest.mark.parametrize("option", ["0", "1.01", "1.5", "-0.1", "nan", "eighty", "list.txt"])
def test_wrong_shares_are_described(tmp_path, option):
    with pytest.raises(DataError, match=r"--dataset.split .* 0.8"):
        opened(shapenet(tmp_path / "set"), split=option)


def test_the_options_go_with_meshes(tmp_path):
    with pytest.raises(DataError, match="go with a folder or zip of meshes, not with furniture10"):
        opened("furniture10", split="0.8")


# ------------------------------------------------------------------------------------------------------------------- names


def test_names_are_whole_paths_where_collections_lie_side_by_side(tmp_path):
    files = members(("mug", "rack"))
    both = {f"batch1/{name}": content for name, content in files.items()} | {
        f"batch2/{name}": content for name, content in files.items()
    }
    source = opened(write(tmp_path / "set", both))
    names = [entry.name for entry in source.entries]
    assert len(set(names)) == len(names) == 12
    assert "batch2/mug/train/mug_0.off" in names
    once = files | {"more/mug/train/mug_0.off": off(*box((1, 1, 9)))}
    source = opened(write(tmp_path / "once", once))
    extents = {entry.name: load_object(entry).extent[2] for entry in source.entries if entry.name.endswith("mug_0.off")}
    assert sorted(extents.values()) == [2, 9]
    single = opened(write(tmp_path / "deep", {f"a/b/{name}": content for name, content in files.items()}))
    assert [entry.name for entry in single.entries] == sorted(files)


@pytest.mark.skipif(sys.platform == "darwin", reason="macOS refuses names that are not UTF-8")
def test_names_that_are_not_unicode_or_long_are_safe(tmp_path):
    root = write(tmp_path / "set", members(("mug", "rack")))
    names = [b"T\xfcr.off", b"T\xfbr.off", "Tür.off".encode(), b"new\nline.off", b"[red]x.off", b"x" * 250 + b".off"]
    for name in names:
        Path(os.fsdecode(os.path.join(os.fsencode(root), b"mug/train", name))).write_bytes(off(*BOX))
    source = opened(root)
    assert len(source.entries) == 12
    assert "mug/train/T\\xfcr.off" in {entry.name for entry in source.entries}
    files = set()
    for entry in source.entries:
        assert entry.name.encode().decode().isprintable()
        assert load_object(entry).extent.tolist() == pytest.approx([1, *load_object(entry).extent.tolist()[1:]])
        path = npz_of(tmp_path, entry.name)
        path.write_bytes(b"")  # the file system takes it
        files.add(path.name.lower())
    assert len(files) == 12


def test_captures_have_files_of_their_own():
    names = ["a/b", "a__b", "A/b", "a/B", "ä", "a", "x" * 300, "x" * 301, "..", ".", "a b", "a:b"]
    paths = {npz_of(Path("out"), name).name.lower() for name in names}
    assert len(paths) == len(names)
    assert all(len(path) < 200 and path.isascii() and "/" not in path for path in paths)
    assert (
        npz_of(Path("out"), "bed/train/bed_0001.off").name == "bed__train__bed_0001.off.npz"
    )  # as finished runs have it


# ---------------------------------------------------------------------------------------------- what is not read, or not there


def test_what_macos_adds_is_ignored_and_said(tmp_path):
    files = members(("mug", "rack"))
    junk = {name.replace("mug_", "._mug_"): b"\0\5\26\7" for name in files if "mug_" in name}
    junk |= {"__MACOSX/mug/train/._mug_0.off": b"", ".DS_Store": b"", ".git/mug/train/a.off": b""}
    source = opened(write(tmp_path / "set", files | junk))
    assert len(source.entries) == 6
    assert source.said == ("ignored by rule: 1 × .DS_Store, 3 × ._*, 1 × __MACOSX, 1 × hidden",)
    assert not source.left_out


def test_formats_that_are_not_read_are_named(tmp_path):
    files = members(("mug", "rack")) | {
        "mug/train/a.fbx": b"",
        "mug/test/b.OFF.gz": b"",
        "readme.txt": b"",
        "extra/c.obj": obj(*BOX),
    }
    source = opened(write(tmp_path / "set", files))
    assert source.left_out == {
        "train": {"mug/train/a.fbx": "is a .fbx file, which is not read; convert it to .glb, .obj or .ply"},
        "test": {"mug/test/b.OFF.gz": "is compressed (.gz); unpack it"},
        "other": {"extra/c.obj": "lies in no folder of a class with train, val or test"},
    }
    write(tmp_path / "set", {"arm/train/a.blend": b"", "arm/test/b.blend": b""})
    with pytest.raises(DataError, match=r"no file of class arm can be read \(arm/test/b.blend is a .blend file"):
        opened(tmp_path / "set")


def test_a_class_of_one_format_among_others(tmp_path):
    files = {f"robots/{name}/{split}/{at}.{suffix}": make(*box((1, 1, at + 1)))
             for name, suffix, make in (("arm", "glb", glb), ("base", "stl", stl), ("grip", "ply", ply))
             for split in ("train", "test") for at in range(2)}  # fmt: skip
    source = opened(write(tmp_path / "set", files))
    assert source.classes == ("arm", "base", "grip")
    assert source.notes == (
        "turned to z up from the axis that their format declares: 4 .glb; the other 8 were taken as z up (--dataset.up auto)",
    )
    assert opened(tmp_path / "set", up="z").notes == ("all 12 files were taken as z up (--dataset.up z)",)
    (first,) = [entry for entry in opened(tmp_path / "set", up="z").entries if entry.name == "arm/train/1.glb"]
    assert load_object(first).extent.tolist() == [1, 1, 2]


def test_what_is_no_file_is_named(tmp_path):
    root = write(tmp_path / "set", members(("mug", "rack")))
    os.mkfifo(root / "mug" / "train" / "pipe.off")
    (root / "mug" / "train" / "folder.off").mkdir()
    source = opened(root)
    assert source.left_out == {"train": {"mug/train/pipe.off": "is not a regular file"}}


def test_a_scan_is_described_in_one_sentence(tmp_path):
    (tmp_path / "scan.ply").write_bytes(ply(BOX[0], []))
    with pytest.raises(DataError, match=r"scan.ply cannot be used: .* point cloud of 8 points"):
        opened(tmp_path / "scan.ply")


def test_files_that_stand_for_files_that_were_not_fetched(tmp_path):
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
    files = members(("mug", "rack")) | {
        "mug/train/a.off": pointer,
        "mug/train/b.ply": b"/annex/objects/SHA256E-s9--a.ply\n",
    }
    source = opened(write(tmp_path / "set", files | {"mug/train/c.obj.dvc": b"outs:"}))
    by_name = {entry.name: entry for entry in source.entries}
    for name, command in (("a.off", "git lfs pull"), ("b.ply", "git annex get")):
        with pytest.raises(
            DamagedMesh, match=f"{name} only stands for a file that is not here; fetch it with: {command}"
        ):
            load_object(by_name[f"mug/train/{name}"])
    assert source.left_out["train"] == {
        "mug/train/c.obj.dvc": "stands for a file that is not here; fetch it with: dvc pull"
    }
