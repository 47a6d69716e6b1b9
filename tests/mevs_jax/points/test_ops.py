"""Indices equal to an obvious loop, on clouds of every awkward kind."""

from __future__ import annotations

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, AxisType, NamedSharding, PartitionSpec

from mevs_jax import ball_query, farthest_point_sample
from mevs_jax.points import farthest, mosaic, ops
from mevs_jax.points import kernels as point_kernels
from tests.reference import numpy_rules

sample = jax.jit(farthest_point_sample, static_argnums=1)
query = jax.jit(ball_query, static_argnums=(2, 3))


def clouds_of(kind: str, random: np.random.Generator, count: int, points: int) -> np.ndarray:
    if kind == "lattice":  # ties everywhere
        return random.integers(-3, 4, (count, points, 3)).astype(np.float32) / 4
    clouds = random.uniform(-1, 1, (count, points, 3)).astype(np.float32)
    if kind == "duplicates":
        clouds[:, points // 3 :] = clouds[:, : points - points // 3]
    if kind == "one_point":
        clouds[:] = clouds[:, :1]
    return clouds


# 1,000 clouds in all: 8 shapes of 125.
CASES = [
    ("random", 97, 24, 0.4, 16),
    ("random", 256, 40, 0.15, 8),
    ("random", 64, 33, 0.7, 64),
    ("random", 33, 8, 0.01, 4),  # mostly no neighbour but the centre itself
    ("duplicates", 90, 24, 0.3, 16),
    ("lattice", 120, 32, 0.5, 12),
    ("random", 12, 20, 0.5, 32),  # fewer points than samples
    ("one_point", 7, 10, 0.2, 9),
]


@pytest.mark.usefixtures("fully_compiled")
@pytest.mark.parametrize(("kind", "points", "k", "radius", "samples"), CASES)
def test_indices_equal_an_obvious_loop(kind, points, k, radius, samples, random):
    clouds = clouds_of(kind, random, 125, points)
    ours = np.asarray(jax.jit(jax.vmap(lambda cloud: farthest_point_sample(cloud, k)))(clouds))
    for cloud, chosen in zip(clouds, ours, strict=True):
        np.testing.assert_array_equal(chosen, numpy_rules.farthest_point_sample(cloud, k))
    on_tpu = jax.jit(jax.vmap(lambda cloud: mosaic.farthest_point_sample(cloud, k, interpret=True)))
    np.testing.assert_array_equal(on_tpu(clouds), ours)
    np.testing.assert_array_equal(on_tpu(clouds[:4]), ours[:4])  # side by side
    if kind == "random":
        clouds[:, points // 2, 1] = np.where(random.random(125) < 0.5, np.nan, np.inf)
        plain = jax.jit(jax.vmap(lambda cloud: farthest.sample(cloud, k)))
        np.testing.assert_array_equal(on_tpu(clouds), plain(clouds))

    centres = clouds[:, :6] + (random.normal(0, 0.2, (125, 6, 3)).astype(np.float32) if kind == "random" else 0)
    groups = np.asarray(jax.jit(jax.vmap(lambda p, c: ball_query(p, c, radius, samples)))(clouds, centres))
    within = jnp.square(jnp.float32(radius))
    on_tpu = jax.jit(jax.vmap(lambda p, c: ops._query_on_tpu(p, c, within, samples)))
    np.testing.assert_array_equal(on_tpu(np.where(np.isfinite(clouds), clouds, np.inf), centres), groups)
    for cloud, centre, group in zip(clouds, centres, groups, strict=True):
        with np.errstate(invalid="ignore"):
            np.testing.assert_array_equal(group, numpy_rules.ball_query(cloud, centre, radius, samples))


@pytest.mark.parametrize(
    "points", [pytest.param(4096, marks=pytest.mark.slow), 3001, pytest.param(700, marks=pytest.mark.slow)]
)
def test_indices_at_the_thesis_sizes(points, random):
    cloud = clouds_of("random", random, 1, points)[0]
    chosen = np.asarray(sample(cloud, 512))
    np.testing.assert_array_equal(chosen, numpy_rules.farthest_point_sample(cloud, 512))
    groups = np.asarray(query(cloud, cloud[chosen[:40]], 0.2, 64))
    np.testing.assert_array_equal(groups, numpy_rules.ball_query(cloud, cloud[chosen[:40]], 0.2, 64))


@pytest.mark.parametrize(
    ("points", "k"),
    [
        (1, 1),
        (1, 3),
        (2, 4),
        (31, 33),
        (63, 1),
        (64, 65),
        (65, 66),
        (1023, 67),
        (8191, 64),
        (8192, 64),
        (8193, 130),
        (9000, 22),
    ],
)
def test_a_cloud_that_is_not_traced(points, k, random):
    cloud = clouds_of("random", random, 1, points)[0]
    expected = numpy_rules.farthest_point_sample(cloud, k)
    np.testing.assert_array_equal(farthest_point_sample(cloud, k), expected)

    def inside(shift):
        return farthest_point_sample(cloud, k) + shift

    assert {str(equation.primitive) for equation in jax.make_jaxpr(inside)(1).eqns} <= {"add", "convert_element_type"}
    np.testing.assert_array_equal(jax.vmap(inside)(jnp.arange(2))[1], expected + 1)


@pytest.mark.parametrize("kind", ["random", "duplicates", "lattice", "one_point", "line", "sphere", "not finite"])
@pytest.mark.parametrize(
    ("points", "k"), [(300, 64), *(pytest.param(*size, marks=pytest.mark.slow) for size in ((257, 90), (128, 8)))]
)
def test_points_that_are_too_near_are_left_out_without_a_difference(kind, points, k, random):
    cloud = clouds_of(kind, random, 1, points)[0]
    if kind == "line":  # distances fall faster than estimated, or more slowly
        cloud[:] = cloud[:, :1] ** 3
    if kind == "sphere":
        cloud /= np.linalg.norm(cloud, axis=1, keepdims=True)
    if kind == "not finite":
        cloud[40] = np.nan
    found = jax.jit(farthest.sample_large, static_argnums=1)(cloud, k)
    np.testing.assert_array_equal(found, jax.jit(farthest.sample, static_argnums=1)(cloud, k))
    if np.isfinite(cloud).all():
        np.testing.assert_array_equal(found, numpy_rules.farthest_point_sample(cloud, k))


def test_a_cloud_that_is_not_traced_where_it_cannot_be_compiled_by_itself(random):
    cloud = clouds_of("random", random, 1, 40)[0]
    expected = numpy_rules.farthest_point_sample(cloud, 5)
    mesh = jax.make_mesh((1,), ("a",))
    shared = jax.shard_map(
        lambda shift: farthest_point_sample(cloud, 5) + shift,
        mesh=mesh,
        in_specs=PartitionSpec(),
        out_specs=PartitionSpec(),
    )
    np.testing.assert_array_equal(shared(jnp.int32(1)), expected + 1)


def test_no_neighbour_gives_point_zero():
    points = np.ones((40, 3), np.float32)
    np.testing.assert_array_equal(query(points, np.zeros((2, 3), np.float32), 0.5, 5), np.zeros((2, 5)))


def test_the_radius_is_strict():
    points = np.array([[1, 0, 0], [0.5, 0, 0]], np.float32)
    np.testing.assert_array_equal(query(points, np.zeros((1, 3), np.float32), 1.0, 3), [[1, 1, 1]])


def test_indices_are_int32_and_sampling_starts_at_point_zero(random):
    cloud = clouds_of("random", random, 1, 50)[0]
    chosen = sample(cloud, 5)
    assert chosen.dtype == jnp.int32
    assert chosen[0] == 0
    assert query(cloud, cloud[:2], 0.1, 3).dtype == jnp.int32


@pytest.mark.parametrize("call", [lambda p: farthest_point_sample(p, 0), lambda p: ball_query(p, p, 0.1, 0)])
def test_zero_samples_are_refused(call):
    with pytest.raises(ValueError, match="k >= 1"):
        call(np.zeros((4, 3), np.float32))


KERNELS = [
    ("random", 700, 40, 0.2, 24),
    ("lattice", 120, 32, 0.5, 12),
    ("one_point", 7, 10, 0.2, 9),
    ("random", 130, 17, 0.6, 64),
]


@pytest.mark.parametrize(("kind", "points", "k", "radius", "samples"), KERNELS)
def test_kernels_give_the_same_indices(kind, points, k, radius, samples, random):
    """Interpreted, since there need not be a GPU; batched as in the networks, and with a centre that has no neighbour."""
    clouds = clouds_of(kind, random, 2, points)
    chosen = jax.vmap(lambda cloud: point_kernels.farthest_point_sample(cloud, k, interpret=True))(clouds)
    centres = np.concatenate([clouds[:, : points // 2], np.full((2, 1, 3), 9, np.float32)], axis=1)
    marred = clouds.copy()
    marred[1, 3], centres[1, 2], centres[0, 1, 2] = np.nan, np.inf, np.nan
    within = jnp.square(jnp.float32(radius))
    ask = lambda p, c: point_kernels.ball_query(p, c, within, samples, interpret=True)  # noqa: E731
    groups = jax.vmap(ask)(marred, centres)
    for cloud, indices in zip(clouds, chosen, strict=True):
        np.testing.assert_array_equal(indices, numpy_rules.farthest_point_sample(cloud, k))
    for cloud, centre, group in zip(marred, centres, groups, strict=True):
        with np.errstate(invalid="ignore"):
            np.testing.assert_array_equal(group, numpy_rules.ball_query(cloud, centre, radius, samples))


@pytest.mark.parametrize("kind", ["random", "lattice", "duplicates", "one_point"])
def test_points_in_the_order_of_sampling_are_sampled_in_this_order(kind, random):
    """So PointNet++ samples once, and takes the first centres for its next level: the same places, whatever their numbers."""
    clouds = clouds_of(kind, random, 25, 60)
    clouds[::5, 7] = np.nan
    for cloud in clouds:
        centres = cloud[sample(cloud, 40)]
        np.testing.assert_array_equal(centres[sample(centres, 16)], centres[:16])


def test_gpus_and_tpus_run_the_kernels_and_nothing_else_does():
    """What is lowered for them; whether it runs there is not seen here."""

    def both(clouds):
        return jax.vmap(lambda cloud: (farthest_point_sample(cloud, 64), ball_query(cloud, cloud[:32], 0.2, 16)))(
            clouds
        )

    h100 = AbstractDevice(device_kind="NVIDIA H100 80GB HBM3", num_cores=None, platform="gpu")

    def lowered(points, platform, dtype=np.float32, devices=1, clouds=8):
        """The number of kernels, and the shapes of the coordinates that those for farthest points receive."""
        everywhere = NamedSharding(AbstractMesh((devices,), ("data",), (AxisType.Auto,)), PartitionSpec())
        given = jax.ShapeDtypeStruct((clouds, points, 3), dtype, sharding=everywhere)
        # JAX 0.12 asks which GPU it lowers kernels for.
        with jax.sharding.use_abstract_mesh(AbstractMesh((), (), abstract_device=h100)):
            traced = jax.jit(both).trace(given)  # once for all platforms
            text = traced.lower(lowering_platforms=(platform,)).as_text()
        return text.count("@xla.gpu.triton") + text.count("@__gpu$xla.gpu.triton") + text.count("@tpu_custom_call")

    assert lowered(1000, "cuda") == 2
    assert lowered(1000, "tpu") == 1
    for devices, clouds in ((8, 16), (8, 3)):  # each has some of the clouds, or all
        assert lowered(1000, "cuda", devices=devices, clouds=clouds) == 2
        assert lowered(1000, "tpu", devices=devices, clouds=clouds) == 1
    assert lowered(20_000, "cuda") == 1  # too large a cloud for the registers of a block
    assert lowered(20_000, "tpu") == 0
    assert lowered(1000, "cuda", np.float16) == 0
    assert lowered(1000, "cpu") == 0
    exported = jax.export.export(jax.jit(both), platforms=["cuda", "tpu"])(
        jax.ShapeDtypeStruct((2, 1000, 3), np.float32)
    )
    # These would run with this version of JAX alone.
    assert not any(kernel in exported.mlir_module() for kernel in ("triton", "tpu_custom_call"))


def test_points_that_are_not_finite_are_no_neighbours():
    """They are left out, as by the plain rule; a centre that is not finite has no neighbours."""
    cloud = np.random.default_rng(7).normal(0, 0.2, (70, 3)).astype(np.float32)
    cloud[[3, 40], 1], cloud[[5, 41], 2], cloud[50] = np.nan, np.inf, -np.inf
    centres = np.concatenate([cloud[:8], np.full((1, 3), np.nan, np.float32)])
    found = np.asarray(query(cloud, centres, 0.4, 12))
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(found, numpy_rules.ball_query(cloud, centres, 0.4, 12))
    finite = np.isfinite(cloud).all(axis=1)
    assert finite[found[np.isfinite(centres).all(axis=1)]].all()
    with pytest.raises(AssertionError):
        np.testing.assert_array_equal(found[3], found[0])
    np.testing.assert_array_equal(found[[3, 5, 8]], 0)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (
            np.zeros((2, 5, 3), np.float32),
            r"takes one cloud \(points, 3\), got shape \(2, 5, 3\): use jax.vmap for several",
        ),
        (np.zeros((5, 6), np.float32), r"takes one cloud \(points, 3\), got shape \(5, 6\)"),
        (np.zeros((0, 3), np.float32), "needs at least one point"),
    ],
)
def test_what_is_no_cloud_is_described(points, said):
    unchecked = map(inspect.unwrap, (farthest_point_sample, ball_query))  # without the check of shapes in tests
    choose, neighbours = unchecked
    for call in (lambda: choose(points, 2), lambda: neighbours(points, points, 0.1, 2)):
        with pytest.raises(ValueError, match=said):
            call()


def test_no_memory_is_said(monkeypatch, random):
    def full(*_):
        raise RuntimeError("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr("mevs_jax.points.ops._farthest_on_cpu", full)
    with pytest.raises(RuntimeError, match="out of memory"):
        farthest_point_sample(random.normal(size=(9, 3)), 2)
