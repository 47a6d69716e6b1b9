"""What a recogniser is expected to say of an object of each class from every direction, as a smooth function on the sphere.

The function is a sum of spherical harmonics. Unlike a table over the viewpoints of a lattice, it holds for any candidate
direction, and for objects turned by any yaw.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import sph_harm_y
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.pose import azimuth_of, yaws
from mevs_jax.models.rotation import rotation_grid


def harmonics(directions: Float[AnyArray, "*batch 3"], degree: int) -> Float[Array, "*batch terms"]:
    """The real spherical harmonics of degree 0 to `degree` at unit vectors: (degree + 1)² terms, orthonormal on the sphere.

    Terms are ordered by degree n, then by order m from −n to n.
    """
    directions = jnp.asarray(directions)
    places = [(n, m) for n in range(degree + 1) for m in range(-n, n + 1)]
    n, m = np.array(places).T
    polar = jnp.arccos(jnp.clip(directions[..., 2], -1, 1)).reshape(-1)
    each, of_order = np.unique(np.stack([n, abs(m)]), axis=1, return_inverse=True)
    flat = [jnp.broadcast_to(array, (len(polar), each.shape[1])).reshape(-1) for array in (*each, polar[:, None])]
    found = sph_harm_y(flat[0], flat[1], flat[2], jnp.zeros_like(flat[2]), n_max=degree).real
    by_height = found.reshape(*directions.shape[:-1], -1)[..., of_order]
    angle = abs(m) * azimuth_of(directions)[..., None]
    around = jnp.where(m > 0, jnp.cos(angle), jnp.sin(angle)) * np.sqrt(2)
    return by_height * jnp.where(m == 0, 1.0, around)


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
        self, directions: Float[AnyArray, "views 3"], count: int
    ) -> Float[Array, "classes {count} views classes"]:
        """The same for `count` yaws of the object (`mevs_jax.models.pose.yaws`) and directions in the world."""
        cos, sin = (jnp.asarray(of(yaws(count)), jnp.float32)[:, None] for of in (np.cos, np.sin))
        x, y, z = jnp.moveaxis(jnp.asarray(directions), -1, 0)
        turned = [cos * x + sin * y, cos * y - sin * x, jnp.broadcast_to(z, (count, len(x)))]
        return self.at(jnp.stack(turned, axis=-1))

    def by_rotation(self, directions: Float[AnyArray, "views 3"]) -> Float[Array, "classes rotations views classes"]:
        """The same for every rotation of the object in `mevs_jax.models.rotation.rotation_grid`."""
        grid = jnp.asarray(rotation_grid(), jnp.float32)
        return self.at(jnp.einsum("rij,vi->rvj", grid, directions, precision=jax.lax.Precision.HIGHEST))
