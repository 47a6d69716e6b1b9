"""Which algorithm runs follows the platform that a program is compiled for, not the host that traces it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import pytest
from flax import nnx
from jax.sharding import AbstractDevice, AbstractMesh

from data_pipeline.capture.rasterise import _render
from mevs_jax import PointNet2, ResNet, ball_query, farthest_point_sample
from mevs_jax.geometry.cameras import Camera
from mevs_jax.models import Abstraction, convolution
from mevs_jax.models.convolution import convolve, pool
from mevs_jax.rendering import ascend, render_mesh

PLATFORMS = ("cpu", "cuda", "tpu")
H100 = AbstractDevice(device_kind="NVIDIA H100 80GB HBM3", num_cores=None, platform="gpu")


def arrays(*shapes: tuple[int, ...]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]


def operations(function: Callable, platform: str, *given: jax.ShapeDtypeStruct) -> Counter[str]:
    """Operations of a program that is lowered here for a platform, and their numbers; not constants, nor what chooses one."""
    with jax.sharding.use_abstract_mesh(AbstractMesh((), (), abstract_device=H100)):  # JAX 0.12 asks which GPU it is
        # A function of its own, since JAX remembers what it traced.
        text = jax.jit(lambda *given: function(*given)).trace(*given).lower(lowering_platforms=(platform,)).as_text()
    lines = [re.sub(r"%[\w#:]+", "", line).strip() for line in text.splitlines() if "hlo." in line]
    return Counter(line for line in lines if not re.search(r"stablehlo\.(case|return|constant)|dims = \[\]", line))


def resnet(x: jax.Array) -> jax.Array:
    return ResNet(depth=10, classes=3, channels=1, width=8, rngs=nnx.Rngs(0))(x)


def pointnet(clouds: jax.Array) -> jax.Array:
    levels = Abstraction(64, 0.5, 128, (8,)), Abstraction(4, 1.0, 4, (8,))
    return PointNet2(views=4, abstractions=levels, global_layers=(8,), head_layers=(8,), rngs=nnx.Rngs(0))(clouds)


def picture(triangles: jax.Array, pose: jax.Array) -> jax.Array:
    return jnp.mean(render_mesh(triangles, Camera(pose, resolution=32)).depth)


def gradient(function: Callable) -> Callable:
    return jax.grad(lambda *given: jnp.sum(function(*given)))


PROGRAMS = {
    "convolution": (partial(convolve, stride=1), arrays((4, 4, 4, 8), (3, 3, 8, 8))),
    "pooling": (pool, arrays((2, 8, 8, 3))),
    "pooling's gradient": (gradient(pool), arrays((2, 8, 8, 3))),
    "ResNet's gradient": (gradient(resnet), arrays((2, 32, 32, 1))),
    "PointNet++": (pointnet, arrays((3, 100, 3))),
    "farthest points": (partial(farthest_point_sample, k=8), arrays((100, 3))),
    "ball query": (partial(ball_query, radius=0.2, k=8), arrays((100, 3), (8, 3))),
    "mesh": (gradient(picture), arrays((40, 3, 3), (4, 4))),
    "ascent": (
        lambda triangles, starts: ascend(partial(picture, triangles), starts, steps=3).poses,
        arrays((40, 3, 3), (5, 4, 4)),
    ),
    "captures": (partial(_render, side=8, field_of_view=1.0), arrays((16, 3, 3), (16, 3), (5, 4, 4))),
}

KERNELS = {"PointNet++": 3, "farthest points": 1, "ball query": 1}


@pytest.mark.parametrize("name", PROGRAMS)
def test_no_program_asks_what_the_host_is(name, monkeypatch):
    def refused(*_):
        raise AssertionError("a program asks for the host's devices")

    for asked in ("default_backend", "devices"):
        monkeypatch.setattr(jax, asked, refused)
    function, given = PROGRAMS[name]
    cpu, cuda, tpu = (operations(function, platform, *given) for platform in PLATFORMS)
    kernels = sum(count for line, count in cuda.items() if "xla.gpu.triton" in line)
    assert kernels == KERNELS.get(name, 0)
    assert cpu != tpu


@pytest.mark.parametrize("function", [resnet, gradient(resnet)], ids=["forwards", "backwards"])
def test_a_resnet_for_a_tpu_is_as_a_tpu_traces_it(function, monkeypatch):
    given = arrays((2, 32, 32, 1))
    found = operations(function, "tpu", *given)
    monkeypatch.setattr(convolution, "convolve", convolution._convolve)
    monkeypatch.setattr(convolution, "pool", convolution._pool)
    monkeypatch.setattr("mevs_jax.models.resnet.pool", convolution._pool)
    expected = operations(function, "tpu", *given)
    assert found == expected
    assert any("stablehlo.convolution" in line for line in found)
