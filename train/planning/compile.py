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
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding

from data_pipeline.dataset.statistics import DatasetStatistics
from train.planning.costs import views_like
from train.planning.hlo import Contents
from train.planning.targets import Target
from train.running.devices import DATA, parameter_sharding
from train.step import Task, abstract_state, train_step_of


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


def training_program(task: Task, statistics: DatasetStatistics, mesh: Mesh) -> Program:
    """Returns the step of a training that the devices of a mesh share."""
    structure, state = abstract_state(task)
    split, whole = NamedSharding(mesh, PartitionSpec(DATA)), NamedSharding(mesh, PartitionSpec())
    given = (
        jax.tree.map(lambda leaf, where: shapes_on(where, leaf), state, parameter_sharding(mesh, state)),
        shapes_on(split, views_like(task, statistics, task.optimiser.batch_size)),
        shapes_on(whole, task.hyperparameters),
    )
    return Program(train_step_of(task, structure, 1000), given, donated=(0,))


@dataclass(frozen=True)
class Compiled:
    """A compiled program. All figures are of one device, and count the body of a loop once.

    Attributes:
        compile_seconds: that tracing and compiling took.
        peak_bytes: the most memory that it needs at one time.
        flop: floating-point operations; for a GPU those before it was compiled, without those of kernels.
        accessed_bytes: that its operations read and write by XLA's count, which includes a TPU's vector memory; None for a GPU.
        contents: what it moves, starts, sends and repeats.
        flop_per_byte: arithmetic for each byte of traffic with the device's memory.
        least_seconds: that it needs at the chip's peak rates.
    """

    compile_seconds: float
    peak_bytes: int
    flop: float
    accessed_bytes: float | None
    contents: Contents
    flop_per_byte: float
    least_seconds: float


def compile_for(target: Target, program: Program) -> Compiled:
    """Compiles a program for a target.

    Raises:
        jax.errors.JaxRuntimeError: if XLA cannot compile it, as where it does not fit the memory.
    """
    before = time.perf_counter()
    jax.config.update("jax_enable_compilation_cache", False)  # what was compiled before would take no time
    with target.lowering():
        traced = jax.jit(program.function, donate_argnums=program.donated).trace(*program.arguments)
        lowered = traced.lower(lowering_platforms=(target.platform,))
        try:
            compiled = lowered.compile()
        except jax.errors.JaxRuntimeError as error:
            if "output tile sizes" not in str(error):
                raise
            # On a GPU, XLA tries tiles of a product and drops those that do not fit it. Without one it takes the same for all.
            compiled = lowered.compile(compiler_options={"xla_gpu_enable_triton_gemm": False})
    seconds = time.perf_counter() - before
    counted = compiled.cost_analysis()
    flop = float(_flop_of(lowered) if counted is None else counted.get("flops", 0.0))
    contents = Contents.of(compiled.as_text())
    return Compiled(
        compile_seconds=seconds,
        peak_bytes=int(compiled.memory_analysis().peak_memory_in_bytes),
        flop=flop,
        accessed_bytes=None if counted is None else float(counted["bytes accessed"]),
        contents=contents,
        flop_per_byte=flop / max(contents.traffic_bytes, 1),
        least_seconds=max(flop / target.chip.flop, contents.traffic_bytes / target.chip.bandwidth),
    )


def _flop_of(lowered: jax.stages.Lowered) -> float:
    """XLA's count before it compiles. `lowered.cost_analysis()` asks a device, which is not here; this asks the CPU."""
    from jax._src.lib import _jax

    program: Any = lowered.compiler_ir("hlo")
    counted = _jax.hlo_module_cost_analysis(jax.devices("cpu")[0].client, program.as_hlo_module())
    return max(0.0, counted.get("flops", 0.0))  # −1 for what holds kernels alone
