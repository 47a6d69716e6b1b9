"""Farthest-point sampling and ball query, the two point operations of PointNet++.

Both follow the index rules of the reference CUDA operations (Qi et al., PointNet++, 2017; the `pointnet2_ops` package), so
weights trained with those can be used:

* farthest-point sampling starts at point 0, and among equal distances takes the smallest index;
* ball query takes the first `k` points, in index order, that lie strictly within the radius, and fills empty slots with the
  first of them, or with point 0 if there is none.

In programs for GPUs both are kernels (`mevs_jax.points.kernels`), in those for TPUs the first is (`mevs_jax.points.mosaic`). For
other devices, larger clouds and float64, and in exported programs, they are array programs. All return the same indices, since
all compare the same distances (`mevs_jax.points.distances`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from mevs_jax.arguments import check, whole
from mevs_jax.arrays import AnyArray
from mevs_jax.points import farthest
from mevs_jax.points.bits import WORD, bits_until, select_bit, set_bits
from mevs_jax.points.distances import only_finite, square, squared_distance
from mevs_jax.points.lowered import with_kernels

LARGEST_OF_KERNEL = 16_384
"""The largest number of points whose coordinates and distances fit into the registers of one block of a GPU, and the largest
numbers of points and of chosen ones that fit into a TPU's scalar memory."""
_FARTHEST = with_kernels("farthest_point_sample", farthest.sample)


def farthest_point_sample(points: Float[AnyArray, "points 3"], k: int) -> Int[Array, " {k}"]:
    """Indices of `k` points, each the farthest from those before it; the first is point 0.

    Source: PointNet++ §3.3; the rule of `pointnet2_ops` without its exception for points near the origin.

    Args:
        points: coordinates in any unit. Duplicates are allowed. A cloud that is not traced is sampled at once on CPU, also while
            a program is traced; the first cloud of a size is compiled.
        k: number of points to take, at least 1. If `k` exceeds the number of distinct points, the rest are 0.

    Returns:
        (k,) int32 indices.

    Raises:
        ValueError: for `k` below 1, a cloud without points, or an array of other than one cloud.
    """
    k = whole(k, "farthest_point_sample needs k >= 1", 1, 2**31 - 1)
    _check_cloud("farthest_point_sample", points)
    if isinstance(points, jax.core.Tracer) or not _is_on_cpu(points):
        return _farthest(points, k)
    try:
        with jax.ensure_compile_time_eval():
            return _farthest_on_cpu(points, k)
    except (ValueError, RuntimeError) as error:
        if "RESOURCE_EXHAUSTED" in str(error):  # out of memory
            raise
        # XLA does not know the option, or JAX refuses options here, as in a shard_map that is not compiled.
        return _farthest(points, k)


def _is_on_cpu(points: AnyArray) -> bool:
    """Whether an array that is not traced is on a CPU, or will be put there."""
    devices = points.devices() if isinstance(points, jax.Array) else jax.local_devices()
    return all(device.platform == "cpu" for device in devices)


def _farthest(points: Float[AnyArray, "points 3"], k: int) -> Int[Array, " {k}"]:
    points = jax.lax.stop_gradient(jnp.asarray(points))
    if points.dtype != jnp.float32 or max(points.shape[0], k) > LARGEST_OF_KERNEL:
        return farthest.sample(points, k)
    return _FARTHEST(points, k=k, shape=(k,))


def _farthest_of_known(points: Float[AnyArray, "points 3"], k: int) -> Int[Array, " {k}"]:
    points = jnp.asarray(points)
    large = points.shape[0] >= farthest.LARGE and k >= 64
    return farthest.sample_large(points, k) if large else farthest.sample(points, k)


# A concrete cloud is compiled as a program of its own, which may have its own options: vectors of 512 bits instead of the 256
# that XLA prefers. For 16,384 points this takes 2.7 ms instead of 3.9.
_farthest_on_cpu = jax.jit(_farthest_of_known, static_argnums=1, compiler_options={"xla_cpu_prefer_vector_width": 512})


def _check_cloud(name: str, points: AnyArray) -> None:
    """Raises `ValueError` unless `points` are those of one cloud, at least one."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name} takes one cloud (points, 3), got shape {points.shape}: use jax.vmap for several")
    if not len(points):
        raise ValueError(f"{name} needs at least one point")


def ball_query(
    points: Float[AnyArray, "points 3"], centres: Float[AnyArray, "centres 3"], radius: float | Float[Array, ""], k: int
) -> Int[Array, "centres {k}"]:
    """For each centre, the indices of the first `k` points, in index order, strictly within `radius`.

    Source: PointNet++ §3.2; the rule of `pointnet2_ops`.

    Args:
        points: coordinates.
        centres: coordinates in the same unit.
        radius: in that unit; compared as `d² < radius·radius` in float32, as in the reference.
        k: number of indices per centre, at least 1. Empty slots repeat the first hit; a centre without hits gets point 0.

    Returns:
        (centres, k) int32 indices. A point with a coordinate that is not finite is no hit.

    Raises:
        ValueError: for `k` below 1, a cloud without points, or arrays of other than one cloud.
    """
    k = whole(k, "ball_query needs k >= 1", 1, 2**31 - 1)
    check(radius, "radius must be at least 0", lambda far: far >= 0)
    _check_cloud("ball_query", points)
    _check_cloud("ball_query", centres)
    points, centres = (jax.lax.stop_gradient(jnp.asarray(array)) for array in (points, centres))
    squared_radius = square(jax.lax.stop_gradient(jnp.asarray(radius, points.dtype)))
    if points.dtype != jnp.float32:
        return _query_of_array(points, centres, squared_radius, k)
    return _BALL_QUERY(points, centres, squared_radius, k=k, shape=(centres.shape[0], k))


def _query_of_array(
    points: Float[Array, "points 3"], centres: Float[Array, "centres 3"], squared_radius: Float[Array, ""], k: int
) -> Int[Array, "centres {k}"]:
    """`ball_query` as an array program.

    The hits of 32 points become the bits of one word. Prefix sums of the numbers of bits find the word of the s-th hit, and five
    halvings find the bit inside it. Only the distances need a pass over all points.
    """
    words = _hits(points, centres, squared_radius)
    return jax.vmap(_first_hits, in_axes=(0, None))(words, k)


def _query_on_tpu(
    points: Float[Array, "points 3"], centres: Float[Array, "centres 3"], squared_radius: Float[Array, ""], k: int
) -> Int[Array, "centres {k}"]:
    """`_query_of_array` without gathers and associative scans, which are slow on a TPU: every slot is compared with every word.

    Arrays have words in rows and centres in columns, so that sums over words add whole vectors.
    """
    words = _hits(points, centres, squared_radius).T
    counts = jax.lax.population_count(words)
    number = jnp.arange(words.shape[0], dtype=jnp.int32)[:, None]
    # A product of numbers up to 32 with ones is exact also in bfloat16, which is what a TPU multiplies.
    until = jnp.matmul((number >= number.T).astype(jnp.float32), counts.astype(jnp.float32)).astype(jnp.int32)
    before = until - counts.astype(jnp.int32)
    slot = jnp.arange(k, dtype=jnp.int32)[:, None]
    rank = jnp.where(slot < until[-1], slot, 0)
    here = (before[:, None] <= rank) & (rank < until[:, None])  # one word of each slot and centre

    def of_slots(values: Int[Array, "words #centres"]) -> Int[Array, "slots centres"]:
        return jnp.sum(jnp.where(here, values[:, None], 0), axis=0, dtype=jnp.int32)

    word = of_slots(jax.lax.bitcast_convert_type(words, jnp.int32)).astype(jnp.uint32)
    position = of_slots(number) * WORD + select_bit(word, rank - of_slots(before))
    return jnp.where(until[-1] > 0, position, 0).T


_BALL_QUERY = with_kernels("ball_query", _query_of_array, arrays_on_tpu=_query_on_tpu)


def _hits(
    points: Float[Array, "points 3"], centres: Float[Array, "centres 3"], squared_radius: Float[Array, ""]
) -> UInt32[Array, "centres words"]:
    """Which points are within the radius of each centre, one bit each."""
    # A point that is not finite is no neighbour of any centre, and a centre that is not finite has none.
    points, centres = only_finite(points, jnp.inf), only_finite(centres, -jnp.inf)
    padded = jnp.pad(points, ((0, -points.shape[0] % WORD), (0, 0)), constant_values=jnp.inf)
    # The points of a word form a column, so that the sum over bits is vectorised over words.
    x, y, z = (padded[:, axis].reshape(-1, WORD).T for axis in range(3))
    hit = (
        squared_distance(centres[:, 0, None, None] - x, centres[:, 1, None, None] - y, centres[:, 2, None, None] - z)
        < squared_radius
    )
    bit = jnp.uint32(1) << jnp.arange(WORD, dtype=jnp.uint32)
    return jnp.sum(jnp.where(hit, bit[:, None], jnp.uint32(0)), axis=1, dtype=jnp.uint32)


def _first_hits(words: UInt32[Array, " words"], k: int) -> Int[Array, " {k}"]:
    """Positions of the first `k` set bits; if there are fewer, the first is repeated, and without any all are 0."""
    until = bits_until(words)
    slot = jnp.arange(k, dtype=jnp.int32)
    position = set_bits(words, until, jnp.where(slot < until[-1], slot, 0))
    return jnp.where(until[-1] > 0, position, 0)
