"""Objects in any rotation: a grid of rotations, and what one view says about them.

The rotation of an object relative to the camera can be seen in an image; with the direction of the camera it becomes the rotation
of the object in the world.
"""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import look_at_origin

ROTATIONS = 576
"""Number of rotations that are distinguished; from any rotation the nearest is 14° away on average, and at most about 27°."""
_EXACT = jax.lax.Precision.HIGHEST
_WIDTH = 0.2
"""Standard deviation in radians of the weights of rotations around a true one."""


@cache
def rotation_grid(count: int = ROTATIONS) -> Float[np.ndarray, "{count} 3 3"]:
    """Rotation matrices that cover all rotations evenly: the super-Fibonacci spiral of Alexa (CVPR 2022)."""
    from scipy.spatial.transform import Rotation  # imported late: few need it

    root, psi = np.sqrt(2), 1.533751168755204288118041  # psi⁴ = psi + 4
    share = (np.arange(count) + 0.5) / count
    alpha, beta = 2 * np.pi * count * share / root, 2 * np.pi * count * share / psi
    small, large = np.sqrt(share), np.sqrt(1 - share)
    quaternions = [small * np.sin(alpha), small * np.cos(alpha), large * np.sin(beta), large * np.cos(beta)]
    return Rotation.from_quat(np.stack(quaternions, axis=1)).as_matrix()


def seen_rotations(
    rotations: Float[AnyArray, "*batch 3 3"], directions: Float[AnyArray, "*batch 3"]
) -> Float[Array, "*batch 3 3"]:
    """Rotations from the object's frame to that of a camera that looks at it.

    Args:
        rotations: from the object's frame to the world.
        directions: unit vectors from the object to the camera, in the world.
    """
    camera = jnp.vectorize(look_at_origin, signature="(n)->(m,m)")(jnp.asarray(directions))[..., :3, :3]
    return jnp.matmul(jnp.swapaxes(camera, -1, -2), jnp.asarray(rotations), precision=_EXACT)


def _alike(rotations: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch rotations"]:
    """1 + 2 cos of the angle to each rotation of the grid."""
    grid = jnp.asarray(rotation_grid(), jnp.float32).reshape(ROTATIONS, 9)
    return jnp.matmul(rotations.reshape(*rotations.shape[:-2], 9), grid.T, precision=_EXACT)


def rotation_weights(rotations: Float[AnyArray, "*batch 3 3"]) -> Float[Array, "*batch rotations"]:
    """Weights of the grid around rotations: a normal density of the angle; their sum is 1."""
    angle = jnp.arccos(jnp.clip((_alike(jnp.asarray(rotations)) - 1) / 2, -1, 1))
    return jax.nn.softmax(-jnp.square(angle / _WIDTH) / 2, axis=-1)


@jax.jit
def nearest_rotations(directions: Float[AnyArray, "views 3"]) -> Int[Array, "views rotations"]:
    """For each view and each rotation of an object in the world: the rotation of the grid nearest to the one that is seen.

    Args:
        directions: unit vectors from the object to the cameras, in the world.
    """
    grid = jnp.asarray(rotation_grid(), jnp.float32)

    def of_view(direction: Array) -> Array:
        seen = seen_rotations(grid, jnp.broadcast_to(direction, (ROTATIONS, 3)))
        return jnp.argmax(_alike(seen), axis=-1).astype(jnp.int32)

    return jax.lax.map(of_view, jnp.asarray(directions))
