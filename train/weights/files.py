"""Files of weights: PyTorch's `.pth` (zip and legacy format) and `.safetensors`, read without PyTorch.

A file may be damaged or hostile. No code of it runs, and reading takes memory in proportion to its size at most.
"""

from __future__ import annotations

import io
import stat
import struct
import zipfile
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
from safetensors import deserialize

from data_pipeline.errors import DataError, reason_of
from mevs_jax.meshes.reading import shown
from train.weights.pickle_format import LONGEST_NAME, MOST_BYTES, BoundedReader, Tensor, WeightsUnpickler

LARGEST_FILE = 1 << 30
"""Largest size of a file of weights in bytes."""
LARGEST_DIRECTORY = 4 << 20
"""Largest size in bytes of the list of contents, of a zip or a `.safetensors` file."""
MOST_TIMES = 4
"""Largest size of a zip's members, and of all arrays, as a multiple of the file's: tensors may share numbers."""
_MARGIN = 1 << 20

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001
_SAFETENSORS_DTYPES = {
    "F64": np.float64,
    "F32": np.float32,
    "F16": np.float16,
    "BF16": ml_dtypes.bfloat16,
    "I64": np.int64,
    "I32": np.int32,
    "I16": np.int16,
    "I8": np.int8,
    "U64": np.uint64,
    "U32": np.uint32,
    "U16": np.uint16,
    "U8": np.uint8,
    "BOOL": np.bool_,
}


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of a `.safetensors` or PyTorch file (`.pth`, `.pt`, zip or legacy format) by PyTorch's names.

    Raises:
        DataError: if the file cannot be read, is no state dict, or refers to anything but arrays.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{path} cannot be read (it is not a file); name a .pth or .safetensors file")
        with path.open("rb") as file:
            return _read(file, status.st_size, path.suffix == ".safetensors")
    except DataError:
        raise
    except OSError as error:
        reason = error.strerror or reason_of(error)
        raise DataError(f"{path} cannot be read ({reason}); name a .pth or .safetensors file") from error
    except Exception as error:  # damaged files raise errors of zipfile, zlib, struct, safetensors, NumPy and others
        raise DataError(
            f"{path} is not a file of weights that can be read safely: {shown(reason_of(error))[:400].rstrip('.')}; "
            f"save the network's state_dict with torch.save or as .safetensors"
        ) from error


def _read(file: io.BufferedReader, size: int, safetensors: bool) -> dict[str, np.ndarray]:
    if size > LARGEST_FILE:
        raise ValueError(f"it is larger than {LARGEST_FILE >> 30} GB")
    if safetensors:
        return _safetensors(file, size)
    head = file.read(4)
    file.seek(0)
    tensors, storages = (_zip_state if head == b"PK\x03\x04" else _legacy_state)(file, size)
    if sum(tensor.nbytes for tensor in tensors.values()) > MOST_TIMES * size + _MARGIN:
        raise ValueError(f"its tensors are together more than {MOST_TIMES} times as large as the file")
    return {name: tensor.array(storages[tensor.storage.key]) for name, tensor in tensors.items()}


def _tensors(state: Any) -> dict[str, Tensor]:
    """Returns the tensors of a state dict by name.

    A `state_dict` entry is unpacked, and the prefix `module.`, which some training scripts add, is removed.
    """
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError("it is not a state dict: a dictionary of tensors by name")
    return {_checked(name).removeprefix("module."): value for name, value in state.items()}


def _checked(name: Any) -> str:
    if type(name) is not str or len(name) > LONGEST_NAME or not name.isprintable():
        raise ValueError("it has a tensor whose name is not printable text")
    return name


# -------------------------------------------------------------------------------------------------------------- PyTorch


def _zip_state(file: io.BufferedReader, size: int) -> tuple[dict[str, Tensor], dict[str, bytes]]:
    bounded = BoundedReader(file, LARGEST_DIRECTORY)
    with zipfile.ZipFile(bounded) as archive:  # it reads a list of contents of any size at once
        bounded.bound = None
        members = {info.filename: info for info in archive.infolist()}
        if sum(info.file_size for info in members.values()) > MOST_TIMES * size + _MARGIN:
            raise ValueError(f"it unpacks to more than {MOST_TIMES} times its size")
        pickles = [name for name in members if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError("it is a zip, but not of weights")
        root = pickles[0].removesuffix("data.pkl")

        def member(name: str, largest: int) -> bytes:
            info = members.get(f"{root}{name}")
            if info is None:
                raise ValueError(f"it has no {name}")
            if info.flag_bits & 1:
                raise ValueError("it is encrypted")
            # As in PyTorch. The decompressors of other methods give any amount of bytes at once.
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"it is compressed with method {info.compress_type}, which PyTorch does not write")
            if info.file_size > largest or info.compress_size > size:
                raise ValueError(f"its {name} is too large")
            with archive.open(info) as packed:
                content = packed.read(info.file_size + 1)  # without a size, it would decompress to any
            if len(content) < info.file_size:
                raise ValueError(f"its {name} ends early")
            return content

        order = member("byteorder", 64).strip() if f"{root}byteorder" in members else b"little"
        if order != b"little":
            raise ValueError("its numbers are big-endian")
        tensors = _tensors(WeightsUnpickler(io.BytesIO(member("data.pkl", MOST_BYTES))).load())
        used = {tensor.storage.key for tensor in tensors.values()}
        return tensors, {key: member(f"data/{key}", MOST_TIMES * LARGEST_FILE) for key in used}


def _legacy_state(file: io.BufferedReader, size: int) -> tuple[dict[str, Tensor], dict[str, bytes]]:
    bounded = BoundedReader(file, MOST_BYTES)
    unpickler = WeightsUnpickler(bounded)
    if unpickler.load() != _LEGACY_MAGIC or unpickler.load() != _LEGACY_VERSION:
        raise ValueError("it does not begin as a file of weights does")
    unpickler.load()  # the writer's machine
    tensors = _tensors(unpickler.load())
    used = {tensor.storage.key for tensor in tensors.values()}
    keys = unpickler.load()
    if type(keys) is not list or not all(type(key) is str and key in unpickler.storages for key in keys):
        raise ValueError("its list of storages has others than its tensors refer to")
    bounded.bound, storages = None, {}
    for key in keys:
        (count,) = struct.unpack("<q", bounded.read(8))
        nbytes = count * unpickler.storages[key].itemsize
        if not 0 <= nbytes <= size - bounded.tell():
            raise ValueError(f"it ends within a storage of {count} numbers")
        if key not in used:  # of an optimiser, beside the state dict
            bounded.seek(nbytes, io.SEEK_CUR)
        elif key in storages:
            raise ValueError("it has two storages of one key")
        else:
            storages[key] = bounded.read(nbytes)
    if used - storages.keys():
        raise ValueError("it lacks the numbers of a tensor")
    return tensors, storages


# ---------------------------------------------------------------------------------------------------------- safetensors


def _safetensors(file: io.BufferedReader, size: int) -> dict[str, np.ndarray]:
    head = file.read(8)
    length = int.from_bytes(head, "little")
    if length > min(LARGEST_DIRECTORY, size):
        raise ValueError(f"its header of {length} bytes is longer than the file or than {LARGEST_DIRECTORY >> 20} MB")
    arrays = {}
    file.seek(0)
    for name, tensor in deserialize(file.read()):
        if tensor["dtype"] not in _SAFETENSORS_DTYPES:
            raise ValueError(f"it has a tensor of the type {tensor['dtype']}, which is not read")
        flat = np.frombuffer(tensor["data"], _SAFETENSORS_DTYPES[tensor["dtype"]])
        arrays[_checked(name)] = flat.reshape(tensor["shape"])
    return arrays
