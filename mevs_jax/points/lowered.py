"""Operations that are a kernel in programs for a GPU or a TPU, and an array program in all others.

Which one it is cannot be known when an operation is traced, only when it is lowered. So each is a primitive of JAX.
`jax.lax.platform_dependent` would trace the kernels for every platform: Pallas takes half a second to import, which a program
for a CPU does not need.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir, xla
from jax.sharding import AbstractMesh, AxisType, PartitionSpec
from jax.typing import DTypeLike
from jaxtyping import Array

_KERNELS = {"cuda": "mevs_jax.points.kernels", "tpu": "mevs_jax.points.mosaic"}
"""Modules with kernels, by platform."""


def with_kernels(
    name: str,
    arrays: Callable[..., Array],
    *,
    arrays_on_tpu: Callable[..., Array] | None = None,
    dtype: DTypeLike = jnp.int32,
) -> Callable[..., Array]:
    """Returns an operation, a function of arrays and, by name, of a number `k` and the shape of its result.

    No gradient passes.

    Args:
        name: of the operation, and of its kernels in the modules that have one.
        arrays: the operation as an array program.
        arrays_on_tpu: the same for a TPU, where that is another program.
        dtype: of the result.
    """
    primitive = Primitive(name)
    primitive.def_impl(partial(xla.apply_primitive, primitive))
    primitive.def_abstract_eval(lambda *_, shape, **__: ShapedArray(shape, dtype))

    def batched(given: Sequence[Array], mapped: Sequence[int | None], *, k: int, shape: tuple, axes: tuple) -> Any:
        count = next(array.shape[axis] for array, axis in zip(given, mapped, strict=True) if axis is not None)
        return primitive.bind(*given, k=k, shape=(count, *shape), axes=(*axes, tuple(mapped))), 0

    def lower(
        program: Callable[..., Array],
        context: mlir.LoweringRuleContext,
        *given: Any,
        k: int,
        shape: tuple,
        axes: tuple,
    ) -> Any:
        kernel, devices = _kernel(name, context)
        function: Callable[..., Array] = partial(kernel or program, k=k)
        for mapped in axes:  # the innermost first
            function = jax.vmap(function, mapped)
        if devices > 1:
            shared = axes and shape[0] % devices == 0
            function = _on_each(function, axes[-1] if shared else (None,) * len(given), devices)
        return mlir.lower_fun(function, multiple_results=False)(context, *given)

    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, partial(lower, arrays))
    mlir.register_lowering(primitive, partial(lower, arrays_on_tpu or arrays), platform="tpu")
    return partial(primitive.bind, axes=())


def _kernel(name: str, context: mlir.LoweringRuleContext) -> tuple[Callable[..., Array] | None, int]:
    """The kernel of an operation, and the number of devices that need one.

    There is none in an exported program, which may be kept for years, nor inside `jax.shard_map`.
    """
    module = context.module_context
    devices = module.axis_context
    platforms = tuple(context.platforms or module.platforms)
    if (
        len(platforms) != 1
        or platforms[0] not in _KERNELS
        or not isinstance(devices, mlir.ShardingContext)
        or module.lowering_parameters.for_export
    ):
        return None, 1
    kernel = getattr(import_module(_KERNELS[platforms[0]]), name, None)
    return kernel, devices.num_devices if kernel else 1


def _on_each(function: Callable[..., Array], mapped: tuple[int | None, ...], devices: int) -> Callable[..., Array]:
    """The function on each of several devices, since the compiler cannot split a kernel: of its share along the mapped axes."""

    def share(axis: int | None) -> PartitionSpec:
        return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, "devices")

    device = getattr(jax.sharding.get_abstract_mesh(), "abstract_device", None)  # of a GPU that is not here
    mesh = AbstractMesh((devices,), ("devices",), (AxisType.Auto,), **({"abstract_device": device} if device else {}))
    result = share(None if set(mapped) == {None} else 0)
    return jax.shard_map(function, mesh=mesh, in_specs=tuple(map(share, mapped)), out_specs=result, check_vma=False)
