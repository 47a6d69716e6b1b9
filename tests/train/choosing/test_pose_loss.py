"""The loss of the pose head, with plain loops."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mevs_jax import look_at_origin
from mevs_jax.models.rotation import ROTATIONS, rotation_grid
from train.tasks.recogniser import _POSE_WEIGHT, _metrics_of

OBJECTS, VIEWS, CLASSES, AZIMUTHS = 3, 4, 5, 12


def given(random: np.random.Generator, poses: int):
    """Outputs of a network that were drawn, labels and directions."""
    logits = jnp.asarray(random.normal(size=(OBJECTS, VIEWS, CLASSES)), jnp.float32)
    said = jax.nn.log_softmax(jnp.asarray(random.normal(size=(OBJECTS, VIEWS, CLASSES, poses)), jnp.float32))
    directions = random.normal(size=(OBJECTS, VIEWS, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    labels = jnp.asarray(random.integers(0, CLASSES, OBJECTS))
    return (logits, logits[:, 0], logits[:, 1], said), labels, directions


def pose_loss(outputs, labels, directions, turns=None) -> np.ndarray:
    """The loss of the pose, once it was checked that it is a part of the whole loss."""
    found = _metrics_of(outputs, labels, jnp.asarray(directions), turns)
    without = _metrics_of((*outputs[:3], None), labels, jnp.asarray(directions), turns)
    assert "pose_loss" not in without
    np.testing.assert_allclose(found["loss"], without["loss"] + _POSE_WEIGHT * found["pose_loss"], rtol=1e-5)
    return np.asarray(found["pose_loss"])


def test_azimuths_are_expected_of_the_true_class_between_the_two_nearest(random):
    outputs, labels, directions = given(random, AZIMUTHS)
    found = pose_loss(outputs, labels, directions)
    for thing in range(OBJECTS):
        for view in range(VIEWS):
            x, y, _ = directions[thing, view]
            place = np.arctan2(y, x) / (2 * np.pi) * AZIMUTHS
            below, share = int(np.floor(place)), place - np.floor(place)
            said = np.asarray(outputs[3])[thing, view, int(labels[thing])]
            expected = -(1 - share) * said[below % AZIMUTHS] - share * said[(below + 1) % AZIMUTHS]
            assert found[thing, view] == pytest.approx(expected, rel=1e-4)


def test_rotations_are_those_that_the_camera_sees(random):
    """The loss is least for a head that is sure of the rotation of the grid nearest to that seen."""
    outputs, labels, directions = given(random, ROTATIONS)
    turns = np.stack([Rotation.random(random_state=seed).as_matrix() for seed in range(OBJECTS)]).astype(np.float32)
    grid, losses = rotation_grid(), {}
    for wrong in (False, True):
        said = np.full(outputs[3].shape, -20.0, np.float32)
        for thing in range(OBJECTS):
            for view in range(VIEWS):
                camera = np.asarray(look_at_origin(jnp.asarray(directions[thing, view])))[:3, :3]
                seen = turns[thing] if wrong else camera.T @ turns[thing]
                said[thing, view, :, np.einsum("rij,ij->r", grid, seen).argmax()] = 0
        losses[wrong] = pose_loss((*outputs[:3], jnp.asarray(said)), labels, directions, jnp.asarray(turns))
    assert losses[False].max() < losses[True].min()
