"""Views that are taken again: every walk ends, and what was looked at last is what a policy reads."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax.agent import Agent
from mevs_jax.trained.situation import REPEATED
from tests.mevs_jax.agent.test_agent import CENTER, RADIUS, begun, in_metres, pose_at, views_of
from tests.mevs_jax.trained import making


def test_a_camera_that_does_not_move_ends_the_loop(classifier):
    agent = begun(classifier, "information_gain", max_views=4)
    there, images = in_metres(*views_of(classifier)[3]), 0
    step = agent.decide()
    while not step.done and images < 10:
        belief = agent.observe(*there)
        images += 1
        assert (belief.images, belief.views) == (images, 1)
        step = agent.decide()
    assert (images, step.reason) == (4, "budget")
    with pytest.raises(ValueError, match="the budget of 4 views is spent"):
        agent.observe(*there)


def test_what_counts_as_seen_is_what_counts_as_repeated(classifier):
    """Among candidates closer to each other than a repeated view, none is chosen that would replace a view seen."""
    direction = classifier.viewpoints[3].astype(float)
    aside = np.cross(direction, [0, 0, 1])
    aside /= np.linalg.norm(aside)
    angles = np.linspace(0, 6 * REPEATED, 25)
    around = np.cos(angles)[:, None] * direction + np.sin(angles)[:, None] * aside
    agent = begun(classifier, "random", max_views=8)
    shots = [(making.depth_of_ball(one), pose_at(*one.tolist())) for one in around]
    poses = np.stack([in_metres(*shot)[2] for shot in shots])
    step = agent.decide(candidates=poses)
    while not step.done:
        belief = agent.observe_view(*shots[step.index])
        assert belief.views == belief.images
        step = agent.decide(candidates=poses)
    assert step.reason == "nothing reachable"


def test_the_last_view_is_the_one_that_was_looked_at_last(classifier):
    seen = []

    def mine(key, state, scene):
        jax.debug.callback(lambda *now: seen.append([np.asarray(one).tolist() for one in now]), state.view, state.views)
        differs = jnp.max(jnp.abs(state.latest.logits - state.seen.logits), axis=-1)
        jax.debug.callback(lambda slot: seen.append(int(slot)), jnp.argmin(differs))
        return jnp.zeros(len(scene.graph.points))

    agent = begun(classifier, mine, max_views=5)
    for index in (3, 10, 3):
        agent.observe_view(*views_of(classifier)[index])
    agent.decide()
    jax.effects_barrier()
    assert 0 in seen
    assert [3, [3, 10, -1, -1, -1]] in seen


def test_the_budget_of_refined_spheres_counts_images_too(classifier):
    depth, K, pose = in_metres(*views_of(classifier)[3])
    agent = Agent(classifier, stop=2, max_views=2, unknown=None)
    image = depth, K, pose
    points = CENTER + RADIUS * np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    agent.reset_from_points(points)
    for _ in range(2):
        belief = agent.observe(*image, mask=np.isfinite(depth))
    assert belief.images == 2
    assert agent.decide().reason == "budget"
