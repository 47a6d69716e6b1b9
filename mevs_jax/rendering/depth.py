"""Depth images of a mesh as one array program for accelerators; equal to casting a ray through each pixel.

In the camera's frame the ray through a pixel is d = (x, y, 1). It meets the triangle abc if d is on the inner side of the
three planes through the camera and an edge: d·(b×c), d·(c×a) and d·(a×b) have the sign of a·n, with n = (b−a)×(c−a). There,
1/depth = d·n / a·n. All four are linear in (x, y), so a face is twelve numbers. Nothing needs to be clipped, not even faces
behind the camera (Olano and Greer, *Triangle Scan Conversion using 2D Homogeneous Coordinates*, 1997).

The image is divided into tiles. For each tile, one bit per face records whether the face may touch the tile. The tile then
processes these faces in groups of `_AT_ONCE` until none is left, so memory is bounded for every mesh and no face is dropped.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped, UInt32

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import Camera
from mevs_jax.points.bits import WORD, bits_until, set_bits

_TILE, _AT_ONCE = 16, 64  # pixels per side of a tile; faces per group


@flax.struct.dataclass
class Rendering:
    """The image of a mesh.

    Attributes:
        depth: (resolution, resolution) metric depth along the optical axis, +inf where nothing is hit.
        face: (resolution, resolution) index of the face that is hit, −1 where nothing is hit.
    """

    depth: Float[Array, "*batch resolution resolution"]
    face: Int[Array, "*batch resolution resolution"]


def pad_triangles(triangles: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "padded 3 3"]:
    """Pads triangles to a power of two (at least 64) with triangles that no ray hits.

    Meshes of similar size then share one compiled program.
    """
    size = max(64, 1 << (max(len(triangles), 1) - 1).bit_length())
    return np.concatenate([triangles, np.zeros((size - len(triangles), 3, 3), triangles.dtype)])


def render_depth(triangles: Float[AnyArray, "faces 3 3"], camera: Camera) -> Rendering:
    """Depth and face of the nearest hit of each pixel; triangles are visible from both sides.

    Args:
        triangles: `vertices[faces]`, corners in the world frame; a triangle without area is never hit.
        camera: the camera.
    """
    triangles = jnp.asarray(triangles)
    corners = jnp.pad(triangles, ((0, -len(triangles) % WORD), (0, 0), (0, 0)))
    exact = jax.lax.Precision.HIGHEST
    planes = _planes(jnp.matmul(corners - camera.pose[:3, 3], camera.pose[:3, :3], precision=exact))
    side, focal = camera.resolution, camera.focal_length
    tiles = -(-side // _TILE)
    pixels = (jnp.arange(_TILE) + 0.5) / focal
    corner = (jnp.arange(tiles) * _TILE - side / 2) / focal

    def tile(row: Array, column: Array) -> tuple[Array, Array]:
        y, x = jnp.meshgrid(row + pixels, column + pixels, indexing="ij")
        half = _TILE / 2 / focal
        return _tile(planes, x.reshape(-1), y.reshape(-1), (column + half, row + half), half)

    rows, columns = (axis.reshape(-1) for axis in jnp.meshgrid(corner, corner, indexing="ij"))
    nearness, face = jax.vmap(tile)(rows, columns)

    return Rendering(image_of_tiles(1 / nearness, _TILE, side), image_of_tiles(face, _TILE, side))


def image_of_tiles(pixels: Shaped[Array, "tiles pixels"], tile: int, side: int) -> Shaped[Array, "{side} {side}"]:
    """The image of `side` by `side` pixels from those of square tiles, `tile` pixels wide, row by row."""
    across = -(-side // tile)
    image = pixels.reshape(across, across, tile, tile).swapaxes(1, 2)
    return image.reshape(across * tile, -1)[:side, :side]


def _planes(corners: Float[Array, "faces 3 3"]) -> Float[Array, "faces 4 3"]:
    """Four vectors per face: the products of a ray with the first three are ≥ 0 inside the face, with the last it is 1/depth."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = jnp.cross(b - a, c - a)
    volume = jnp.sum(a * normal, axis=-1)
    # b×c is computed as b×(c−b), which is more accurate for small faces.
    edges = jnp.stack([jnp.cross(b, c - b), jnp.cross(c, a - c), jnp.cross(a, b - a)], axis=1)
    edges = edges * jnp.sign(volume)[:, None, None]
    hidden = (volume == 0)[:, None]  # without area, or seen edge-on
    nearness = normal / jnp.where(hidden, 1.0, volume[:, None])
    planes = jnp.concatenate([edges, nearness[:, None]], axis=1)
    return jnp.where(hidden[..., None], jnp.array([0.0, 0.0, -1.0]), planes)


def _tile(
    planes: Float[Array, "faces 4 3"],
    x: Float[Array, " pixels"],
    y: Float[Array, " pixels"],
    centre: tuple[Array, Array],
    half: float,
) -> tuple[Float[Array, " pixels"], Int[Array, " pixels"]]:
    """1/depth and face of each pixel of a tile; 0 and −1 where nothing is hit.

    Args:
        planes: from `_planes`.
        x, y: components of the pixels' rays.
        centre: x and y of the tile's centre.
        half: half of the tile's side, in the same unit.
    """
    most = planes[..., 0] * centre[0] + planes[..., 1] * centre[1] + planes[..., 2]
    most = most + half * (jnp.abs(planes[..., 0]) + jnp.abs(planes[..., 1]))
    touches = jnp.all(most >= 0, axis=-1)
    words = _packed(touches)
    until = bits_until(words)

    def some(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        start, nearness, face = carry
        ranks = start + jnp.arange(_AT_ONCE, dtype=jnp.int32)
        index = jnp.where(ranks < until[-1], set_bits(words, until, ranks), 0)
        of_tile = planes[index]
        along = of_tile[:, :, 0, None] * x + of_tile[:, :, 1, None] * y + of_tile[:, :, 2, None]
        inside = jnp.all(along[:, :3] >= 0, axis=1) & (ranks < until[-1])[:, None]
        candidates = jnp.where(inside, along[:, 3], 0.0)
        best = jnp.max(candidates, axis=0)
        which = jnp.max(jnp.where(candidates == best, index[:, None], -1), axis=0)
        nearer = best > nearness
        return start + _AT_ONCE, jnp.where(nearer, best, nearness), jnp.where(nearer, which, face)

    nothing = (jnp.int32(0), jnp.zeros_like(x), jnp.full(x.shape, -1, jnp.int32))
    _, nearness, face = jax.lax.while_loop(lambda carry: carry[0] < until[-1], some, nothing)
    return nearness, face


def _packed(flags: Array) -> UInt32[Array, " words"]:
    """Booleans as the bits of words, lowest bit first."""
    bit = jnp.uint32(1) << jnp.arange(WORD, dtype=jnp.uint32)
    return jnp.sum(jnp.where(flags.reshape(-1, WORD), bit, jnp.uint32(0)), axis=1, dtype=jnp.uint32)
