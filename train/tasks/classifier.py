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
from data_pipeline.dataset.inputs import image_input, metric_depth, view_camera
from data_pipeline.dataset.reality import RealityAugmentation, realistic_views, used_reality
from data_pipeline.errors import DataError
from mevs_jax.geometry.inputs import depth_image, normal_image
from mevs_jax.models import ResNet
from mevs_jax.models.shapes import ENCODERS, EncoderShape
from train.optimiser import OptimiserConfig
from train.step import Batch, Hyperparameters, Metrics, view_batches
from train.tasks.own_encoder import OwnEncoderConfig, own_encoder
from train.weights.starting import StartingWeights, weights_from_torch, weights_of_encoder


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
    if encoder in ENCODERS:
        return weights_of_encoder(files, encoder)
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
    """a network instead of the ResNet: efficientnet_lite0, vit_tiny_patch8, vit_tiny_patch16; or your own, module:function or
    path/to/file.py:function (docs/own.md)"""
    frozen: bool = False
    """train the last layer alone, on the features of --pretrained weights"""
    images: Literal["depth", "normals", "image"] = "depth"
    """its input: depth; the surface normals, which are computed from depth, in three channels; or the shaded image"""
    augmentation: ImageAugmentation = ImageAugmentation()
    reality: RealityAugmentation = RealityAugmentation()
    optimiser: OptimiserConfig = OptimiserConfig(weight_decay=1e-4)

    @property
    def own(self) -> str:
        """The encoder if it is of the user's own, which no trained system can be made of; empty for this project's networks."""
        return "" if self.encoder in ENCODERS else self.encoder


def _encoder(config: ClassifierConfig, classes: int, resolution: int) -> OwnEncoderConfig | EncoderShape:
    """The network that takes the ResNet's place."""
    if config.own:
        return own_encoder(config.own, classes, config.network.channels, resolution)
    shape = EncoderShape(config.encoder, resolution)  # type: ignore[arg-type]
    try:
        nnx.eval_shape(lambda: shape.network(classes, nnx.Rngs(0)))
    except ValueError as error:
        raise DataError(f"--encoder {config.encoder}: {error}; choose another --dataset.capture.resolution") from error
    return shape


def with_frozen_features(network: nnx.Module) -> nnx.Module:
    """Returns a network of which training changes the last layer alone: all other weights become statistics."""
    for path, module in nnx.iter_modules(network):
        for name, variable in list(vars(module).items()):
            if type(variable) is nnx.Param and "head" not in path:
                setattr(module, name, nnx.BatchStat(variable.get_value()))
    return network


@dataclass(frozen=True)
class ClassifierTask:
    """Training of the classifier, or of a network of the user's in its place, by cross-entropy on single views."""

    network_config: ResNetConfig | OwnEncoderConfig | EncoderShape
    classes: int
    images: Literal["depth", "normals", "image"]
    camera: CaptureConfig
    augmentation: ImageAugmentation
    optimiser: OptimiserConfig
    reality: RealityAugmentation | None = None
    frozen: bool = False
    name: str = "classifier"

    @classmethod
    def of(cls, config: ClassifierConfig, classes: int, camera: CaptureConfig) -> ClassifierTask:
        """Returns the task.

        Raises:
            DataError: if the encoder cannot be loaded or used, or the errors of images are not valid, or are not for its images.
        """
        network: ResNetConfig | OwnEncoderConfig | EncoderShape = config.network
        if config.encoder:
            if config.optimiser.compute != "float32":
                raise DataError(
                    f"--classifier.optimiser.compute {config.optimiser.compute} is for this project's own networks; an "
                    f"--encoder decides itself in which precision it computes: leave the option out"
                )
            network = _encoder(config, classes, camera.resolution)
        if config.images == "normals" and network.channels != 3:
            raise DataError("--classifier.images normals have three channels; give --classifier.network.channels 3 too")
        if config.frozen and isinstance(network, OwnEncoderConfig):
            raise DataError(
                f"--classifier.frozen is for this project's own networks, not for {config.encoder}; leave it out"
            )
        reality = used_reality(config.reality, "--classifier.reality")
        if reality and config.images != "depth":
            raise DataError(
                f"--classifier.reality is for images of depth; leave out --classifier.images {config.images}"
            )
        return cls(
            network, classes, config.images, camera, config.augmentation, config.optimiser, reality, config.frozen
        )

    @property
    def stored(self) -> Literal["depth", "image"]:
        """The kind of stored views that its images are made of."""
        return "image" if self.images == "image" else "depth"

    @property
    def batches(self) -> ViewBatches:
        return view_batches(self.optimiser, images=self.stored, validation_by=self.optimiser.validation_by)

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
        network = self._network(rngs)
        return with_frozen_features(network) if self.frozen else network

    def _network(self, rngs: nnx.Rngs) -> Any:
        shape = self.network_config
        if isinstance(shape, OwnEncoderConfig):
            return shape.network(self.classes, self.camera.resolution, rngs)
        if isinstance(shape, EncoderShape):
            return shape.network(self.classes, rngs)
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
        return jax.vmap(convert)(batch[self.stored])

    def augmented(self, key: jax.Array, batch: Batch, strength: Any) -> jax.Array:
        """Returns the images of a batch with augmentation; normals are those of augmented depth."""
        key, reality = jax.random.split(key) if self.reality else (key, key)
        if self.images == "normals":
            images = metric_depth(batch["depth"])[..., None]
        else:
            images = self.realistic(reality, batch) if self.reality else self.inputs(batch)
        keys = jax.random.split(key, len(images))
        images = jax.vmap(augment_image, in_axes=(0, 0, None, None))(keys, images, self.augmentation, strength)
        if self.images == "normals":
            return jax.vmap(partial(normal_image, camera=view_camera(self.camera)))(images[..., 0])
        return images

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
        logits = network(self.augmented(key, batch, hyper.augmentation), train=not self.frozen)
        loss = jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, batch["label"]))
        return loss, {"loss": loss, "accuracy": jnp.mean(jnp.argmax(logits, -1) == batch["label"])}

    def evaluate(self, network: Any, batch: Batch) -> Metrics:
        logits = network(self.inputs(batch))
        return {
            "loss": optax.softmax_cross_entropy_with_integer_labels(logits, batch["label"]),
            "accuracy": (jnp.argmax(logits, -1) == batch["label"]).astype(jnp.float32),
        }
