"""Initial weights of a training: from a torchvision file, or from a classifier trained before.

A `.pth` file is a pickle, and unpickling can run any code. The reader here accepts only the few names that a file of weights
needs, runs none of PyTorch's code, and refuses any other name. `.safetensors` files hold nothing but arrays.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import ml_dtypes
import numpy as np
from flax import nnx
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors

from data_pipeline.errors import DataError
from mevs_jax.models import ResNet
from mevs_jax.models.pretrained import resnet_from_torch

_STORAGES = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "BFloat16Storage": ml_dtypes.bfloat16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C


@dataclass(frozen=True)
class StartingWeights:
    """Initial weights of a network.

    Attributes:
        name: identifies the weights; part of the identity of a training run.
        put: writes the weights into a new network.
    """

    name: str
    put: Callable[[nnx.Module], None]


# ---------------------------------------------------------------------------------------------------------- reading files


@dataclass(frozen=True)
class _Storage:
    """A flat array of a file. Its numbers may follow the pickle that refers to it, so tensors are built last."""

    key: str
    dtype: Any


@dataclass(frozen=True)
class _Tensor:
    storage: _Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]

    def array(self, storages: dict[str, np.ndarray]) -> np.ndarray:
        flat = storages[self.storage.key]
        last = self.offset + sum((extent - 1) * step for extent, step in zip(self.size, self.stride, strict=True))
        if 0 in self.size:
            return np.zeros(self.size, flat.dtype)
        if self.offset < 0 or min(self.stride, default=0) < 0 or last >= len(flat):
            raise ValueError("a tensor reaches beyond its storage")
        strides = [step * flat.itemsize for step in self.stride]
        return np.lib.stride_tricks.as_strided(flat[self.offset :], self.size, strides).copy()


def _tensor(storage: _Storage, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *rest: Any) -> _Tensor:
    return _Tensor(storage, int(offset), tuple(size), tuple(stride))


def _parameter(tensor: _Tensor, *rest: Any) -> _Tensor:
    return tensor


class _WeightsUnpickler(pickle.Unpickler):
    """Unpickles ordered dictionaries, tensors and storages, and refuses everything else."""

    _known: ClassVar[dict[tuple[str, str], Any]] = {
        ("collections", "OrderedDict"): OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2"): _tensor,
        ("torch._utils", "_rebuild_parameter"): _parameter,
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in self._known:
            return self._known[module, name]
        if module in ("torch", "torch.storage") and name in _STORAGES:
            return _STORAGES[name]
        raise pickle.UnpicklingError(f"it holds a {module}.{name}, which no file of weights needs")

    def persistent_load(self, pid: Any) -> _Storage:
        kind, dtype, key = pid[:3]
        if kind != "storage" or dtype not in _STORAGES.values():
            raise pickle.UnpicklingError(f"it refers to {kind!r} outside the file")
        return _Storage(str(key), dtype)


def _zip_state(content: bytes) -> tuple[Any, Callable[[_Storage], np.ndarray]]:
    archive = zipfile.ZipFile(io.BytesIO(content))
    names = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    if len(names) != 1:
        raise ValueError("it is a zip, but not of weights")
    root = names[0].removesuffix("data.pkl")
    order = archive.read(f"{root}byteorder").strip() if f"{root}byteorder" in archive.namelist() else b"little"
    if order != b"little":
        raise ValueError("its numbers are big-endian")
    state = _WeightsUnpickler(io.BytesIO(archive.read(names[0]))).load()
    return state, lambda storage: np.frombuffer(archive.read(f"{root}data/{storage.key}"), storage.dtype)


def _legacy_state(file: io.BytesIO) -> tuple[Any, Callable[[_Storage], np.ndarray]]:
    if _WeightsUnpickler(file).load() != _LEGACY_MAGIC:
        raise ValueError("it does not begin as a file of weights does")
    for _ in range(2):  # version, and the writer's machine
        _WeightsUnpickler(file).load()
    state = _WeightsUnpickler(file).load()
    dtypes = {tensor.storage.key: np.dtype(tensor.storage.dtype) for tensor in _flat(state).values()}
    storages = {}
    for key in _WeightsUnpickler(file).load():
        (count,) = struct.unpack("<q", file.read(8))
        dtype = dtypes[key]
        storages[key] = np.frombuffer(file.read(count * dtype.itemsize), dtype)
    return state, lambda storage: storages[storage.key]


def _flat(state: Any) -> dict[str, _Tensor]:
    """Returns the tensors of a state dict by name.

    A `state_dict` entry is unpacked, and the prefix `module.`, which some training scripts add, is removed.
    """
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    if not isinstance(state, dict) or not all(isinstance(value, _Tensor) for value in state.values()):
        raise ValueError("it is not a state dict: a dictionary of tensors by name")
    return {str(name).removeprefix("module."): value for name, value in state.items()}


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of a `.safetensors` or PyTorch file (`.pth`, `.pt`, zip or legacy format) by PyTorch's names.

    Raises:
        DataError: if the file cannot be read, is no state dict, or refers to anything but arrays.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); name a .pth or .safetensors file") from error
    try:
        if path.suffix == ".safetensors":
            return load_safetensors(content)
        if zipfile.is_zipfile(io.BytesIO(content)):
            state, storage_of = _zip_state(content)
        else:
            state, storage_of = _legacy_state(io.BytesIO(content))
        tensors = _flat(state)
        storages = {tensor.storage.key: storage_of(tensor.storage) for tensor in tensors.values()}
        return {name: tensor.array(storages) for name, tensor in tensors.items()}
    except (
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        EOFError,
        struct.error,
        pickle.UnpicklingError,
        zipfile.BadZipFile,
        SafetensorError,
    ) as error:
        raise DataError(
            f"{path} is not a file of weights that can be read safely: {error}; "
            f"save the network's state_dict with torch.save or as .safetensors"
        ) from error


# ------------------------------------------------------------------------------------------------------- starting weights


def resnet_depth(state: dict[str, np.ndarray]) -> int:
    """Returns the depth of a ResNet, 18 or 34, by the blocks of its third stage; 0 for any other network."""
    if "layer1.0.conv3.weight" in state:
        return 0
    return {"1": 18, "5": 34}.get(max((n.split(".")[1] for n in state if n.startswith("layer3.")), default=""), 0)


def weights_from_torch(paths: tuple[Path, ...], depth: int) -> StartingWeights:
    """Returns ImageNet weights of a ResNet, from the first of `paths` that holds one of this depth.

    The head of the network that they are put into keeps its values.

    Raises:
        DataError: if no file holds such a ResNet, or a file cannot be read.
    """
    for path in paths:
        state = read_state_dict(path)
        if resnet_depth(state) == depth:
            break
    else:
        raise DataError(
            f"none of {', '.join(map(str, paths))} holds a ResNet-{depth}; give --pretrained torchvision's resnet{depth} too"
        )

    def put(network: nnx.Module) -> None:
        assert isinstance(network, ResNet)
        try:
            resnet_from_torch(network, state, head=False)
        except ValueError as error:
            raise DataError(f"{path} does not fit the classifier: {error}") from error

    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return StartingWeights(f"{path.name}, sha256 {digest[:16]}", put)


def weights_from_network(trained: nnx.Module, name: str) -> StartingWeights:
    """Returns all weights of a trained network, including its head."""

    def put(network: nnx.Module) -> None:
        nnx.update(network, nnx.state(trained))

    return StartingWeights(name, put)
