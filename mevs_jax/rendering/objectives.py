"""What makes a view worth taking, as numbers with gradients: each is larger for a better view.

Each takes soft images. Of hard ones, what rays or a threshold give, it is its own hard counterpart, or one is named.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.cameras import Camera
from mevs_jax.entropy import DEPTH_SCALE, shannon_entropy
from mevs_jax.rendering.piecewise import limited

_LEVELS = 256
_GRAZING = 0.05  # the least cosine that a visible area is divided by


def opacity_entropy(opacity: Float[AnyArray, "height width"]) -> Float[Array, ""]:
    """How evenly opacity is spread over the image, in [0, 1]: −Σ p log p / log N with p = opacity / Σ opacity (DiffDVR, §4.1).

    Its hard counterpart is itself: of a silhouette it is log(pixels covered) / log N. 0 for an empty image.
    """
    opacity = jnp.asarray(opacity)
    total = jnp.sum(opacity)
    p = opacity / limited(total, 1e-12)
    return -jnp.sum(jnp.where(p > 1e-12, p * jnp.log(limited(p, 1e-12)), 0.0)) / jnp.log(float(opacity.size))


def soft_depth_entropy(
    depth: Float[AnyArray, "height width"], silhouette: Float[AnyArray, "height width"], softness: float = 0.2
) -> Float[Array, ""]:
    """The thesis's depth entropy in bits (eq. 9), with levels that pass into each other.

    Args:
        depth: metric, anything where nothing is seen.
        silhouette: in [0, 1]; what is not covered counts as level 0, as the thesis's background does.
        softness: how far a pixel reaches into the next level, in levels. As it goes to 0 and the silhouette becomes hard,
            this becomes `depth_entropy`, its hard counterpart.
    """
    scaled = jnp.asarray(depth).reshape(-1) * (DEPTH_SCALE / _LEVELS)
    covered = jnp.asarray(silhouette).reshape(-1)
    level = jnp.floor(jax.lax.stop_gradient(scaled))
    reach = 1 + math.ceil(10 * softness)  # beyond it a pixel has less than e⁻¹⁰ of itself
    counts = jnp.zeros(_LEVELS, scaled.dtype).at[0].set(jnp.sum(1 - covered))
    below = jax.nn.sigmoid((level - reach - scaled) / softness)
    for offset in range(-reach, reach + 1):
        above = jax.nn.sigmoid((level + offset + 1 - scaled) / softness)
        index = jnp.clip(level + offset, 0, _LEVELS - 1).astype(jnp.int32)
        counts = counts.at[index].add((above - below) * covered)
        below = above
    return shannon_entropy(counts)


def silhouette_gaussian(silhouette: Float[AnyArray, "side side"], width: float = 70 / 256) -> Float[Array, ""]:
    """Minus the squared difference between a silhouette and a Gaussian in the middle of the image, summed over 256² pixels.

    The thesis's published objective for the mesh renderer, without its term for the distance, which is constant here.

    Args:
        silhouette: in [0, 1]; a hard one gives the hard counterpart.
        width: of the Gaussian at half its height, as a share of the image's side.
    """
    silhouette = jnp.asarray(silhouette)
    side = silhouette.shape[0]
    at = (jnp.arange(side) + 0.5) / side - 0.5
    squared = (jnp.square(at)[:, None] + jnp.square(at)) / width**2
    return -jnp.sum(jnp.square(silhouette - jnp.exp2(-4 * squared))) * (256 / side) ** 2


def visible_area(
    depth: Float[AnyArray, "side side"],
    normal: Float[AnyArray, "side side 3"],
    silhouette: Float[AnyArray, "side side"],
    camera: Camera,
) -> Float[Array, ""]:
    """The area of surface that is seen, in square units.

    A pixel of side 1/f at depth z shows z² / (f² |n·d|) of a surface with normal n, d the ray with length one along the axis.

    Args:
        depth: metric; anything finite where the silhouette is 0.
        normal: in the camera's frame.
        silhouette: in [0, 1]; a hard one with the depths and normals of a ray caster gives the hard counterpart.
    """
    offset = (jnp.arange(camera.resolution) + 0.5 - camera.resolution / 2) / camera.focal_length
    facing = jnp.abs(normal[..., 0] * offset + normal[..., 1] * offset[:, None] + normal[..., 2])
    # Smooth where it would be divided by nothing; a surface so nearly edge-on shows little.
    facing = jnp.sqrt(jnp.square(facing) + _GRAZING**2)
    return jnp.sum(silhouette * jnp.square(depth / camera.focal_length) / facing)


def edge_content(
    depth: Float[AnyArray, "side side"], silhouette: Float[AnyArray, "side side"], step: float = 0.05
) -> Float[Array, ""]:
    """How much of the image is edges, in [0, 1): where depth jumps by more than some `step` units, or the object ends.

    Args:
        depth: metric; anything finite where the silhouette is 0.
        silhouette: in [0, 1]; a hard one with hard depths gives the hard counterpart.
    """
    # Background stands as far behind as the far end of the unit sphere from a camera two radii away.
    seen = silhouette * depth + (1 - silhouette) * 3.0
    across, down = jnp.diff(seen, axis=1)[:-1], jnp.diff(seen, axis=0)[:, :-1]
    jump = (jnp.square(across) + jnp.square(down)) / step**2
    return jnp.mean(jump / (1 + jump))
