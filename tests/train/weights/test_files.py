"""Files of weights: read without PyTorch, exactly, and never trusted."""

from __future__ import annotations

import importlib.util
import os
import pickle
import struct
import tracemalloc
import zipfile
from functools import cache
from pathlib import Path

import ml_dtypes
import numpy as np
import pytest
from safetensors.numpy import save_file

from data_pipeline.errors import DataError
from tests.reference.weights import small_state
from tests.train.weights.making import (
    HOSTILE_PICKLES,
    MAGIC,
    entry,
    legacy,
    safetensors,
    state,
    tensor,
    text,
    zipped,
)
from train.weights.files import read_state_dict
from train.weights.starting import resnet_depth

REFERENCE = Path(__file__).parents[2] / "reference"
MOST_MEGABYTES = 100
"""Largest memory that Python may hold while it reads a hostile file of less than a few megabytes."""


def check_small(read: dict[str, np.ndarray]) -> None:
    expected = small_state()
    assert read.keys() == expected.keys()
    for name, array in expected.items():
        assert read[name].shape == array.shape
        np.testing.assert_array_equal(np.asarray(read[name], np.float64), array, err_msg=name)


def reason(path: Path, content: bytes) -> str:
    """Returns why a file is refused, and checks that this is one line and took little memory."""
    path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            read_state_dict(path)
        peak = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert peak < MOST_MEGABYTES
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path} is not a file of weights that can be read safely: ")
    return message


# -------------------------------------------------------------------------------------------------------------- PyTorch


@pytest.mark.parametrize("kind", ["zip", "legacy"])
def test_both_formats_of_pytorch_are_read_exactly(kind):
    read = read_state_dict(REFERENCE / f"weights_{kind}.pth")
    check_small(read)
    assert read["half"].dtype == np.float16
    assert read["count"].dtype == np.int64
    assert read["bfloat16"].dtype == ml_dtypes.bfloat16


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed; stored files are read")
@pytest.mark.parametrize(("new", "protocol"), [(True, 2), (False, 2), (True, 4), (True, 5)])
def test_files_that_pytorch_writes_now_are_read_exactly(tmp_path, new, protocol):
    import torch

    from tests.reference.torch_networks import build, small_tensors

    how = {"_use_new_zipfile_serialization": new, "pickle_protocol": protocol}
    torch.save(small_tensors(), tmp_path / "small.pth", **how)
    check_small(read_state_dict(tmp_path / "small.pth"))
    network = build("resnet18")
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.zeros(2, 3, 32, 32)).sum().backward()
    optimiser.step()
    wrapped = {
        "epoch": 3,
        "state_dict": {f"module.{name}": value for name, value in network.state_dict().items()},
        "optimizer": optimiser.state_dict(),
    }
    torch.save(wrapped, tmp_path / "wrapped.pt", **how)
    read = read_state_dict(tmp_path / "wrapped.pt")
    assert resnet_depth(read) == 18
    for name, value in network.state_dict().items():
        np.testing.assert_array_equal(read[name], value.numpy())


@pytest.mark.parametrize("make", [legacy, zipped])
def test_what_stands_beside_the_state_dict_is_not_used(tmp_path, make):
    """A checkpoint: parameters of an optimiser are counted, and their tensors are not in the state dict."""
    wrapped = b"\x80\x02}(" + text("state_dict") + state({"module.a": tensor(key="a")})[2:-1]
    wrapped += (
        text("optimizer") + b"}K\x00" + tensor(key="b") + b"s" + text("loss") + b"G" + struct.pack(">d", 0.5) + b"u."
    )
    path = tmp_path / "checkpoint.pth"
    path.write_bytes(make(wrapped, {"b": bytes(8), "a": np.array([1, 2], np.float32).tobytes()}))
    read = read_state_dict(path)
    assert list(read) == ["a"]
    np.testing.assert_array_equal(read["a"], [1, 2])


def test_ordered_dictionaries_of_python_2_are_read(tmp_path):
    path = tmp_path / "old.pth"
    path.write_bytes(legacy(b"\x80\x02ccollections\nOrderedDict\n](U\x01a" + tensor() + b"\x86e\x85R."))
    assert list(read_state_dict(path)) == ["a"]


@pytest.mark.parametrize(
    ("size", "stride", "offset", "expected"),
    [
        ((2, 2), (1, 2), 1, [[1, 3], [2, 4]]),
        ((3, 2), (0, 1), 0, [[0, 1]] * 3),
        ((), (), 5, 5),
        ((1, 2), (1 << 62, 3), 0, [[0, 3]]),
    ],
)
def test_views_of_storages_are_read(tmp_path, size, stride, offset, expected):
    path = tmp_path / "views.pth"
    path.write_bytes(
        legacy(state({"a": tensor(size, stride, offset)}), {"0": np.arange(6, dtype=np.float32).tobytes()})
    )
    np.testing.assert_array_equal(read_state_dict(path)["a"], expected)


class _Evil:
    """What a hostile file would hold: unpickled as usual, it makes a folder."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("kind", ["zip", "legacy", "bare"])
def test_a_hostile_file_is_refused_and_nothing_runs(tmp_path, kind):
    marker, path = tmp_path / "was_here", tmp_path / "evil.pth"
    evil = pickle.dumps({"conv1.weight": _Evil(marker)})
    path.write_bytes({"zip": zipped, "legacy": legacy, "bare": bytes}[kind](evil))
    with pytest.raises(DataError, match=r"evil\.pth is not a file of weights.*mkdir, which no file of weights needs"):
        read_state_dict(path)
    assert not marker.exists()
    pickle.loads(evil)  # the file does what it says it does
    assert marker.exists()


@pytest.mark.parametrize("make", [legacy, pytest.param(zipped, marks=pytest.mark.slow)])
@pytest.mark.parametrize("hazard", HOSTILE_PICKLES)
def test_hostile_pickles_give_one_sentence_in_little_memory(tmp_path, hazard, make):
    content, message = HOSTILE_PICKLES[hazard]
    refused = reason(tmp_path / "hostile.pth", make(content))
    assert any(part in refused for part in message.split("|")), refused


@pytest.mark.parametrize(
    ("follows", "message"),
    [
        (pickle.dumps(["0"], 2) + struct.pack("<q", -1) + bytes(8), "within a storage of -1 numbers"),
        (pickle.dumps(["0"], 2) + struct.pack("<q", 1 << 62) + bytes(8), "within a storage of 4611686018427387904"),
        (pickle.dumps(["0"], 2) + struct.pack("<q", 3) + bytes(8), "within a storage of 3 numbers"),
        (pickle.dumps(["0"], 2) + bytes(3), "unpack"),
        (pickle.dumps(["0", "0"], 2) + 2 * (struct.pack("<q", 2) + bytes(8)), "two storages of one key"),
        (pickle.dumps(["1"], 2) + struct.pack("<q", 2) + bytes(8), "list of storages"),
        (pickle.dumps([["0"]], 2), "list of storages"),
        (pickle.dumps("0", 2), "list of storages"),
        (pickle.dumps([], 2), "lacks the numbers"),
        (b"", "exhausted before"),
    ],
)
def test_numbers_that_do_not_follow_as_declared_are_refused(tmp_path, follows, message):
    assert message in reason(tmp_path / "legacy.pth", MAGIC + state({"a": tensor()}) + follows)


def _changed(content: bytes, at: int, value: bytes) -> bytes:
    """Returns a zip with other bytes `at` this place of the last entry of its directory."""
    begin = content.rindex(b"PK\x01\x02") + at
    return content[:begin] + value + content[begin + len(value) :]


@cache
def _zips() -> dict[str, tuple[bytes, str]]:
    sound = zipped(state({"a": tensor()}))
    large = state({"a": tensor((1 << 25,))})
    deflated = zipped(large, {"0": bytes(1 << 27)}, zipfile.ZIP_DEFLATED)
    with_pickle = sound.index(b"storage")
    directory = sound.rindex(b"PK\x05\x06")
    many = zipped(b".", {f"{number}{300 * 'x'}": b"" for number in range(13_000)})
    return {
        "too large unpacked": (deflated, "unpacks to more than 4 times"),
        "declared smaller than it is": (_changed(deflated, 24, struct.pack("<I", 8)), "CRC"),
        "declared larger than it is": (_changed(sound, 24, struct.pack("<I", 1 << 19)), "data/0 ends early"),
        "packed size beyond the file": (_changed(sound, 20, b"\xfe\xff\xff\xff"), "too large"),
        "bzip2": (zipped(large, {"0": bytes(1 << 20)}, zipfile.ZIP_BZIP2), "method 12"),
        "lzma": (zipped(large, {"0": bytes(1 << 20)}, zipfile.ZIP_LZMA), "method 14"),
        "unknown method": (_changed(sound, 10, b"\x63"), "method 99"),
        "encrypted": (_changed(sound, 8, b"\x01"), "encrypted"),
        "damaged": (sound[:with_pickle] + b"x" + sound[with_pickle + 1 :], "CRC"),
        "directory of gigabytes": (sound[: directory + 12] + b"\0\0\0\x7f" + sound[directory + 16 :], "directory"),
        "many members": (many, "larger than 4 MB"),
        "without numbers": (zipped(state({"a": tensor()}), {}), "no data/0"),
        "other content": (zipped(b".").replace(b"data.pkl", b"data.txt"), "not of weights"),
        "pickle of gigabytes": (_changed(zipped(b".", {}), 24, struct.pack("<I", 1 << 20)), "data.pkl ends early"),
        "large pickle": (zipped(bytes(33 << 20), {}), "data.pkl is too large"),
        "no directory": (sound[:-22], "zip"),
    }


@pytest.mark.parametrize("case", range(16))
def test_damaged_and_hostile_zips_give_one_sentence(tmp_path, case):
    content, message = list(_zips().values())[case]
    refused = reason(tmp_path / "hostile.pth", content)
    assert any(part in refused for part in message.split("|")), refused


# ---------------------------------------------------------------------------------------------------------- safetensors


@pytest.mark.parametrize(
    ("name", "dtype"),
    [("F16", np.float16), ("BF16", ml_dtypes.bfloat16), ("F32", np.float32), ("F64", np.float64), ("I64", np.int64)],
)
def test_safetensors_of_every_precision_are_read(tmp_path, name, dtype):
    array = np.array([[1.0, -2.5, 0.25]]).astype(dtype)
    path = tmp_path / "weights.safetensors"
    path.write_bytes(safetensors({"a": entry(name, [1, 3], 0, array.nbytes)}, array.tobytes()))
    read = read_state_dict(path)["a"]
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, array)


def test_safetensors_that_its_library_writes_are_read(tmp_path):
    small = {name: array.astype(np.float16 if name == "half" else array.dtype) for name, array in small_state().items()}
    save_file({name: np.ascontiguousarray(array) for name, array in small.items()}, tmp_path / "small.safetensors")
    read = read_state_dict(tmp_path / "small.safetensors")
    for name, array in small.items():
        np.testing.assert_array_equal(read[name].reshape(array.shape), array)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "weights"),
        (b"\xff" * 8, "header of 18446744073709551615 bytes"),
        (struct.pack("<Q", 1 << 40) + b"{}", "header of 1099511627776 bytes"),
        (safetensors(b" " * (5 << 20)), "longer than the file or than 4 MB"),
        (safetensors(b"[" * 1_000_000), "header"),
        (safetensors(b'{"a":' * 700_000), "header"),
        (safetensors(b"\xff\xfe"), "header"),
        (safetensors({"a": entry("F32", [2], 0, 8)}, bytes(4)), "weights"),
        (safetensors({"a": entry("F32", [1 << 62, 1 << 62], 0, 0)}), "overflow"),
        (safetensors({"a": entry("F32", [0, 1 << 62, 1 << 62], 0, 0)}), "too big|dimension"),
        (safetensors({"a": entry("F32", [1] * 100, 0, 4)}, bytes(4)), "dimension"),
        (safetensors({"a": entry("F32", [1], 0, 4), "b": entry("F32", [1], 0, 4)}, bytes(4)), "weights"),
        (safetensors({"a": entry("F8_E4M3", [2], 0, 2)}, bytes(2)), "type F8_E4M3, which is not read"),
        (safetensors({"a": entry("unheard of", [2], 0, 2)}, bytes(2)), "unheard of"),
        (safetensors({"a\nb": entry("F32", [1], 0, 4)}, bytes(4)), "not printable text"),
    ],
)
def test_damaged_and_hostile_safetensors_give_one_sentence(tmp_path, content, message):
    refused = reason(tmp_path / "hostile.safetensors", content)
    assert any(part in refused for part in message.split("|")), refused


# ------------------------------------------------------------------------------------------------------------ all files


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.pth", b"", "not a file of weights"),
        ("text.pth", b"<!doctype html>", "not a file of weights"),
        ("short.pth", (REFERENCE / "weights_legacy.pth").read_bytes()[:-8], "not a file of weights"),
        ("half.pth", (REFERENCE / "weights_zip.pth").read_bytes()[:400], "not a file of weights"),
        ("text.safetensors", b"nothing of the kind", "not a file of weights"),
        ("list.pth", zipped(pickle.dumps([1, 2])), "not a state dict"),
    ],
)
def test_unusable_files_are_described(tmp_path, name, content, message):
    assert message in reason(tmp_path / name, content)


def test_what_is_not_a_file_is_described(tmp_path):
    os.mkfifo(tmp_path / "pipe.pth")
    (tmp_path / "loop.pth").symlink_to("loop.pth")
    for path in (tmp_path, tmp_path / "pipe.pth", tmp_path / "missing.pth", tmp_path / "loop.pth", Path("/dev/zero")):
        with pytest.raises(DataError, match=r"cannot be read \(.*\); name a \.pth or \.safetensors file"):
            read_state_dict(path)
    with pytest.raises(DataError, match="not a file of weights"):
        read_state_dict(Path("nul\0.pth"))


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_a_file_larger_than_any_weights_is_not_read(tmp_path, suffix):
    path = tmp_path / f"sparse{suffix}"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(DataError, match="larger than 1 GB"):
        read_state_dict(path)
