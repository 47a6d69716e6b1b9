"""Compiles programs by XLA's own compiler for devices that are not here, and tells what it made of them.

Nothing runs, so nothing is timed. XLA's counts are of one device; they count the body of a loop once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.sharding import Sharding

from train.planning.hlo import Contents
from train.planning.targets import Target


@dataclass(frozen=True)
class Program:
    """A program to compile.

    Attributes:
        function: of arrays.
        arguments: their shapes, with the devices that hold them (`shapes_on`).
        donated: numbers of the arguments whose memory it may use for its results.
    """

    function: Callable[..., Any]
    arguments: Sequence[Any]
    donated: tuple[int, ...] = ()


def shapes_on(where: Sharding, tree: Any) -> Any:
    """Returns the shapes of a tree of arrays, numbers or shapes, placed on devices."""

    def of(leaf: Any) -> jax.ShapeDtypeStruct:
        dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
        return jax.ShapeDtypeStruct(np.shape(leaf), dtype, sharding=where)

    return jax.tree.map(of, tree)


@dataclass(frozen=True)
class Compiled:
    """A compiled program. All figures are of one device, and count the body of a loop once.

    Attributes:
        compile_seconds: that tracing and compiling took.
        peak_bytes: the most memory that it needs at one time.
        flop: floating-point operations.
        traffic_bytes: bytes that its operations read and write.
        flop_per_byte: of these, arithmetic intensity.
        least_seconds: that it needs at the chip's peak rates.
        bound_by_memory: whether its traffic takes longer at these rates than its arithmetic.
        contents: what it sends, calls and repeats.
    """

    compile_seconds: float
    peak_bytes: int
    flop: float
    traffic_bytes: float
    flop_per_byte: float
    least_seconds: float
    bound_by_memory: bool
    contents: Contents


def compile_for(target: Target, program: Program) -> Compiled:
    """Compiles a program for a target.

    Raises:
        jax.errors.JaxRuntimeError: if XLA cannot compile it, as where it does not fit the memory.
    """
    before = time.perf_counter()
    jax.config.update("jax_enable_compilation_cache", False)  # what was compiled before would take no time
    with target.lowering():
        traced = jax.jit(program.function, donate_argnums=program.donated).trace(*program.arguments)
        compiled = traced.lower(lowering_platforms=(target.platform,)).compile()
    seconds = time.perf_counter() - before
    costs, memory = compiled.cost_analysis() or {}, compiled.memory_analysis()
    flop, traffic = (max(0.0, float(costs.get(name, 0.0))) for name in ("flops", "bytes accessed"))
    by_arithmetic, by_memory = flop / target.chip.flop, traffic / target.chip.bandwidth
    return Compiled(
        compile_seconds=seconds,
        peak_bytes=int(memory.peak_memory_in_bytes),
        flop=flop,
        traffic_bytes=traffic,
        flop_per_byte=flop / traffic if traffic else 0.0,
        least_seconds=max(by_arithmetic, by_memory),
        bound_by_memory=by_memory >= by_arithmetic,
        contents=Contents.of(compiled.as_text()),
    )
