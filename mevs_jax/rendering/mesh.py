"""Soft rendering of a mesh: silhouette, depth and normals with gradients to the camera and to the corners of the faces.

After the soft rasteriser (Liu et al., *Soft Rasterizer*, 2019). Every face covers every pixel by D = sigmoid(δ / σ), where δ is
the signed distance in pixels from the pixel to the border of the face, positive inside. The silhouette combines the coverages as
independent probabilities, 1 − Π(1 − D). Depth and normals are means over all faces, weighted by
exp((nearness + min(0, log 2D)) / γ), so beyond its border a face counts as if it were farther away. (The paper's weights are
D · exp(nearness / γ), by which near faces hide others many σ beyond their border.) As σ and γ go to 0, the result becomes that of
ray casting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import Camera
from mevs_jax.rendering.depth import image_of_tiles
from mevs_jax.rendering.piecewise import limited, smaller

_NEAREST = 1e-3  # least depth of a corner of a visible face
_NOWHERE = -1e6  # δ / σ that marks a face as not visible
_FAR = 12.0  # −δ / σ beyond which a face covers less than 1e-5 of a pixel and is ignored
_LEAST = math.log(2) - _FAR  # log 2D at that distance


@dataclass(frozen=True)
class Softness:
    """The parameters of a soft rendering; as both go to 0, it becomes a hard one."""

    edge: float = 0.5
    """σ in pixels: the width of the border of a face."""
    nearness: float = 0.005
    """γ in 1/units: how much nearer (in 1/depth) a face must be to hide another."""


@flax.struct.dataclass
class SoftRendering:
    """The soft image of a mesh.

    Attributes:
        silhouette: (resolution, resolution) coverage of each pixel, in [0, 1].
        depth: (resolution, resolution) metric depth along the optical axis of the faces that cover a pixel or lie near it; 0
            where there are none.
        normal: (resolution, resolution, 3) in the camera's frame, towards the camera; a mean of unit vectors.
    """

    silhouette: Float[Array, "*batch resolution resolution"]
    depth: Float[Array, "*batch resolution resolution"]
    normal: Float[Array, "*batch resolution resolution 3"]


@jax.custom_jvp
def _softplus(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """log(1 + exp(x)); the derivative of JAX's own function needs two more exponentials."""
    return jnp.maximum(x, 0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


@_softplus.defjvp
def _softplus_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (along,) = primals, tangents
    small = jnp.exp(-jnp.abs(x))
    return jnp.maximum(x, 0) + jnp.log1p(small), jnp.where(x >= 0, 1, small) / (1 + small) * along


def _near_tiles(
    corners: Float[Array, "faces 3 3"], camera: Camera, margin: float, tile: int
) -> tuple[Int[Array, "tiles faces"], Int[Array, " tiles"]]:
    """For each tile, the indices of the faces whose bounding boxes come within `margin` pixels of it, and their number.

    The indices come first in each row; the rest of the row is filled with the number of faces.
    """
    depth = jnp.maximum(corners[..., 2:], _NEAREST)
    at = camera.focal_length * corners[..., :2] / depth + camera.resolution / 2  # (faces, 3, 2), column and row
    low, high = at.min(axis=1) - margin, at.max(axis=1) + margin
    seen = jnp.min(corners[..., 2], axis=-1) >= _NEAREST
    edge = jnp.arange(0, camera.resolution, tile)[:, None]
    columns, rows = (
        (low[:, axis] < edge + tile) & (high[:, axis] > edge) for axis in range(2)
    )  # (tiles per side, faces)
    near = (rows[:, None] & columns & seen).reshape(-1, len(corners))
    place = jnp.where(near, jnp.cumsum(near, axis=1) - 1, len(corners))
    every = jnp.broadcast_to(jnp.arange(len(corners)), near.shape)
    empty = jnp.full(near.shape, len(corners))
    listed = jax.vmap(lambda into, at, which: into.at[at].set(which, mode="drop"))(empty, place, every)
    return listed, jnp.sum(near, axis=1)


def render_mesh(
    triangles: Float[AnyArray, "faces 3 3"], camera: Camera, softness: Softness = Softness()
) -> SoftRendering:
    """Silhouette, depth and normals of a mesh, with gradients to triangles and camera in forward and reverse mode.

    Args:
        triangles: `vertices[faces]`, corners in the world frame, all in front of the camera. A triangle without area is
            invisible and has no gradient.
        camera: the camera.
        softness: widths of the transitions between faces.
    """
    small = partial(_in_pieces, softness=softness, tile=16, at_once=16)  # arrays that stay in a CPU's cache
    large = partial(_in_pieces, softness=softness, tile=camera.resolution, at_once=256)
    return jax.lax.platform_dependent(jnp.asarray(triangles), camera, cpu=small, default=large)


def _in_pieces(
    triangles: Float[Array, "faces 3 3"], camera: Camera, *, softness: Softness, tile: int, at_once: int
) -> SoftRendering:
    """`render_mesh` in tiles of so many pixels per side, with so many faces per step."""
    corners = (triangles - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    side = camera.resolution
    listed, counts = _near_tiles(jax.lax.stop_gradient(corners), camera, _FAR * softness.edge, tile)
    listed = jnp.pad(listed, ((0, 0), (0, -len(corners) % at_once)), constant_values=len(corners))
    corners = jnp.pad(corners, ((0, 1), (0, 0), (0, 0)))  # the last face stands for none
    pixel = jnp.arange(tile, dtype=corners.dtype) + 0.5 - side / 2
    rows, columns = jnp.meshgrid(pixel, pixel, indexing="ij")
    within = jnp.stack([columns.reshape(-1), rows.reshape(-1)])
    edge = jnp.arange(0, side, tile, dtype=corners.dtype)
    corner = jnp.stack(jnp.meshgrid(edge, edge, indexing="xy"), axis=-1).reshape(-1, 2)

    def of_tile(arguments: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        faces, count, corner = arguments
        chunks, at = faces.reshape(-1, at_once), within + corner[:, None]
        return _tile(corners, chunks, count, at, camera.focal_length, softness)

    empty, seen = jax.lax.map(of_tile, (listed, counts, corner))
    depth, *normal = (image_of_tiles(seen[:, channel], tile, side) for channel in range(4))
    return SoftRendering(-jnp.expm1(image_of_tiles(empty, tile, side)), depth, jnp.stack(normal, axis=-1))


def _tile(
    corners: Float[Array, "faces 3 3"],
    chunks: Int[Array, "chunks faces_at_once"],
    count: Int[Array, ""],
    at: Float[Array, "2 pixels"],
    focal: float,
    softness: Softness,
) -> tuple[Float[Array, " pixels"], Float[Array, "4 pixels"]]:
    """The log-transmittance of the pixels of a tile, and their depth and normal, from the first `count` of the faces listed."""

    @jax.checkpoint
    def some(carry: tuple[Array, ...], chunk: tuple[Array, Array]) -> tuple[tuple[Array, ...], None]:
        first, chosen = chunk
        seen = jax.lax.cond(
            first < count, lambda: _with_faces(carry, corners[chosen], at, focal, softness), lambda: carry
        )
        return seen, None

    none = jnp.zeros_like(at[0])
    start = (none, jnp.full_like(none, -1e30), *[none] * 5)
    (empty, _, total, *seen), _ = jax.lax.scan(some, start, (jnp.arange(0, chunks.size, chunks.shape[1]), chunks))
    return empty, jnp.stack(seen) / jnp.where(total > 0, total, 1.0)


def _with_faces(
    carry: tuple[Array, ...], faces: Float[Array, "faces 3 3"], at: Array, focal: float, softness: Softness
) -> tuple[Array, ...]:
    """The sums over faces with some more: log-transmittance, largest weight, sums of weights, depths and normals."""
    empty, largest, total, *seen = carry
    # The barriers keep XLA from recomputing all of this for each of the sums.
    cover, nearness, normal = jax.lax.optimization_barrier(_faces(faces, at, focal, softness.edge))
    spread = _softplus(cover)
    empty = empty - jnp.sum(spread, axis=0)  # log(1 − sigmoid(x)) = −softplus(x)
    # log(sigmoid(x)) = x − softplus(x). The lower limit: with less coverage a face is invisible at any nearness, and adding a
    # larger number would round off differences of nearness.
    hidden = limited(cover - spread + math.log(2), _LEAST, 0.0)
    weight = jnp.where(cover > _NOWHERE, (hidden + nearness) / softness.nearness, -jnp.inf)
    now = jax.lax.stop_gradient(jnp.maximum(largest, jnp.max(weight, axis=0)))
    weight, before = jax.lax.optimization_barrier((jnp.exp(weight - now), jnp.exp(largest - now)))
    # No matrix products here, since an accelerator might lower their precision.
    here = [weight / nearness, *(weight * normal[:, axis, None] for axis in range(3))]
    seen = [before * sofar + jnp.sum(part, axis=0) for sofar, part in zip(seen, here, strict=True)]
    return empty, now, before * total + jnp.sum(weight, axis=0), *seen


def _faces(
    corners: Float[Array, "faces 3 3"], at: Float[Array, "2 pixels"], focal: float, edge: float
) -> tuple[Float[Array, "faces pixels"], Float[Array, "faces pixels"], Float[Array, "faces 3"]]:
    """For some faces and pixels: the signed distance to the border in units of its width, 1/depth, and the faces' normals."""
    depth = limited(corners[..., 2], _NEAREST)
    x, y = (focal * corners[..., axis] / depth for axis in range(2))  # (faces, 3), in pixels from the middle
    before, after = (0, 1, 2), (1, 2, 0)
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    flat = jnp.abs(area) < 1e-9
    over_area = 1 / jnp.where(flat, 1.0, area)
    shares, squares = [], []
    for i, j in zip(before, after, strict=True):
        along = x[:, j] - x[:, i], y[:, j] - y[:, i]
        over_length = 1 / jnp.where(flat, 1.0, along[0] ** 2 + along[1] ** 2)
        dx, dy = at[0] - x[:, i, None], at[1] - y[:, i, None]
        part = limited((dx * along[0][:, None] + dy * along[1][:, None]) * over_length[:, None], 0.0, 1.0)
        squares.append(jnp.square(dx - part * along[0][:, None]) + jnp.square(dy - part * along[1][:, None]))
        # The barycentric coordinate of the corner opposite this edge.
        shares.append((along[0][:, None] * dy - along[1][:, None] * dx) * over_area[:, None])
    inside = (shares[0] >= 0) & (shares[1] >= 0) & (shares[2] >= 0)
    distance = jnp.sqrt(smaller(smaller(squares[0], squares[1]), squares[2]) + 1e-12)
    cover = jnp.where(inside, distance, -distance) / edge
    clipped = [limited(share, 0.0, 1.0) for share in shares]
    total = jnp.where(flat[:, None], 1.0, clipped[0] + clipped[1] + clipped[2])
    across = (2, 0, 1)
    nearness = sum(share / depth[:, corner, None] for share, corner in zip(clipped, across, strict=True)) / total
    normal = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = jnp.sqrt(jnp.where(flat, 1.0, jnp.sum(jnp.square(normal), axis=-1)))
    normal = normal / length[:, None] * -jnp.sign(jnp.sum(normal * corners[:, 0], axis=-1))[:, None]
    hidden = (flat | (jnp.min(corners[..., 2], axis=-1) < _NEAREST))[:, None]
    return jnp.where(hidden, _NOWHERE, cover), jnp.where(hidden, 1.0, nearness), jnp.where(hidden, 0.0, normal)
