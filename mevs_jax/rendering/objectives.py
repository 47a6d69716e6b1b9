"""Objectives for good views, with gradients; larger is better.

Each objective takes soft images. Evaluated on hard images (from ray casting or a threshold), it is its own hard counterpart,
unless its docstring names another.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.entropy import DEPTH_SCALE, shannon_entropy
from mevs_jax.geometry.cameras import Camera
from mevs_jax.rendering.piecewise import limited

_LEVELS = 256
_GRAZING = 0.05  # lower bound on the cosine that a visible area is divided by


def opacity_entropy(opacity: Float[AnyArray, "height width"]) -> Float[Array, ""]:
    """Normalised entropy of the distribution of opacity over the image, in [0, 1]; 0 for an empty image.

    It is −Σ p log p / log N with p = opacity / Σ opacity and N pixels (DiffDVR, §4.1). For a hard silhouette it is
    log(covered pixels) / log N.
    """
    opacity = jnp.asarray(opacity)
    total = jnp.sum(opacity)
    p = opacity / limited(total, 1e-12)
    return -jnp.sum(jnp.where(p > 1e-12, p * jnp.log(limited(p, 1e-12)), 0.0)) / jnp.log(float(opacity.size))


def soft_depth_entropy(
    depth: Float[AnyArray, "height width"], silhouette: Float[AnyArray, "height width"], softness: float = 0.2
) -> Float[Array, ""]:
    """The thesis's depth entropy in bits (eq. 9), with a soft assignment of pixels to levels.

    Its hard counterpart is `depth_entropy`, which it becomes as `softness` goes to 0 and the silhouette becomes hard.

    Args:
        depth: metric depth; arbitrary where the silhouette is 0.
        silhouette: in [0, 1]; the uncovered part counts as level 0, like the thesis's background.
        softness: width of the transition between two levels, in levels.
    """
    scaled = jnp.asarray(depth).reshape(-1) * (DEPTH_SCALE / _LEVELS)
    covered = jnp.asarray(silhouette).reshape(-1)
    level = jnp.floor(jax.lax.stop_gradient(scaled))
    reach = 1 + math.ceil(10 * softness)  # beyond it lies less than e⁻¹⁰ of a pixel's weight
    counts = jnp.zeros(_LEVELS, scaled.dtype).at[0].set(jnp.sum(1 - covered))
    below = jax.nn.sigmoid((level - reach - scaled) / softness)
    for offset in range(-reach, reach + 1):
        above = jax.nn.sigmoid((level + offset + 1 - scaled) / softness)
        index = jnp.clip(level + offset, 0, _LEVELS - 1).astype(jnp.int32)
        counts = counts.at[index].add((above - below) * covered)
        below = above
    return shannon_entropy(counts)


def silhouette_gaussian(silhouette: Float[AnyArray, "side side"], width: float = 70 / 256) -> Float[Array, ""]:
    """Negative squared difference of a silhouette and a Gaussian at the image centre, summed and scaled to 256² pixels.

    The thesis's published objective for the mesh renderer, without its term for the distance, which is constant here.

    Args:
        silhouette: in [0, 1].
        width: full width at half maximum of the Gaussian, as a share of the image's side.
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
    """The visible area of the surface, in square units.

    A pixel of side 1/f at depth z shows the area z² / (f² |n·d|) of a surface with normal n, where d is the ray with length one
    along the optical axis.

    Args:
        depth: metric depth; any finite value where the silhouette is 0.
        normal: in the camera's frame.
        silhouette: in [0, 1].
        camera: the camera of the images.
    """
    offset = (jnp.arange(camera.resolution) + 0.5 - camera.resolution / 2) / camera.focal_length
    facing = jnp.abs(normal[..., 0] * offset + normal[..., 1] * offset[:, None] + normal[..., 2])
    # A smooth lower bound against division by zero; a surface that is almost edge-on shows little area.
    facing = jnp.sqrt(jnp.square(facing) + _GRAZING**2)
    return jnp.sum(silhouette * jnp.square(depth / camera.focal_length) / facing)


def edge_content(
    depth: Float[AnyArray, "side side"], silhouette: Float[AnyArray, "side side"], step: float = 0.05
) -> Float[Array, ""]:
    """The share of edges in the image, in [0, 1): depth jumps of more than about `step`, and the outline of the object.

    Args:
        depth: metric depth; any finite value where the silhouette is 0.
        silhouette: in [0, 1].
        step: jump of depth that counts half as an edge, in metric units.
    """
    # The background is placed at the far end of the unit sphere, seen from a camera at a distance of two radii.
    seen = silhouette * depth + (1 - silhouette) * 3.0
    across, down = jnp.diff(seen, axis=1)[:-1], jnp.diff(seen, axis=0)[:, :-1]
    jump = (jnp.square(across) + jnp.square(down)) / step**2
    return jnp.mean(jump / (1 + jump))
