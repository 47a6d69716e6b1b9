"""Operations that are a kernel in programs for one GPU, and an array program in all others.

Which one it is cannot be known when an operation is traced, only when it is lowered. So each is a primitive of JAX.
`jax.lax.platform_dependent` would trace the kernels for every platform: Pallas takes half a second to import, which a program
for a CPU does not need.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir, xla
from jaxtyping import Array


def kernel_on_one_gpu(name: str, arrays: Callable[..., Array]) -> Callable[..., Array]:
    """Returns an operation, a function of arrays and, by name, of a number `k` and the shape of its result.

    The result is of int32, and no gradient passes.

    Args:
        name: of the operation, and of its kernel in `mevs_jax.points.kernels`.
        arrays: the operation as an array program.
    """
    primitive = Primitive(name)
    primitive.def_impl(partial(xla.apply_primitive, primitive))
    primitive.def_abstract_eval(lambda *_, shape, **__: ShapedArray(shape, jnp.int32))

    def batched(given: Sequence[Array], mapped: Sequence[int | None], *, k: int, shape: tuple, axes: tuple) -> Any:
        count = next(array.shape[axis] for array, axis in zip(given, mapped, strict=True) if axis is not None)
        return primitive.bind(*given, k=k, shape=(count, *shape), axes=(*axes, tuple(mapped))), 0

    def lower(context: mlir.LoweringRuleContext, *given: Any, k: int, shape: tuple, axes: tuple) -> Any:
        function = arrays
        if _is_for_one_gpu(context):
            from mevs_jax.points import kernels

            function = getattr(kernels, name)
        function = partial(function, k=k)
        for mapped in axes:  # the innermost first
            function = jax.vmap(function, mapped)
        return mlir.lower_fun(function, multiple_results=False)(context, *given)

    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, lower)
    return partial(primitive.bind, axes=())


def _is_for_one_gpu(context: mlir.LoweringRuleContext) -> bool:
    """Whether a program is lowered for one GPU alone. The compiler cannot split a kernel over several devices, and an exported
    program, which may be kept for years, holds no kernels."""
    module, devices = context.module_context, context.module_context.axis_context
    return (
        tuple(context.platforms or module.platforms) == ("cuda",)
        and isinstance(devices, mlir.ShardingContext)
        and devices.num_devices == 1
        and not module.lowering_parameters.for_export
    )
