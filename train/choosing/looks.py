"""What is computed of each view of a batch for the learned study: features, logits, directions, embeddings."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from data_pipeline.dataset.augment import object_changes, views_after
from mevs_jax.models import PointNet2, Recogniser
from mevs_jax.viewpoints import viewpoint_lattice
from train.outputs import Ask
from train.step import Batch, Task
from train.tasks.entropy import EntropyTask
from train.tasks.recogniser import RecogniserTask, views_by_object


def see(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
    """Features, logits, direction and label of every view, side by side."""
    assert isinstance(task, RecogniserTask)
    return _seen(network, task.inputs(batch), task.directions(batch), batch)


def _seen(network: Recogniser, images: Array, directions: Array, batch: Batch) -> jax.Array:
    label = batch["label"][:, None].astype(jnp.float32)
    return jnp.concatenate([network.see(images), directions, label], axis=-1)


def _seen_after(changes: Array, network: Recogniser, task: RecogniserTask, batch: Batch) -> jax.Array:
    """`see` of objects whose points were multiplied by these matrices, one for each."""
    images, poses = (views_by_object(array, task.camera.views) for array in (task.inputs(batch), batch["pose"]))
    images, directions = jax.vmap(partial(views_after, camera=task.camera))(changes, images, poses)
    return _seen(network, images.reshape(-1, *images.shape[2:]), directions.reshape(-1, 3), batch)


def see_rotated(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
    """`see` of turned views after the object was turned, by the rotation after which its cameras stand as in the lattice again.

    Turns are drawn evenly among all rotations, and so are these.
    """
    assert isinstance(task, RecogniserTask)
    lattice = jnp.asarray(viewpoint_lattice(task.camera.views, task.camera.lattice), jnp.float32)

    def turn_back(directions: Array) -> Array:
        return jnp.linalg.solve(directions.T @ directions, directions.T @ lattice).T

    turns = jax.vmap(turn_back)(views_by_object(task.directions(batch), task.camera.views))
    return _seen_after(turns, network, task, batch)


@cache
def see_changed(number: int) -> Ask:
    """`see` of objects that are changed as in the recogniser's training, each in a way of its own, and otherwise by number."""

    def see(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
        assert isinstance(task, RecogniserTask)
        drawn, augmentation = jax.random.fold_in(jax.random.key(1), number), task.augmentation
        positions = views_by_object(batch["position"], task.camera.views)[:, 0]
        changes = jax.vmap(lambda position: object_changes(jax.random.fold_in(drawn, position), 1, augmentation)[0])
        return _seen_after(changes(positions), network, task, batch)

    return see


def embed(network: PointNet2, task: Task, batch: Batch) -> jax.Array:
    assert isinstance(task, EntropyTask)
    return network.embed(task.inputs(batch))
