"""The entropy predictor: depth entropy of every candidate view from one partial point cloud (thesis §4.3.2 and §5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.augment import CloudAugmentation, augment_cloud
from data_pipeline.dataset.batches import ViewBatches
from data_pipeline.dataset.inputs import cloud_input
from mevs_jax.models import THESIS_ABSTRACTIONS, Abstraction, PointNet2
from train.optimiser import OptimiserConfig
from train.step import Batch, Hyperparameters, Metrics, view_batches


@dataclass(frozen=True)
class PointNet2Config:
    """Architecture of the network, and format of its point clouds."""

    points: int = 4096
    """points in a cloud"""
    frame: Literal["world", "camera"] = "world"
    """coordinate frame of the clouds: world (needs the camera's pose), or camera (as in the thesis, without the pose)"""
    directions: bool = True
    """give each point of a cloud in the world frame the direction to the camera, in the columns meant for normals"""
    abstractions: tuple[Abstraction, ...] = THESIS_ABSTRACTIONS
    """the set-abstraction levels"""
    global_layers: tuple[int, ...] = (256, 512, 1024)
    """widths of the layers over all centres"""
    head_layers: tuple[int, ...] = (512, 256)
    """widths of the layers before the output"""
    dropout: float = 0.5
    """dropout rate before the output"""


@dataclass(frozen=True)
class EntropyConfig:
    """Settings of the entropy predictor and its training."""

    network: PointNet2Config = PointNet2Config()
    augmentation: CloudAugmentation = CloudAugmentation()
    optimiser: OptimiserConfig = OptimiserConfig(epochs=200, batch_size=32, schedule="steps")


@dataclass(frozen=True)
class EntropyTask:
    """Training of the entropy predictor by mean squared error of normalised entropies."""

    network_config: PointNet2Config
    views: int
    entropy_max: float
    camera: CaptureConfig
    augmentation: CloudAugmentation
    optimiser: OptimiserConfig
    name: str = "entropy predictor"

    @classmethod
    def of(cls, config: EntropyConfig, views: int, entropy_max: float, camera: CaptureConfig) -> EntropyTask:
        return cls(config.network, views, entropy_max, camera, config.augmentation, config.optimiser)

    @property
    def batches(self) -> ViewBatches:
        config = self.optimiser
        return view_batches(config, points=self.network_config.points, validation_by=config.validation_by)

    @property
    def group(self) -> int:
        return 1

    @property
    def metrics(self) -> tuple[str, ...]:
        return ("loss",)

    @property
    def hyperparameters(self) -> Hyperparameters:
        return Hyperparameters.of(self.optimiser, self.network_config.dropout, self.augmentation.strength)

    def network(self, rngs: nnx.Rngs) -> Any:
        shape = self.network_config
        return PointNet2(
            views=self.views,
            abstractions=shape.abstractions,
            global_layers=shape.global_layers,
            head_layers=shape.head_layers,
            dropout=shape.dropout,
            dtype=jnp.dtype(self.optimiser.compute),
            rngs=rngs,
        )

    def inputs(self, batch: Batch) -> jax.Array:
        """Returns the clouds of a batch, (views, points, 3 or 6)."""
        shape = self.network_config
        directions = shape.directions and shape.frame == "world"
        convert = partial(cloud_input, camera=self.camera, frame=shape.frame, directions=directions)
        return jax.vmap(convert)(batch["pixels"], batch["pixel_depth"], batch["pose"])

    def momentum(self, samples: jax.Array) -> jax.Array:
        """Returns the batch-norm momentum after `samples` samples: 0.5, halved every 20,000, not below 0.01 (thesis code)."""
        return jnp.maximum(0.5 * 0.5 ** (samples // 20_000), 0.01)

    def loss(
        self, network: Any, batch: Batch, key: jax.Array, samples: jax.Array, hyper: Hyperparameters
    ) -> tuple[jax.Array, Metrics]:
        augment, drop = jax.random.split(key)
        clouds = self.inputs(batch)
        keys = jax.random.split(augment, len(clouds))
        clouds = jax.vmap(augment_cloud, in_axes=(0, 0, None, None))(
            keys, clouds, self.augmentation, hyper.augmentation
        )
        predicted = network(clouds, train=True, key=drop, momentum=self.momentum(samples), dropout=hyper.dropout)
        loss = jnp.mean(jnp.square(predicted - batch["entropy"] / self.entropy_max))
        return loss, {"loss": loss}

    def evaluate(self, network: Any, batch: Batch) -> Metrics:
        predicted = network(self.inputs(batch))
        return {"loss": jnp.mean(jnp.square(predicted - batch["entropy"] / self.entropy_max), axis=-1)}
