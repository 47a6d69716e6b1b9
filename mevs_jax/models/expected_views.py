"""What a recogniser is expected to say of an object of each class from every direction, as a smooth function on the sphere.

The function is a sum of spherical harmonics. Unlike a table over the viewpoints of a lattice, it holds for any candidate
direction, and for objects turned by any yaw.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.pose import azimuth_of, yaws
from mevs_jax.models.rotation import rotation_grid


def harmonics(directions: Float[AnyArray, "*batch 3"], degree: int) -> Float[Array, "*batch terms"]:
    """The real spherical harmonics of degree 0 to `degree` at unit vectors: (degree + 1)² terms, orthonormal on the sphere.

    Terms are ordered by degree n, then by order m from −n to n. Signs are those of `scipy.special.sph_harm_y`, which JAX computes
    for each term anew.
    """
    directions = jnp.asarray(directions)
    z, level, angle = directions[..., 2], jnp.linalg.norm(directions[..., :2], axis=-1), azimuth_of(directions)
    by_height: dict[tuple[int, int], Array] = {}  # the normalised Legendre functions of z
    for m in range(degree + 1):
        last = by_height.get((m - 1, m - 1))
        first = (
            jnp.full_like(z, 0.5 / np.sqrt(np.pi)) if last is None else -np.sqrt((2 * m + 1) / (2 * m)) * level * last
        )
        by_height[m, m], before = first, jnp.zeros_like(z)
        for n in range(m + 1, degree + 1):
            scale = np.sqrt((4 * n**2 - 1) / (n**2 - m**2))
            share = np.sqrt(((n - 1) ** 2 - m**2) / (4 * (n - 1) ** 2 - 1))
            by_height[n, m] = scale * (z * by_height[n - 1, m] - share * before)
            before = by_height[n - 1, m]

    def term(n: int, m: int) -> Array:
        if not m:
            return by_height[n, 0]
        around = jnp.cos(m * angle) if m > 0 else jnp.sin(-m * angle)
        return np.sqrt(2) * by_height[n, abs(m)] * around

    return jnp.stack([term(n, m) for n in range(degree + 1) for m in range(-n, n + 1)], axis=-1)


@flax.struct.dataclass
class ExpectedViews:
    """Expected log-probabilities of the classes after a single view, for each true class and any direction of the camera.

    Attributes:
        coefficients: (classes, terms, classes); [y, k, c] of harmonic k, for class c if the object is of class y.
    """

    coefficients: Float[Array, "classes terms classes"]

    @property
    def degree(self) -> int:
        """The largest degree of the harmonics."""
        return round(self.coefficients.shape[1] ** 0.5) - 1

    def at(self, directions: Float[AnyArray, "*places 3"]) -> Float[Array, "classes *places classes"]:
        """Expected log-probabilities if the camera is in these directions, unit vectors in the object's frame."""
        terms = harmonics(directions, self.degree)
        return jnp.einsum("...k,ykc->y...c", terms, self.coefficients, precision=jax.lax.Precision.HIGHEST)

    def by_yaw(
        self, directions: Float[AnyArray, "views 3"], count: int, offset: float = 0.0
    ) -> Float[Array, "classes {count} views classes"]:
        """The same for `count` yaws of the object (`mevs_jax.models.pose.yaws`) plus `offset`, and directions in the world."""
        cos, sin = (jnp.asarray(of(yaws(count) + offset), jnp.float32)[:, None] for of in (np.cos, np.sin))
        x, y, z = jnp.moveaxis(jnp.asarray(directions), -1, 0)
        turned = [cos * x + sin * y, cos * y - sin * x, jnp.broadcast_to(z, (count, len(x)))]
        return self.at(jnp.stack(turned, axis=-1))

    def by_rotation(self, directions: Float[AnyArray, "views 3"]) -> Float[Array, "classes rotations views classes"]:
        """The same for every rotation of the object in `mevs_jax.models.rotation.rotation_grid`."""
        grid = jnp.asarray(rotation_grid(), jnp.float32)
        return self.at(jnp.einsum("rij,vi->rvj", grid, directions, precision=jax.lax.Precision.HIGHEST))
