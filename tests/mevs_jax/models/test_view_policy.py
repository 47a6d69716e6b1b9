"""The view policy: what its predictions may depend on, and what they are."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mevs_jax import fibonacci_sphere
from mevs_jax.models import ViewPolicy
from mevs_jax.models.view_policy import direction_features, expected_gain, utility_of
from tests.reference.choosing import CLASSES, SEEN, VIEWS, asked, moved


def test_worth_depends_on_what_was_seen_not_on_its_order_nor_on_other_candidates(policy, random):
    belief = jax.nn.log_softmax(random.normal(size=CLASSES)).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points = fibonacci_sphere(VIEWS).astype(np.float32)
    present = np.array([True, True, False])
    gain, gain_if = asked(policy, belief, views, points[:SEEN], present, points)
    assert gain.shape == (VIEWS,)
    assert gain_if.shape == (VIEWS, CLASSES)
    turned = asked(policy, belief, views[jnp.array([1, 0, 2])], points[[1, 0, 2]], present, points)
    np.testing.assert_allclose(turned[0], gain, atol=1e-5)
    junk = np.where(present[:, None], np.asarray(views), np.nan).astype(np.float32)
    nowhere = np.where(present[:, None], points[:SEEN], np.nan).astype(np.float32)
    np.testing.assert_allclose(asked(policy, belief, junk, nowhere, present, points)[0], gain, atol=1e-5)
    alone = asked(policy, belief, views, points[:SEEN], present, points[[4, 2]])
    np.testing.assert_allclose(alone[0], gain[jnp.array([4, 2])], atol=1e-5)
    np.testing.assert_allclose(alone[1], gain_if[jnp.array([4, 2])], atol=1e-5)


def test_without_a_pose_worth_is_the_same_whichever_way_an_object_faces(random):
    policy = moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=2, posed=False, rngs=nnx.Rngs(1)), 0.1)
    belief = jax.nn.log_softmax(random.normal(size=CLASSES)).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points, present = fibonacci_sphere(VIEWS).astype(np.float32), np.array([True, True, False])
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], np.float32)
    found = [asked(policy, belief, views, there[1 : 1 + SEEN], present, there) for there in (points, points @ turn.T)]
    np.testing.assert_allclose(*(gain for gain, _ in found), atol=1e-5)
    np.testing.assert_allclose(*(gain_if for _, gain_if in found), atol=1e-5)


@pytest.mark.parametrize("utility", ["probability", "log"])
def test_what_is_expected_for_a_class_leaves_its_probability_a_probability(random, utility):
    make = partial(ViewPolicy, CLASSES, width=16, heads=2, blocks=1, utility=utility, floor=0.01, rngs=nnx.Rngs(1))
    belief = np.log(np.array([1 - 2e-7, 1e-7, 1e-7, 0.0]) + 1e-30).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points, present = fibonacci_sphere(VIEWS).astype(np.float32), np.array([True, True, False])
    known = views, points[:SEEN], present, points
    for gain in asked(make(), belief, *known):
        np.testing.assert_allclose(gain, 0, atol=1e-6)  # untrained, it expects nothing
    sure = moved(make(), 3.0)
    for held in (belief, np.log(np.array([0.4, 0.3, 0.2, 0.1], np.float32))):
        _, gain_if = asked(sure, held, *known)
        before = utility_of(np.clip(held, -12, -1e-5), utility)
        low, high = (0.0, 1.0) if utility == "probability" else (np.log(0.01), np.log(1.01))
        after = np.asarray(before + gain_if)
        assert (after >= low - 1e-5).all()
        assert (after <= high + 1e-5).all()
    assert after.max() - after.min() > 0.5


def test_directions_become_all_their_monomials():
    x, y, z = 0.5, -2.0, 3.0
    found = np.asarray(direction_features(np.array([x, y, z])))
    assert len(found) == 3 + 6 + 10
    for expected in (x, y * z, z * z, x * y * z, y**3, x * x * z):
        assert np.isclose(found, expected).any()


def test_the_expected_gain_in_log_probability_is_the_expected_information(random):
    prior, shows = (
        random.dirichlet(np.ones(CLASSES)),
        random.dirichlet(np.ones(5), size=CLASSES),
    )  # p(what is seen | class)
    joint = prior[:, None] * shows
    after = joint / joint.sum(axis=0)
    gain_if = np.sum(shows * np.log(after / prior[:, None]), axis=1)
    entropy = lambda p: -np.sum(p * np.log(p), axis=0)  # noqa: E731
    expected = entropy(prior) - np.sum(joint.sum(axis=0) * entropy(after))
    found = expected_gain(np.log(prior).astype(np.float32), gain_if[None].astype(np.float32))
    np.testing.assert_allclose(found, [expected], rtol=1e-4)


@pytest.mark.parametrize(
    "seen", [[True, False, False], [True, True, False], [False, False, False], [True, False, True]]
)
def test_without_a_pose_and_an_azimuth_only_elevations_count(random, seen):
    """Views from straight above and below do not determine the yaw, so the candidates' azimuths must not matter."""
    policy = moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=2, posed=False, rngs=nnx.Rngs(1)), 0.1)
    belief = jax.nn.log_softmax(random.normal(size=CLASSES)).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(3, CLASSES)), axis=-1)
    directions = np.array([[0, 0, 1], [0, 0, -1], [0.6, 0, 0.8]], np.float32)
    points, present = fibonacci_sphere(VIEWS).astype(np.float32), np.array(seen)
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], np.float32)
    gain, gain_if = asked(policy, belief, views, directions, present, points)
    turned = asked(policy, belief, views, directions @ turn.T, present, points @ turn.T)
    np.testing.assert_allclose(gain, turned[0], atol=1e-5)
    np.testing.assert_allclose(gain_if, turned[1], atol=1e-5)
    around = np.array([[0.8, 0, 0.6], [0, 0.8, 0.6], [-0.8, 0, 0.6]], np.float32)
    differ = np.ptp(np.asarray(asked(policy, belief, views, directions, present, around)[0])) > 1e-4
    assert differ == seen[2]  # candidates of one elevation differ only if some view seen is not vertical
