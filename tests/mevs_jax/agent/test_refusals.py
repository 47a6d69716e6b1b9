"""What an agent does not take for evidence, and what it cannot use: one sentence each."""

from __future__ import annotations

import numpy as np
import pytest

from mevs_jax.agent import Agent
from mevs_jax.agent.candidates import aimed, mask_of, pose_towards
from mevs_jax.agent.looking import Frames, look_at_frames
from mevs_jax.geometry.inputs import check_depth
from mevs_jax.geometry.sphere import Sphere
from tests.mevs_jax.agent.test_agent import CENTER, RADIUS, K, views_of
from tests.mevs_jax.trained import making

UP = np.array([0, 0, 1.0])


@pytest.fixture
def agent(system):
    made = Agent(system, stop=2, max_views=3, unknown=None)
    made.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    return made


def shot(system, view: int, aim=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Depth in metres and pose of a view; its camera may aim beside the object, which is then elsewhere in the image."""
    direction = system.viewpoints[view].astype(float)
    depth = making.depth_of_ball(direction)
    return np.where(depth > 0, RADIUS * depth, np.inf).astype(np.float32), pose_towards(
        direction, CENTER + aim, 0.6, UP
    )


def test_a_view_taken_again_is_no_new_evidence(system):
    agent = Agent(system, stop=2, max_views=7)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    first = agent.observe(*_camera(shot(system, 2)))
    for _ in range(4):
        again = agent.observe(*_camera(shot(system, 2)))
    assert again.views == 1
    np.testing.assert_allclose(again.probabilities, first.probabilities, atol=1e-5)
    third, fourth = (agent.observe(*_camera(shot(system, view))) for view in (5, 7))
    assert (third.views, fourth.views) == (2, 3)
    assert (again.images, fourth.images) == (5, 7)
    other = Agent(system, stop=2, max_views=7)
    other.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    for view in (2, 5, 7):
        once = other.observe(*_camera(shot(system, view)))
    np.testing.assert_allclose(fourth.probabilities, once.probabilities, atol=1e-5)
    with pytest.raises(ValueError, match="the budget of 7 views is spent"):
        agent.observe(*_camera(shot(system, 9)))


def test_another_image_from_the_same_pose_is_refused(system, agent):
    depth, pose = shot(system, 2)
    agent.observe(depth, K, pose)
    with pytest.raises(
        ValueError, match=r"depth is another than that of image 0, taken from there, at \d+% of the object's"
    ):
        agent.observe(depth - 0.4 * RADIUS, K, pose)
    noise = np.random.default_rng(0).normal(0, 0.02 * RADIUS, depth.shape).astype(np.float32)
    assert agent.observe(depth + noise, K, pose).images == 2


def _camera(taken):
    return taken[0], K, taken[1]


def test_an_image_that_shows_too_little_is_refused(system, agent):
    depth, pose = shot(system, 2)
    turned = pose.copy()
    angle = np.deg2rad(35)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned[:3, :3] = pose[:3, :3] @ turn
    with pytest.raises(ValueError, match=r"only \d+% of the object's sphere is in the image, and half of it is needed"):
        agent.observe(depth, K, turned)
    mask, holes = np.isfinite(depth), depth.copy()
    holes[np.random.default_rng(0).uniform(size=depth.shape) < 0.7] = 0
    with pytest.raises(ValueError, match=r"only \d+% of the mask's pixels have a measured depth"):
        agent.observe(holes, K, pose, mask=mask)
    with pytest.raises(ValueError, match="mask has NaN"):
        agent.observe(depth, K, pose, mask=np.full(depth.shape, np.nan))
    assert agent.history.views == 0


def test_views_that_are_not_in_radii_are_refused(system, agent):
    depth, pose = views_of(system)[0]
    for wrong, message in (
        (0.1 * depth, r"an object seen from 2 radii has 0.9 to 3.1 radii"),
        (900 * depth, r"make it from any camera's image with mevs_jax.canonical_view"),
    ):
        with pytest.raises(ValueError, match=message):
            agent.observe_view(wrong, pose)
        with pytest.raises(ValueError, match=message):
            system.observe(wrong, pose)
    with pytest.raises(ValueError, match="of a floating type, got uint16"):
        check_depth((1000 * depth).astype(np.uint16), system.description.camera)


def test_nothing_to_choose_from_is_a_result(system, agent):
    agent.observe(*_camera(shot(system, 2)))
    for none in ([], np.zeros((0, 4, 4))):
        step = agent.decide(candidates=none)
        assert (step.done, step.reason, step.index) == (True, "nothing reachable", -1)
    inside = np.stack([pose_towards(system.viewpoints[5].astype(float), CENTER, 0.5 * RADIUS, UP)])
    assert agent.decide(candidates=inside).reason == "nothing reachable"
    stranger = Agent(system, stop=2, max_views=3, unknown=1e-9)
    stranger.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    if not stranger.observe(*_camera(shot(system, 2))).known:
        assert stranger.decide(reachable=[]).reason == "unknown object"


def test_candidates_that_are_no_cameras_at_the_object_are_refused(system, agent):
    poses = agent.poses
    opengl = poses @ np.diag([1.0, -1, -1, 1])
    with pytest.raises(ValueError, match="no candidate looks at the object"):
        agent.decide(candidates=opengl)
    _, useful = aimed(np.concatenate([poses[:2], opengl[2:4]]), CENTER, RADIUS)
    assert useful.tolist() == [True, True, False, False]
    scaled = poses.copy()
    scaled[1, :3, :3] *= 3
    with pytest.raises(ValueError, match=r"candidate 1: .* is not a rotation"):
        agent.decide(candidates=scaled)
    with pytest.raises(ValueError, match="candidates must be poses"):
        agent.decide(candidates=np.eye(4))
    with pytest.raises(ValueError, match="away from the object's centre"):
        agent.mark_failed(np.block([[np.eye(3), CENTER[:, None]], [0, 0, 0, 1]]))
    near = Agent(system, distance=0.1)
    with pytest.raises(ValueError, match=r"distance of 0.1 m is inside the object's radius of 0.3 m"):
        near.reset(center=CENTER, radius=RADIUS)


def test_zeros_and_ones_are_no_indices():
    with pytest.raises(ValueError, match=r"reachable.astype\(bool\)"):
        mask_of((np.arange(40) >= 20).astype(np.uint8), 40)
    assert np.flatnonzero(mask_of([1, 0], 3)).tolist() == [0, 1]


def test_frames_that_cannot_be_used_are_left_out_by_name(system):
    shots = [shot(system, view) for view in range(6)]
    depth, poses = np.stack([one[0] for one in shots]), np.stack([one[1] for one in shots])
    depth[3] = 0
    frames = Frames(depth, np.stack([K] * 6), poses, Sphere(CENTER, RADIUS, yaw=0.0))
    walk = look_at_frames(Agent(system, "farthest", stop=2, max_views=8, max_candidates=12), frames)
    assert sorted(walk.views) == [0, 1, 2, 4, 5]
    assert list(walk.left_out) == [3]
    assert "view   3: left out, depth has no measured pixel" in str(walk)
    nothing = Frames(np.zeros_like(depth), np.stack([K] * 6), poses, Sphere(CENTER, RADIUS, yaw=0.0))
    with pytest.raises(ValueError, match="no measured pixel"):
        look_at_frames(Agent(system, "farthest", stop=2, max_views=8, max_candidates=12), nothing)


REFUSED = {
    "stop must be a probability": {"stop": 0.0},
    "stop must be a probability above 0, as 0.95": {"stop": 95},
    "max_views must be from 1": {"max_views": 0},
    r"unknown must be in \(0, 1\]": {"unknown": 1.5},
    "gain_per_cost must be at least 0": {"gain_per_cost": -1.0},
    "distance must be positive": {"distance": 0.0},
    "unknown policy 'luck'": {"policy": "luck"},
    r"policy label_oracle cannot be used here: this policy needs Scene\.": {"policy": "label_oracle"},
}


@pytest.mark.parametrize("message", REFUSED)
def test_options_that_cannot_be_are_refused(system, message):
    with pytest.raises(ValueError, match=message):
        system.agent(**REFUSED[message])


def test_calls_that_cannot_be_are_refused(system):
    agent = Agent(system, max_views=1, stop=2)
    depth, pose = views_of(system)[0]
    for call in (agent.decide, lambda: agent.observe_view(depth, pose), lambda: agent.poses):
        with pytest.raises(ValueError, match="call reset or reset_from_points first"):
            call()
    for message, options in {
        "center must be three finite numbers": {"center": (0, 0), "radius": 1},
        "radius must be positive": {"center": (0, 0, 0), "radius": -1},
        "up must be a direction": {"center": (0, 0, 0), "radius": 1, "up": (0, 0, 0)},
        "yaw must be an angle in radians": {"center": (0, 0, 0), "radius": 1, "yaw": np.nan},
        "yaw must be an angle in radians, within two turns": {"center": (0, 0, 0), "radius": 1, "yaw": 300},
    }.items():
        with pytest.raises(ValueError, match=message):
            agent.reset(**options)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    for message, options in {
        r"reachable has shape \(3,\); there are 12 candidates": {"reachable": np.ones(3, bool)},
        "or indices from 0 to 11": {"reachable": [12]},
        "cost has 2 values; there are 12 candidates": {"cost": [1, 2]},
        "cost has values that are NaN": {"cost": [np.nan] * 12},
        "costs differ, but gain_per_cost is 0": {"cost": range(12)},
        r"candidates must be poses \(candidates, 4, 4\)": {"candidates": np.eye(4)},
        "a candidate is at the object's centre": {
            "candidates": pose_towards(np.eye(3)[0], CENTER, 0.0, np.eye(3)[2])[None]
        },
    }.items():
        with pytest.raises(ValueError, match=message):
            agent.decide(**options)
    agent.observe_view(depth, pose)
    with pytest.raises(ValueError, match="the budget of 1 views is spent"):
        agent.observe_view(depth, pose)
    with pytest.raises(ValueError, match="needs depth images of 32×32 pixels, got 8×8"):
        system.observe(np.zeros((8, 8)), pose)
    agent.reset(center=CENTER, radius=RADIUS)
    for message, given in {
        r"takes images \(32, 32\) at poses \(4, 4\), got \(8, 8\)": (np.zeros((8, 8)), pose),
        "pose is not finite, or at the object's centre": (depth, np.eye(4)),
    }.items():
        with pytest.raises(ValueError, match=message):
            agent.observe_view(*given)
