"""Files of weights: read without PyTorch, exactly, and never trusted."""

from __future__ import annotations

import importlib.util
import os
import pickle
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file

from data_pipeline.errors import DataError
from mevs_jax import ResNet
from tests.mevs_jax.models.test_networks import GOLDEN, golden_shapes
from tests.reference.weights import made_up_inputs, made_up_weights, small_state
from train.starting_weights import (
    _Storage,
    _Tensor,
    read_state_dict,
    resnet_depth,
    weights_from_network,
    weights_from_torch,
)

REFERENCE = Path(__file__).parents[2] / "reference"


def check_small(read: dict[str, np.ndarray]) -> None:
    expected = small_state()
    assert read.keys() == expected.keys()
    for name, array in expected.items():
        assert read[name].shape == array.shape
        np.testing.assert_array_equal(np.asarray(read[name], np.float64), array, err_msg=name)


@pytest.mark.parametrize("kind", ["zip", "legacy"])
def test_both_formats_of_pytorch_are_read_exactly(kind):
    read = read_state_dict(REFERENCE / f"weights_{kind}.pth")
    check_small(read)
    assert read["half"].dtype == np.float16
    assert read["count"].dtype == np.int64


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed; stored files are read")
@pytest.mark.parametrize("new", [True, False])
def test_files_that_pytorch_writes_now_are_read_exactly(tmp_path, new):
    import torch

    from tests.reference.torch_networks import build, small_tensors

    torch.save(small_tensors(), tmp_path / "small.pth", _use_new_zipfile_serialization=new)
    check_small(read_state_dict(tmp_path / "small.pth"))
    network = build("resnet18")
    wrapped = {"state_dict": {f"module.{name}": value for name, value in network.state_dict().items()}}
    torch.save(wrapped, tmp_path / "wrapped.pt", _use_new_zipfile_serialization=new)
    read = read_state_dict(tmp_path / "wrapped.pt")
    assert resnet_depth(read) == 18
    for name, value in network.state_dict().items():
        np.testing.assert_array_equal(read[name], value.numpy())


class _Evil:
    """What a hostile file would hold: unpickled as usual, it makes a folder."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("kind", ["zip", "legacy", "bare"])
def test_a_hostile_file_is_refused_and_nothing_runs(tmp_path, kind):
    marker, path = tmp_path / "was_here", tmp_path / "evil.pth"
    evil = pickle.dumps({"conv1.weight": _Evil(marker)})
    if kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", evil)
    elif kind == "legacy":
        path.write_bytes(pickle.dumps(0x1950A86A20F9469CFC6C) + pickle.dumps(1001) + pickle.dumps({}) + evil)
    else:
        path.write_bytes(evil)
    with pytest.raises(DataError, match=r"evil\.pth is not a file of weights.*mkdir, which no file of weights needs"):
        read_state_dict(path)
    assert not marker.exists()
    pickle.loads(evil)  # the file does what it says it does
    assert marker.exists()


@pytest.mark.parametrize(("size", "stride", "offset"), [((3,), (1,), 0), ((1,), (1,), 2), ((2,), (-1,), 0)])
def test_a_tensor_beyond_its_storage_is_refused(size, stride, offset):
    with pytest.raises(ValueError, match="beyond its storage"):
        _Tensor(_Storage("0", np.float32), offset, size, stride).array({"0": np.zeros(2, np.float32)})


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.pth", b"", "not a file of weights"),
        ("text.pth", b"<!doctype html>", "not a file of weights"),
        ("short.pth", (REFERENCE / "weights_legacy.pth").read_bytes()[:-8], "not a file of weights"),
        ("half.pth", (REFERENCE / "weights_zip.pth").read_bytes()[:400], "not a file of weights"),
        ("text.safetensors", b"nothing of the kind", "not a file of weights"),
        ("list.pth", None, "not a state dict"),
    ],
)
def test_unusable_files_are_described(tmp_path, name, content, message):
    path = tmp_path / name
    if content is None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickle.dumps([1, 2]))
    else:
        path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_state_dict(path)
    with pytest.raises(DataError, match="cannot be read"):
        read_state_dict(tmp_path / "missing.pth")


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """Made-up weights of a ResNet-18 for ten classes, under torchvision's names."""
    path = tmp_path_factory.mktemp("weights") / "resnet18.safetensors"
    save_file({name: np.asarray(array) for name, array in made_up_weights(golden_shapes("resnet18")).items()}, path)
    return path


@pytest.mark.usefixtures("fully_compiled")
def test_weights_from_a_file_give_pytorchs_outputs(weights):
    """Features are compared, since the head stays new: the stored logits are the file's head on them."""
    network = ResNet(depth=18, rngs=nnx.Rngs(0))
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
    plain, standard = (ResNet(depth=18, standardise=s, rngs=nnx.Rngs(0)) for s in (False, True))
    for network in (plain, standard):
        weights_from_torch((weights,), 18).put(network)
    images = jax.random.uniform(jax.random.key(0), (2, 64, 64, 3))
    expected = plain((images - jnp.array([0.485, 0.456, 0.406])) / jnp.array([0.229, 0.224, 0.225]))
    np.testing.assert_allclose(standard(images), expected, atol=1e-5)
    with pytest.raises(ValueError, match="3 channels only, got 1"):
        ResNet(channels=1, standardise=True, rngs=nnx.Rngs(0))


def test_the_file_of_the_right_depth_is_taken(weights, tmp_path):
    deeper = tmp_path / "resnet34.safetensors"
    save_file({name: np.asarray(array) for name, array in made_up_weights(golden_shapes("resnet34")).items()}, deeper)
    assert weights_from_torch((weights, deeper), 34).name.startswith("resnet34.safetensors, sha256 ")
    assert weights_from_torch((deeper, weights), 18).name.startswith("resnet18.safetensors, sha256 ")
    with pytest.raises(DataError, match=r"holds a ResNet-34; give --pretrained torchvision's resnet34 too"):
        weights_from_torch((weights,), 34)


def test_a_network_of_another_width_refuses_them(weights):
    with pytest.raises(DataError, match=r"does not fit the classifier: conv1.weight has shape"):
        weights_from_torch((weights,), 18).put(ResNet(depth=18, width=8, rngs=nnx.Rngs(0)))


def test_going_on_from_a_network_begins_with_all_of_it():
    before, after = (ResNet(depth=18, width=4, rngs=nnx.Rngs(seed)) for seed in (1, 2))
    before.norm.mean[...] = before.norm.mean[...] + 0.3
    weights_from_network(before, "the one before").put(after)
    images = jax.random.uniform(jax.random.key(0), (2, 32, 32, 3))
    np.testing.assert_array_equal(before(images), after(images))
