"""Errors that all views of an object share: those of its believed sphere and of its yaw.

A sphere that is off moves and scales all images of an object in one way. So a difference between views and predictions that some
error of the sphere explains says little against a hypothesis, and one that no *common* error explains says much. Images change
about linearly with small errors; the error is then found by least squares, with a prior, from what is kept of each view. Let `r`
be the features by which a view differs from a prediction, and `J` their slopes by the errors. A view keeps the mean of `r²`
(its square), the means of `r J` (its lean) and of `J Jᵀ` (the gram). These add up over views.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray

DEVIATIONS = np.array([0.015, 0.015, 0.015, 0.02, 0.05], np.float32)
"""Of the sphere's centre along the object's axes, in radii; of the logarithm of its radius; of the yaw in radians, as hypotheses
are 10° apart."""
ERRORS = len(DEVIATIONS)
KEPT = 1 + ERRORS + ERRORS * (ERRORS + 1) // 2
"""Numbers that are kept of a view and a hypothesis: square, lean and gram."""
HELD = 0.05
"""Squared difference of features, as a mean over them, that an error by its standard deviation costs."""
_CALM = 0.2
"""Added to how much images change before the logarithm, since less does not matter."""


def slopes(
    images: Float[AnyArray, "heights yaws pixels"], rotations: Float[AnyArray, "heights yaws 3 3"]
) -> Float[Array, "heights yaws errors pixels"]:
    """How small images of an object change with errors in the order of `DEVIATIONS`, by these.

    Args:
        images: from all directions.
        rotations: of their cameras, to the object.
    """
    images = jnp.asarray(images)
    changes = _changes(images)
    moved = jnp.einsum("hyac,hycp->hyap", jnp.asarray(rotations, jnp.float32), changes[:, :, :3])
    yaws = images.shape[1]
    turned = (jnp.roll(images, -1, axis=1) - jnp.roll(images, 1, axis=1)) * (yaws / (4 * jnp.pi))
    return jnp.concatenate([moved, changes[:, :, 3:], turned[:, :, None]], axis=2) * DEVIATIONS[:, None]


def _changes(images: Float[Array, "*grid pixels"]) -> Float[Array, "*grid 4 pixels"]:
    """Derivatives of small images by the place of the object, to the right, down and forwards in radii, and by its log size.

    To first order, for a camera two radii away whose image the object's sphere touches.
    """
    side = math.isqrt(images.shape[-1] // 2)
    both = images.reshape(*images.shape[:-1], 2, side, side)  # depth, and share
    padded = jnp.pad(both, [(0, 0)] * (both.ndim - 2) + [(1, 1), (1, 1)], mode="edge")
    across = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
    down = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
    at = jnp.arange(side) - (side - 1) / 2
    outwards, focal = across * at + down * at[:, None], side / 2 / math.tan(math.pi / 6)
    near, share = both[..., :1, :, :], both[..., 1:, :, :]
    nothing = jnp.zeros_like(share)
    nearer, deeper = (
        jnp.concatenate([-share / 2, nothing], axis=-3),
        jnp.concatenate([near - share / 2, nothing], axis=-3),
    )
    each = -focal / 2 * across, -focal / 2 * down, outwards / 2 + nearer, -outwards + deeper
    return jnp.stack([one.reshape(images.shape) for one in each], axis=-2)


def details(slopes: Float[AnyArray, "objects heights yaws errors features"]) -> Float[Array, " objects"]:
    """Logarithm of how much images of each object change with errors by standard deviations: mean squares, added up.

    The finer the details of an object, the larger are the differences that the best prediction leaves.
    """
    squares = jnp.einsum("ohyef,ohyef->o", slopes, slopes) / np.prod([slopes.shape[axis] for axis in (1, 2, 4)])
    return jnp.log(squares + _CALM)


def gram_of(slope: Float[Array, "*batch errors features"]) -> Float[Array, "*batch pairs"]:
    """The means of products of slopes, over features: the upper half of a symmetric matrix, row by row."""
    first, second = np.triu_indices(slope.shape[-2])
    return jnp.einsum("...af,...bf->...ab", slope, slope)[..., first, second] / slope.shape[-1]


def parted(kept: Float[Array, "*batch kept"]) -> tuple[Array, Array, Array]:
    """Square, lean and gram."""
    return kept[..., 0], kept[..., 1 : 1 + ERRORS], kept[..., 1 + ERRORS :]


def unexplained(
    square: Float[Array, "*batch"],
    lean: Float[Array, "*batch errors"],
    gram: Float[Array, "*other pairs"],
    count: float | Float[AnyArray, ""],
) -> Float[Array, "*batch"]:
    """The mean squared difference of features that is left when the likeliest common error is taken away, with its cost.

    Args:
        square, lean: means over views.
        gram: means over views; its shape must broadcast to that of `square`.
        count: number of views.
    """
    return jnp.maximum(square - sum(one**2 for one in _reduced(lean, gram, count)[1]), 0.0)


def likeliest(
    lean: Float[Array, "*batch errors"], gram: Float[Array, "*batch pairs"], count: float | Float[AnyArray, ""]
) -> Float[Array, "*batch errors"]:
    """The common error that `unexplained` takes away, in standard deviations."""
    lower, reduced = _reduced(lean, gram, count)
    found: dict[int, Array] = {}
    for row in reversed(range(len(reduced))):
        rest = sum((lower[k, row] * found[k] for k in range(row + 1, len(reduced))), jnp.zeros(()))
        found[row] = (reduced[row] - rest) / lower[row, row]
    return jnp.stack([found[row] for row in range(len(reduced))], axis=-1)


def _reduced(
    lean: Float[Array, "*batch errors"], gram: Float[Array, "*other pairs"], count: float | Float[AnyArray, ""]
) -> tuple[dict[tuple[int, int], Array], list[Array]]:
    """The entries of `L`, where `L Lᵀ` is the gram with the cost of errors (Cholesky), and those of `L⁻¹ lean`."""
    # Written out: libraries call a routine for each of many tiny matrices. On a CPU, that of JAX also waits for threads that are
    # needed to run it, so that two programs side by side may wait for ever.
    errors = lean.shape[-1]
    pairs = combinations_with_replacement(range(errors), 2)
    entry = {(b, a): gram[..., place] for place, (a, b) in enumerate(pairs)}
    lower: dict[tuple[int, int], Array] = {}
    reduced: list[Array] = []
    for row in range(errors):
        for column in range(row):
            rest = sum((lower[row, k] * lower[column, k] for k in range(column)), jnp.zeros(()))
            lower[row, column] = (entry[row, column] - rest) / lower[column, column]
        rest = sum((lower[row, k] ** 2 for k in range(row)), jnp.zeros(()))
        lower[row, row] = jnp.sqrt(jnp.maximum(entry[row, row] - rest, 0.0) + HELD / count)
        rest = sum((lower[row, k] * reduced[k] for k in range(row)), jnp.zeros(()))
        reduced.append((lean[..., row] - rest) / lower[row, row])
    return lower, reduced
