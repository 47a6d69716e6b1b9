"""A classifier with a network of the user's: any Flax NNX module, by `module:function` or `path/to/file.py:function`.

The contract: `function(classes=…, channels=…, resolution=…, rngs=…)` returns an `nnx.Module`; the module, called with images
(batch, resolution, resolution, channels), float32 in [0, 1] with background 0, returns logits (batch, classes). It is called with
`train=True` in training, where it may update batch-norm statistics and draw dropout from its `rngs`, and without in evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.errors import DataError, kind_and_reason_of
from train.own_code import load_own
from train.tasks.classifier import ClassifierConfig, ClassifierTask, reality_of


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


_FUNCTIONS: dict[OwnEncoderConfig, Callable[..., Any]] = {}
"""The functions that make the networks. They are no fields of a task, since a task is compared, hashed and stored."""


@dataclass(frozen=True)
class OwnEncoderTask(ClassifierTask):
    """Training of a user's encoder as the classifier: batches, augmentation, loss and metrics are those of `ClassifierTask`."""

    network_config: OwnEncoderConfig  # type: ignore[assignment]

    @classmethod
    def of_encoder(cls, config: ClassifierConfig, classes: int, camera: CaptureConfig) -> OwnEncoderTask:
        """Returns the task, once its network was found to keep the contract.

        Raises:
            DataError: if the encoder cannot be loaded or used.
        """
        if config.optimiser.compute != "float32":
            raise DataError(
                f"--classifier.optimiser.compute {config.optimiser.compute} is for this project's own networks; an "
                f"--encoder decides itself in which precision it computes: leave the option out"
            )
        code = load_own(config.encoder, "--encoder")
        described = OwnEncoderConfig(**code.identity, channels=config.network.channels)
        _FUNCTIONS[described] = code.function
        reality = reality_of(config)
        task = cls(described, classes, config.images, camera, config.augmentation, config.optimiser, reality)
        _check(task, config.encoder)
        return task

    @property
    def encoder(self) -> dict[str, Any]:
        """What identifies the encoder, for `summary.json`."""
        return asdict(self.network_config)

    def network(self, rngs: nnx.Rngs) -> Any:
        make, channels = _FUNCTIONS[self.network_config], self.network_config.channels
        return make(classes=self.classes, channels=channels, resolution=self.camera.resolution, rngs=rngs)


def _check(task: OwnEncoderTask, reference: str) -> None:
    """Raises `DataError` if the network of a task does not keep the contract; nothing is computed."""
    side, channels = task.camera.resolution, task.network_config.channels

    def logits() -> Any:
        network = task.network(nnx.Rngs(0))
        if not isinstance(network, nnx.Module):
            raise DataError(f"--encoder {reference} returns {type(network).__name__}, not a Flax nnx.Module; repair it")
        if not jax.tree.leaves(nnx.state(network, nnx.Param)):
            raise DataError(f"--encoder {reference} has no weights (nnx.Param) to train; repair it")
        images = jnp.zeros((2, side, side, channels))
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
    for one in found:
        arrays = jax.tree.leaves(one)
        shapes = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays) or "nothing"
        if (
            len(arrays) != 1
            or arrays[0].shape != (2, task.classes)
            or not jnp.issubdtype(arrays[0].dtype, jnp.floating)
        ):
            raise DataError(
                f"--encoder {reference} returns {shapes} for 2 images, not floating-point logits [2, {task.classes}]; repair it"
            )
