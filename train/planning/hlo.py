"""What the text of a compiled program says: what it sends, calls and repeats."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

_INSTRUCTION = re.compile(
    r"^\s*(?:ROOT )?%?([\w.\-]+) = (\((?:[^()]|\((?:[^()]|\([^()]*\))*\))*\)|\S+) ([\w\-]+)\((.*?)\)(?:, |$)"
)
_SHAPE = re.compile(r"\b(pred|[sufc]\d+|bf16|f8\w*)\[([\d,]*)\](?:\{([\d,]*)(?::([^}]*))?\})?")
_COLLECTIVES = ("all-reduce", "all-gather", "reduce-scatter", "all-to-all", "collective-permute")
_OF_THE_HOST = ("infeed", "outfeed", "send", "recv")
_COUNTERS = {"parameter", "get-tuple-element", "constant", "compare", "copy", "bitcast", "fusion"}
"""What the condition of a loop of known length consists of."""
_NOTHING = {
    "parameter",
    "constant",
    "bitcast",
    "tuple",
    "get-tuple-element",
    "while",
    "call",
    "conditional",
    "after-all",
}
"""Operations for which nothing is started, or what they call."""
_SLICES = {"slice", "dynamic-slice", "gather"}


class Instruction(NamedTuple):
    """A line of a program: its result's type, operation and operands, by name, and the whole line."""

    shape: str
    operation: str
    operands: list[str]
    line: str


@dataclass(frozen=True)
class Collective:
    """Operations of one kind between devices: how many, and the bytes of their results on one device."""

    count: int
    bytes: int


@dataclass(frozen=True)
class Contents:
    """What a compiled program contains. The body of a loop counts once.

    Attributes:
        collectives: by kind.
        custom_calls: numbers of kernels and library calls, by target.
        kernels: number of operations that are started one after the other: fused ones, kernels, library calls and copies.
        traffic_bytes: that these read from the device's memory and write to it, as arrays lie there. What a TPU holds in its
            vector memory does not count.
        loops: number of loops.
        open_loops: of these, those whose length depends on values.
        host_transfers: number of transfers from and to the host.
    """

    collectives: dict[str, Collective]
    custom_calls: dict[str, int]
    kernels: int
    traffic_bytes: int
    loops: int
    open_loops: int
    host_transfers: int

    @classmethod
    def of(cls, text: str) -> Contents:
        """Returns the contents of a program from `compiled.as_text()`."""
        computations = _computations(text)
        counts, bytes_of, loops = Counter[str](), Counter[str](), []
        for instruction in (one for lines in computations.values() for one in lines.values()):
            name = instruction.operation
            if (ended := name.removesuffix("-done")) in _COLLECTIVES:  # it has begun elsewhere
                name = ended
            if name in ("send", "recv") and "is_host_transfer=true" not in instruction.line:  # to another device
                continue
            counts[name] += 1
            bytes_of[name] += bytes_of_shape(instruction.shape)
            if name == "while":
                loops.append(instruction.line)
        targets = Counter(re.findall(r'custom_call_target="([^"]+)"', text))
        started: list[int] = [
            _traffic_of(one, computations[name], computations)
            for name in _scheduled(text, computations)
            for one in computations[name].values()
            if _is_started(one)
        ]
        return cls(
            collectives={name: Collective(counts[name], bytes_of[name]) for name in _COLLECTIVES if counts[name]},
            custom_calls=dict(sorted(targets.items())),
            kernels=len(started),
            traffic_bytes=sum(started),
            loops=len(loops),
            open_loops=sum(not _is_counted(line, computations) for line in loops),
            host_transfers=sum(counts[name] for name in _OF_THE_HOST)
            + sum(count for target, count in targets.items() if "callback" in target),
        )


def bytes_of_shape(shape: str, *, in_memory: bool = False) -> int:
    """Returns the bytes of an array or a tuple of arrays, from its type in HLO, such as `(f32[8,3]{1,0}, s32[])`.

    Args:
        shape: the type.
        in_memory: count what lies in the device's memory alone, with what a TPU adds to fill its tiles.
    """
    return sum(_bytes_of_array(array, in_memory) for array in _SHAPE.findall(shape))


def _bytes_of_array(array: tuple[str, str, str, str], in_memory: bool) -> int:
    kind, extents, order, placed = array
    size = [int(extent) for extent in extents.split(",") if extent]
    if in_memory and "S(" in placed:
        return 0
    if in_memory and (tile := re.match(r"T\(([\d,]+)\)", placed)) and order:
        for axis, edge in zip(order.split(","), reversed(tile[1].split(",")), strict=False):
            size[int(axis)] += -size[int(axis)] % int(edge)
    bits = 8 if kind == "pred" or kind.startswith("f8") else int(re.sub(r"\D", "", kind))
    return math.prod(size) * bits // 8


_Computations = dict[str, dict[str, Instruction]]
"""The instructions of each computation of a program, both by name."""


def _computations(text: str) -> _Computations:
    found: _Computations = {}
    name = ""
    for line in text.splitlines():
        if line.endswith("{") and (begins := re.match(r"(?:ENTRY )?%?([\w.\-]+) ", line)):
            name = begins[1]
            found[name] = {}
        elif name and (read := _INSTRUCTION.match(line)):
            found[name][read[1]] = Instruction(read[2], read[3], re.findall(r"%?([\w.\-]+)(?:,|$)", read[4]), line)
    return found


def _scheduled(text: str, computations: _Computations) -> set[str]:
    """The names of the computations whose instructions are started: the whole program, bodies of loops, and branches."""
    entry = re.search(r"^ENTRY %?([\w.\-]+)", text, re.MULTILINE)
    found, waiting = set[str](), [entry[1]] if entry else []
    while waiting:
        name = waiting.pop()
        found.add(name)
        for one in computations.get(name, {}).values():
            if one.operation in ("while", "call", "conditional"):
                called = re.findall(r"(?:body|condition|to_apply|_computations?)=(\{[^}]*\}|[^,\s]*)", one.line)
                waiting += set(re.findall(r"[\w.\-]+", " ".join(called))) & computations.keys() - found
    return found


def _is_started(one: Instruction) -> bool:
    by_name = one.operation == "custom-call" and re.search(r'"(AllocateBuffer|ConcatBitcast)"', one.line)
    return one.operation not in _NOTHING and not one.operation.endswith("-done") and not by_name


def _traffic_of(one: Instruction, lines: dict[str, Instruction], computations: _Computations) -> int:
    """Bytes that an instruction reads and writes in the device's memory."""
    if one.operation == "slice-start":  # its type holds all of what it reads from
        return _read_in_slices([Instruction(one.shape.split("), ", 1)[1].split(", s32[]")[0], "slice", [], "")])
    written = bytes_of_shape(one.shape, in_memory=True)
    if one.operation.endswith("-start"):  # its type holds what it reads
        return written
    read = [bytes_of_shape(lines[name].shape, in_memory=True) if name in lines else 0 for name in one.operands]
    if one.operation in _SLICES:
        return written + min(read[0], bytes_of_shape(one.shape))
    if one.operation == "fusion" and (called := re.search(r"calls=%?([\w.\-]+)", one.line)):
        inner = computations.get(called[1], {})
        for name, inside in inner.items():
            users = [other for other in inner.values() if name in other.operands]
            if inside.operation == "parameter" and users and all(other.operation in _SLICES for other in users):
                number = int(inside.line.split("parameter(")[1].split(")")[0])
                read[number] = min(read[number], _read_in_slices(users))
    return written + sum(read)


def _read_in_slices(slices: list[Instruction]) -> int:
    return sum(bytes_of_shape(one.shape) for one in slices)


def _is_counted(loop: str, computations: _Computations) -> bool:
    """Whether the length of a loop is known: its condition compares a counter with a constant."""
    condition = re.search(r"condition=%?([\w.\-]+)", loop)
    return "known_trip_count" in loop or (condition is not None and _compares(condition[1], computations) == 1)


def _compares(name: str, computations: _Computations) -> float:
    """The number of comparisons of a computation; infinity where it does something else than to compare a counter."""
    total = 0.0
    for one in computations.get(name, {}).values():
        if one.operation not in _COUNTERS:
            return math.inf
        total += one.operation == "compare"
        if one.operation == "fusion" and (called := re.search(r"calls=%?([\w.\-]+)", one.line)):
            total += _compares(called[1], computations)
    return total
