"""A hard silhouette with an approximate gradient: the thesis's mesh renderer (Kato et al., *Neural 3D Mesh Renderer*, 2018).

A pixel is covered or not, so its derivative is zero almost everywhere. It is replaced by a quotient: the change of the pixel if
an edge of a visible face moved along the pixel's row (for x) or column (for y) until it crossed the pixel, divided by the
distance that the edge moves. Only changes that improve the objective count (eq. 6 of the paper). This gradient is therefore not
linear in the incoming gradient, and it depends on whether the objective is maximised or minimised. Unlike in the published code,
only edges next to the background count: when a camera moves, faces move together, and an edge between two faces uncovers nothing.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import Camera
from mevs_jax.rendering.depth import render_depth
from mevs_jax.rendering.piecewise import limited

_AT_ONCE = 32  # faces per batch
_NEAREST = 0.5  # least distance to a crossing, in pixels; without it, gradients would be unbounded


def render_silhouette(
    triangles: Float[AnyArray, "faces 3 3"], camera: Camera, *, rises: bool = True
) -> Float[Array, "resolution resolution"]:
    """1 where a ray hits the mesh, 0 elsewhere, with the approximate gradient in reverse mode only.

    Args:
        triangles: `vertices[faces]`, corners in the world frame, all in front of the camera.
        camera: the camera.
        rises: whether the objective computed from the silhouette is maximised; False if it is minimised, like a loss.
    """
    triangles = jnp.asarray(triangles)
    corners = (triangles - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    projected = camera.focal_length * corners[..., :2] / limited(corners[..., 2:], 1e-3)
    seen = render_depth(jax.lax.stop_gradient(triangles), jax.lax.stop_gradient(camera))
    return _silhouette(projected, seen.face, rises)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _silhouette(
    corners: Float[Array, "faces 3 2"], face: Int[Array, "side side"], rises: bool
) -> Float[Array, "side side"]:
    return (face >= 0).astype(corners.dtype)


def _forward(corners: Array, face: Array, rises: bool) -> tuple[Array, tuple[Array, Array]]:
    return (face >= 0).astype(corners.dtype), (corners, face)


def _backward(rises: bool, residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, None]:
    corners, face = residuals
    along_x = _of_rows(corners, face, cotangent, rises)
    along_y = _of_rows(corners[..., ::-1], face.T, cotangent.T, rises)
    return jnp.stack([along_x, along_y], axis=-1), None


_silhouette.defvjp(_forward, _backward)


def _of_rows(
    corners: Float[Array, "faces 3 2"], face: Int[Array, "side side"], cotangent: Float[Array, "side side"], rises: bool
) -> Float[Array, "faces 3"]:
    """The gradient with respect to the x of the corners, from edges that move along the rows."""
    side = face.shape[0]
    pixel = jnp.arange(side)
    y = pixel + 0.5 - side / 2
    covered = face >= 0

    def of_edge(number: Array, start: Array, end: Array, third: Array) -> tuple[Array, Array]:
        """The gradients with respect to the x of the two ends of one edge of face `number`."""
        height = end[1] - start[1]
        slope = (end[0] - start[0]) / jnp.where(height == 0, 1.0, height)
        part = (y - start[1]) / jnp.where(height == 0, 1.0, height)
        crossing = start[0] + part * (end[0] - start[0]) + side / 2 - 0.5  # in columns
        inwards = jnp.sign(third[0] - (start[0] + (third[1] - start[1]) * slope))
        inner = jnp.where(inwards > 0, jnp.ceil(crossing), jnp.floor(crossing)).astype(jnp.int32)
        outer = inner - inwards.astype(jnp.int32)
        there = (height != 0) & (part >= 0) & (part < 1) & (inwards != 0)
        there &= (jnp.minimum(inner, outer) >= 0) & (jnp.maximum(inner, outer) < side)
        inner, outer = (jnp.clip(column, 0, side - 1) for column in (inner, outer))
        there &= jnp.take_along_axis(face, inner[:, None], axis=1)[:, 0] == number  # visible
        there &= ~jnp.take_along_axis(covered, outer[:, None], axis=1)[:, 0]
        # Change of each pixel of a row: +1 for background outside of the edge, −1 for this face inside of it.
        outside = (pixel - crossing[:, None]) * inwards < 0
        gain = jnp.where(outside & ~covered, 1.0, 0.0) - jnp.where(~outside & (face == number), 1.0, 0.0)
        pull = gain * cotangent
        pull = jnp.where(pull > 0 if rises else pull < 0, pull, 0.0)
        distance = pixel - crossing[:, None]
        distance = jnp.where(distance < 0, jnp.minimum(distance, -_NEAREST), jnp.maximum(distance, _NEAREST))
        of_row = jnp.where(there, jnp.sum(pull / distance, axis=1), 0.0)
        return jnp.sum((1 - part) * of_row), jnp.sum(part * of_row)

    def of_face(arguments: tuple[Array, Array]) -> Array:
        number, corner = arguments
        gradient = jnp.zeros(3, corners.dtype)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            start, end = of_edge(number, corner[i], corner[j], corner[k])
            gradient = gradient.at[i].add(start).at[j].add(end)
        return gradient

    return jax.lax.map(of_face, (jnp.arange(len(corners)), corners), batch_size=_AT_ONCE)
