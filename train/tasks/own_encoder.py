"""A classifier with a network of the user's: any Flax NNX module, by `module:function` or `path/to/file.py:function`.

The contract: `function(classes=…, channels=…, resolution=…, rngs=…)` returns an `nnx.Module`; the module, called with images
(batch, resolution, resolution, channels), float32 in [0, 1] with background 0, returns logits (batch, classes). It is called with
`train=True` in training, where it may update batch-norm statistics and draw dropout from its `rngs`, and without in evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from data_pipeline.errors import DataError, kind_and_reason_of
from train.own_code import load_own


@dataclass(frozen=True)
class OwnEncoderConfig:
    """What identifies an encoder of a user in `config.json`.

    Attributes:
        module: its module, or the name of its file.
        name: of the function that makes the network.
        source: hash of its source file.
        channels: of its input; depth and grey images are repeated in all of them.
    """

    module: str
    name: str
    source: str
    channels: int

    def network(self, classes: int, resolution: int, rngs: nnx.Rngs) -> Any:
        """Returns a new network with random weights."""
        make = _FUNCTIONS[self]
        return make(classes=classes, channels=self.channels, resolution=resolution, rngs=rngs)


_FUNCTIONS: dict[OwnEncoderConfig, Callable[..., Any]] = {}
"""The functions that make the networks. They are no fields of a task, since a task is compared, hashed and stored."""


def own_encoder(reference: str, classes: int, channels: int, resolution: int) -> OwnEncoderConfig:
    """Returns the encoder that a reference names, once its network was found to keep the contract; nothing is computed.

    Raises:
        DataError: if it cannot be loaded or used.
    """
    code = load_own(reference, "--encoder")
    config = OwnEncoderConfig(**code.identity, channels=channels)
    _FUNCTIONS[config] = code.function

    def logits() -> Any:
        network = config.network(classes, resolution, nnx.Rngs(0))
        if not isinstance(network, nnx.Module):
            raise DataError(f"--encoder {reference} returns {type(network).__name__}, not a Flax nnx.Module; repair it")
        if not jax.tree.leaves(nnx.state(network, nnx.Param)):
            raise DataError(f"--encoder {reference} has no weights (nnx.Param) to train; repair it")
        images = jnp.zeros((2, resolution, resolution, channels))
        return network(images), network(images, train=True)

    try:
        found = jax.eval_shape(logits)
    except DataError:
        raise
    except Exception as error:  # of the user's own code
        raise DataError(
            f"--encoder {reference} cannot be used: {kind_and_reason_of(error)}; it is called as function(classes=, channels=, "
            f"resolution=, rngs=), and its network as network(images, train=)"
        ) from error
    for arrays in map(jax.tree.leaves, found):
        sound = len(arrays) == 1 and arrays[0].shape == (2, classes) and jnp.issubdtype(arrays[0].dtype, jnp.floating)
        if not sound:
            shapes = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays) or "nothing"
            raise DataError(
                f"--encoder {reference} returns {shapes} for 2 images, not floating-point logits [2, {classes}]; repair it"
            )
    return config
