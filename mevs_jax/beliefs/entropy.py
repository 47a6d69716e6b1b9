"""Depth entropy: the entropy of the histogram of depths in a view, in bits (thesis eq. 9).

The thesis stores depth × 10,000 as a 16-bit image and reads it back as 8 bits. Its levels are therefore ⌊10,000 d / 256⌋, steps
of 0.0256 units, and the background is level 0, counted like any other. This is the variant `thesis`. The variant `foreground`
ignores the background, so that it measures the distribution of depths and not how much of the image is covered.
"""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mevs_jax.arguments import check
from mevs_jax.arrays import AnyArray

DEPTH_SCALE = 10_000
"""Units of the stored 16-bit depth per metric unit."""
DEPTH_STEP = np.float32(1 / DEPTH_SCALE)
"""A unit of stored depth, by which it is multiplied: a division by `DEPTH_SCALE` differs by a bit between NumPy and XLA."""
_LEVELS = 256

EntropyVariant = Literal["thesis", "foreground"]


def quantise_depth(depth: Float[AnyArray, "*shape"]) -> Int[Array, "*shape"]:
    """Metric depth as in the thesis's 16-bit images: ⌊10,000 d⌋, at most 65,535; 0 where nothing is hit (depth 0 or +inf).

    Raises:
        ValueError: for depth in integers, which is stored depth and not metric.
    """
    if not jnp.issubdtype(jnp.asarray(depth).dtype, jnp.floating):
        raise ValueError(
            f"depth must be metric, in floating point, got {jnp.asarray(depth).dtype}: divide stored depth by {DEPTH_SCALE:,}"
        )
    return jnp.floor(jnp.clip(jnp.where(jnp.isfinite(depth), depth, 0.0) * DEPTH_SCALE, 0, 65535)).astype(jnp.int32)


def depth_levels(depth: Float[AnyArray, "*shape"]) -> Int[Array, "*shape"]:
    """The 8-bit levels 0..255 of a metric depth image, whose histogram the thesis's entropy is computed from."""
    return quantise_depth(depth) // _LEVELS


def shannon_entropy(counts: Float[AnyArray, " levels"] | Int[AnyArray, " levels"]) -> Float[Array, ""]:
    """Entropy of a histogram in bits, whatever its sum; 0 for an empty histogram.

    Raises:
        ValueError: for a count that is known and negative or not finite.
    """
    check(counts, "counts must be at least 0", lambda count: (count >= 0) & (count < np.inf))
    total = jnp.sum(counts)
    p = counts / jnp.where(total > 0, total, 1)
    return -jnp.sum(jnp.where(p > 0, p * jnp.log2(jnp.where(p > 0, p, 1.0)), 0.0))


def level_entropy(levels: Int[AnyArray, "height width"], variant: EntropyVariant = "thesis") -> Float[Array, ""]:
    """Entropy in bits of an image of levels 0..255; the variant `foreground` ignores level 0.

    Raises:
        ValueError: for an unknown variant.
    """
    counts = jnp.bincount(jnp.asarray(levels).reshape(-1), length=_LEVELS)
    if variant == "foreground":
        counts = counts.at[0].set(0)
    elif variant != "thesis":
        raise ValueError(f"unknown entropy variant {variant!r}: it is 'thesis' or 'foreground'")
    return shannon_entropy(counts)


def depth_entropy(depth: Float[AnyArray, "height width"], variant: EntropyVariant = "thesis") -> Float[Array, ""]:
    """Depth entropy of one view in bits: 0 for an empty or flat view, at most 8.

    Args:
        depth: metric depth, 0 or +inf where nothing is hit.
        variant: `thesis` counts the background as a level, `foreground` ignores it.

    Raises:
        ValueError: for an unknown variant, or depth in integers.
    """
    return level_entropy(depth_levels(depth), variant)
