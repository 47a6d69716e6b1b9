"""An agent walks as the selection loop does on tables, takes any candidates, and says what it cannot use."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mevs_jax
from mevs_jax.agent import Agent, load_history, replay
from mevs_jax.agent.candidates import candidates_of
from mevs_jax.agent.frames import pose_towards
from mevs_jax.beliefs.fusing import running_sum
from mevs_jax.selection.loop import ViewTable, by_attention, select_from_table
from tests.mevs_jax.trained import making

K = np.array([[16 / np.tan(np.pi / 6), 0, 15.5], [0, 16 / np.tan(np.pi / 6), 15.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def classifier():
    return making.system("classifier")


@pytest.fixture(scope="module")
def recogniser():
    return making.system("recogniser")


def pose_at(direction) -> np.ndarray:
    return np.asarray(mevs_jax.look_at_origin(jnp.asarray(direction, jnp.float32) * 2), float)


def views_of(system, **ball):
    """Depth images and poses of all viewpoints."""
    return [(making.depth_of_ball(point, **ball), pose_at(point)) for point in system.viewpoints]


def table_of(system, views) -> ViewTable:
    seen = [system.observe(depth, pose) for depth, pose in views]
    entropies = None if seen[0].predicted_entropy is None else jnp.stack([one.predicted_entropy for one in seen])
    features = jnp.stack([one.features for one in seen])
    evidence = None if seen[0].pose_evidence is None else jnp.stack([one.pose_evidence for one in seen])
    logits = jnp.stack([one.logits for one in seen])
    return ViewTable(logits, entropies, None, jnp.int32(0), features=features, pose_evidence=evidence)


CENTER, RADIUS = np.array([0.5, -0.2, 0.8]), 0.3


def in_metres(depth, pose, rotation):
    """A depth image and its camera, around an object that is turned by the rotation, away from the origin."""
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = rotation @ pose[:3, :3], CENTER + RADIUS * rotation @ pose[:3, 3]
    return np.where(depth > 0, RADIUS * depth, np.inf).astype(np.float32), K, placed


def walk(agent, views, first, **reset):
    """Views and probabilities of a walk in metres, around an object away from the origin."""
    reset = {"yaw": 0.0} | reset
    agent.reset(center=CENTER, radius=RADIUS, **reset)
    rotation = mevs_jax.Sphere(CENTER, RADIUS, **reset).rotation
    seen, found, index = [], [], first
    while True:
        found.append(agent.observe(*in_metres(*views[index], rotation)).probabilities)
        seen.append(index)
        step = agent.decide()
        if step.done:
            return seen, np.stack(found), step.reason
        index = step.index


@pytest.mark.parametrize(
    ("kind", "policy"),
    [
        ("classifier", "information_gain"),
        pytest.param("classifier", "predicted_entropy", marks=pytest.mark.slow),
        ("classifier", "remembered_entropy"),
        pytest.param("classifier", "random", marks=pytest.mark.slow),
        pytest.param("classifier", "farthest", marks=pytest.mark.slow),
        pytest.param("classifier", "fixed_order", marks=pytest.mark.slow),
        ("recogniser", "learned"),
        ("recogniser", "expected_views"),
        ("recogniser", "expected_views_unposed"),
        pytest.param("recogniser", "learned_and_table", marks=pytest.mark.slow),
    ],
)
def test_walks_are_those_of_the_selection_loop_on_tables(request, kind, policy):
    """From one view of an upright object, and from another of one that lies somewhere in the world."""
    system = request.getfixturevalue(kind)
    views = views_of(system)
    table, graph = table_of(system, views), system.graph
    policy, posed = policy.removesuffix("_unposed"), not policy.endswith("_unposed")
    knowledge = system.parts.knowledge if posed else system.parts.knowledge_by_pose(graph.points)
    fusion = system.parts.fusion["posed" if posed else "unposed"] if kind == "recogniser" else None
    fuse = by_attention(fusion) if fusion else mevs_jax.sum_of_logits
    run, scene = system.policy(policy, posed=posed), table.scene(graph, knowledge)

    @jax.jit
    def by_table(key, first):
        return select_from_table(key, table, scene, run, first, max_views=6, fuse=fuse)

    agent = Agent(system, policy, stop=2, max_views=6)
    for first, placed in ((0, {}), (7, {"up": (0.3, -1.0, 0.2), "yaw": 0.7})):
        seen, probabilities, reason = walk(agent, views, first, **placed | ({} if posed else {"yaw": None}))
        episode = by_table(agent.key, first)
        assert seen == list(map(int, episode.views))
        assert reason == "budget"
        if kind == "classifier":
            beliefs = running_sum(table.logits[jnp.asarray(seen)])
            expected = [system.log_probabilities(belief, count, policy) for count, belief in enumerate(beliefs, 1)]
            np.testing.assert_allclose(probabilities, np.exp(np.stack(expected)), atol=1e-4)
        else:
            np.testing.assert_allclose(probabilities.argmax(-1), episode.predictions)


def test_random_views_differ_between_objects_and_repeat_with_the_seed(classifier):
    views, orders = views_of(classifier), []
    for seed in (0, 0, 1):
        agent = Agent(classifier, "random", stop=2, max_views=5, seed=seed)
        orders.append([tuple(walk(agent, views, 0)[0]) for _ in range(3)])
    assert orders[0] == orders[1] != orders[2]
    assert len(set(orders[0])) == 3


def test_it_stops_when_it_is_sure(classifier):
    views = views_of(classifier)
    seen, probabilities, reason = walk(Agent(classifier, "farthest", stop=0.3, max_views=6), views, 0)
    assert reason == "sure"
    assert (probabilities[:-1].max(axis=1) < 0.3).all()
    assert probabilities[-1].max() >= 0.3
    seen, _, reason = walk(Agent(classifier, "farthest", stop=2, max_views=3), views, 0)
    assert (len(seen), reason) == (3, "budget")


def test_the_first_view_is_that_of_the_fixed_order(classifier):
    agent = Agent(classifier)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    step = agent.decide()
    assert step.index == int(np.argmax(classifier.parts.knowledge.order))
    expected = pose_towards(classifier.viewpoints[step.index].astype(float), CENTER, 2 * RADIUS, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(step.T_world_camera, expected, atol=1e-6)
    np.testing.assert_allclose(step.direction, classifier.viewpoints[step.index], atol=1e-6)
    only = agent.decide(reachable=[4]).index
    assert only == 4
    agent = Agent(classifier, gain_per_cost=1.0)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    assert agent.decide(cost=np.where(np.arange(making.VIEWS) == step.index, 9.0, 0.0)).index != step.index


def test_what_cannot_be_reached_or_failed_is_not_chosen(classifier):
    views = views_of(classifier)
    agent = Agent(classifier, "information_gain", stop=2)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    agent.observe_view(*views[0])
    best = agent.decide()
    agent.mark_failed(best)
    second = agent.decide()
    assert second.index not in (0, best.index)
    above = np.flatnonzero(2 * RADIUS * classifier.viewpoints[:, 2] > 0.15)
    assert agent.decide(reachable=lambda pose: pose[2, 3] > CENTER[2] + 0.15).index in above
    step = agent.decide(reachable=[0, best.index])
    assert (step.done, step.reason, step.index, step.T_world_camera) == (True, "nothing reachable", -1, None)
    mask = np.zeros(making.VIEWS, bool)
    assert agent.decide(reachable=mask).reason == "nothing reachable"
    mask = jnp.ones(making.VIEWS, bool)
    assert agent.decide(reachable=mask).index == second.index
    mine = np.ones(making.VIEWS, bool)
    agent.decide(reachable=mine, cost=np.where(np.arange(making.VIEWS) == 3, np.inf, 0.0))
    assert mine.all()


def test_costs_change_the_choice(classifier):
    views = views_of(classifier)
    agent = Agent(classifier, "information_gain", stop=2, gain_per_cost=1.0)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    agent.observe_view(*views[0])
    free = agent.decide()
    cost = np.zeros(making.VIEWS)
    cost[free.index] = 100.0
    assert agent.decide(cost=cost).index != free.index
    cost[:] = np.inf
    cost[3] = 5.0
    assert agent.decide(cost=cost).index == 3
    assert np.isfinite(free.expected_gain)


def test_an_unknown_sphere_is_estimated_and_refined(classifier):
    """Of a ball whose first view shows half: the belief at the end is that of the ball's own sphere."""
    directions = classifier.viewpoints[[2, 6, 9, 11]]
    ball, radius = CENTER + np.array([0.05, 0.02, -0.01]), 0.2
    shots = []
    for direction in directions:
        pose = pose_towards(direction.astype(float), CENTER, 0.9, np.array([0, 0, 1.0]))
        depth = making.depth_of_ball(direction, centre=(ball - CENTER) / 0.45, radius=radius / 0.45, notch=False) * 0.45
        shots.append((depth, pose))
    known, unknown = (Agent(classifier, stop=2, max_views=5) for _ in range(2))
    known.reset(center=ball, radius=radius, yaw=0.0)
    unknown.reset_from_points(mevs_jax.DepthImage(shots[0][0], K, shots[0][1]).points(), yaw=0.0)
    first = np.linalg.norm(unknown.center - ball)
    buffer = np.zeros_like(shots[0][0])  # which a driver fills again and again
    for depth, pose in shots:
        expected = known.observe(depth, K, pose)
        buffer[:] = depth
        belief = unknown.observe(buffer, K, pose, mask=buffer > 0)
        before = unknown.center, unknown.radius
        with pytest.raises(ValueError, match="needs a mask of its pixels or a floor"):
            unknown.observe(depth, K, pose)
        with pytest.raises(ValueError, match="is seen by observe alone"):
            unknown.observe_view(depth, pose)
        with pytest.raises(ValueError, match=r"no measured pixel|no pixel shows"):
            unknown.observe(np.zeros_like(depth), K, pose, mask=depth > 0)
        np.testing.assert_array_equal(unknown.center, before[0])
    assert first > 0.05
    assert np.linalg.norm(unknown.center - ball) < 0.1 * first + 0.01
    np.testing.assert_allclose(unknown.radius, radius, rtol=0.05)
    np.testing.assert_allclose(belief.probabilities, expected.probabilities, atol=0.1)
    assert belief.views == unknown.history.views == 4
    again = replay(unknown.history, Agent(classifier, stop=2, max_views=5))
    np.testing.assert_allclose(again[-1].probabilities, belief.probabilities, atol=1e-5)


def test_candidates_may_be_any_poses(classifier):
    views = views_of(classifier)
    agent = Agent(classifier, "information_gain", stop=2)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    agent.observe_view(*views[2])
    by_index = agent.decide().index
    poses = agent.poses
    order = np.random.default_rng(0).permutation(making.VIEWS)
    assert order[agent.decide(candidates=poses[order]).index] == by_index  # the same poses, in another order
    random = np.random.default_rng(1)
    free = random.normal(size=(30, 3))
    free[:, 2] = np.abs(free[:, 2])
    free /= np.linalg.norm(free, axis=1, keepdims=True)
    around = np.stack([pose_towards(one, CENTER, 0.9, np.array([0, 0, 1.0])) for one in free])
    step = agent.decide(candidates=around)
    np.testing.assert_array_equal(step.T_world_camera, around[step.index])
    assert agent.decide(candidates=around[:1]).index == 0
    beside = views[2][1][:3, 3] / 2 + np.array([0.01, 0, 0])
    near = pose_towards(beside / np.linalg.norm(beside), CENTER, 0.9, np.array([0, 0, 1.0]))
    assert agent.decide(candidates=near[None]).reason == "nothing reachable"  # it was seen from there
    with pytest.raises(ValueError, match="make it with max_candidates=200"):
        agent.decide(candidates=np.repeat(around[:1], 200, axis=0))


def test_views_may_be_between_the_viewpoints(classifier):
    direction = classifier.viewpoints[0] + 0.6 * classifier.viewpoints[1]
    direction /= np.linalg.norm(direction)
    for policy in ("information_gain", "farthest", "predicted_entropy"):
        agent = Agent(classifier, policy, stop=2)
        agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
        agent.observe_view(making.depth_of_ball(direction), pose_at(direction))
        index = agent.decide().index
        if policy == "farthest":
            assert index == int(np.argmin(classifier.viewpoints @ direction))


def test_values_between_viewpoints_are_interpolated(classifier):
    points = np.stack([classifier.viewpoints[3], (classifier.viewpoints[3] + classifier.viewpoints[4]) / 2])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    weights = np.asarray(candidates_of(classifier, points, 5).weights)
    np.testing.assert_array_equal(weights[0], np.eye(making.VIEWS)[3])
    np.testing.assert_allclose(weights[:2].sum(axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(weights[1, 3], weights[1, 4], rtol=1e-4)
    assert not weights[2:].any()


def test_the_yaw_may_be_unknown(recogniser, classifier):
    views = views_of(recogniser)
    known, unknown = (Agent(recogniser, stop=2, max_views=4) for _ in range(2))
    turned = {"yaw": 1.1}
    first = walk(unknown, views, 0, yaw=None)
    np.testing.assert_allclose(first[1], walk(unknown, views, 0, yaw=None, up=(0, 0, 2))[1], atol=1e-5)
    assert walk(known, views, 0, **turned)[0] == walk(known, views, 0)[0]
    agent = Agent(classifier, "information_gain")
    with pytest.raises(
        ValueError, match=r"cannot be used here for an object of unknown yaw: this policy needs Scene\.knowledge"
    ):
        agent.reset(center=CENTER, radius=RADIUS, yaw=None)
    agent = Agent(classifier, stop=2)
    agent.reset(center=CENTER, radius=RADIUS, yaw=None)
    agent.observe_view(*views_of(classifier)[0])
    assert agent.decide().index == int(np.argmin(classifier.viewpoints @ classifier.viewpoints[0]))  # farthest


def test_beliefs_do_not_depend_on_an_unknown_yaw(recogniser):
    """If the yaw is known, beliefs are those of the object that is not turned. A wrong yaw changes them."""
    views = [views_of(recogniser)[index] for index in (0, 3, 5)]

    def beliefs(yaw: float, told: float | None) -> np.ndarray:
        agent, rotation = Agent(recogniser, stop=2, max_views=4), mevs_jax.Sphere(CENTER, RADIUS, yaw=yaw).rotation
        agent.reset(center=CENTER, radius=RADIUS, yaw=told)
        return np.stack([agent.observe(*in_metres(*view, rotation)).probabilities for view in views])

    for yaw in (0.7, -2.5):
        np.testing.assert_allclose(beliefs(yaw, None), beliefs(0.0, None), atol=1e-5)
        np.testing.assert_allclose(beliefs(yaw, yaw), beliefs(0.0, 0.0), atol=1e-5)
        assert np.abs(beliefs(yaw, 0.0) - beliefs(0.0, 0.0)).max() > 1e-3


def test_strange_objects_are_unknown(classifier):
    views = views_of(classifier)
    agent = Agent(classifier, stop=2, max_views=2, unknown=0.9)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    beliefs = [agent.observe_view(*views[index]) for index in (0, 5)]
    assert all(belief.strangeness > 0.9 and not belief.known for belief in beliefs)  # its features were random numbers
    assert agent.decide().reason == "unknown object"
    assert Agent(classifier, stop=2, max_views=1).unknown is None


def test_nothing_is_compiled_after_the_warm_up(recogniser):
    agent = Agent(recogniser, stop=0.01, max_views=5)  # sure of the first view, also while it warms up
    agent.warm_up()
    agent.stop = 2
    views, events = views_of(recogniser), []

    def listen(event, *_, **__):
        if "compile" in event:
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for yaw in (0.0, None):
            agent.reset(center=CENTER, radius=RADIUS, yaw=yaw)
            for index in (0, 3):
                depth, pose = views[index]
                placed = pose.copy()
                placed[:3, 3] = CENTER + RADIUS * pose[:3, 3]
                for rows in (32, 48):  # images of other sizes
                    image = np.zeros((rows, 40), np.float32)
                    image[:32, :32] = RADIUS * depth
                    agent.observe(image, K, placed)
                agent.decide()
                agent.decide(reachable=[1, 2], cost=np.ones(making.VIEWS))
                agent.decide(candidates=agent.poses[:7])
        assert events == []
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_a_history_is_saved_and_repeated(classifier, tmp_path):
    views = views_of(classifier)
    agent = Agent(classifier, "information_gain", stop=2, max_views=4)
    _, probabilities, _ = walk(agent, views, 3, up=(0, 1, 0), yaw=0.4)
    agent.history.save(tmp_path / "walk.npz")
    history = load_history(tmp_path / "walk.npz")
    assert [event["call"] for event in history.events] == ["observe", "decide"] * 4
    assert history.options["reset"]["yaw"] == 0.4
    again = replay(history, Agent(classifier, "information_gain", stop=2, max_views=4))
    np.testing.assert_allclose([belief.probabilities for belief in again], probabilities, atol=1e-6)
    (tmp_path / "other.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="is no history of an agent"):
        load_history(tmp_path / "other.npz")


def test_a_policy_of_ones_own(classifier):
    def lowest(key, state, scene):
        return -scene.graph.points[:, 2]

    agent = Agent(classifier, lowest, stop=2)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    agent.observe_view(*views_of(classifier)[0])
    assert agent.decide().index == int(np.argmin(classifier.viewpoints[:, 2]))

    def wrong(key, state, scene):
        return jnp.zeros(1)

    with pytest.raises(ValueError, match=r"policy wrong cannot be used here: it returns scores of shape \(1,\)"):
        Agent(classifier, wrong)


def test_the_smallest_rotation_takes_z_to_up():
    for up in ((0, 0, 1), (0, 0, -3), (1, 2, 3), (0, -1, 0)):
        rotation = mevs_jax.Sphere(CENTER, RADIUS, up).rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(rotation), 1)
        np.testing.assert_allclose(rotation[:, 2], np.asarray(up) / np.linalg.norm(up), atol=1e-12)
    np.testing.assert_allclose(mevs_jax.Sphere(CENTER, RADIUS, yaw=np.pi / 2).rotation[:, 0], [0, 1, 0], atol=1e-12)


def test_size_is_told_unless_it_is_not_true():
    """A system that uses sizes: agents tell it their radius, and a mesh's only where its unit is known."""
    sized = making.system("sized")
    view = 3
    depth, pose = making.depth_of_ball(sized.viewpoints[view]), sized.poses[view]
    agent, found = sized.agent(stop=2.0, max_views=3), {}
    for name, options in {
        "small": {"radius": 0.1},
        "large": {"radius": 1.0},
        "model": {"radius": 0.1, "true_size": False},
        "other model": {"radius": 1.0, "true_size": False},
    }.items():
        agent.reset(center=(0, 0, 0), yaw=0.0, **options)
        found[name] = agent.observe_view(depth, pose).probabilities
    assert np.abs(found["small"] - found["large"]).max() > 1e-3
    np.testing.assert_array_equal(found["model"], found["other model"])
    again = agent.history.options["reset"]
    assert again["true_size"] is False
    expected = sized.observe(depth, pose, 0.1)
    assert np.abs(np.asarray(expected.features - sized.observe(depth, pose).features)).max() > 0.1
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]])
    walks = [mevs_jax.look(sized, cube, faces, stop=2.0, max_views=1, metres=metres) for metres in (None, 0.1, 1.0)]
    unknown, small, large = (walk.beliefs[0].probabilities for walk in walks)
    assert np.abs(small - large).max() > 1e-3
    assert np.abs(small - unknown).max() > 1e-4
    far = mevs_jax.look(sized, 1000 * cube, faces, stop=2.0, max_views=1, metres=0.001)
    np.testing.assert_allclose(far.beliefs[0].probabilities, large, atol=1e-5)


def test_an_agent_for_near_objects_is_warm_too(classifier):
    near = classifier.agent("random", stop=2.0, distance=0.3, max_views=6)
    near.warm_up()
    assert near._programs[True]._see._cache_size() > 0
