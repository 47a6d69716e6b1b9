"""The recogniser: class from single views and from any set of views; encoder and set fusion are trained together.

The views are from directions all around the object (a data set made with `dataset.capture.turned`), so that no lattice is
preferred.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.augment import ViewAugmentation, object_changes, object_turns, random_shift, views_after
from data_pipeline.dataset.batches import ViewBatches
from data_pipeline.dataset.inputs import depth_and_normals, view_camera
from data_pipeline.dataset.reality import RealityAugmentation, realistic_views, used_reality
from mevs_jax.geometry import inputs as inputs_of
from mevs_jax.geometry.inputs import SizeInput
from mevs_jax.models import Recogniser, ResNet
from mevs_jax.models.pose import PoseHead, azimuth_of, azimuth_weights
from mevs_jax.models.rotation import ROTATIONS, rotation_weights, seen_rotations
from train.optimiser import OptimiserConfig
from train.step import Batch, Hyperparameters, Metrics, view_batches
from train.tasks.classifier import ResNetConfig
from train.tasks.set_fusion import SetFusionConfig, new_fusion, random_sets
from train.tasks.size import SizeConfig, radii_for_training, used_size


@dataclass(frozen=True)
class RecogniserConfig:
    """Settings of the recogniser and its training."""

    network: ResNetConfig = ResNetConfig(channels=4, standardise=False)
    """the encoder; its input is depth and normals in four channels, and a fifth one where it is told what is unknown"""
    fusion: SetFusionConfig = SetFusionConfig()
    """the set fusion"""
    augmentation: ViewAugmentation = ViewAugmentation()
    """augmentation of training objects"""
    shift: int = 3
    """maximal shift of training images in pixels, in each direction"""
    reality: RealityAugmentation = RealityAugmentation()
    size: SizeConfig = SizeConfig()
    balanced: bool = False
    """draw equally many training objects of each class, objects of rarer classes more often; else each object equally often"""
    azimuths: int = 24
    """number of azimuths that are distinguished where the yaw of objects is unknown; 0: the pose of objects is not estimated"""
    mirrored: bool = False
    """once trained, features of a view are means of those of its image and of the mirror image, which shows an object of the same
    class"""
    optimiser: OptimiserConfig = OptimiserConfig()


Outputs = tuple[jax.Array, jax.Array, jax.Array, jax.Array | None]
"""What a `Recogniser` returns."""
_POSE_WEIGHT = 0.25
"""Weight of the loss of the object's pose in views, relative to that of the class of single views."""


@dataclass(frozen=True)
class RecogniserTask:
    """Training of the recogniser by cross-entropy on single views and on random sets of an object's views in the batch.

    The loss of a set is half that with the object's pose known, half that with it unknown. The azimuth of each view in the
    object's frame is learned too, for the object's class; its rotation relative to the camera if training turns objects.
    """

    network_config: ResNetConfig
    fusion_config: SetFusionConfig
    classes: int
    camera: CaptureConfig
    augmentation: ViewAugmentation
    shift: int
    balanced: bool
    optimiser: OptimiserConfig
    fold: tuple[int, int] | None = None
    """(k, n): trained without part k of n parts of the training objects"""
    reality: RealityAugmentation | None = None
    size: SizeConfig | None = None
    azimuths: int = 0
    mirrored: bool = False
    name: str = "recogniser"

    @classmethod
    def of(
        cls, config: RecogniserConfig, classes: int, camera: CaptureConfig, fold: tuple[int, int] | None = None
    ) -> RecogniserTask:
        name = "recogniser" if fold is None else f"recogniser without part {fold[0] + 1} of {fold[1]}"
        return cls(
            config.network,
            config.fusion,
            classes,
            camera,
            config.augmentation,
            config.shift,
            config.balanced,
            config.optimiser,
            fold,
            used_reality(config.reality, "--learned.recogniser.reality"),
            used_size(config.size, "--learned.recogniser.size"),
            config.azimuths,
            config.mirrored,
            name,
        )

    @property
    def batches(self) -> ViewBatches:
        return view_batches(self.optimiser, images="depth", fold=self.fold, balanced=self.balanced)

    @property
    def group(self) -> int:
        return self.optimiser.views_per_object

    @property
    def metrics(self) -> tuple[str, ...]:
        return ("accuracy", "fused_accuracy", "unposed_accuracy", *["pose_loss"] * bool(self.azimuths), "loss")

    @property
    def hyperparameters(self) -> Hyperparameters:
        return Hyperparameters.of(self.optimiser, self.fusion_config.dropout, 1.0)

    def network(self, rngs: nnx.Rngs) -> Recogniser:
        shape = self.network_config
        encoder = ResNet(
            depth=shape.depth,
            classes=self.classes,
            channels=shape.channels,
            width=shape.width,
            stem=shape.stem,
            dtype=jnp.dtype(self.optimiser.compute),
            rngs=rngs,
        )
        fusion = new_fusion(self.fusion_config, 8 * shape.width, self.classes, rngs)
        pose = None
        if self.azimuths:
            poses, dropout = ROTATIONS if self.augmentation.turn else self.azimuths, self.fusion_config.dropout
            pose = PoseHead(8 * shape.width, self.classes, poses=poses, dropout=dropout, rngs=rngs)
        return Recogniser(encoder, fusion, SizeInput() if self.size else None, pose)

    def inputs(self, batch: Batch) -> jax.Array:
        """Returns the images of a batch, (views, height, width, channels)."""
        of_view = partial(depth_and_normals, camera=self.camera, channels=self.network_config.channels)
        return jax.vmap(of_view)(batch["depth"])

    def realistic(self, key: jax.Array, batch: Batch, views: int) -> tuple[jax.Array, jax.Array]:
        """Returns the images of a batch with the errors of `reality`, as `inputs` does, and their poses.

        Args:
            views: number of views of each object, which are one after another.
        """
        assert self.reality is not None
        camera = view_camera(self.camera)
        depth, poses = realistic_views(key, batch, camera, self.reality, views)
        of_view = partial(inputs_of.depth_and_normals, camera=camera, channels=self.network_config.channels)
        return jax.vmap(of_view)(depth), poses

    def directions(self, batch: Batch) -> jax.Array:
        """Returns the unit vectors from the object to the cameras, (views, 3)."""
        return directions_of(batch["pose"])

    def radii(self, batch: Batch) -> jax.Array | None:
        """Returns the radius of the object of every view in metres, (views,); None if sizes are not used."""
        return batch["radius"] * self.size.metres if self.size else None

    def loss(
        self, network: Recogniser, batch: Batch, key: jax.Array, samples: jax.Array, hyper: Hyperparameters
    ) -> tuple[jax.Array, Metrics]:
        del samples, hyper
        change, move, sets, drop = jax.random.split(key, 4)
        by_object = partial(views_by_object, views=self.optimiser.views_per_object)
        inputs, poses = self.inputs(batch), batch["pose"]
        if self.reality:
            inputs, poses = self.realistic(jax.random.fold_in(key, 4), batch, self.optimiser.views_per_object)
        images, poses = by_object(inputs), by_object(poses)
        labels = batch["label"].reshape(images.shape[:2])[:, 0]
        changes = object_changes(change, len(images), self.augmentation)
        turns = object_turns(change, len(images)) if self.augmentation.turn else None
        shifts = jax.vmap(jax.vmap(partial(random_shift, largest=self.shift)))(jax.random.split(move, images.shape[:2]))
        images, directions = jax.vmap(partial(views_after, camera=self.camera))(changes, images, poses, shifts=shifts)
        present = random_sets(sets, len(images), images.shape[1], images.shape[1])
        radii = self.radii(batch)
        if self.size and radii is not None:
            radii = radii_for_training(jax.random.fold_in(key, 5), by_object(radii), self.size)
        outputs = network(images, directions, present, radii, train=True, key=drop)
        found = _metrics_of(outputs, labels, directions, turns)
        means = {name: jnp.mean(values) for name, values in found.items()}
        return means["loss"], means

    def evaluate(self, network: Recogniser, batch: Batch) -> Metrics:
        """Returns metrics of every view; the fused ones are of all views of an object in the batch together.

        If training turns objects, they are turned here too, each by the same rotation every time.
        """
        by_object = partial(views_by_object, views=self.optimiser.validation_views)
        images, directions, turns = by_object(self.inputs(batch)), by_object(self.directions(batch)), None
        if self.augmentation.turn:
            turns = object_changes(jax.random.key(1), len(images), ViewAugmentation(mirror=False, turn=True))
            images, directions = jax.vmap(partial(views_after, camera=self.camera))(
                turns, images, by_object(batch["pose"])
            )
        labels = batch["label"].reshape(images.shape[:2])[:, 0]
        radii = self.radii(batch)
        radii = None if radii is None else by_object(radii)
        outputs = network(images, directions, jnp.ones(images.shape[:2], bool), radii)
        found = _metrics_of(outputs, labels, directions, turns)
        return {name: values.reshape(-1) for name, values in found.items()}


def directions_of(poses: jax.Array) -> jax.Array:
    """Returns the unit vectors from the object to cameras, (views, 3), from their poses (views, 4, 4)."""
    return poses[:, :3, 3] / jnp.linalg.norm(poses[:, :3, 3], axis=-1, keepdims=True)


def _metrics_of(outputs: Outputs, labels: jax.Array, directions: jax.Array, turns: jax.Array | None) -> Metrics:
    """Returns metrics of every view, each (objects, views). The loss of the pose is a part of the loss, also in validation.

    Args:
        outputs: of the network.
        labels: (objects,) true classes.
        directions: (objects, views, 3) unit vectors from the object to the cameras.
        turns: (objects, 3, 3) rotations of the objects, if they are in any rotation.
    """
    each, posed, unposed, poses = outputs
    found = _metrics_of_class(each, posed, unposed, labels)
    if poses is not None:
        own = jnp.take_along_axis(poses, labels[:, None, None, None], axis=2)[:, :, 0]
        if turns is None:
            wanted = azimuth_weights(azimuth_of(directions), own.shape[-1])
        else:
            turns = jnp.broadcast_to(turns[:, None], (*directions.shape, 3))
            wanted = rotation_weights(seen_rotations(turns, directions))
        found["pose_loss"] = -jnp.sum(wanted * own, axis=-1)
        found["loss"] += _POSE_WEIGHT * found["pose_loss"]
    return found


def _metrics_of_class(each: jax.Array, posed: jax.Array, unposed: jax.Array, labels: jax.Array) -> Metrics:
    """Returns metrics of every view, each (objects, views).

    Args:
        each: (objects, views, classes) logits of single views.
        posed: (objects, classes) logits of all views with the pose known; `unposed`: with it unknown.
    """
    labels = jnp.broadcast_to(labels[:, None], each.shape[:2])
    posed, unposed = (jnp.broadcast_to(logits[:, None], each.shape) for logits in (posed, unposed))
    single, with_pose, without_pose = (
        optax.softmax_cross_entropy_with_integer_labels(logits, labels) for logits in (each, posed, unposed)
    )
    logits_of = {"accuracy": each, "fused_accuracy": posed, "unposed_accuracy": unposed}
    return {"loss": single + (with_pose + without_pose) / 2} | {
        name: (jnp.argmax(logits, -1) == labels).astype(jnp.float32) for name, logits in logits_of.items()
    }


def views_by_object(array: jax.Array, views: int) -> jax.Array:
    """Reshapes (objects · views, …) to (objects, views, …)."""
    return array.reshape(-1, views, *array.shape[1:])
