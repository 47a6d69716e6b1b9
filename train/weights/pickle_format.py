"""The part of the pickle format that PyTorch's files of weights use.

Unpickling as Python does it can run any code, and a short pickle can take gigabytes or hours. The reader here knows only the
instructions of a state dict, makes only plain values and descriptions of tensors, and bounds what a pickle may take.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import prod
from typing import Any, no_type_check

import ml_dtypes
import numpy as np

MOST_INSTRUCTIONS = 250_000
"""Largest number of instructions in a pickle. A state dict has about 35 for each tensor."""
MOST_BYTES = 32 << 20
"""Largest size of a pickle in bytes, without the numbers of the tensors."""
MOST_AXES = 8
"""Largest number of axes of a tensor."""
LONGEST_NAME = 256
"""Largest number of characters in the name of a class or function."""

DTYPES = {
    "DoubleStorage": np.dtype(np.float64),
    "FloatStorage": np.dtype(np.float32),
    "HalfStorage": np.dtype(np.float16),
    "BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
    "LongStorage": np.dtype(np.int64),
    "IntStorage": np.dtype(np.int32),
    "ShortStorage": np.dtype(np.int16),
    "CharStorage": np.dtype(np.int8),
    "ByteStorage": np.dtype(np.uint8),
    "BoolStorage": np.dtype(np.bool_),
}
"""Types of numbers by PyTorch's names of their storages."""


@dataclass(frozen=True)
class Storage:
    """A flat array of a file. Its numbers may follow the pickle that refers to it."""

    key: str
    dtype: np.dtype


@dataclass(frozen=True)
class Tensor:
    """A view of a storage. Offset and strides are in numbers, not in bytes."""

    storage: Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]

    @property
    def nbytes(self) -> int:
        return prod(self.size) * self.storage.dtype.itemsize

    def array(self, content: bytes) -> np.ndarray:
        """Returns a copy of the view of the storage's numbers.

        Raises:
            ValueError: if the tensor reaches beyond them, or NumPy has no array of its shape.
        """
        dtype = self.storage.dtype
        if 0 in self.size:
            return np.zeros(self.size, dtype)
        last = self.offset + sum((extent - 1) * step for extent, step in zip(self.size, self.stride, strict=True))
        if last >= len(content) // dtype.itemsize:
            raise ValueError("a tensor reaches beyond its storage")
        # The stride of an axis of one number has no meaning, and may be too large for NumPy.
        steps = [step * (extent > 1) * dtype.itemsize for extent, step in zip(self.size, self.stride, strict=True)]
        return np.ndarray(self.size, dtype, content, self.offset * dtype.itemsize, steps).copy()


class _Function(Enum):
    """What a pickle may call."""

    ORDERED_DICT = ("collections", "OrderedDict")
    TENSOR = ("torch._utils", "_rebuild_tensor_v2")
    PARAMETER = ("torch._utils", "_rebuild_parameter")


@dataclass(frozen=True)
class _StorageType:
    dtype: np.dtype


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 63


def _are_counts(values: Any) -> bool:
    return type(values) is tuple and len(values) <= MOST_AXES and all(map(_is_count, values))


def _tensor(arguments: tuple[Any, ...]) -> Tensor:
    storage, offset, size, stride = arguments[:4]
    sound = isinstance(storage, Storage) and _is_count(offset) and _are_counts(size) and _are_counts(stride)
    if not sound or len(size) != len(stride):
        raise ValueError("it describes a tensor whose offset, size or strides are not usable")
    return Tensor(storage, offset, size, stride)


def _parameter(arguments: tuple[Any, ...]) -> Tensor:
    if not isinstance(arguments[0], Tensor):
        raise ValueError("it describes a parameter that is not a tensor")
    return arguments[0]


@no_type_check  # several calls an instruction: the tests' type checks take a hundred times as long as the calls
class WeightsUnpickler:
    """Reads pickles of plain values and tensors, one after another, from a file.

    Attributes:
        storages: the types of the storages that the pickles refer to, by key.
    """

    def __init__(self, file: io.BufferedIOBase):
        self.storages: dict[str, np.dtype] = {}
        self._file = file
        self._left = 0
        self._bytes_left = 0
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def load(self) -> Any:
        """Returns the value of the next pickle.

        Raises:
            ValueError: if it is damaged, too large, or contains what no state dict needs.
        """
        self._stack, self._marks, self._memo = [], [], {}
        self._left, self._bytes_left = MOST_INSTRUCTIONS, MOST_BYTES
        try:
            while (code := self._read(1)) != b".":
                self._spend(1)
                if code not in _INSTRUCTIONS:
                    raise ValueError(f"its pickle has the instruction {code!r}, which no file of weights needs")
                _INSTRUCTIONS[code](self)
            return self._stack.pop()
        except (IndexError, KeyError) as error:  # of the stack, the marks or the memo
            raise ValueError("its pickle is damaged") from error

    def _spend(self, instructions: int) -> None:
        self._left -= instructions
        if self._left < 0:
            raise ValueError(f"its pickle has more than {MOST_INSTRUCTIONS} instructions")

    # ---------------------------------------------------------------------------------------------------- bytes

    def _read(self, size: int) -> bytes:
        self._bytes_left -= size
        if self._bytes_left < 0:
            raise ValueError(f"its pickle is larger than {MOST_BYTES >> 20} MB")
        content = self._file.read(size)
        if len(content) < size:
            raise ValueError("its pickle ends early")
        return content

    def _number(self, layout: str) -> Any:
        return struct.unpack(layout, self._read(struct.calcsize(layout)))[0]

    def _line(self) -> str:
        line = self._file.readline(LONGEST_NAME + 1)
        self._bytes_left -= len(line)
        if not line.endswith(b"\n"):
            raise ValueError("its pickle has a name without an end")
        return line[:-1].decode()

    def _text(self, layout: str, encoding: str = "utf-8") -> None:
        self._stack.append(self._read(self._number(layout)).decode(encoding))

    # ---------------------------------------------------------------------------------------------------- values

    def _put(self, value: Any) -> None:
        self._stack.append(value)

    def _since_mark(self) -> list[Any]:
        at = self._marks.pop()
        items = self._stack[at:]
        del self._stack[at:]
        return items

    def _tuple(self, count: int) -> None:
        if len(self._stack) < count:
            raise IndexError
        items = tuple(self._stack[-count:])
        del self._stack[-count:]
        self._stack.append(items)

    def _extend(self, items: list[Any]) -> None:
        values = self._stack[-1]
        if type(values) is not list:
            raise ValueError("its pickle appends to what is not a list")
        values += items

    def _set(self, items: list[Any]) -> None:
        values = self._stack[-1]
        if type(values) is not dict or len(items) % 2:
            raise ValueError("its pickle sets entries of what is not a dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            # Other keys could take any time to compare; optimisers count their parameters.
            if type(key) is not str and not (type(key) is int and 0 <= key < 1 << 31):
                raise ValueError("its pickle has a dictionary whose keys are not names")
            values[key] = value

    def _one_item(self) -> None:
        value = self._stack.pop()
        key = self._stack.pop()
        self._set([key, value])

    def _appended(self) -> None:
        value = self._stack.pop()
        self._extend([value])

    def _remember(self, index: int) -> None:
        self._memo[index] = self._stack[-1]

    # ---------------------------------------------------------------------------------------------------- names

    def _name(self, module: Any, name: Any) -> None:
        texts = type(module) is str and type(name) is str and module.isprintable() and name.isprintable()
        if not texts or len(module) + len(name) > LONGEST_NAME:
            raise ValueError("its pickle names a class by what is not a name")
        if module in ("torch", "torch.storage") and name in DTYPES:
            self._stack.append(_StorageType(DTYPES[name]))
            return
        try:
            self._stack.append(_Function((module, name)))
        except ValueError:
            raise ValueError(f"it holds a {module}.{name}, which no file of weights needs") from None

    def _stacked_name(self) -> None:
        name = self._stack.pop()
        module = self._stack.pop()
        self._name(module, name)

    def _call(self) -> None:
        arguments, function = self._stack.pop(), self._stack.pop()
        if not isinstance(function, _Function) or type(arguments) is not tuple:
            raise ValueError("its pickle calls what is not a function")
        if function is _Function.ORDERED_DICT:
            self._stack.append({})
            for pair in self._pairs(arguments):
                self._set(list(pair))
        elif function is _Function.TENSOR and len(arguments) >= 4:
            self._stack.append(_tensor(arguments))
        elif function is _Function.PARAMETER and arguments:
            self._stack.append(_parameter(arguments))
        else:
            raise ValueError("its pickle calls a function with too few arguments")

    def _pairs(self, arguments: tuple[Any, ...]) -> list[Any]:
        """Returns the entries of an ordered dictionary: none, or, as Python 2 wrote them, a list of pairs."""
        if not arguments:
            return []
        pairs = arguments[0]
        if len(arguments) > 1 or type(pairs) is not list:
            raise ValueError("its pickle makes a dictionary from what is not a list of pairs")
        self._spend(len(pairs))
        if not all(type(pair) in (list, tuple) and len(pair) == 2 for pair in pairs):
            raise ValueError("its pickle makes a dictionary from what is not a list of pairs")
        return pairs

    def _build(self) -> None:
        """Drops the attributes of a dictionary: PyTorch's `_metadata`, the versions of its layers."""
        self._stack.pop()
        if type(self._stack[-1]) is not dict:
            raise ValueError("its pickle sets attributes of what is not a dictionary")

    def _storage(self) -> None:
        """Puts the storage that a persistent id describes: kind, type, key, device, count, view of another storage."""
        pid = self._stack.pop()
        if type(pid) is not tuple or len(pid) not in (5, 6) or type(pid[0]) is not str:
            raise ValueError("it refers to something outside the file")
        kind, dtype, key = pid[:3]
        if kind != "storage":
            raise ValueError(f"it refers to {kind[:LONGEST_NAME]!r} outside the file")
        if not isinstance(dtype, _StorageType) or type(key) is not str or len(key) > LONGEST_NAME:
            raise ValueError("it refers to a storage without a type or a key")
        if pid[5:] not in ((), (None,)):
            raise ValueError("it has a storage that is a part of another, as no PyTorch since 0.4 writes it")
        if self.storages.setdefault(key, dtype.dtype) != dtype.dtype:
            raise ValueError("it has a storage of two types")
        self._stack.append(Storage(key, dtype.dtype))


_INSTRUCTIONS: dict[bytes, Callable[[WeightsUnpickler], Any]] = {
    b"\x80": lambda self: self._read(1),  # the protocol, of which nothing depends
    b"\x95": lambda self: self._read(8),  # the length of a frame
    b"(": lambda self: self._marks.append(len(self._stack)),
    b"N": lambda self: self._put(None),
    b"\x88": lambda self: self._put(True),
    b"\x89": lambda self: self._put(False),
    b"J": lambda self: self._put(self._number("<i")),
    b"K": lambda self: self._put(self._number("<B")),
    b"M": lambda self: self._put(self._number("<H")),
    b"\x8a": lambda self: self._put(int.from_bytes(self._read(self._number("<B")), "little", signed=True)),
    b"G": lambda self: self._put(self._number(">d")),
    b"X": lambda self: self._text("<I"),
    b"\x8c": lambda self: self._text("<B"),
    b"T": lambda self: self._text("<I", "ascii"),  # of Python 2
    b"U": lambda self: self._text("<B", "ascii"),
    b")": lambda self: self._put(()),
    b"\x85": lambda self: self._tuple(1),
    b"\x86": lambda self: self._tuple(2),
    b"\x87": lambda self: self._tuple(3),
    b"t": lambda self: self._put(tuple(self._since_mark())),
    b"]": lambda self: self._put([]),
    b"a": lambda self: self._appended(),
    b"e": lambda self: self._extend(self._since_mark()),
    b"}": lambda self: self._put({}),
    b"s": lambda self: self._one_item(),
    b"u": lambda self: self._set(self._since_mark()),
    b"q": lambda self: self._remember(self._number("<B")),
    b"r": lambda self: self._remember(self._number("<I")),
    b"\x94": lambda self: self._remember(len(self._memo)),
    b"h": lambda self: self._put(self._memo[self._number("<B")]),
    b"j": lambda self: self._put(self._memo[self._number("<I")]),
    b"c": lambda self: self._name(self._line(), self._line()),
    b"\x93": lambda self: self._stacked_name(),
    b"R": lambda self: self._call(),
    b"b": lambda self: self._build(),
    b"Q": lambda self: self._storage(),
}
"""What each instruction does, by its byte."""
