"""Copies weights trained with PyTorch into the networks of this package, with their names and layouts translated.

A state dict is a mapping from PyTorch's names to NumPy arrays; this module does not read files. The names are torchvision's for
ResNet, those of the package `efficientnet-lite-pytorch` for EfficientNet, timm's for the vision transformer, and those of the
usual PyTorch PointNet++ (`PointnetSAModule` of `pointnet2_ops`) for PointNet2.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx

from mevs_jax.models import BatchNorm, PointNet2, ResNet
from mevs_jax.models.efficientnet import EfficientNetLite0
from mevs_jax.models.pointnet2 import Perceptron
from mevs_jax.models.resnet import Convolution
from mevs_jax.models.vision_transformer import VisionTransformer

StateDict = Mapping[str, np.ndarray]


class _Reader:
    """Copies arrays from a state dict by name, checks their shapes, and records which names have not been used."""

    def __init__(self, state: StateDict):
        self.state = state
        self.left = set(state)

    def put(self, variable: nnx.Variable | None, name: str, *axes: int) -> None:
        """Copies the array `name`, transposed to `axes` if given, into `variable`."""
        assert variable is not None  # a bias exists wherever the caller names one
        like = variable.get_value()  # an array, or only its shape in a network without initial weights
        if name not in self.state:
            raise ValueError(f"the state dict has no {name!r}; check that it belongs to this network")
        array = np.asarray(self.state[name])
        array = array.transpose(axes) if axes else array
        if array.ndim == 4 and like.ndim == 2:  # a convolution over points or patches is a linear layer
            array = array.reshape(-1, array.shape[-1])
        if array.shape != like.shape:
            raise ValueError(f"{name} has shape {array.shape} in the state dict, the network has {like.shape}")
        self.left.discard(name)
        variable.set_value(jnp.asarray(array, like.dtype))

    def norm(self, norm: BatchNorm, name: str) -> None:
        """Copies the weights and running statistics of a batch norm."""
        self.put(norm.scale, f"{name}.weight")
        self.put(norm.bias, f"{name}.bias")
        self.put(norm.mean, f"{name}.running_mean")
        self.put(norm.variance, f"{name}.running_var")
        if f"{name}.num_batches_tracked" in self.state:  # files of before 2018 have none
            self.put(norm.batches, f"{name}.num_batches_tracked")

    def linear(self, layer: nnx.Linear, name: str) -> None:
        """Copies the weights and biases of a linear layer."""
        self.put(layer.kernel, f"{name}.weight", 1, 0)
        self.put(layer.bias, f"{name}.bias")

    def head(self, layer: nnx.Linear, name: str, fill: bool) -> None:
        """Copies those of the last layer, or leaves it as it is; ends with `finish`."""
        if fill:
            self.linear(layer, name)
        self.left -= {f"{name}.weight", f"{name}.bias"}
        self.finish()

    def finish(self) -> None:
        """Raises ValueError if the state dict has unused entries."""
        if self.left:
            raise ValueError(f"the state dict has entries that this network lacks: {', '.join(sorted(self.left)[:4])}")


def resnet_from_torch(network: ResNet, state: StateDict, *, head: bool = True) -> None:
    """Fills `network` with a torchvision `resnet18` or `resnet34` state dict.

    Args:
        network: of the same depth, with width 64, images of three channels and a convolution as its stem.
        state: arrays by torchvision's names.
        head: whether to fill the last layer too; if not, the network keeps its own, for other classes.

    Raises:
        ValueError: for a missing or unexpected entry, a different shape, or a network with another stem.
    """
    reader = _Reader(state)
    if not isinstance(network.convolution, Convolution):
        raise ValueError("the network's stem is patches, torchvision's is a convolution")
    reader.put(network.convolution.kernel, "conv1.weight", 2, 3, 1, 0)
    reader.norm(network.norm, "bn1")
    names = [f"layer{stage + 1}.{block}" for stage, blocks in enumerate(network.stages) for block in range(blocks)]
    for block, name in zip(network.blocks, names, strict=True):
        reader.put(block.convolution1.kernel, f"{name}.conv1.weight", 2, 3, 1, 0)
        reader.norm(block.norm1, f"{name}.bn1")
        reader.put(block.convolution2.kernel, f"{name}.conv2.weight", 2, 3, 1, 0)
        reader.norm(block.norm2, f"{name}.bn2")
        if block.projects:
            reader.put(block.shortcut.kernel, f"{name}.downsample.0.weight", 2, 3, 1, 0)
            reader.norm(block.shortcut_norm, f"{name}.downsample.1")
    reader.head(network.head, "fc", head)


def efficientnet_from_torch(network: EfficientNetLite0, state: StateDict, *, head: bool = True) -> None:
    """Fills `network` with the state dict of an `efficientnet-lite0` of the package `efficientnet-lite-pytorch`.

    Arguments and errors are those of `resnet_from_torch`.
    """
    reader = _Reader(state)
    pairs: list[tuple[Any, BatchNorm, str, str]] = [
        (network.stem, network.stem_norm, "_conv_stem", "_bn0"),
        (network.last, network.last_norm, "_conv_head", "_bn1"),
    ]
    for number, block in enumerate(network.blocks):
        name = f"_blocks.{number}"
        if block.expands:
            pairs.append((block.expand, block.expand_norm, f"{name}._expand_conv", f"{name}._bn0"))
        pairs.append((block.depthwise, block.depthwise_norm, f"{name}._depthwise_conv", f"{name}._bn1"))
        pairs.append((block.project, block.project_norm, f"{name}._project_conv", f"{name}._bn2"))
    for convolution, norm, weights, statistics in pairs:
        reader.put(convolution.kernel, f"{weights}.weight", 2, 3, 1, 0)
        reader.norm(norm, statistics)
    reader.head(network.head, "_fc", head)


def vision_transformer_from_torch(network: VisionTransformer, state: StateDict, *, head: bool = True) -> None:
    """Fills `network` with the state dict of timm's `vit_tiny_patch…`, for images of the same resolution.

    Arguments and errors are those of `resnet_from_torch`.
    """
    reader = _Reader(state)
    reader.put(network.embedding.kernel, "patch_embed.proj.weight", 2, 3, 1, 0)
    reader.put(network.embedding.bias, "patch_embed.proj.bias")
    reader.put(network.token, "cls_token")
    reader.put(network.positions, "pos_embed")
    norms = {"norm": network.norm}
    for number, block in enumerate(network.blocks):
        name = f"blocks.{number}"
        norms |= {f"{name}.norm1": block.norm1, f"{name}.norm2": block.norm2}
        layers = {"attn.qkv": block.qkv, "attn.proj": block.proj, "mlp.fc1": block.layer1, "mlp.fc2": block.layer2}
        for layer, linear in layers.items():
            reader.linear(linear, f"{name}.{layer}")
    for name, norm in norms.items():
        reader.put(norm.scale, f"{name}.weight")
        reader.put(norm.bias, f"{name}.bias")
    reader.head(network.head, "head", head)


def pointnet2_from_torch(network: PointNet2, state: StateDict) -> None:
    """Fills `network` with the state dict of a PyTorch PointNet++ SSG: `SA_modules.i.mlps.0.*` and `fc_layer.*`.

    Raises:
        ValueError: for a missing or unexpected entry, or a different shape.
    """
    reader = _Reader(state)
    for level, perceptron in enumerate([*network.perceptrons, network.whole]):
        _shared_layers(reader, perceptron, f"SA_modules.{level}.mlps.0")
    for index in range(len(network.head.linear)):  # linear, norm, ReLU: three entries each
        reader.put(network.head.linear[index].kernel, f"fc_layer.{3 * index}.weight", 1, 0)
        reader.norm(network.head.norm[index], f"fc_layer.{3 * index + 1}")
    reader.head(network.out, f"fc_layer.{3 * len(network.head.linear) + 1}", True)  # after the dropout


def _shared_layers(reader: _Reader, perceptron: Perceptron, name: str) -> None:
    """Fills a `Perceptron` from the entries that begin with `name`."""
    for index in range(len(perceptron.linear)):  # 1×1 convolution, norm, ReLU
        reader.put(perceptron.linear[index].kernel, f"{name}.{3 * index}.weight", 2, 3, 1, 0)
        reader.norm(perceptron.norm[index], f"{name}.{3 * index + 1}")
