"""The grid of rotations, and what is seen of a rotated object."""

from __future__ import annotations

import jax
import numpy as np
from flax import nnx
from scipy.spatial.transform import Rotation

from eval.learned.poses import of_any_rotation, of_unknown_yaw
from mevs_jax import fibonacci_sphere
from mevs_jax.geometry.cameras import look_at_origin
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.models.pose import PoseHead, pose_log_probabilities, yaw_evidence
from mevs_jax.models.rotation import ROTATIONS, nearest_rotations, rotation_grid, rotation_weights, seen_rotations

VIEWS = fibonacci_sphere(8).astype(np.float32)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    return (Rotation.from_matrix(one).inv() * Rotation.from_matrix(other)).magnitude()


def test_the_grid_covers_all_rotations_evenly(random):
    grid = Rotation.from_matrix(rotation_grid())
    some = Rotation.random(2000, random_state=1)
    nearest = np.array([(one.inv() * grid).magnitude().min() for one in some])
    assert np.degrees(nearest.max()) < 30
    assert np.degrees(nearest.mean()) < 17
    assert np.degrees((grid[0].inv() * grid[1:]).magnitude().min()) > 15
    weights = np.asarray(rotation_weights(some.as_matrix().astype(np.float32)))
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-5)
    np.testing.assert_array_equal(weights.argmax(axis=1), [(one.inv() * grid).magnitude().argmin() for one in some])


def test_a_rotation_is_seen_relative_to_the_camera():
    turn = Rotation.random(random_state=3).as_matrix()
    seen = np.asarray(seen_rotations(np.stack([turn] * len(VIEWS)).astype(np.float32), VIEWS))
    for view, found in zip(VIEWS, seen, strict=True):
        camera = np.asarray(look_at_origin(jax.numpy.asarray(view)))[:3, :3]
        np.testing.assert_allclose(found, camera.T @ turn, atol=1e-5)
    nearest = np.asarray(nearest_rotations(VIEWS))
    assert nearest.shape == (len(VIEWS), ROTATIONS)
    for view in (0, 5):
        for one in (0, 100, 575):
            camera = np.asarray(look_at_origin(jax.numpy.asarray(VIEWS[view])))[:3, :3]
            apart = [angle(camera.T @ rotation_grid()[one], other) for other in rotation_grid()]
            assert angle(rotation_grid()[nearest[view, one]], camera.T @ rotation_grid()[one]) <= min(apart) + 1e-3


def test_evidence_of_several_views_finds_the_rotation(random):
    """Each view says what the rotation relative to its camera is, up to the width of the weights, for an object in the grid."""
    true, classes = 123, 2
    seen = seen_rotations(np.stack([rotation_grid()[true]] * len(VIEWS)).astype(np.float32), VIEWS)
    said = np.log(np.asarray(rotation_weights(seen)) + 1e-4)
    evidence = np.take_along_axis(said, np.asarray(nearest_rotations(VIEWS)), axis=1)
    evidence = np.broadcast_to(evidence[:, None], (len(VIEWS), classes, ROTATIONS)).astype(np.float32)
    found = np.asarray(pose_log_probabilities(evidence, np.arange(len(VIEWS)) < 4))
    assert angle(rotation_grid()[found[0].argmax()], rotation_grid()[true]) < np.radians(25)
    assert np.exp(found[0, true]) > 0.1


def test_expected_views_of_rotated_objects(random):
    """A turned object is expected to look from a direction as the object itself does from the direction turned back."""
    expected = ExpectedViews(jax.numpy.asarray(random.normal(size=(3, 9, 3)), jax.numpy.float32))
    found = np.asarray(expected.by_rotation(VIEWS))
    for one in (0, 77, 400):
        np.testing.assert_allclose(
            found[:, one], expected.at(VIEWS @ rotation_grid()[one].astype(np.float32)), atol=1e-4
        )


def test_what_is_known_of_unknown_poses_is_what_the_head_says_of_each_view(random):
    expected = ExpectedViews(jax.numpy.asarray(random.normal(size=(3, 9, 3)), jax.numpy.float32))
    features = random.normal(size=(len(VIEWS), 12)).astype(np.float32)
    for made, poses in ((of_unknown_yaw, 6), (of_any_rotation, ROTATIONS)):
        head = PoseHead(8, 3, poses=poses, width=4, rngs=nnx.Rngs(0))
        known = made(head, expected, VIEWS)
        found = np.asarray(known.evidence(jax.numpy.asarray(features), jax.numpy.asarray(VIEWS)))
        said = np.asarray(head(features[:, 4:], VIEWS[:, 2]))
        if made is of_unknown_yaw:
            np.testing.assert_allclose(found, yaw_evidence(said, VIEWS, np.pi / 6), atol=1e-5)
        else:
            np.testing.assert_allclose(found[2, 1], said[2, 1][np.asarray(nearest_rotations(VIEWS))[2]], atol=1e-5)
        assert known.knowledge.by_pose.shape == (3, poses, len(VIEWS), 3)
