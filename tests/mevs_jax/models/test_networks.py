"""Networks: the thesis's parameter counts, and PyTorch's numbers for the same weights."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mevs_jax import PointNet2, ResNet, count_parameters, pointnet2_from_torch, resnet_from_torch
from mevs_jax.models import Abstraction, BatchNorm
from tests.reference.weights import made_up_inputs, made_up_weights

GOLDEN = Path(__file__).parents[2] / "reference" / "golden.npz"
KINDS = ("resnet18", "resnet34", "pointnet2")


@partial(nnx.jit, static_argnames="make")
def made(make: Callable[[], nnx.Module]) -> nnx.Module:
    """A network with random weights, drawn by one program."""
    return make()


def outputs(network: nnx.Module, inputs: np.ndarray | jax.Array) -> jax.Array:
    """What a network returns, by one program that is traced anew."""
    return nnx.jit(lambda network, inputs: network(inputs))(network, inputs)


@pytest.mark.parametrize(
    ("network", "count", "trainable"),
    [
        (lambda: PointNet2(views=10, rngs=nnx.Rngs(0)), 1_471_509, 1_464_842),
        (lambda: PointNet2(views=40, rngs=nnx.Rngs(0)), 1_479_219, 1_472_552),
        (lambda: ResNet(depth=18, classes=10, rngs=nnx.Rngs(0)), 11_191_262, 11_181_642),
        (lambda: ResNet(depth=34, classes=10, rngs=nnx.Rngs(0)), 21_306_862, 21_289_802),
    ],
)
def test_parameters_are_counted_as_in_the_thesis(network, count, trainable):
    shapes = nnx.eval_shape(network)
    assert count_parameters(shapes) == count
    assert count_parameters(shapes, trainable_only=True) == trainable


def ours(kind: str, state: dict[str, np.ndarray]) -> nnx.Module:
    """A network with these weights; none are drawn before."""
    if kind == "pointnet2":
        network = nnx.eval_shape(lambda: PointNet2(views=40, dropout=0.0, rngs=nnx.Rngs(0)))
        pointnet2_from_torch(network, state)
    else:
        network = nnx.eval_shape(lambda: ResNet(depth=int(kind[-2:]), rngs=nnx.Rngs(0)))
        resnet_from_torch(network, state)
    return network


class _Named:
    """Collects our gradients under torch's names, by loading a state dict whose every entry is a marker of its own."""

    @staticmethod
    def map(kind: str, shapes: dict[str, tuple[int, ...]], gradients: nnx.State) -> dict[str, np.ndarray]:
        markers = {name: np.full(shape, index, np.float32) for index, (name, shape) in enumerate(shapes.items())}
        marked = nnx.state(ours(kind, markers), nnx.Param)
        names = list(shapes)
        out = {}
        for marker, gradient in zip(jax.tree.leaves(marked), jax.tree.leaves(gradients), strict=True):
            name = names[int(np.asarray(marker).reshape(-1)[0])]
            array = np.asarray(gradient)
            if array.ndim == 4:
                array = array.transpose(3, 2, 0, 1)
            elif array.ndim == 2:
                array = array.T
            out[name] = array.reshape(shapes[name])
        return out


def forward_ours(kind: str) -> np.ndarray:
    """Outputs in evaluation mode, in single precision."""
    network = ours(kind, made_up_weights(golden_shapes(kind)))
    inputs = jnp.asarray(made_up_inputs("pointnet2" if kind == "pointnet2" else "resnet"))
    return np.asarray(nnx.jit(lambda network, x: network(x))(network, inputs))


@cache
def train_ours(kind: str) -> tuple[dict[str, np.ndarray], nnx.Module]:
    """Gradients of the mean squared output in training mode, and the network after it.

    In double precision: a batch of three through 30 batch norms amplifies rounding in single precision beyond any use, in
    PyTorch and here alike; in double, what differs is what is wrong.
    """
    shapes = golden_shapes(kind)
    network = ours(kind, made_up_weights(shapes))
    inputs = made_up_inputs("pointnet2" if kind == "pointnet2" else "resnet")
    with jax.enable_x64(True):
        structure, parameters, rest = jax.tree.map(
            lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf,
            nnx.split(network, nnx.Param, ...),
        )

        @jax.jit
        def step(parameters, rest, inputs):
            def loss(parameters):
                merged = nnx.merge(structure, parameters, rest, copy=True)
                extra = {"key": jax.random.key(0)} if kind == "pointnet2" else {}
                out = merged(inputs, train=True, **extra)
                return jnp.mean(jnp.square(out)), nnx.state(merged, nnx.BatchStat)

            return jax.grad(loss, has_aux=True)(parameters)

        gradients, statistics = step(parameters, rest, jnp.asarray(inputs, jnp.float64))
        named = _Named.map(kind, shapes, gradients)
    nnx.update(network, statistics)
    return named, network


def golden_shapes(kind: str) -> dict[str, tuple[int, ...]]:
    with np.load(GOLDEN) as golden:
        return {
            str(name): tuple(map(int, str(shape).split()))
            for name, shape in zip(golden[f"{kind}/names"], golden[f"{kind}/shapes"], strict=True)
        }


def fingerprint(array: np.ndarray) -> np.ndarray:
    flat = np.zeros(6, np.float32)
    flat[: min(6, array.size)] = array.reshape(-1)[:6]
    return np.concatenate([[np.linalg.norm(array), array.sum()], flat])


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind == "resnet34")) for kind in KINDS]
)
def test_forward_and_gradients_equal_stored_pytorch(kind):
    gradients, _ = train_ours(kind)
    with np.load(GOLDEN) as golden:
        np.testing.assert_allclose(forward_ours(kind), golden[f"{kind}/outputs"], atol=1e-4, rtol=0)
        for name, stored in zip(golden[f"{kind}/gradient_names"], golden[f"{kind}/gradients"], strict=True):
            np.testing.assert_allclose(
                fingerprint(gradients[str(name)]), stored, atol=1e-4, rtol=1e-4, err_msg=str(name)
            )


@pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="PyTorch is not installed; stored outputs are compared"
)
@pytest.mark.parametrize("kind", KINDS)
def test_forward_gradients_and_running_statistics_equal_live_pytorch(kind):
    from tests.reference.torch_networks import run

    theirs = run(kind)
    gradients, after = train_ours(kind)
    np.testing.assert_allclose(forward_ours(kind), theirs["outputs"], atol=1e-4, rtol=0)
    for name, gradient in theirs["gradients"].items():
        np.testing.assert_allclose(gradients[name], gradient, atol=1e-6, rtol=1e-6, err_msg=name)
    first = after.perceptrons[0].norm[0] if kind == "pointnet2" else after.norm
    prefix = "SA_modules.0.mlps.0.1" if kind == "pointnet2" else "bn1"
    np.testing.assert_allclose(first.mean[...], theirs["running"][f"{prefix}.running_mean"], atol=1e-6)
    np.testing.assert_allclose(first.variance[...], theirs["running"][f"{prefix}.running_var"], rtol=1e-6)
    assert int(first.batches[...]) == 1


def test_one_input_equals_a_batch_of_one():
    network = made(lambda: ResNet(depth=18, width=8, rngs=nnx.Rngs(0)))
    images = jax.random.normal(jax.random.key(0), (3, 32, 32, 3))
    one = outputs(network, images[1])
    np.testing.assert_allclose(one, outputs(network, images)[1], atol=1e-5)
    assert one.shape == (10,)


def test_batch_norm_in_training_updates_with_the_momentum_given():
    norm = BatchNorm(3)
    x = jax.random.normal(jax.random.key(0), (50, 3)) * 2 + 1
    out = norm(x, train=True, momentum=0.25)
    np.testing.assert_allclose(jnp.mean(out, 0), 0, atol=1e-5)
    np.testing.assert_allclose(norm.mean[...], 0.25 * jnp.mean(x, 0), rtol=1e-5)
    np.testing.assert_allclose(norm.variance[...], 0.75 + 0.25 * jnp.var(x, 0, ddof=1), rtol=1e-5)


def test_directions_stand_in_the_place_of_the_normals(random):
    """Zeros there are the network of the thesis; anything else is seen."""
    network = made(lambda: PointNet2(views=4, rngs=nnx.Rngs(0)))
    cloud = random.normal(0, 0.4, (600, 3)).astype(np.float32)
    directions = random.normal(0, 1, (600, 3)).astype(np.float32)
    nothing = outputs(network, np.concatenate([cloud, np.zeros_like(cloud)], axis=1))
    found, embedded = nnx.jit(lambda network, cloud: (network(cloud), network.embed(cloud)))(network, cloud)
    np.testing.assert_allclose(found, nothing, rtol=1e-5, atol=1e-6)
    assert embedded.shape == (1024,)
    hidden = embedded
    for weights, factor, bias in network.head.layers():
        hidden = jax.nn.relu(hidden @ weights * factor + bias)
    np.testing.assert_allclose(network.out(hidden), found, rtol=1e-4, atol=1e-6)
    seen = outputs(network, np.concatenate([cloud, directions], axis=1))
    assert np.abs(np.asarray(seen - nothing)).max() > 1e-3


@pytest.mark.parametrize("columns", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_pieces_of_a_cloud_equal_the_whole(columns, random):
    """On a CPU neighbourhoods pass in pieces, elsewhere all at once; in bfloat16 coordinates keep their own precision."""
    network, halved = (
        made(lambda dtype=dtype: PointNet2(views=4, dtype=jnp.dtype(dtype), rngs=nnx.Rngs(0)))
        for dtype in ("float32", "bfloat16")
    )
    clouds = random.normal(0, 0.4, (3, 700, columns)).astype(np.float32)
    pieces, rough = outputs(network, clouds), outputs(halved, clouds)
    here, elsewhere = (
        nnx.jit(lambda network, clouds, fits=fits: network._embed_in_parts(clouds, in_cache=fits))(network, clouds)
        for fits in (True, False)
    )
    np.testing.assert_allclose(elsewhere, here, rtol=1e-4, atol=1e-5)
    assert rough.dtype == jnp.float32
    np.testing.assert_allclose(rough, pieces, atol=0.05 * float(jnp.abs(pieces).max()))


def test_dropout_acts_in_training_only():
    network = made(lambda: PointNet2(views=4, rngs=nnx.Rngs(0)))
    cloud = jax.random.uniform(jax.random.key(0), (2, 600, 3))
    train = nnx.jit(lambda network, cloud, key: network(cloud, train=True, key=key))
    a, b = (train(network, cloud, jax.random.key(k)) for k in (1, 2))
    assert not np.allclose(a, b)
    say = nnx.jit(lambda network, cloud: network(cloud))
    np.testing.assert_array_equal(say(network, cloud), say(network, cloud))
    with pytest.raises(ValueError, match="key"):
        network(cloud, train=True)


def test_wrong_state_dicts_are_refused():
    shapes = golden_shapes("resnet18")
    state = made_up_weights(shapes)
    network = nnx.eval_shape(lambda: ResNet(depth=18, rngs=nnx.Rngs(0)))
    with pytest.raises(ValueError, match=r"no 'fc\.bias'"):
        resnet_from_torch(network, {name: value for name, value in state.items() if name != "fc.bias"})
    with pytest.raises(ValueError, match="lacks"):
        resnet_from_torch(network, state | {"extra.weight": np.zeros(3)})
    with pytest.raises(ValueError, match="shape"):
        resnet_from_torch(network, state | {"fc.bias": np.zeros(40, np.float32)})
    with pytest.raises(ValueError, match="18 or 34"):
        ResNet(depth=50, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="3 or 6 columns, got 4"):
        outputs(nnx.eval_shape(lambda: PointNet2(views=4, rngs=nnx.Rngs(0))), jnp.zeros((600, 4)))
    with pytest.raises(ValueError, match="at least 2"):
        PointNet2(views=1, rngs=nnx.Rngs(0))


def test_images_of_integers_are_refused():
    """They would cast the weights to integers, and all logits would be 0."""
    network = ResNet(depth=10, classes=3, channels=1, width=8, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match=r"needs floating-point images in .* got uint8: divide 8-bit images by 255"):
        inspect.unwrap(ResNet.features)(network, np.zeros((32, 32, 1), np.uint8))


def small_pointnet(views: int) -> PointNet2:
    levels = Abstraction(8, 0.5, 4, (8,)), Abstraction(4, 1.0, 4, (8,))
    return PointNet2(views=views, abstractions=levels, global_layers=(8,), head_layers=(8,), rngs=nnx.Rngs(0))


def test_clouds_without_points_are_refused():
    with pytest.raises(ValueError, match="at least one point, got none"):
        small_pointnet(6)(np.zeros((2, 0, 3), np.float32))


@pytest.mark.parametrize(
    ("network", "inputs"),
    [
        (
            lambda: ResNet(depth=10, classes=3, channels=1, width=8, rngs=nnx.Rngs(0)),
            np.ones((4, 16, 16, 1), np.float32),
        ),
        (lambda: small_pointnet(6), np.ones((4, 20, 3), np.float32)),
    ],
)
def test_training_is_told_with_each_call(network, inputs):
    """Flax's modes would change nothing in silence; and statistics cannot be updated within a vmap."""
    network = made(network)
    before = outputs(network, inputs)
    with pytest.raises(ValueError, match="has no training mode: call it with train=True"):
        network.train()
    network.eval()
    np.testing.assert_array_equal(outputs(network, inputs), before)
    rest = {"key": jax.random.key(0)} if not isinstance(network, ResNet) else {}
    with pytest.raises(ValueError, match="give the network the whole batch in one call"):
        jax.jit(jax.vmap(lambda one: network(one[None], train=True, **rest)))(inputs)
    nnx.jit(lambda network, inputs: network(inputs, train=True, **rest))(network, inputs)
