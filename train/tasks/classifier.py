"""The classifier: logits of the class from one view (thesis §5.2)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.augment import ImageAugmentation, augment_image
from data_pipeline.dataset.batches import ViewBatches
from data_pipeline.dataset.inputs import image_input, view_camera
from data_pipeline.dataset.reality import RealityAugmentation, realistic_views, used_reality
from data_pipeline.errors import DataError
from mevs_jax.geometry.inputs import depth_image
from mevs_jax.models import ResNet
from train.optimiser import OptimiserConfig
from train.step import Batch, Hyperparameters, Metrics, view_batches
from train.tasks.own_encoder import OwnEncoderConfig, own_encoder
from train.weights.starting import StartingWeights, weights_from_torch


@dataclass(frozen=True)
class ResNetConfig:
    """Architecture of the network."""

    depth: Literal[10, 18, 34] = 18
    """18 or 34; 10 has half the blocks of 18"""
    width: int = 64
    """channels of the first stage"""
    channels: int = 3
    """channels of the input; depth and grey images are repeated in all channels"""
    standardise: bool = True
    """subtract ImageNet's mean and divide by its standard deviation; only with three channels"""
    stem: Literal["convolution", "patches"] = "convolution"
    """the first layer: ResNet's convolution, or patches of 4×4 pixels, a third faster on a CPU"""


def starting_weights(files: tuple[Path, ...], network: ResNetConfig, encoder: str = "") -> StartingWeights | None:
    """Returns the initial weights of a classifier from the file that holds its depth, or None without files.

    Raises:
        DataError: if a file cannot be read, or none fits the network.
    """
    if not files:
        return None
    if encoder:
        raise DataError(
            f"--pretrained weights are those of a ResNet, not of --encoder {encoder}; leave one of them out"
        )
    if network.depth < 18 or (network.width, network.channels, network.stem) != (64, 3, "convolution"):
        raise DataError(
            "--pretrained weights fit a ResNet of width 64 and depth 18 or 34 with 3 input channels and a convolution as its "
            f"stem, this one has width {network.width}, depth {network.depth}, {network.channels} channels and the stem "
            f"{network.stem}; use --preset thesis, or --classifier.network.width 64 --classifier.network.depth 18 "
            "--classifier.network.channels 3 --classifier.network.stem convolution"
        )
    return weights_from_torch(files, network.depth)


@dataclass(frozen=True)
class ClassifierConfig:
    """Settings of the classifier and its training."""

    network: ResNetConfig = ResNetConfig()
    encoder: str = ""
    """a network of your own instead of the ResNet: module:function or path/to/file.py:function (docs/own.md)"""
    images: Literal["depth", "image"] = "depth"
    """its input: depth, or the shaded image"""
    augmentation: ImageAugmentation = ImageAugmentation()
    reality: RealityAugmentation = RealityAugmentation()
    optimiser: OptimiserConfig = OptimiserConfig(weight_decay=1e-4)


@dataclass(frozen=True)
class ClassifierTask:
    """Training of the classifier, or of a network of the user's in its place, by cross-entropy on single views."""

    network_config: ResNetConfig | OwnEncoderConfig
    classes: int
    images: Literal["depth", "image"]
    camera: CaptureConfig
    augmentation: ImageAugmentation
    optimiser: OptimiserConfig
    reality: RealityAugmentation | None = None
    name: str = "classifier"

    @classmethod
    def of(cls, config: ClassifierConfig, classes: int, camera: CaptureConfig) -> ClassifierTask:
        """Returns the task.

        Raises:
            DataError: if the encoder cannot be loaded or used, or the errors of images are not valid, or are not for its images.
        """
        network: ResNetConfig | OwnEncoderConfig = config.network
        if config.encoder:
            if config.optimiser.compute != "float32":
                raise DataError(
                    f"--classifier.optimiser.compute {config.optimiser.compute} is for this project's own networks; an "
                    f"--encoder decides itself in which precision it computes: leave the option out"
                )
            network = own_encoder(config.encoder, classes, config.network.channels, camera.resolution)
        reality = used_reality(config.reality, "--classifier.reality")
        if reality and config.images != "depth":
            raise DataError("--classifier.reality is for images of depth; leave out --classifier.images image")
        return cls(network, classes, config.images, camera, config.augmentation, config.optimiser, reality)

    @property
    def batches(self) -> ViewBatches:
        return view_batches(self.optimiser, images=self.images, validation_by=self.optimiser.validation_by)

    @property
    def group(self) -> int:
        return 1

    @property
    def metrics(self) -> tuple[str, ...]:
        return ("accuracy", "loss")

    @property
    def hyperparameters(self) -> Hyperparameters:
        return Hyperparameters.of(self.optimiser, 0.0, self.augmentation.strength)

    @property
    def encoder(self) -> dict[str, Any] | None:
        """What identifies a user's encoder, for `summary.json`."""
        return asdict(self.network_config) if isinstance(self.network_config, OwnEncoderConfig) else None

    def network(self, rngs: nnx.Rngs) -> Any:
        shape = self.network_config
        if isinstance(shape, OwnEncoderConfig):
            return shape.network(self.classes, self.camera.resolution, rngs)
        return ResNet(
            depth=shape.depth,
            classes=self.classes,
            channels=shape.channels,
            width=shape.width,
            standardise=shape.standardise and shape.channels == 3,
            stem=shape.stem,
            dtype=jnp.dtype(self.optimiser.compute),
            rngs=rngs,
        )

    def inputs(self, batch: Batch) -> jax.Array:
        """Returns the images of a batch, (views, height, width, channels)."""
        convert = partial(image_input, images=self.images, channels=self.network_config.channels, camera=self.camera)
        return jax.vmap(convert)(batch[self.images])

    def realistic(self, key: jax.Array, batch: Batch) -> jax.Array:
        """Returns the images of a batch with the errors of `reality`, (views, height, width, channels)."""
        assert self.reality is not None
        camera, channels = view_camera(self.camera), self.network_config.channels
        depth, _ = realistic_views(key, batch, camera, self.reality)
        return jax.vmap(lambda image: depth_image(image, camera, channels))(depth)

    def loss(
        self, network: Any, batch: Batch, key: jax.Array, samples: jax.Array, hyper: Hyperparameters
    ) -> tuple[jax.Array, Metrics]:
        del samples
        key, reality = jax.random.split(key) if self.reality else (key, key)
        images = self.realistic(reality, batch) if self.reality else self.inputs(batch)
        keys = jax.random.split(key, len(images))
        images = jax.vmap(augment_image, in_axes=(0, 0, None, None))(
            keys, images, self.augmentation, hyper.augmentation
        )
        logits = network(images, train=True)
        loss = jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, batch["label"]))
        return loss, {"loss": loss, "accuracy": jnp.mean(jnp.argmax(logits, -1) == batch["label"])}

    def evaluate(self, network: Any, batch: Batch) -> Metrics:
        logits = network(self.inputs(batch))
        return {
            "loss": optax.softmax_cross_entropy_with_integer_labels(logits, batch["label"]),
            "accuracy": (jnp.argmax(logits, -1) == batch["label"]).astype(jnp.float32),
        }
