"""What the learned study computes for each view of a batch: features, logits, directions, labels, embeddings.

These are `ask` functions for `train.results.outputs.network_outputs`.
"""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from data_pipeline.dataset.augment import object_changes, views_after
from data_pipeline.errors import DataError
from mevs_jax.geometry.inputs import mirrored
from mevs_jax.models import PointNet2, Recogniser
from train.results.outputs import Ask
from train.step import Batch, Task
from train.tasks.entropy import EntropyTask
from train.tasks.recogniser import RecogniserTask, directions_of, views_by_object


def see(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
    """Returns features, logits, direction and label of every view, concatenated: (views, features + classes + 3 + 1)."""
    assert isinstance(task, RecogniserTask)
    return _see_images(network, task, task.inputs(batch), task.directions(batch), batch)


def quarter_turns(images: Float[Array, "*batch side side channels"]) -> list[Float[Array, "*batch side side channels"]]:
    """Returns images of depth and normals turned about the optical axis by 0, 90, 180 and 270 degrees."""
    found = [images]
    for _ in range(3):
        near, right, down, *others = jnp.moveaxis(jnp.rot90(found[-1], 1, (-3, -2)), -1, 0)
        found.append(jnp.stack([near, down, -right, *others], axis=-1))
    return found


def _see_images(network: Recogniser, task: RecogniserTask, images: Array, directions: Array, batch: Batch) -> jax.Array:
    """Returns what `see` does."""
    label = batch["label"][:, None].astype(jnp.float32)
    return jnp.concatenate([seen_alike(network, task, images, task.radii(batch)), directions, label], axis=-1)


def seen_alike(network: Recogniser, task: RecogniserTask, images: Array, radii: Array | None = None) -> Array:
    """Returns features and logits of every view, concatenated.

    Of a recogniser for any rotation, features and logits are means over four turns of each image; of one with the setting
    `mirrored`, over each image and its mirror image. The features of the image as it is, which the pose can be read from, come
    after those.
    """
    seen = network.see(images, radii)
    alike = quarter_turns(images)[1:] if task.augmentation.turn else []
    alike += [mirrored(one) for one in (images, *alike)] if task.mirrored else []
    if alike:
        mean = (seen + sum(network.see(one, radii) for one in alike)) / (1 + len(alike))
        features = network.encoder.head.in_features
        seen = jnp.concatenate([mean[..., :features], seen[..., :features], mean[..., features:]], axis=-1)
    return seen


def _see_changed_by(changes: Array, network: Recogniser, task: RecogniserTask, batch: Batch) -> jax.Array:
    """Returns `see` of transformed objects.

    Args:
        changes: (objects, 3, 3) matrices that the objects' points are multiplied by.
    """
    images, poses = (views_by_object(array, task.camera.views) for array in (task.inputs(batch), batch["pose"]))
    images, directions = jax.vmap(partial(views_after, camera=task.camera))(changes, images, poses)
    return _see_images(network, task, images.reshape(-1, *images.shape[2:]), directions.reshape(-1, 3), batch)


@cache
def see_rotated(viewpoints: tuple[tuple[float, ...], ...], own_frame: bool = False) -> Ask:
    """Returns a `see` for objects turned so that their cameras are in the directions of the lattice again.

    For data sets made with `turned`, where the lattice around each object is turned by a random rotation. Those rotations are
    uniform over all rotations, and so are the ones applied here.

    Args:
        viewpoints: unit vectors of the lattice.
        own_frame: whether the directions that are returned are those in the object's own frame.

    Raises:
        DataError: if they lie in one plane with the origin, which does not determine a rotation.
    """
    if np.linalg.matrix_rank(np.array(viewpoints), tol=1e-6) < 3:
        raise DataError(
            "the viewpoints lie in one plane with the object's centre, which does not determine the rotation of an object; set "
            "--learned.rotation-epochs 0"
        )

    def see(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
        assert isinstance(task, RecogniserTask)
        lattice = jnp.asarray(viewpoints, jnp.float32)

        def turn_back(directions: Array) -> Array:
            return jnp.linalg.solve(directions.T @ directions, directions.T @ lattice).T

        turns = jax.vmap(turn_back)(views_by_object(task.directions(batch), task.camera.views))
        found = _see_changed_by(turns, network, task, batch)
        return found.at[:, -4:-1].set(task.directions(batch)) if own_frame else found

    return see


@cache
def answers(see: Ask, classes: int) -> Ask:
    """Returns a `see` without features: logits, direction and label of every view."""

    def of_views(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
        return see(network, task, batch)[:, -classes - 4 :]

    return of_views


@cache
def see_changed(number: int) -> Ask:
    """Returns a `see` for objects that are augmented as in the recogniser's training.

    Args:
        number: seeds the augmentation; each object is changed by its own draw, another one for each number.
    """

    def see(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
        assert isinstance(task, RecogniserTask)
        drawn, augmentation = jax.random.fold_in(jax.random.key(1), number), task.augmentation
        positions = views_by_object(batch["position"], task.camera.views)[:, 0]
        changes = jax.vmap(lambda position: object_changes(jax.random.fold_in(drawn, position), 1, augmentation)[0])
        return _see_changed_by(changes(positions), network, task, batch)

    return see


def see_in_reality(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
    """Returns `see` of images with the errors of `task.reality`; each object has its own draw."""
    assert isinstance(task, RecogniserTask)

    def of_object(position: Array, depth: Array, pose: Array) -> tuple[Array, Array]:
        key = jax.random.fold_in(jax.random.key(2), position[0])
        return task.realistic(key, {"depth": depth, "pose": pose}, task.camera.views)

    each = (views_by_object(batch[name], task.camera.views) for name in ("position", "depth", "pose"))
    images, poses = jax.vmap(of_object)(*each)
    directions = directions_of(poses.reshape(-1, 4, 4))
    return _see_images(network, task, images.reshape(-1, *images.shape[2:]), directions, batch)


def embed(network: PointNet2, task: Task, batch: Batch) -> jax.Array:
    """Returns PointNet++'s embedding of the partial cloud of every view, (views, embedding)."""
    assert isinstance(task, EntropyTask)
    return network.embed(task.inputs(batch))
