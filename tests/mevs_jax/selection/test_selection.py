"""The jitted loop walks exactly the views of a plain Python loop."""

from __future__ import annotations

import inspect
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.walks.ladder import BY_ASCENT
from mevs_jax import (
    POLICIES,
    Knowledge,
    Observation,
    Scene,
    SelectionState,
    ViewGraph,
    ViewTable,
    fibonacci_sphere,
    select_from_table,
    select_views,
    with_movement,
)
from mevs_jax.policies import policy_named, policy_record, register_policy
from mevs_jax.policies.informed import expected_views
from tests.reference import numpy_rules, policies

THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
TABLES = 10_000
POSES = 6


def random_tables(views: int, classes: int, count: int, seed: int) -> ViewTable:
    random = np.random.default_rng(seed)
    entropy = random.uniform(0, 1, (count, views))
    entropy[: count // 4] = np.round(entropy[: count // 4], 1)  # ties
    return ViewTable(
        logits=jnp.asarray(random.normal(0, 1.5, (count, views, classes)), jnp.float32),
        predicted_entropy=jnp.asarray(random.uniform(0, 1, (count, views, views)), jnp.float32),
        entropy=jnp.asarray(entropy, jnp.float32),
        label=jnp.asarray(random.integers(0, classes, count), jnp.int32),
        ascent_scores={policy.name: jnp.asarray(random.uniform(0, 1, (count, views, views))) for policy in BY_ASCENT},
        pose_evidence=jax.nn.log_softmax(jnp.asarray(random.normal(0, 1, (count, views, classes, POSES)), jnp.float32)),
    )


@partial(jax.jit, static_argnames=("policy", "max_views"))
def walk_jitted(keys, tables, graph, starts, thresholds, policy, max_views):
    def one(key, table, start, threshold):
        scene = Scene(graph, table.entropy)
        return select_from_table(key, table, scene, POLICIES[policy], start, threshold=threshold, max_views=max_views)

    over_thresholds = jax.vmap(one, in_axes=(None, None, None, 0))
    return jax.vmap(over_thresholds, in_axes=(0, 0, 0, None))(keys, tables, starts, thresholds)


@pytest.mark.parametrize(
    "policy", ["random", "predicted_entropy", pytest.param("oracle_entropy", marks=pytest.mark.slow)]
)
def test_the_jitted_loop_walks_the_views_of_a_plain_loop(policy):
    views, classes, max_views = 10, 5, 6
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    tables = random_tables(views, classes, TABLES, seed=3)
    starts = jnp.arange(TABLES, dtype=jnp.int32) % views
    keys = jax.random.split(jax.random.key(1), TABLES)
    walked = walk_jitted(keys, tables, graph, starts, jnp.array(THRESHOLDS), policy=policy, max_views=max_views)
    episodes = SimpleNamespace(**{name: np.asarray(leaf) for name, leaf in vars(walked).items()})
    draws = np.asarray(
        jax.vmap(
            lambda key: jax.vmap(lambda step: jax.random.uniform(jax.random.fold_in(key, step), (views,)))(
                jnp.arange(max_views)
            )
        )(keys)
    )
    neighbours = np.asarray(graph.neighbours)
    logits, predicted_entropy, entropy = map(np.asarray, (tables.logits, tables.predicted_entropy, tables.entropy))
    for index in range(TABLES):
        weights = {
            "random": draws[index],
            "predicted_entropy": predicted_entropy[index],
            "oracle_entropy": np.broadcast_to(entropy[index], (views, views)),
        }[policy]
        graph_used = None if policy == "random" else neighbours
        # The walk does not depend on the threshold, only its length does, so the plain loop runs once without one.
        plain = numpy_rules.walk(logits[index], weights, graph_used, int(starts[index]), 2.0, max_views)
        for column, threshold in enumerate(THRESHOLDS):
            length = next((i + 1 for i, c in enumerate(plain[2]) if c >= threshold), max_views)
            assert episodes.count[index, column] == length
            visited = episodes.views[index, column]
            assert visited.tolist() == plain[0][:length] + [-1] * (max_views - length)
            assert episodes.predictions[index, column, :length].tolist() == plain[1][:length]
            assert np.abs(episodes.confidences[index, column, :length] - plain[2][:length]).max() < 1e-5
        if index % 100 == 0:  # and with its threshold too, now and then
            again = numpy_rules.walk(logits[index], weights, graph_used, int(starts[index]), THRESHOLDS[2], max_views)
            count = episodes.count[index, 2]
            assert again[0] == list(episodes.views[index, 2, :count])


def knowledge_of(views: int, classes: int) -> Knowledge:
    random = np.random.default_rng(11)
    return Knowledge(
        order=jnp.asarray(random.permutation(views), jnp.float32),
        expected_logits=jnp.asarray(random.normal(0, 1.5, (classes, views, classes)), jnp.float32),
        by_pose=jnp.asarray(random.normal(0, 1.5, (classes, POSES, views, classes)), jnp.float32),
    )


def whole_scene(table: ViewTable, graph: ViewGraph) -> Scene:
    return table.scene(graph, knowledge_of(table.logits.shape[0], table.logits.shape[1]))


DRAWING = ("random", "random_with_repetition")


EXPECTED = ("expected_views", "expected_views_by_pose")
"""Rules of one policy, for a known and for an unknown pose."""


@pytest.mark.parametrize("policy", [*(name for name in POLICIES if name not in DRAWING), *EXPECTED])
def test_every_step_of_a_policy_is_the_best_by_its_plain_rule(policy):
    """At each step of the jitted walk the view chosen has the highest score that slow, obvious code gives."""
    views, classes, count, max_views = 12, 4, 150, 8
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    tables = random_tables(views, classes, count, seed=12)
    knowledge = knowledge_of(views, classes)
    run = expected_views if policy in EXPECTED else POLICIES[policy]
    known = replace(knowledge, expected_logits=None) if policy == EXPECTED[1] else knowledge

    @jax.jit
    @jax.vmap
    def walk(table, start):
        scene = table.scene(graph, known)
        return select_from_table(jax.random.key(0), table, scene, run, start, max_views=max_views).views

    walks = np.asarray(walk(tables, jnp.arange(count, dtype=jnp.int32) % views))
    plain_graph = {name: np.asarray(getattr(graph, name)) for name in ("neighbours", "distances", "points")}
    plain_knowledge = {name: np.asarray(getattr(knowledge, name)) for name in ("order", "expected_logits", "by_pose")}
    arrays = jax.tree.map(np.asarray, vars(tables))
    for index, walked in enumerate(walks):
        table = jax.tree.map(lambda leaf, at=index: leaf[at], arrays)
        assert len(set(walked)) == max_views
        for step in range(1, max_views):
            seen = walked[:step].tolist()
            scores = policies.scores(policy, seen, table, plain_graph, plain_knowledge)
            left = [view for view in range(views) if view not in seen]
            assert scores[walked[step]] >= scores[left].max() - 1e-5


def test_random_draws_are_uniform_over_what_they_may_draw():
    views, count = 10, 20_000
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(views, 4, 1, seed=2))

    def third(policy):
        def walk(key):
            return select_from_table(key, table, whole_scene(table, graph), POLICIES[policy], 3, max_views=3).views

        return np.asarray(jax.jit(jax.vmap(walk))(jax.random.split(jax.random.key(0), count)))

    fresh, repeated = third("random"), third("random_with_repetition")
    assert all(len(set(walk)) == 3 for walk in fresh[:500])
    shares = np.bincount(fresh[:, 2], minlength=views) / count
    np.testing.assert_allclose(np.delete(shares, 3), 1 / 9, atol=0.012)
    np.testing.assert_allclose(np.bincount(repeated[:, 2], minlength=views) / count, 0.1, atol=0.012)
    # Any two of three looks may coincide: 1 − (9/10)(8/10) of the walks hold a repetition.
    assert np.mean([len(set(walk)) < 3 for walk in repeated]) == pytest.approx(0.28, abs=0.02)


def test_a_view_seen_again_adds_its_logits_again():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=2))

    def stay(key, state, scene):
        return jnp.where(jnp.arange(10) == state.view, jnp.inf, 0.0)

    episode = select_from_table(jax.random.key(0), table, whole_scene(table, graph), stay, 6, max_views=4)
    assert episode.views.tolist() == [6, 6, 6, 6]
    expected = [jnp.max(jax.nn.softmax(n * table.logits[6])) for n in (1, 2, 3, 4)]
    np.testing.assert_allclose(episode.confidences, expected, atol=1e-6)


@pytest.mark.parametrize("policy", list(POLICIES))
def test_no_policy_goes_where_it_cannot(policy):
    views = 12
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(views, 4, 1, seed=4))
    reachable = jnp.asarray(np.isin(np.arange(views), [0, 2, 3, 7, 9]))
    scene = whole_scene(table, graph)
    scene = Scene(**{**vars(scene), "reachable": reachable})
    walk = jax.jit(
        lambda start: select_from_table(jax.random.key(0), table, scene, POLICIES[policy], start, max_views=8)
    )
    episode = walk(7)
    if policy == "random_with_repetition":
        assert set(episode.views[1:5].tolist()) <= {0, 2, 3, 7, 9}
        return
    assert sorted(episode.views[:5].tolist()) == [0, 2, 3, 7, 9]
    assert episode.views[5:].tolist() == [-1] * 3
    assert episode.count == 5
    assert sorted(walk(1).views[:6].tolist()) == [0, 1, 2, 3, 7, 9]  # the start may lie outside


def test_a_dear_way_is_not_taken():
    graph = ViewGraph.from_points(fibonacci_sphere(20))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(20, 4, 1, seed=5))
    plain = POLICIES["predicted_entropy_without_maxima"]
    ways = []
    for cost in (0.0, 0.2, 100.0):
        walk = select_from_table(
            jax.random.key(0), table, whole_scene(table, graph), with_movement(plain, cost), 4, max_views=6
        ).views
        ways.append(float(np.asarray(graph.distances)[walk[:-1], walk[1:]].sum()))
        if cost == 0.0:
            same = select_from_table(jax.random.key(0), table, whole_scene(table, graph), plain, 4, max_views=6)
            np.testing.assert_array_equal(walk, same.views)
        if cost == 100.0:  # nothing but the distance counts: always the nearest view left
            seen = [4]
            for view in walk[1:]:
                left = [v for v in range(20) if v not in seen]
                assert view == min(left, key=lambda v: graph.distances[seen[-1], v])
                seen.append(int(view))
    assert ways[0] > ways[1] > ways[2]


@pytest.mark.parametrize(
    ("policy", "field"),
    [
        ("fixed_order", "knowledge"),
        ("diff_mesh", "ascent_scores"),
        ("oracle_entropy", "entropy"),
        ("label_oracle", "logits"),
    ],
)
def test_a_scene_that_lacks_what_a_policy_needs_is_described(policy, field):
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=6))
    with pytest.raises(ValueError, match=rf"needs Scene\.{field}"):
        select_from_table(jax.random.key(0), table, Scene(graph), POLICIES[policy], 0, max_views=3)


def test_a_policy_may_look_back_on_all_that_was_seen():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=6))
    states: list[SelectionState] = []

    def watch(key, state, scene):
        jax.debug.callback(lambda state: states.append(state), state)
        return -jnp.arange(10.0)

    select_from_table(jax.random.key(0), table, Scene(graph), watch, 5, max_views=4)
    jax.effects_barrier()
    assert sorted(int(state.count) for state in states) == [1, 2, 3]  # after the last view there is nothing to choose
    last = max(states, key=lambda state: int(state.count))
    assert last.views.tolist() == [5, 0, 1, -1]
    np.testing.assert_array_equal(last.seen.logits[:3], table.logits[jnp.array([5, 0, 1])])
    np.testing.assert_array_equal(last.seen.predicted_entropy[:3], table.predicted_entropy[jnp.array([5, 0, 1])])
    np.testing.assert_array_equal(last.latest.logits, table.logits[1])
    np.testing.assert_allclose(last.belief, table.logits[jnp.array([5, 0, 1])].sum(axis=0), rtol=1e-5)


def test_a_full_walk_holds_the_answer_for_every_threshold_and_limit():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    tables = random_tables(10, 4, 50, seed=5)
    keys, starts = jax.random.split(jax.random.key(0), 50), jnp.full(50, 2)
    policy = POLICIES["predicted_entropy"]

    @jax.jit
    def whole(keys, tables, starts):
        def walk(key, table, start):
            return select_from_table(key, table, Scene(graph), policy, start, max_views=9)

        return jax.vmap(walk)(keys, tables, starts)

    full, thresholds = whole(keys, tables, starts), jnp.array([0.6, 0.9])
    for limit in (1, 3, 9):
        stopped = walk_jitted(keys, tables, graph, starts, thresholds, policy="predicted_entropy", max_views=limit)
        for index in range(50):
            for at, threshold in enumerate(thresholds):
                sure = np.append(np.asarray(full.confidences[index] >= threshold), True)
                used = min(int(np.argmax(sure)) + 1, limit)
                assert used == int(stopped.count[index, at])
                assert int(full.predictions[index, used - 1]) == int(stopped.predictions[index, at, used - 1])


def test_observing_may_be_anything():
    """A look that computes instead of reading a table walks the same views."""
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=6))
    scene = Scene(graph, table.entropy)

    def look(view):
        onehot = jax.nn.one_hot(view, 10)
        return Observation(onehot @ table.logits, jnp.einsum("v,vw->w", onehot, table.predicted_entropy))

    live = select_views(jax.random.key(0), look, scene, POLICIES["predicted_entropy"], 4, threshold=0.9, max_views=8)
    stored = select_from_table(
        jax.random.key(0), table, scene, POLICIES["predicted_entropy"], 4, threshold=0.9, max_views=8
    )
    np.testing.assert_array_equal(live.views, stored.views)


def test_all_views_can_be_visited_each_once():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=7))
    for name, policy in POLICIES.items():
        episode = select_from_table(jax.random.key(0), table, whole_scene(table, graph), policy, 0, max_views=10)
        if name != "random_with_repetition":
            assert sorted(np.asarray(episode.views)) == list(range(10))


def test_scores_that_are_not_numbers_come_last():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=8))

    def mostly_nan(key, state, scene):
        return jnp.full(10, jnp.nan).at[7].set(-5.0)

    episode = select_from_table(jax.random.key(0), table, Scene(graph, table.entropy), mostly_nan, 0, max_views=10)
    assert episode.views[1] == 7
    assert sorted(np.asarray(episode.views)) == list(range(10))


@pytest.mark.parametrize("max_views", [0, 11])
def test_an_impossible_number_of_views_is_refused(max_views):
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=9))
    with pytest.raises(ValueError, match="max_views"):
        select_from_table(
            jax.random.key(0), table, Scene(graph, table.entropy), POLICIES["random"], 0, max_views=max_views
        )


def test_nothing_is_compiled_twice():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    compiled = 0

    @jax.jit
    def walk(key, table, start, threshold):
        nonlocal compiled
        compiled += 1
        return select_from_table(
            key, table, Scene(graph, table.entropy), POLICIES["oracle_entropy"], start, threshold=threshold, max_views=5
        )

    for seed in range(3):
        table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=seed))
        walk(jax.random.key(seed), table, jnp.int32(seed), jnp.float32(0.5 + 0.1 * seed))
    assert compiled == 1


def test_policies_are_registered_by_call_or_decorator_and_no_name_twice():
    try:

        @register_policy("decorated", title="a title", knows="truth")
        def decorated(key, state, scene):
            return jnp.zeros(10)

        assert register_policy("called", decorated) is decorated
        assert list(POLICIES)[-2:] == ["decorated", "called"]
        entries = [policy_record(name) for name in ("decorated", "called", "predicted_entropy")]
        assert [(entry.title, entry.knows) for entry in entries] == [
            ("a title", "truth"),
            ("called", "networks"),
            ("PointNet++ entropy (thesis)", "networks"),
        ]
        with pytest.raises(ValueError, match="knows 'all', which is none of nothing, networks"):
            inspect.unwrap(register_policy)("other", decorated, knows="all")
        assert policy_named("decorated") is policy_named("called") is decorated
        for register in (
            lambda: register_policy("called", POLICIES["farthest"]),
            lambda: register_policy("random")(decorated),
        ):
            with pytest.raises(ValueError, match="is taken"):
                register()
    finally:
        POLICIES.pop("decorated", None), POLICIES.pop("called", None)
    with pytest.raises(ValueError, match=r"unknown policy 'called'; it is one of random, .*pair_oracle"):
        policy_named("called")


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16, jnp.float32, jnp.float64])
def test_logits_of_any_precision_are_walked(dtype):
    """The loop computes in float32, also where JAX has 64 bits switched on."""
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 4, seed=3))
    graph = ViewGraph.from_points(fibonacci_sphere(10))

    def walk(table):
        scene = table.scene(graph)
        return select_from_table(
            jax.random.key(0), table, scene, POLICIES["label_oracle"], 2, threshold=0.99, max_views=5
        )

    with jax.enable_x64(dtype == jnp.float64):
        rounded = replace(table, logits=table.logits.astype(dtype))
        found = walk(rounded)
        expected = walk(replace(table, logits=rounded.logits.astype(jnp.float32)))
    assert found.confidences.dtype == jnp.float32
    assert found.views.tolist() == expected.views.tolist()
    np.testing.assert_array_equal(found.confidences, expected.confidences)


def test_an_order_does_not_reach_a_view_out_of_reach():
    """A score of +inf takes a view a second time, but not one that the camera cannot go to."""
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 4, seed=3))
    reachable = jnp.arange(10) != 7

    def orders(key, state, scene):
        return jnp.where(jnp.arange(10) == 7, jnp.inf, jnp.where(jnp.arange(10) == 4, jnp.inf, 0.0))

    scene = table.scene(graph, reachable=reachable)
    assert select_from_table(jax.random.key(0), table, scene, orders, 0, max_views=4).views.tolist() == [0, 4, 4, 4]
    everywhere = table.scene(graph)
    views = select_from_table(jax.random.key(0), table, everywhere, orders, 0, max_views=4).views
    assert views.tolist() == [0, 4, 4, 4]  # the lowest index among equals
    no_order = table.scene(graph, reachable=jnp.arange(10) < 4)
    walked = select_from_table(jax.random.key(0), table, no_order, orders, 0, max_views=4).views
    assert sorted(walked.tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize("policy", ["predicted_entropy", "remembered_entropy", "oracle_entropy"])
def test_a_neighbour_out_of_reach_does_not_keep_a_view_from_being_a_maximum(policy):
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    neighbours = np.asarray(graph.neighbours)
    top = 4
    beside = int(np.flatnonzero(neighbours[top])[0])
    away = [view for view in range(10) if view not in (top, beside) and not neighbours[beside, view]]
    second = next(view for view in away if not neighbours[top, view])
    entropy = np.full(10, 0.1, np.float32) + np.arange(10, dtype=np.float32) / 1000
    entropy[[top, beside, second]] = 0.9, 0.8, 0.5  # `beside` is a maximum only where `top` is out of reach
    start = next(view for view in range(10) if view not in (top, beside, second))
    table = ViewTable(jnp.zeros((10, 3)), jnp.tile(entropy, (10, 1)), jnp.asarray(entropy), jnp.int32(0))

    def second_view(reachable):
        scene = table.scene(graph, reachable=reachable)
        return int(select_from_table(jax.random.key(0), table, scene, POLICIES[policy], start, max_views=2).views[1])

    assert second_view(None) == top
    assert second_view(jnp.arange(10) != top) == beside
