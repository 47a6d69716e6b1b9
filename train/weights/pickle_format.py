"""The part of the pickle format that PyTorch's files of weights use.

Unpickling as Python does it can run any code, and a short pickle can take gigabytes or hours. The reader here takes the
instructions apart with `pickletools`, which executes nothing. It knows only those of a state dict, makes only plain values and
descriptions of tensors, and bounds what a pickle may take.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Iterable
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


class BoundedReader(io.BufferedReader):
    """A file of which one call reads at most `bound` bytes: standard libraries reserve memory for any size that a file names.

    Attributes:
        bound: None removes the bound.
    """

    bound: int | None

    def __init__(self, file: io.BufferedReader, bound: int) -> None:
        super().__init__(io.FileIO(file.fileno(), closefd=False))
        self.seek(0)
        self.bound = bound

    def read(self, size: int | None = -1, /) -> bytes:
        if self.bound is None:
            return super().read(size)
        count = self.bound if size is None or size < 0 else size
        if count > self.bound:
            raise ValueError(f"it has a part that is larger than {self.bound >> 20} MB")
        return super().read(count)

    def readline(self, size: int | None = -1, /) -> bytes:
        return super().readline(LONGEST_NAME + 1)


_VALUES = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}


@no_type_check  # several calls an instruction: the tests' type checks take a hundred times as long as the calls
class WeightsUnpickler:
    """Reads pickles of plain values and tensors, one after another, from a file.

    Attributes:
        storages: the types of the storages that the pickles refer to, by key.
    """

    def __init__(self, file: io.BytesIO | BoundedReader):
        self.storages: dict[str, np.dtype] = {}
        self._file = file
        self._left = 0
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def load(self) -> Any:
        """Returns the value of the next pickle.

        Raises:
            ValueError: if it is damaged, too large, or contains what no state dict needs.
        """
        self._stack, self._marks, self._memo, self._left = [], [], {}, MOST_INSTRUCTIONS
        end = self._file.tell() + MOST_BYTES
        try:
            for instruction, argument, place in pickletools.genops(self._file):
                if place is not None and place > end:
                    raise ValueError(f"its pickle is larger than {MOST_BYTES >> 20} MB")
                if instruction.name == "STOP":
                    break
                self._spend(1)
                self._follow(instruction.name, argument)
            return self._stack.pop()
        except (IndexError, KeyError) as error:  # of the stack, the marks or the memo
            raise ValueError("its pickle is damaged") from error

    def _spend(self, instructions: int) -> None:
        self._left -= instructions
        if self._left < 0:
            raise ValueError(f"its pickle has more than {MOST_INSTRUCTIONS} instructions")

    def _follow(self, name: str, argument: Any) -> None:
        stack = self._stack
        match name:
            case "PROTO" | "FRAME":
                pass  # nothing depends on them
            case "NONE" | "NEWTRUE" | "NEWFALSE" | "EMPTY_TUPLE":
                stack.append(_VALUES[name])
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "BINUNICODE" | "SHORT_BINUNICODE":
                stack.append(argument)
            case "BINSTRING" | "SHORT_BINSTRING":  # of Python 2
                stack.append(argument)
            case "MARK":
                self._marks.append(len(stack))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(self._last(int(name[-1]))))
            case "TUPLE":
                stack.append(tuple(self._since_mark()))
            case "EMPTY_LIST":
                stack.append([])
            case "APPEND":
                self._extend(self._last(1))
            case "APPENDS":
                self._extend(self._since_mark())
            case "EMPTY_DICT":
                stack.append({})
            case "SETITEM":
                self._set(self._last(2))
            case "SETITEMS":
                self._set(self._since_mark())
            case "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = stack[-1]
            case "MEMOIZE":
                self._memo[len(self._memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(self._memo[argument])
            case "GLOBAL":
                stack.append(_named(*argument.split(" ", 1)))
            case "STACK_GLOBAL":
                stack.append(_named(*self._last(2)))
            case "REDUCE":
                stack.append(self._called(*self._last(2)))
            case "BUILD":  # drops the attributes of a dictionary: PyTorch's `_metadata`, the versions of its layers
                stack.pop()
                if type(stack[-1]) is not dict:
                    raise ValueError("its pickle sets attributes of what is not a dictionary")
            case "BINPERSID":
                stack.append(self._storage(stack.pop()))
            case _:
                raise ValueError(f"its pickle has the instruction {name}, which no file of weights needs")

    def _last(self, count: int) -> list[Any]:
        """Takes so many values from the stack."""
        if len(self._stack) < count:
            raise IndexError
        items = self._stack[-count:]
        del self._stack[-count:]
        return items

    def _since_mark(self) -> list[Any]:
        at = self._marks.pop()
        items = self._stack[at:]
        del self._stack[at:]
        return items

    def _extend(self, items: list[Any]) -> None:
        if type(self._stack[-1]) is not list:
            raise ValueError("its pickle appends to what is not a list")
        self._stack[-1] += items

    def _set(self, items: list[Any]) -> None:
        values = self._stack[-1]
        if type(values) is not dict or len(items) % 2:
            raise ValueError("its pickle sets entries of what is not a dictionary")
        values |= _entries(zip(items[::2], items[1::2], strict=True))

    def _called(self, function: Any, arguments: Any) -> Any:
        if not isinstance(function, _Function) or type(arguments) is not tuple:
            raise ValueError("its pickle calls what is not a function")
        if function is _Function.ORDERED_DICT:
            # Without an argument; or, as Python 2 wrote them, with a list of pairs.
            pairs = arguments[0] if len(arguments) == 1 else list(arguments)
            self._spend(len(pairs) if type(pairs) is list else 0)
            if type(pairs) is not list or not all(type(pair) in (list, tuple) and len(pair) == 2 for pair in pairs):
                raise ValueError("its pickle makes a dictionary from what is not a list of pairs")
            return _entries(pairs)
        if function is _Function.TENSOR and len(arguments) >= 4:
            return _tensor(*arguments[:4])
        if function is _Function.PARAMETER and arguments and isinstance(arguments[0], Tensor):
            return arguments[0]
        raise ValueError("its pickle calls a function with arguments that it does not take")

    def _storage(self, pid: Any) -> Storage:
        """Returns the storage that a persistent id describes: kind, type, key, device, count, view of another storage."""
        if type(pid) is not tuple or len(pid) not in (5, 6) or type(pid[0]) is not str:
            raise ValueError("it refers to something outside the file")
        kind, dtype, key = pid[:3]
        if kind != "storage":
            raise ValueError(f"it refers to {kind[:LONGEST_NAME]!r} outside the file")
        if not isinstance(dtype, np.dtype) or type(key) is not str or len(key) > LONGEST_NAME:
            raise ValueError("it refers to a storage without a type or a key")
        if pid[5:] not in ((), (None,)):
            raise ValueError("it has a storage that is a part of another, as no PyTorch since 0.4 writes it")
        if self.storages.setdefault(key, dtype) != dtype:
            raise ValueError("it has a storage of two types")
        return Storage(key, dtype)


def _named(module: Any, name: Any) -> np.dtype | _Function:
    """Returns what a pickle refers to by the name of a class or function."""
    texts = type(module) is str and type(name) is str and module.isprintable() and name.isprintable()
    if not texts or len(module) + len(name) > LONGEST_NAME:
        raise ValueError("its pickle names a class by what is not a name")
    if module in ("torch", "torch.storage") and name in DTYPES:
        return DTYPES[name]
    try:
        return _Function((module, name))
    except ValueError:
        raise ValueError(f"it holds a {module}.{name}, which no file of weights needs") from None


def _entries(pairs: Iterable[Any]) -> dict[str | int, Any]:
    entries = {}
    for key, value in pairs:
        # Other keys could take any time to compare; optimisers count their parameters.
        if type(key) is not str and not (type(key) is int and 0 <= key < 1 << 31):
            raise ValueError("its pickle has a dictionary whose keys are not names")
        entries[key] = value
    return entries


def _tensor(storage: Any, offset: Any, size: Any, stride: Any) -> Tensor:
    sound = isinstance(storage, Storage) and _are_counts((offset,)) and _are_counts(size) and _are_counts(stride)
    if not sound or len(size) != len(stride):
        raise ValueError("it describes a tensor whose offset, size or strides are not usable")
    return Tensor(storage, offset, size, stride)


def _are_counts(values: Any) -> bool:
    return (
        type(values) is tuple
        and len(values) <= MOST_AXES
        and all(type(value) is int and 0 <= value < 1 << 63 for value in values)
    )
