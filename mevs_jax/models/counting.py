"""The number of parameters of a network, counted as in the thesis."""

from __future__ import annotations

import jax
from flax import nnx


def count_parameters(module: nnx.Module, *, trainable_only: bool = False) -> int:
    """Number of scalars in `module`: the weights, and unless `trainable_only` also batch norm's mean, variance and counter.

    The thesis reports the larger number (§4.3): 11,191,262 for ResNet-18, 1,471,509 for PointNet++ with 10 views.
    """
    kinds = nnx.Param if trainable_only else (nnx.Param, nnx.BatchStat)
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(module, kinds)))
