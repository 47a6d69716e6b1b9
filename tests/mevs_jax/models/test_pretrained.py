"""Weights of torchvision in the networks of this package."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file

from data_pipeline.errors import DataError
from mevs_jax import ResNet
from tests.mevs_jax.models.test_networks import GOLDEN, golden_shapes, made, outputs
from tests.reference.weights import made_up_inputs, made_up_weights, untrained
from tests.train.weights.making import entry, safetensors
from train.tasks.classifier import ResNetConfig, starting_weights
from train.weights.files import read_state_dict
from train.weights.starting import weights_from_network, weights_from_torch


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """Made-up weights of a ResNet-18 for ten classes, under torchvision's names."""
    path = tmp_path_factory.mktemp("weights") / "resnet18.safetensors"
    save_file({name: np.asarray(array) for name, array in made_up_weights(golden_shapes("resnet18")).items()}, path)
    return path


def test_weights_from_a_file_give_pytorchs_outputs(weights):
    """Features are compared, since the head stays new: the stored logits are the file's head on them."""
    network = untrained(lambda: ResNet(depth=18, rngs=nnx.Rngs(0)))
    head = np.asarray(network.head.kernel[...])
    weights_from_torch((weights,), 18).put(network)
    np.testing.assert_array_equal(network.head.kernel[...], head)
    state = read_state_dict(weights)
    features = nnx.jit(lambda network, x: network.features(x))(network, jnp.asarray(made_up_inputs("resnet")))
    with np.load(GOLDEN) as golden:
        np.testing.assert_allclose(
            features @ state["fc.weight"].T + state["fc.bias"], golden["resnet18/outputs"], atol=1e-4
        )


def test_standardised_images_are_what_torchvision_expects(weights):
    """A network that standardises gives on [0, 1] images what one that does not gives on standardised ones."""
    plain, standard = (untrained(lambda s=s: ResNet(depth=18, standardise=s, rngs=nnx.Rngs(0))) for s in (False, True))
    for network in (plain, standard):
        weights_from_torch((weights,), 18).put(network)
    images = jax.random.uniform(jax.random.key(0), (2, 64, 64, 3))
    expected = outputs(plain, (images - jnp.array([0.485, 0.456, 0.406])) / jnp.array([0.229, 0.224, 0.225]))
    np.testing.assert_allclose(outputs(standard, images), expected, atol=1e-5)
    with pytest.raises(ValueError, match="3 channels only, got 1"):
        ResNet(channels=1, standardise=True, rngs=nnx.Rngs(0))


def test_the_file_of_the_right_depth_is_taken(weights, tmp_path):
    deeper = tmp_path / "resnet34.safetensors"
    save_file({name: np.asarray(array) for name, array in made_up_weights(golden_shapes("resnet34")).items()}, deeper)
    assert weights_from_torch((weights, deeper), 34).name.startswith("resnet34.safetensors, sha256 ")
    assert weights_from_torch((deeper, weights), 18).name.startswith("resnet18.safetensors, sha256 ")
    with pytest.raises(DataError, match=r"holds a ResNet-34; give --pretrained torchvision's resnet34 too"):
        weights_from_torch((weights,), 34)


def test_a_network_of_another_shape_refuses_them(weights):
    with pytest.raises(DataError, match=r"does not fit the classifier: conv1.weight has shape"):
        weights_from_torch((weights,), 18).put(untrained(lambda: ResNet(depth=18, width=8, rngs=nnx.Rngs(0))))
    with pytest.raises(DataError, match=r"does not fit the classifier: the network's stem is patches"):
        weights_from_torch((weights,), 18).put(untrained(lambda: ResNet(depth=18, stem="patches", rngs=nnx.Rngs(0))))


@pytest.mark.parametrize(
    "other", [{"width": 32}, {"depth": 10}, {"channels": 4, "standardise": False}, {"stem": "patches"}]
)
def test_settings_that_they_cannot_fit_are_refused_before_anything_is_read(other):
    with pytest.raises(DataError, match=r"--pretrained weights fit a ResNet of width 64 .* a convolution as its stem"):
        starting_weights((Path("absent.pth"),), replace(ResNetConfig(depth=18), **other))


def test_bfloat16_weights_are_used_as_float32(weights, tmp_path):
    """The same network comes from a bfloat16 file as from its numbers in float32."""
    state = {name: array.astype(ml_dtypes.bfloat16) for name, array in read_state_dict(weights).items()}
    header, content = {}, b""
    for name, array in state.items():
        header[name] = entry("BF16", array.shape, len(content), len(content) + array.nbytes)
        content += array.tobytes()
    half, whole = tmp_path / "half.safetensors", tmp_path / "whole.safetensors"
    half.write_bytes(safetensors(header, content))
    save_file({name: array.astype(np.float32) for name, array in state.items()}, whole)
    networks = [untrained(lambda: ResNet(depth=18, rngs=nnx.Rngs(0))) for _ in range(2)]
    for path, network in zip((half, whole), networks, strict=True):
        weights_from_torch((path,), 18).put(network)
    leaves = [jax.tree.leaves(nnx.state(network, nnx.Param, nnx.BatchStat)) for network in networks]
    for one, other in zip(*leaves, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e300])
def test_weights_that_are_not_finite_are_refused(weights, tmp_path, value):
    state = {name: np.array(array) for name, array in read_state_dict(weights).items()}
    state["layer1.0.bn1.weight"] = state["layer1.0.bn1.weight"].astype(np.float64)
    state["layer1.0.bn1.weight"][3] = value
    save_file(state, tmp_path / "diverged.safetensors")
    with pytest.raises(
        DataError, match=r"diverged.safetensors has weights that are not finite in layer1\.0\.bn1\.weight; "
    ):
        weights_from_torch((tmp_path / "diverged.safetensors",), 18)


def test_going_on_from_a_network_begins_with_all_of_it():
    before, after = (made(lambda seed=seed: ResNet(depth=18, width=4, rngs=nnx.Rngs(seed))) for seed in (1, 2))
    before.norm.mean[...] = before.norm.mean[...] + 0.3
    weights_from_network(before, "the one before").put(after)
    images = jax.random.uniform(jax.random.key(0), (2, 32, 32, 3))
    np.testing.assert_array_equal(outputs(before, images), outputs(after, images))
