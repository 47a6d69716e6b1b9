"""Files of weights written by hand, sound and hostile, byte for byte."""

from __future__ import annotations

import io
import json
import pickle
import struct
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

MAGIC = pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2) + pickle.dumps({"little_endian": True}, 2)


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def number(value: int) -> bytes:
    content = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(content)]) + content


def numbers(values: Sequence[int]) -> bytes:
    return b"(" + b"".join(map(number, values)) + b"t"


def tensor(
    size: Sequence[int] = (2,), stride: Sequence[int] = (1,), offset: int = 0, key: str = "0", kind: str = "Float"
) -> bytes:
    """Returns the instructions that make a tensor."""
    storage = b"(" + text("storage") + f"ctorch\n{kind}Storage\n".encode() + text(key) + text("cpu") + number(2) + b"tQ"
    rest = number(offset) + numbers(size) + numbers(stride) + b"\x89)t"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + rest + b"R"


def state(tensors: Mapping[str, bytes]) -> bytes:
    """Returns the pickle of a state dict from the instructions that make its tensors."""
    return b"\x80\x02}(" + b"".join(text(name) + made for name, made in tensors.items()) + b"u."


def legacy(content: bytes, storages: Mapping[str, bytes] | None = None, width: int = 4) -> bytes:
    """Returns a file of the legacy format with the pickle `content`."""
    storages = {"0": bytes(8)} if storages is None else storages
    follow = b"".join(struct.pack("<q", len(values) // width) + values for values in storages.values())
    return MAGIC + content + pickle.dumps(list(storages), 2) + follow


def zipped(content: bytes, storages: Mapping[str, bytes] | None = None, method: int = zipfile.ZIP_STORED) -> bytes:
    """Returns a file of the zip format with the pickle `content`."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr("archive/data.pkl", content)
        for key, values in ({"0": bytes(8)} if storages is None else storages).items():
            archive.writestr(f"archive/data/{key}", values)
    return buffer.getvalue()


def safetensors(header: Mapping[str, Any] | bytes, content: bytes = b"") -> bytes:
    """Returns a `.safetensors` file with this header."""
    head = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(head)) + head + content


def entry(dtype: str, shape: Sequence[int], begin: int, end: int) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": [begin, end]}


def _shared(depth: int) -> bytes:
    """A tuple of two equal tuples, and so on: its hash, comparison and text take 2**depth steps."""
    return b")" + b"".join(b"q\x00h\x00\x86" for _ in range(depth))


HOSTILE_PICKLES: dict[str, tuple[bytes, str]] = {
    "memo of gigabytes": (b"\x80\x02]r\xff\xff\xff\xff.", "not a state dict"),
    "bytearray of gigabytes": (b"\x80\x05\x96" + struct.pack("<Q", 1 << 34) + b".", "larger than 32 MB|only 1 remain"),
    "bytes of gigabytes": (b"\x80\x03B\xff\xff\xff\xff.", "larger than 32 MB|only 1 remain"),
    "bytes": (b"\x80\x03C\x01a.", "instruction SHORT_BINBYTES"),
    "text of gigabytes": (b"\x80\x02X\xff\xff\xff\xffabc.", "larger than 32 MB|only 4 remain"),
    "frame of gigabytes": (b"\x80\x04\x95" + b"\xff" * 8 + b"].", "not a state dict"),
    "key that takes ages": (b"\x80\x02}" + _shared(60) + b"K\x01s.", "keys are not names"),
    "kind that takes ages": (b"\x80\x02(" + _shared(60) + b"NNNNtQ.", "outside the file"),
    "name that takes ages": (b"\x80\x04" + _shared(60) + text("x") + b"\x93.", "not a name"),
    "deep lists": (b"\x80\x02" + b"]" * 120_000 + b"a" * 119_999 + b".", "not a state dict"),
    "deep tuples": (b"\x80\x02)" + b"\x85" * 240_000 + b".", "not a state dict"),
    "marks without an end": (b"\x80\x02" + b"(" * 250_001 + b".", "more than 250000 instructions"),
    "many dictionaries": (b"\x80\x02" + b"}" * 250_001 + b".", "more than 250000 instructions"),
    "pairs again and again": (
        b"\x80\x02]("
        + b"X\x01\0\0\0aN\x86" * 2000
        + b"e\x85q\x00"
        + b"ccollections\nOrderedDict\nh\x00R" * 2000
        + b".",
        "more than 250000 instructions",
    ),
    "list in itself": (b"\x80\x02]q\x00h\x00a.", "not a state dict"),
    "attributes of a tensor": (b"\x80\x02" + tensor() + b"}" + text("size") + b"Nsb.", "not a dictionary"),
    "attributes of a class": (b"\x80\x02ctorch\nFloatStorage\n}b.", "not a dictionary"),
    "call of a type": (b"\x80\x02ctorch\nFloatStorage\nK\x7f\x85R.", "not a function"),
    "call of nothing": (b"\x80\x02NNR.", "not a function"),
    "long name": (b"\x80\x02c" + b"x" * 100_000 + b"\ny\n.", "no newline|not a name"),
    "name of two lines": (b"\x80\x04" + text("a\nb") + text("c") + b"\x93.", "not a name"),
    "empty stack": (b"\x80\x02.", "pickle is damaged"),
    "no memo": (b"\x80\x02h\x07.", "pickle is damaged"),
    "not enough for a tuple": (b"\x80\x02\x87.", "pickle is damaged"),
    "other protocol": (b"I1\n.", "instruction"),
    "number as name": (b"\x80\x02}K\x01" + tensor() + b"s.", "not printable text"),
    "line in a name": (state({"a\nb": tensor()}), "not printable text"),
    "very long tensor name": (state({"a" * 300: tensor()}), "not printable text"),
    "shared numbers": (state({str(n): tensor((1 << 16,), (0,)) for n in range(8)}), "4 times as large"),
    "one number a petabyte": (state({"a": tensor((1 << 20,) * 3, (0, 0, 0))}), "4 times as large"),
    "sizes that overflow": (state({"a": tensor((1 << 62,) * 8, (1 << 62,) * 8)}), "4 times as large"),
    "nothing of absurd size": (state({"a": tensor((0, 1 << 62, 1 << 62), (1, 1, 1))}), "array|dimension"),
    "negative size": (state({"a": tensor((-1,), (1,))}), "not usable"),
    "negative stride": (state({"a": tensor((2,), (-1,))}), "not usable"),
    "negative offset": (state({"a": tensor(offset=-1)}), "not usable"),
    "offset beyond": (state({"a": tensor(offset=1)}), "beyond its storage"),
    "offset of 2**200": (state({"a": tensor(offset=1 << 200)}), "not usable"),
    "sizes without strides": (state({"a": tensor((1, 1), (1,))}), "not usable"),
    "many axes": (state({"a": tensor((1,) * 9, (1,) * 9)}), "not usable"),
    "storage of two types": (state({"a": tensor(), "b": tensor(kind="Half")}), "of two types"),
    "storage that is lacking": (state({"a": tensor(), "b": tensor(key="1")}), "lacks the numbers|has no data/1"),
    "storage of another kind": (
        state({"a": tensor(kind="QInt8")}),
        "torch.QInt8Storage, which no file of weights needs",
    ),
}
"""Pickles that take a naive reader gigabytes, ages or its life, or make no sense, each with what is said about them."""
