"""Archives of voxel grids: read in parts, and checked whole before any object is made."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from data_pipeline.errors import DataError
from data_pipeline.objects import voxels
from data_pipeline.objects.sources import load_object
from tests.data_pipeline.objects.making import opened


def grids(count: int, side: int = 6) -> np.ndarray:
    found = np.zeros((count, side, side, side), np.uint8)
    for at in range(count):
        found[at, 1 : 4 + at % 2, 2:5, 1 : 3 + at % 3] = 1
    return found


SOUND = {"X_train": grids(4), "y_train": np.array([0, 1, 0, 1]), "X_test": grids(2), "y_test": np.array([1, 0])}


def saved(folder, **changes):
    path = folder / "grids.npz"
    np.savez_compressed(path, **(SOUND | changes))
    return path


@pytest.mark.parametrize("kind", [np.bool_, np.uint8, np.int32, np.float32, np.float64, ">i4"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("part", [1, 500, 1 << 20])
def test_grids_of_any_kind_are_the_same_objects(tmp_path, monkeypatch, kind, order, part):
    expected = [entry.recipe for entry in opened(saved(tmp_path)).entries]
    monkeypatch.setattr(voxels, "_BYTES_PER_PART", part)
    changes = {f"X_{split}": np.asarray(SOUND[f"X_{split}"], kind, order=order) for split in ("train", "test")}
    changes["y_train"] = SOUND["y_train"].astype(np.float32).reshape(-1, 1)
    source = opened(saved(tmp_path, **changes))
    assert [entry.recipe for entry in source.entries] == expected
    assert expected[1].bits == np.packbits(SOUND["X_train"][1].reshape(-1) > 0).tobytes()
    load_object(source.entries[0])


@pytest.mark.parametrize("names", [np.array(["mug", "Räck"]), np.array([b"mug", "Räck".encode()])])
def test_class_names_may_come_along(tmp_path, names):
    source = opened(saved(tmp_path, classes=names))
    assert source.classes == ("mug", "Räck")
    assert source.entries[1].name == "Räck_train_0001"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"X_test": grids(0), "y_test": np.zeros(0, int)}, "y_test is empty"),
        ({"y_train": np.array(["mug", "rack", "mug", "rack"])}, "y_train holds strings; .* an array `classes`"),
        (
            {"y_train": np.array([1, 2, 1, 2]), "y_test": np.array([2, 1])},
            "no training object has the label 0; subtract 1",
        ),
        ({"y_train": np.eye(2, dtype=int)[[0, 1, 0, 1]]}, r"shape \(4, 2\), as labels coded one-hot"),
        ({"y_train": np.array([0, 1, -1, 1])}, "y_train has the label -1, and 1 labels below 0"),
        ({"y_test": np.array([0, 2**40])}, "the label 1099511627776"),
        ({"y_test": np.array([0, 2**63], np.uint64)}, "the label 9223372036854775808"),
        ({"y_train": np.array([0, 1, 0, 10**6])}, "no training object has the label 2"),
        ({"y_train": np.zeros(1_000_001, np.uint8)}, "1,000,001 labels, more than 1,000,000"),
        ({"y_train": np.array([0, 1, 0.5, 1])}, "not whole numbers"),
        ({"y_train": np.array([0, 1, np.nan, 1])}, "not whole numbers"),
        ({"y_train": np.array([0, 1j, 0, 1])}, "type complex128"),
        ({"y_train": np.array([0, 1, 0, None], object)}, "y_train holds Python objects, which are never unpickled"),
        ({"X_train": SOUND["X_train"].astype(object)}, "X_train holds Python objects"),
        ({"X_train": SOUND["X_train"].astype(str)}, "X_train has type <U"),
        ({"X_train": np.full((4, 6, 6, 6), np.nan)}, "not finite"),
        ({"X_train": grids(3)}, r"X_train has shape \(3, 6, 6, 6\), expected \(4, side"),
        ({"X_train": grids(4)[..., :5]}, "X_train has shape"),
        ({"X_train": np.zeros((4, 0, 0, 0))}, "which is nothing"),
        ({"y_train": np.zeros(4, int), "y_test": np.zeros(2, int)}, "one class only"),
        ({"classes": np.array(["mug"])}, "1 names, and the labels go up to 1"),
        ({"classes": np.array(["mug", "mug"])}, "a name twice"),
        ({"classes": np.array([1, 2])}, "give a list of strings"),
    ],
)
def test_wrong_archives_are_described_in_one_sentence(tmp_path, changes, message):
    with pytest.raises(DataError, match=message) as caught:
        opened(saved(tmp_path, **changes))
    assert "\n" not in str(caught.value)
    assert "grids.npz" in str(caught.value)


def test_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    for key in ("X_train", "y_test", "classes"):
        with pytest.raises(DataError, match="never unpickled"):
            opened(saved(tmp_path, **{key: np.array([Trap()], object)}))
    assert not (tmp_path / "sprung").exists()


def test_arrays_that_lie_about_their_size_are_described(tmp_path):
    path = saved(tmp_path)
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    for key, old, new in (
        ("X_train.npy", b"(4, 6, 6, 6)", b"(4, 9, 9, 9)"),
        ("X_train.npy", b"(4, 6, 6, 6)", b"(4, 2, 2, 2)"),
        ("y_train.npy", b"(4,)", b"(9,)"),
        ("y_train.npy", b"(4,)", b"(99999999999999,)"),
        ("X_test.npy", b"NUMPY", b"LUMPY"),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            for name, whole in content.items():
                archive.writestr(name, whole.replace(old, new, 1) if name == key else whole)
        with pytest.raises(DataError, match=r"cut short|longer than its shape|not a readable .npz"):
            opened(path)


def test_sizes_are_capped(tmp_path, monkeypatch):
    monkeypatch.setattr(voxels, "LARGEST_GRIDS", 500)
    with pytest.raises(DataError, match="4 grids of 6³ cells as uint8, which is nothing or more than 0 MB"):
        opened(saved(tmp_path))
    monkeypatch.setattr(voxels, "LARGEST_LABELS", 100)
    with pytest.raises(DataError, match="y_train unpacks to more than 0 MB"):
        opened(saved(tmp_path))
