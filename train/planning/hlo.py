"""What the text of a compiled program says: what it sends, calls and repeats."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass

_INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%?[\w.\-]+ = (\(.*?\)|\S+) ([\w\-]+)\(")
_SHAPE = re.compile(r"\b(pred|[sufc]\d+|bf16|f8\w*)\[([\d,]*)\]")
_COLLECTIVES = ("all-reduce", "all-gather", "reduce-scatter", "all-to-all", "collective-permute")
_OF_THE_HOST = ("infeed", "outfeed", "send", "recv")
_COUNTERS = {"parameter", "get-tuple-element", "constant", "compare", "copy", "bitcast", "fusion"}
"""What the condition of a loop of known length consists of."""


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
        loops: number of loops.
        open_loops: of these, those whose length depends on values.
        host_transfers: number of transfers from and to the host.
    """

    collectives: dict[str, Collective]
    custom_calls: dict[str, int]
    loops: int
    open_loops: int
    host_transfers: int

    @classmethod
    def of(cls, text: str) -> Contents:
        """Returns the contents of a program from `compiled.as_text()`."""
        counts, bytes_of, loops = Counter[str](), Counter[str](), []
        for line in text.splitlines():
            if (instruction := _INSTRUCTION.match(line)) is None:
                continue
            shape, name = instruction.groups()
            if (ended := name.removesuffix("-done")) in _COLLECTIVES:  # it has begun elsewhere
                name = ended
            if name in ("send", "recv") and "is_host_transfer=true" not in line:  # to another device
                continue
            counts[name] += 1
            bytes_of[name] += bytes_of_shape(shape)
            if name == "while":
                loops.append(line)
        targets, bodies = Counter(re.findall(r'custom_call_target="([^"]+)"', text)), _computations(text)
        return cls(
            collectives={name: Collective(counts[name], bytes_of[name]) for name in _COLLECTIVES if counts[name]},
            custom_calls=dict(sorted(targets.items())),
            loops=len(loops),
            open_loops=sum(not _is_counted(line, bodies) for line in loops),
            host_transfers=sum(counts[name] for name in _OF_THE_HOST)
            + sum(count for target, count in targets.items() if "callback" in target),
        )


def bytes_of_shape(shape: str) -> int:
    """Returns the bytes of an array or a tuple of arrays, from its type in HLO, such as `(f32[8,3]{1,0}, s32[])`."""
    return (
        sum(
            math.prod(int(extent) for extent in extents.split(",") if extent) * _bits(kind)
            for kind, extents in _SHAPE.findall(shape)
        )
        // 8
    )


def _bits(kind: str) -> int:
    return 8 if kind == "pred" or kind.startswith("f8") else int(re.sub(r"\D", "", kind))


def _computations(text: str) -> dict[str, list[str]]:
    """The lines of each computation of a program, by its name."""
    found: dict[str, list[str]] = {}
    name = ""
    for line in text.splitlines():
        if line.endswith("{") and (begins := re.match(r"(?:ENTRY )?%?([\w.\-]+) ", line)):
            name = begins[1]
            found[name] = []
        elif name:
            found[name].append(line)
    return found


def _is_counted(loop: str, bodies: dict[str, list[str]]) -> bool:
    """Whether the length of a loop is known: its condition compares a counter with a constant."""
    condition = re.search(r"condition=%?([\w.\-]+)", loop)
    return "known_trip_count" in loop or (condition is not None and _compares(condition[1], bodies) == 1)


def _compares(name: str, bodies: dict[str, list[str]]) -> float:
    """The number of comparisons of a computation; infinity where it does something else than to compare a counter."""
    total = 0.0
    for line in bodies.get(name, []):
        if (instruction := _INSTRUCTION.match(line)) is None:
            continue
        operation = instruction[2]
        if operation not in _COUNTERS:
            return math.inf
        total += operation == "compare"
        if operation == "fusion" and (called := re.search(r"calls=%?([\w.\-]+)", line)):
            total += _compares(called[1], bodies)
    return total
