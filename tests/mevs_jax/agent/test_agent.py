"""An agent walks as the selection loop does on tables, takes any candidates, and says what it cannot use."""

from __future__ import annotations

import resource
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mevs_jax
from mevs_jax.agent import Agent, load_history, replay
from mevs_jax.agent.candidates import candidates_of, pose_towards
from mevs_jax.agent.looking import Frames, look_at_frames
from mevs_jax.beliefs.fusing import running_sum
from mevs_jax.geometry.viewpoints import fibonacci_sphere
from mevs_jax.selection.loop import ViewTable, by_attention, select_from_table
from tests.mevs_jax.trained import making

K = np.array([[16 / np.tan(np.pi / 6), 0, 15.5], [0, 16 / np.tan(np.pi / 6), 15.5], [0, 0, 1]])
CENTER, RADIUS, UP, YAW = np.array([0.5, -0.2, 0.8]), 0.3, np.array([0.3, -1.0, 0.2]), 0.7
LYING = mevs_jax.Sphere(CENTER, RADIUS, UP, YAW)
"""Where objects are, unless a test says otherwise: away from the origin, tilted, and turned."""


@cache
def pose_at(x: float, y: float, z: float) -> np.ndarray:
    return np.asarray(mevs_jax.look_at_origin(jnp.array([x, y, z], jnp.float32) * 2), float)


@cache
def _views(points: tuple[tuple[float, float, float], ...]) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(making.depth_of_ball(np.array(point)), pose_at(*point)) for point in points]


def views_of(system):
    """Depth images and poses of all viewpoints."""
    return _views(tuple(map(tuple, system.viewpoints.tolist())))


def table_of(system, views) -> ViewTable:
    seen = [system.observe(depth, pose) for depth, pose in views]
    entropies = None if seen[0].predicted_entropy is None else jnp.stack([one.predicted_entropy for one in seen])
    features = jnp.stack([one.features for one in seen])
    evidence = None if seen[0].pose_evidence is None else jnp.stack([one.pose_evidence for one in seen])
    logits = jnp.stack([one.logits for one in seen])
    return ViewTable(logits, entropies, None, jnp.int32(0), features=features, pose_evidence=evidence)


def rotation_of(sphere) -> np.ndarray:
    """From the object's frame to the world, by another way than the library's."""
    up = np.asarray(sphere.up, float) / np.linalg.norm(sphere.up)
    axis, angle = np.cross([0, 0, 1], up), np.arccos(up[2])
    lifted = Rotation.from_rotvec(angle * axis / max(np.linalg.norm(axis), 1e-12))
    return (lifted * Rotation.from_rotvec([0, 0, sphere.yaw or 0.0])).as_matrix()


def in_metres(depth, pose, sphere=LYING):
    """A depth image in radii and its camera, around an object in the world."""
    placed, rotation = np.eye(4), rotation_of(sphere)
    placed[:3, :3] = rotation @ pose[:3, :3]
    placed[:3, 3] = sphere.position + sphere.radius * rotation @ pose[:3, 3]
    return np.where(depth > 0, sphere.radius * depth, np.inf).astype(np.float32), K, placed


def begun(system, policy="best", sphere=LYING, **options) -> Agent:
    """An agent that is never sure, with an object."""
    agent = Agent(system, policy, **{"stop": 2, "unknown": None} | options)
    agent.begin(sphere)
    return agent


def walk(agent, views, first, sphere=LYING):
    """Views and probabilities of a walk around an object, whose images are taken where the agent says."""
    agent.begin(sphere)
    seen, beliefs, index = [], [], first
    while True:
        beliefs.append(agent.observe(*in_metres(*views[index], sphere)).probabilities)
        seen.append(index)
        step = agent.decide()
        if step.done:
            return seen, np.stack(beliefs), step.reason
        index, there = step.index, in_metres(*views[step.index], sphere)[2]
        if sphere.yaw is not None:
            np.testing.assert_allclose(step.T_world_camera[:3, 2:], there[:3, 2:], atol=1e-5)  # where it is and looks
            np.testing.assert_allclose(step.direction, -there[:3, 2], atol=1e-5)


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
    """From one view of an upright object, and from another of one that lies somewhere."""
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

    agent = Agent(system, policy, stop=2, max_views=6, unknown=None)
    for first, up, yaw in ((0, (0, 0, 1), 0.0), (7, UP, YAW)):
        sphere = mevs_jax.Sphere(CENTER, RADIUS, up, yaw if posed else None)
        seen, probabilities, reason = walk(agent, views, first, sphere)
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


def test_it_stops_when_it_is_sure_or_has_spent_its_budget(classifier):
    views = views_of(classifier)
    _, probabilities, reason = walk(Agent(classifier, "farthest", stop=0.3, max_views=6, unknown=None), views, 0)
    assert reason == "sure"
    assert (probabilities[:-1].max(axis=1) < 0.3).all()
    assert probabilities[-1].max() >= 0.3
    for most in (1, 3):
        seen, _, reason = walk(Agent(classifier, "farthest", stop=2, max_views=most, unknown=None), views, 0)
        assert (len(seen), reason) == (most, "budget")


def test_the_first_view_is_that_of_the_fixed_order(classifier):
    agent = begun(classifier, gain_per_cost=1.0)
    step = agent.decide()
    assert step.index == int(np.argmax(classifier.parts.knowledge.order))
    there = in_metres(*views_of(classifier)[step.index])[2]
    np.testing.assert_allclose(step.T_world_camera, there, atol=1e-6)
    np.testing.assert_allclose(step.direction, -there[:3, 2], atol=1e-6)
    assert agent.decide(reachable=[4]).index == 4
    assert agent.decide(cost=np.where(np.arange(making.VIEWS) == step.index, 9.0, 0.0)).index != step.index


def test_the_first_view_is_the_best_of_a_fixed_order_of_negative_scores(classifier):
    """A log-likelihood, for example."""
    knowledge = classifier.parts.knowledge
    for order in (knowledge.order - 100.0, jnp.full(making.VIEWS, -1.0)):
        changed = replace(classifier.parts, knowledge=replace(knowledge, order=order))
        agent = begun(mevs_jax.TrainedSystem(classifier.description, changed))
        assert agent.decide().index == int(np.argmax(order))


def test_without_a_fixed_order_the_first_view_is_from_thirty_degrees_above(classifier):
    """Above the object, which may lie: heights are along its own upward direction."""
    agent = begun(classifier, sphere=mevs_jax.Sphere(CENTER, RADIUS, UP))
    heights = classifier.viewpoints[:, 2]
    assert agent.decide().index == int(np.argmin(np.abs(heights - 0.5)))
    candidates = agent.poses[[int(np.argmin(heights)), int(np.argmax(heights)), int(np.argmin(np.abs(heights + 0.5)))]]
    assert agent.decide(candidates=candidates).index == 1


def test_what_cannot_be_reached_or_failed_is_not_chosen(classifier):
    agent = begun(classifier, "information_gain")
    agent.observe_view(*views_of(classifier)[0])
    best = agent.decide()
    agent.mark_failed(best)
    second = agent.decide()
    assert second.index not in (0, best.index)
    agent.mark_failed(second.T_world_camera)
    assert agent.decide().index not in (0, best.index, second.index)
    above = np.flatnonzero((2 * RADIUS * classifier.viewpoints @ rotation_of(LYING).T)[:, 2] > 0.15)
    assert agent.decide(reachable=lambda pose: pose[2, 3] > CENTER[2] + 0.15).index in above
    for none in ([0, best.index], np.zeros(making.VIEWS, bool), lambda pose: False):
        step = agent.decide(reachable=none)
        assert (step.done, step.reason, step.index, step.T_world_camera) == (True, "nothing reachable", -1, None)
    mine = np.ones(making.VIEWS, bool)
    agent.decide(reachable=mine, cost=np.where(np.arange(making.VIEWS) == 3, np.inf, 0.0))
    assert mine.all()
    assert agent.decide(reachable=jnp.ones(making.VIEWS, bool)).index == agent.decide().index


def test_costs_change_the_choice_by_what_a_unit_is_worth(classifier):
    """A cost that takes half of the lead from the best view does not change the choice; one that takes twice the lead does."""
    agent = begun(classifier, "information_gain", gain_per_cost=0.25)
    agent.observe_view(*views_of(classifier)[0])
    free = agent.decide()
    gains = np.array(agent.history.events[-1]["gains"])
    gains[0] = -np.inf  # it was seen
    best, second = np.argsort(-gains)[:2]
    assert (best, np.isfinite(free.expected_gain)) == (free.index, True)
    lead = gains[best] - gains[second]
    for share, chosen in ((0.5, best), (2.0, second)):
        cost = np.where(np.arange(making.VIEWS) == best, share * lead / 0.25, 0.0)
        assert agent.decide(cost=cost).index == chosen
        by_pose = dict(zip([pose.tobytes() for pose in agent.poses], cost, strict=True))
        assert agent.decide(cost=lambda pose, by_pose=by_pose: by_pose[pose.tobytes()]).index == chosen
    cost = np.full(making.VIEWS, np.inf)
    cost[3] = 5.0
    assert agent.decide(cost=cost).index == 3


HEIGHT, WALL = -0.5, 4.0
"""Of a table below the ball, in radii of the object; and how far a wall is from the camera."""


def on_a_table(system, index):
    """A view of the ball on a table before a wall, in radii: everything is measured."""
    depth, pose = views_of(system)[index]
    rays = np.asarray(mevs_jax.pixel_directions(system.description.camera.at(pose)))
    down = np.where(rays[..., 2] < 0, (HEIGHT - pose[2, 3]) / np.minimum(rays[..., 2], -1e-9), WALL)
    return np.where(depth > 0, depth, np.minimum(down, WALL)).astype(np.float32), pose


FLOOR = float(CENTER @ UP / np.linalg.norm(UP)) + RADIUS * (HEIGHT + 0.01)
FROM_ABOVE = [1, 3, 6, 8]


def test_a_floor_is_where_the_object_stands_in_the_world(classifier):
    table, alone, without = (begun(classifier, max_views=5) for _ in range(3))
    assert (classifier.viewpoints[FROM_ABOVE, 2] > 0.2).all()
    for index in FROM_ABOVE:
        seen = in_metres(*on_a_table(classifier, index))
        beliefs = table.observe(*seen, floor=FLOOR), alone.observe(*in_metres(*views_of(classifier)[index]))
        without.observe(*seen)
        np.testing.assert_allclose(beliefs[0].probabilities, beliefs[1].probabilities, atol=0.02)
    off = [np.abs(np.array(other.history.depths) - alone.history.depths) > 0.01 for other in (table, without)]
    assert off[0].mean() < 0.01
    assert off[1].mean() > 0.05


@pytest.mark.parametrize("told", ["mask", "floor"])
def test_recorded_frames_tell_the_object_from_its_table(classifier, told):
    table = [in_metres(*on_a_table(classifier, index)) for index in FROM_ABOVE]
    alone = [in_metres(*views_of(classifier)[index]) for index in FROM_ABOVE]
    frames, bare = (Frames(*map(np.stack, zip(*shots, strict=True)), LYING) for shots in (table, alone))
    tells = {"mask": np.isfinite(bare.depth)} if told == "mask" else {"floor": FLOOR}
    agents = [Agent(classifier, "farthest", stop=2, max_views=4) for _ in range(3)]
    walks = [look_at_frames(agents[0], replace(frames, **tells)), look_at_frames(agents[1], bare)]
    assert sorted(walks[0].views) == sorted(walks[1].views) == [0, 1, 2, 3]
    images = [dict(zip(one.views, one.history.depths, strict=True)) for one in walks]
    assert all((np.abs(images[0][index] - images[1][index]) > 0.01).mean() < 0.01 for index in range(4))
    shown = look_at_frames(agents[2], frames).history.depths[0]
    assert (np.abs(shown - images[1][0]) > 0.01).mean() > 0.05


@pytest.mark.parametrize("told", ["mask", "floor"])
def test_an_unknown_sphere_is_estimated_and_refined(classifier, told):
    """Of a ball whose first view shows half, on a table before a wall: the belief at the end is that of the ball's own sphere."""
    ball = mevs_jax.Sphere(CENTER + RADIUS * rotation_of(LYING) @ (0.1, -0.2, 0.15), 0.6 * RADIUS, UP, YAW)
    shots = []
    for index in (1, 4, 8, 11):  # from all sides, and as low as the table allows
        whole = making.depth_of_ball(classifier.viewpoints[index], notch=False)
        depth, K, pose = in_metres(*on_a_table(classifier, index))
        shots.append((np.where(whole > 0, RADIUS * whole, depth).astype(np.float32), K, pose, whole > 0))
    known = begun(classifier, sphere=ball, max_views=5)
    unknown = Agent(classifier, stop=2, max_views=5)
    unknown.reset_from_points(mevs_jax.DepthImage(*shots[0]).points(), up=UP, yaw=YAW)
    first = np.linalg.norm(unknown.center - ball.center)
    buffer = np.zeros_like(shots[0][0])  # which a driver fills again and again
    for depth, K, pose, mask in shots:
        expected = known.observe(depth, K, pose, mask=mask)
        buffer[:] = depth
        belief = unknown.observe(buffer, K, pose, **({"mask": mask} if told == "mask" else {"floor": FLOOR}))
        before = unknown.center
        with pytest.raises(ValueError, match="needs a mask of its pixels or a floor"):
            unknown.observe(depth, K, pose)
        with pytest.raises(ValueError, match="is seen by observe alone"):
            unknown.observe_view(depth, pose)
        with pytest.raises(ValueError, match=r"no measured pixel|no pixel shows"):
            unknown.observe(np.zeros_like(depth), K, pose, mask=mask)
        np.testing.assert_array_equal(unknown.center, before)
    assert first > 0.05
    assert np.linalg.norm(unknown.center - ball.center) < 0.1 * first + 0.01
    np.testing.assert_allclose(unknown.radius, ball.radius, rtol=0.05)
    np.testing.assert_allclose(belief.probabilities, expected.probabilities, atol=0.1)
    assert belief.views == unknown.history.views == 4
    again = replay(unknown.history, Agent(classifier, stop=2, max_views=5))
    np.testing.assert_allclose(again[-1].probabilities, belief.probabilities, atol=1e-5)


def test_candidates_may_be_any_poses(classifier):
    views = views_of(classifier)
    agent = begun(classifier, "information_gain")
    agent.observe_view(*views[2])
    by_index = agent.decide().index
    order = np.random.default_rng(0).permutation(making.VIEWS)
    assert order[agent.decide(candidates=agent.poses[order]).index] == by_index  # the same poses, in another order
    directions = agent.history.events[-1]["directions"]
    np.testing.assert_allclose(directions, classifier.viewpoints[order], atol=1e-5)  # in the object's own frame
    free = np.random.default_rng(1).normal(size=(30, 3))
    free[:, 2] = np.abs(free[:, 2])
    free /= np.linalg.norm(free, axis=1, keepdims=True)
    around = np.stack([pose_towards(one, CENTER, 0.9, UP) for one in free])
    step = agent.decide(candidates=around)
    np.testing.assert_array_equal(step.T_world_camera, around[step.index])
    assert agent.decide(candidates=around[:1]).index == 0
    beside = rotation_of(LYING) @ (views[2][1][:3, 3] / 2 + np.array([0.01, 0, 0]))
    near = pose_towards(beside / np.linalg.norm(beside), CENTER, 0.9, UP)
    assert agent.decide(candidates=near[None]).reason == "nothing reachable"  # it was seen from there
    with pytest.raises(ValueError, match="make it with max_candidates=200"):
        agent.decide(candidates=np.repeat(around[:1], 200, axis=0))


def test_of_many_candidates_the_cheapest_from_each_direction_are_compared(classifier):
    every = fibonacci_sphere(20_000)
    poses = pose_towards(every, CENTER, 0.9, UP)
    agent = Agent(classifier, "farthest", stop=2, max_candidates=20_000, gain_per_cost=1e-6)
    agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)
    agent.observe_view(making.depth_of_ball(classifier.viewpoints[0]), pose_at(*classifier.viewpoints[0].tolist()))
    cost = np.random.default_rng(0).uniform(size=len(every))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    step = agent.decide(candidates=poses, cost=cost, reachable=every[:, 2] > 0)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # in kB
    np.testing.assert_array_equal(step.T_world_camera, poses[step.index])
    assert every[step.index, 2] > 0
    angles = np.arccos(np.clip(every @ classifier.viewpoints[0], -1, 1))
    assert angles[step.index] > angles[every[:, 2] > 0].max() - 0.15
    assert np.mean(cost[every @ every[step.index] > np.cos(0.05)] < cost[step.index]) < 0.3


@pytest.mark.parametrize("policy", ["information_gain", "farthest", "predicted_entropy"])
def test_views_may_be_between_the_viewpoints(classifier, policy):
    direction = classifier.viewpoints[0] + 0.6 * classifier.viewpoints[1]
    direction /= np.linalg.norm(direction)
    agent = begun(classifier, policy)
    agent.observe_view(making.depth_of_ball(direction), pose_at(*direction.tolist()))
    index = agent.decide().index
    if policy == "farthest":
        assert index == int(np.argmin(classifier.viewpoints @ direction))


@pytest.mark.parametrize(("apart", "views"), [(0.01, 1), (0.03, 2)])
def test_a_view_within_a_degree_is_taken_again(classifier, apart, views):
    agent = begun(classifier)
    direction = classifier.viewpoints[3].astype(float)
    aside = np.cross(direction, [0, 0, 1])
    aside /= np.linalg.norm(aside)
    for angle in (0.0, apart):
        turned = np.cos(angle) * direction + np.sin(angle) * aside
        belief = agent.observe_view(making.depth_of_ball(turned), pose_at(*turned.tolist()))
    assert belief.views == views


def test_candidates_on_one_side_are_no_neighbours_across_its_border(classifier):
    """The hull of candidates is closed below by long edges, between opposite views of a hemisphere."""
    points = mevs_jax.fibonacci_sphere(60, "equation8")
    points = points[points[:, 2] > 0.1]
    made = candidates_of(classifier, points, 40)
    distances = np.asarray(made.distances)[: len(points), : len(points)]
    neighbours = np.asarray(made.neighbours)
    assert neighbours[: len(points), : len(points)].any(axis=1).all()
    assert not neighbours[len(points) :].any()
    assert distances[neighbours[: len(points), : len(points)]].max() < 1.0
    np.testing.assert_array_equal(neighbours, neighbours.T)


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
    places = [mevs_jax.Sphere(CENTER, RADIUS, up, None) for up in ((0, 0, 1), (0, 0, 2))]
    first, again = (walk(unknown, views, 0, place)[1] for place in places)
    np.testing.assert_allclose(first, again, atol=1e-5)
    turned = [walk(known, views, 0, mevs_jax.Sphere(CENTER, RADIUS, yaw=yaw))[0] for yaw in (0.0, 1.1)]
    assert turned[0] == turned[1]
    agent = Agent(classifier, "information_gain")
    with pytest.raises(
        ValueError, match=r"cannot be used here for an object of unknown yaw: this policy needs Scene\.knowledge"
    ):
        agent.reset(center=CENTER, radius=RADIUS, yaw=None)
    agent = begun(classifier, sphere=places[0])
    agent.observe_view(*views[0])
    assert agent.decide().index == int(np.argmin(classifier.viewpoints @ classifier.viewpoints[0]))  # farthest


def test_beliefs_do_not_depend_on_an_unknown_yaw(recogniser):
    """If the yaw is known, beliefs are those of the object that is not turned. A wrong yaw changes them."""
    views = [views_of(recogniser)[index] for index in (0, 3, 5)]

    def beliefs(yaw: float, told: float | None) -> np.ndarray:
        truth, agent = mevs_jax.Sphere(CENTER, RADIUS, UP, yaw), Agent(recogniser, stop=2, max_views=4)
        agent.begin(mevs_jax.Sphere(CENTER, RADIUS, UP, told))
        return np.stack([agent.observe(*in_metres(*view, truth)).probabilities for view in views])

    upright = beliefs(0.0, None), beliefs(0.0, 0.0)
    for yaw in (0.7, -2.5):
        np.testing.assert_allclose(beliefs(yaw, None), upright[0], atol=1e-5)
        np.testing.assert_allclose(beliefs(yaw, yaw), upright[1], atol=1e-5)
        assert np.abs(beliefs(yaw, 0.0) - upright[1]).max() > 1e-3


def test_strange_objects_are_unknown_when_the_agent_would_stop(classifier):
    """Its features were random numbers, so every object is strange."""
    views = views_of(classifier)
    agent = begun(classifier, max_views=2, unknown=0.9)
    for index, reason in ((0, ""), (5, "unknown object")):
        belief = agent.observe_view(*views[index])
        assert belief.strangeness > 0.9
        assert not belief.known
        step = agent.decide()
        assert (step.done, step.reason) == (bool(reason), reason)
    agent.begin(LYING)
    agent.stop = 1e-9  # sure of every view
    agent.observe_view(*views[0])
    assert agent.decide().reason == "unknown object"
    assert Agent(classifier, stop=2, max_views=2).unknown == 0.95


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
        further = Agent(recogniser, stop=2, max_views=5)  # of the same policy, which shares the programs
        further.begin(mevs_jax.Sphere(CENTER, RADIUS, yaw=0.0))
        further.observe_view(*views[0])
        further.decide()
        assert events == []
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_a_history_is_saved_and_repeated(classifier, tmp_path):
    views = views_of(classifier)
    agent = Agent(classifier, "information_gain", stop=2, max_views=4)
    _, probabilities, _ = walk(agent, views, 3)
    agent.history.save(tmp_path / "walk.npz")
    history = load_history(tmp_path / "walk.npz")
    assert [event["call"] for event in history.events] == ["observe", "decide"] * 4
    assert history.options["reset"]["yaw"] == YAW
    again = replay(history, Agent(classifier, "information_gain", stop=2, max_views=4))
    np.testing.assert_allclose([belief.probabilities for belief in again], probabilities, atol=1e-6)
    (tmp_path / "other.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="is no history of an agent"):
        load_history(tmp_path / "other.npz")
    with np.load(tmp_path / "walk.npz") as stored:
        np.savez(tmp_path / "newer.npz", **dict(stored) | {"form": np.array(2)})
    with pytest.raises(ValueError, match=r"is no history of an agent \(it is of another version"):
        load_history(tmp_path / "newer.npz")


def test_a_policy_of_ones_own(classifier):
    def lowest(key, state, scene):
        return -scene.graph.points[:, 2]

    agent = begun(classifier, lowest)
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
