"""Values of a view besides its depth entropy, for which a camera could be sent there, as targets of a predictor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from data_pipeline.dataset.inputs import metric_depth, view_camera
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import ViewCamera, pixel_directions
from train.results.outputs import Ask, network_outputs
from train.step import Batch
from train.tasks.classifier import ClassifierTask

EDGE = 0.1
"""Difference of depths, in radii of the object, from which on two adjacent pixels show different surfaces."""
FLOOR = 0.01
"""Added to probabilities before the logarithm, so that an object that is always misjudged does not outweigh all others."""


def _edges(depth: Float[Array, "height width"], axis: int) -> Bool[Array, "_ _"]:
    """Whether adjacent pixels along an axis show different surfaces; background is far behind all of them."""
    return jnp.abs(jnp.diff(jnp.where(depth > 0, depth, 1e3), axis=axis)) > EDGE


def edge_content(depth: Float[AnyArray, "height width"]) -> Float[Array, ""]:
    """Share of the pairs of adjacent pixels that show different surfaces, outlines included.

    Args:
        depth: metric depth, 0 where nothing is hit.
    """
    edges = [_edges(jnp.asarray(depth), axis) for axis in (0, 1)]
    return jnp.mean(jnp.concatenate([edge.reshape(-1) for edge in edges]).astype(jnp.float32))


def visible_area(depth: Float[AnyArray, "height width"], camera: ViewCamera) -> Float[Array, ""]:
    """Area of the surfaces in a view, in squared radii: of the quads between four pixels of one surface.

    Args:
        depth: metric depth, 0 where nothing is hit.
        camera: the camera; its resolution is not used, since that of `depth` is known.
    """
    depth = jnp.asarray(depth)
    points = pixel_directions(camera.at(jnp.eye(4), len(depth))) * depth[..., None]
    across, along = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    down, right = _edges(depth, 0), _edges(depth, 1)
    whole = (depth[:-1, :-1] > 0) & ~(down[:, :-1] | down[:, 1:] | right[:-1] | right[1:])
    return jnp.sum(jnp.where(whole, jnp.linalg.norm(jnp.cross(across, along), axis=-1) / 2, 0.0))


def confidence_of_truth(logits: Float[AnyArray, "views classes"], label: Int[AnyArray, ""]) -> Float[Array, " views"]:
    """Probability of the true class after each view alone."""
    return jax.nn.softmax(jnp.asarray(logits), axis=-1)[:, label]


def mean_gain(logits: Float[AnyArray, "views classes"], label: Int[AnyArray, ""]) -> Float[Array, " views"]:
    """By how much each view as the second one raises the log-probability of the truth, averaged over all other first views."""

    def utility(beliefs: Float[Array, "*batch classes"]) -> Float[Array, "*batch"]:
        return jnp.log(jax.nn.softmax(beliefs, axis=-1)[..., label] + FLOOR)

    logits = jnp.asarray(logits)
    gain = utility(logits[:, None] + logits) - utility(logits)[:, None]
    return (jnp.sum(gain, axis=0) - jnp.diagonal(gain)) / (len(logits) - 1)


def _edge_content(network: Any, task: Any, batch: Batch) -> jax.Array:
    return jax.vmap(edge_content)(metric_depth(batch["depth"]))[:, None]


def _visible_area(network: Any, task: Any, batch: Batch) -> jax.Array:
    camera = view_camera(task.camera)
    return jax.vmap(lambda depth: visible_area(depth, camera))(metric_depth(batch["depth"]))[:, None]


_OF_DEPTH: dict[str, Ask] = {"edges": _edge_content, "area": _visible_area}
_OF_LOGITS = {"confidence": confidence_of_truth, "gain": mean_gain}
VALUES = (*_OF_DEPTH, *_OF_LOGITS)


def view_values(
    name: str,
    data: Path,
    split: str,
    classify: ClassifierTask,
    classifier: nnx.Module,
    logits: Callable[[], tuple[np.ndarray, np.ndarray]],
) -> Float[np.ndarray, "objects views"]:
    """Returns a value of every view of every object of a split.

    Args:
        name: one of `VALUES`.
        data: folder of the data set.
        classify, classifier: the classifier whose confidence is meant.
        logits: returns its logits (objects, views, classes) of the split, and the labels (objects,).
    """
    if name in _OF_DEPTH:
        task = replace(classify, images="depth")
        return network_outputs(data, split, task, classifier, _OF_DEPTH[name])[..., 0]
    function, given = _OF_LOGITS[name], jax.tree.map(jnp.asarray, logits())
    return np.asarray(jax.lax.map(lambda one: function(*one), given, batch_size=64))
