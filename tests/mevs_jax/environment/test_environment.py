"""The pure environment: rewards by hand, walks of the selection loop, ends, repeated and unreachable views."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax import (
    POLICIES,
    ActiveRecognition,
    Knowledge,
    ViewGraph,
    ViewTable,
    by_attention,
    fibonacci_sphere,
    select_from_table,
)

OBJECTS, VIEWS, CLASSES, FEATURES, MAX_VIEWS = 7, 12, 4, 5, 6
GRAPH = ViewGraph.from_points(fibonacci_sphere(VIEWS))


def tables_of(classes: int = CLASSES) -> ViewTable:
    random = np.random.default_rng(2)
    return ViewTable(
        logits=jnp.asarray(random.normal(0, 1.5, (OBJECTS, VIEWS, classes)), jnp.float32),
        predicted_entropy=jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS, VIEWS)), jnp.float32),
        entropy=jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS)), jnp.float32),
        label=jnp.asarray(random.integers(0, classes, OBJECTS), jnp.int32),
        features=jnp.asarray(random.normal(0, 1, (OBJECTS, VIEWS, FEATURES)), jnp.float32),
    )


def environment_of(**options) -> ActiveRecognition:
    return ActiveRecognition(tables_of(), GRAPH, **{"max_views": MAX_VIEWS} | options)


@jax.jit
def reset(environment, key, object_index=None, start=None):
    return environment.reset(key, object_index, start)


@jax.jit
def step_of(environment, key, state, action):
    return environment.step(key, state, action)


def log_softmax(values: np.ndarray) -> np.ndarray:
    return values - np.log(np.exp(values).sum(axis=-1, keepdims=True))


@jax.jit
def walk(environment, key, object_index, start, actions, predictions):
    """States, observations, rewards, ends and infos of one episode; state and observation are those after each step."""

    def body(state, taken):
        found = environment.step(key, state, {"action": taken[0], "prediction": taken[1]})
        return found[0], found

    first = environment.reset(key, object_index, start)
    return first, jax.lax.scan(body, first[0], (actions, predictions))[1]


def random_walk(environment: ActiveRecognition, seed: int, steps: int = MAX_VIEWS, repeats: bool = False):
    random = np.random.default_rng(seed)
    order = random.integers(0, VIEWS, steps + 1) if repeats else random.permutation(VIEWS)[: steps + 1]
    predictions = random.normal(0, 2, (steps, environment.classes)).astype(np.float32)
    index = seed % OBJECTS
    return index, order, predictions, walk(environment, jax.random.key(seed), index, order[0], order[1:], predictions)


@pytest.mark.parametrize("normalised", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_the_reward_is_the_base_reward_minus_the_cross_entropy(seed, normalised):
    cost = 0.3
    environment = environment_of(movement_cost=cost, normalised=normalised)
    index, order, predictions, (_, (_, _, rewards, done, info)) = random_walk(environment, seed, repeats=True)
    label = int(environment.tables.label[index])
    points = np.asarray(GRAPH.points, np.float64)
    for step in range(MAX_VIEWS):
        cross_entropy = -log_softmax(predictions[step].astype(np.float64))[label]
        loss = cross_entropy / np.log(CLASSES) if normalised else cross_entropy
        moves = step < MAX_VIEWS - 1
        cosine = points[order[step]] @ points[order[step + 1]]
        distance = np.arccos(np.clip(cosine, -1, 1)) if moves and order[step] != order[step + 1] else 0.0
        assert info["prediction"]["target"][step] == label
        np.testing.assert_allclose(info["prediction"]["loss"][step], loss, rtol=1e-5)
        np.testing.assert_allclose(info["distance"][step], distance, atol=1e-5)
        np.testing.assert_allclose(info["base_reward"][step], -cost * distance, atol=1e-5)
        np.testing.assert_allclose(rewards[step], -cost * distance - loss, rtol=1e-5, atol=1e-5)
        assert done[step] == (not moves)
    assert info["prediction"]["metrics"] == {}


@pytest.mark.parametrize("by", ["sum", "attention"])
@pytest.mark.parametrize("seed", range(3))
def test_a_random_walk_has_the_beliefs_of_the_selection_loop(seed, by, fusion):
    fuses = {} if by == "sum" else {"fuse": by_attention(fusion)}
    classes = CLASSES if by == "sum" else len(fusion.prior)
    environment = ActiveRecognition(tables_of(classes), GRAPH, max_views=MAX_VIEWS, **fuses)
    index, order, _, ((_, first), (states, after, *_)) = random_walk(environment, seed)
    table = jax.tree.map(lambda leaf: leaf[index], environment.tables)

    def in_order(key, state, scene):
        return (jnp.arange(VIEWS) == jnp.asarray(order)[state.count]).astype(jnp.float32)

    episode = select_from_table(
        jax.random.key(0), table, table.scene(GRAPH), in_order, int(order[0]), max_views=MAX_VIEWS, **fuses
    )
    beliefs = np.concatenate([first.belief[None], after.belief])
    np.testing.assert_array_equal(episode.views, order[:MAX_VIEWS])
    np.testing.assert_array_equal(states.views[-1], order[:MAX_VIEWS])
    np.testing.assert_array_equal(episode.predictions, beliefs[:MAX_VIEWS].argmax(axis=1))
    np.testing.assert_allclose(episode.confidences, np.exp(beliefs[:MAX_VIEWS]).max(axis=1), rtol=1e-5)
    np.testing.assert_array_equal(beliefs[MAX_VIEWS], beliefs[MAX_VIEWS - 1])  # the last step moves nowhere


@pytest.mark.parametrize("name", ["random", "information_gain", "remembered_entropy", "belief_oracle"])
def test_a_registered_policy_acts_as_in_the_selection_loop(name):
    environment, key = environment_of(), jax.random.key(4)
    knowledge = Knowledge(
        jnp.arange(VIEWS, dtype=jnp.float32),
        jnp.asarray(np.random.default_rng(3).normal(0, 1, (CLASSES, VIEWS, CLASSES)), jnp.float32),
    )
    state, _ = reset(environment, key, 3, 5)
    visited = [5]
    for _ in range(MAX_VIEWS - 1):
        selection, scene = environment.selection(state), environment.scene(state, knowledge)
        scores = POLICIES[name](jax.random.fold_in(key, selection.count), selection, scene)
        view = int(jnp.argmax(jnp.where(state.attempted, -jnp.inf, scores)))
        visited.append(view)
        state = step_of(environment, key, state, {"action": view, "prediction": state.belief})[0]
    table = jax.tree.map(lambda leaf: leaf[3], environment.tables)
    episode = select_from_table(key, table, table.scene(GRAPH, knowledge), POLICIES[name], 5, max_views=MAX_VIEWS)
    assert episode.views.tolist() == visited


def test_an_observation_is_what_the_tables_hold():
    environment = environment_of()
    index, order, _, ((_, first), (_, after, *_)) = random_walk(environment, 1)
    tables = environment.tables
    logits = np.asarray(tables.logits[index])
    observations = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, after)
    for step, view in enumerate(order[:MAX_VIEWS]):
        seen = order[: step + 1]
        now = jax.tree.map(lambda leaf: leaf[step], observations)  # noqa: B023
        np.testing.assert_allclose(now.log_probabilities, log_softmax(logits[view]), atol=1e-5)
        np.testing.assert_allclose(now.belief, log_softmax(logits[seen].sum(axis=0)), atol=1e-5)
        assert now.view == view
        assert now.steps == step + 1
        np.testing.assert_array_equal(now.direction, GRAPH.points[view])
        np.testing.assert_array_equal(np.flatnonzero(now.attempted), sorted(seen))
        np.testing.assert_array_equal(now.predicted_entropy, tables.predicted_entropy[index, view])
        np.testing.assert_array_equal(now.features, tables.features[index, view])
        assert now.cloud is None
        assert now.reachable is None


def test_a_view_seen_before_reveals_nothing_new():
    environment = environment_of()
    key = jax.random.key(0)
    nothing = jnp.zeros(CLASSES)
    state, first = reset(environment, key, 2, 4)
    state, second, _, _, info = step_of(environment, key, state, {"action": 7, "prediction": nothing})
    assert info["new_view"]
    state, third, _, done, info = step_of(environment, key, state, {"action": 4, "prediction": nothing})
    assert not info["new_view"]
    assert not done
    np.testing.assert_allclose(info["distance"], GRAPH.distances[7, 4])
    np.testing.assert_array_equal(third.belief, second.belief)
    np.testing.assert_array_equal(third.attempted, second.attempted)
    np.testing.assert_array_equal(third.log_probabilities, first.log_probabilities)
    assert (third.view, third.steps, state.count) == (4, 3, 2)
    assert state.views.tolist() == [4, 7] + [-1] * (MAX_VIEWS - 2)


def test_the_camera_stays_where_it_is_if_a_view_is_unreachable():
    reachable = jnp.arange(VIEWS) < 6
    environment = environment_of(reachable=reachable, movement_cost=1.0)
    key = jax.random.key(0)
    state, first = reset(environment, key, 2, 4)
    np.testing.assert_array_equal(first.reachable, reachable)
    state, second, _, _, info = step_of(environment, key, state, {"action": 8, "prediction": jnp.zeros(CLASSES)})
    assert (second.view, second.steps, state.count, info["distance"], info["base_reward"]) == (4, 2, 1, 0, 0)
    np.testing.assert_array_equal(second.belief, first.belief)
    state, third, *_ = step_of(environment, key, state, {"action": 5, "prediction": jnp.zeros(CLASSES)})
    assert (third.view, state.count) == (5, 2)


def test_a_finished_episode_changes_no_more():
    environment = environment_of(movement_cost=1.0)
    *_, (_, (states, observations, rewards, done, info)) = random_walk(environment, 1, steps=MAX_VIEWS + 3)
    assert done.tolist() == [False] * (MAX_VIEWS - 1) + [True] * 4
    for leaf in jax.tree.leaves((states, observations)):
        for step in range(MAX_VIEWS - 1, MAX_VIEWS + 3):
            np.testing.assert_array_equal(leaf[step], leaf[MAX_VIEWS - 2])
    assert (info["distance"][MAX_VIEWS - 1 :] == 0).all()
    np.testing.assert_allclose(rewards, info["base_reward"] - info["prediction"]["loss"], rtol=1e-6)


def test_an_episode_of_one_view_is_one_prediction():
    environment = environment_of(max_views=1)
    state, _ = reset(environment, jax.random.key(0), 1, 2)
    after, _, reward, done, _ = step_of(
        environment, jax.random.key(1), state, {"action": 3, "prediction": jnp.zeros(CLASSES)}
    )
    assert done
    assert after.view == 2
    np.testing.assert_allclose(reward, -1, rtol=1e-6)  # a uniform prediction costs 1


def test_the_loss_of_logits_that_are_large_or_infinite():
    environment = environment_of(normalised=False)
    label = jnp.int32(1)
    for prediction, loss in (
        ([0, 1e4, 0, 0], 0),
        ([1e4, 0, 0, 0], 1e4),
        ([-np.inf, 0, -np.inf, -np.inf], 0),
        ([0, -np.inf, -np.inf, 0], np.inf),
    ):
        np.testing.assert_allclose(environment.loss(jnp.array(prediction, jnp.float32), label), loss)


def test_autoreset_begins_another_episode_in_the_step_that_ends_one():
    environment = environment_of(max_views=2)
    state, observation = reset(environment, jax.random.key(0), 1, 2)
    autoreset = jax.jit(environment.step_autoreset)
    for step in range(5):
        key = jax.random.key(step)
        action = {"action": (step * 5) % VIEWS, "prediction": observation.belief}
        plain = step_of(environment, key, state, action)
        found = autoreset(key, state, action)
        expected = reset(environment, key) if plain[3] else plain[:2]
        for one, other in zip(jax.tree.leaves((expected, plain[2:])), jax.tree.leaves(found), strict=True):
            np.testing.assert_array_equal(one, other)
        assert bool(plain[3]) == (step % 2 == 1)
        state, observation = found[:2]


def test_the_same_key_gives_the_same_episodes_and_a_batch_is_its_episodes():
    environment = environment_of()
    keys = jax.random.split(jax.random.key(5), 9)
    actions = {
        "action": jnp.arange(9) % VIEWS,
        "prediction": jax.random.normal(jax.random.key(1), (9, CLASSES)),
    }
    states, observations = jax.jit(jax.vmap(environment.reset))(keys)
    again = jax.jit(jax.vmap(environment.reset))(keys)
    for one, other in zip(jax.tree.leaves((states, observations)), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    together = jax.jit(jax.vmap(environment.step))(keys, states, actions)
    for index, key in enumerate(keys):
        state, _ = reset(environment, key)
        alone = step_of(environment, key, state, jax.tree.map(lambda leaf: leaf[index], actions))  # noqa: B023
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(one, other[index], rtol=1e-5, atol=1e-6)


def test_objects_and_start_views_are_drawn_uniformly():
    environment = environment_of()
    states, _ = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(0), 20_000))
    counts = np.zeros((OBJECTS, VIEWS))
    np.add.at(counts, (np.asarray(states.object_index), np.asarray(states.view)), 1)
    expected = 20_000 / counts.size
    degrees = counts.size - 1
    chi_square = ((counts - expected) ** 2 / expected).sum()
    assert abs(chi_square - degrees) < 5 * np.sqrt(2 * degrees)


def test_an_environment_is_an_argument_of_a_compiled_program():
    environment = environment_of()
    traced = []

    @jax.jit
    def reward(environment, key):
        traced.append(1)
        state, observation = environment.reset(key, 0, 0)
        return environment.step(key, state, {"action": 3, "prediction": observation.belief})[2]

    costs = [float(reward(environment_of(movement_cost=cost), jax.random.key(0))) for cost in (0.0, 1.0)]
    np.testing.assert_allclose(costs[0] - costs[1], GRAPH.distances[0, 3], rtol=1e-5)
    assert len(traced) == 1
    assert (environment.objects, environment.views, environment.classes) == (OBJECTS, VIEWS, CLASSES)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_views": 0}, "max_views must be between 1 and the 12"),
        ({"max_views": 13}, "max_views must be between 1 and the 12"),
        ({"movement_cost": float("nan")}, "movement_cost must be at least 0, got nan"),
        ({"movement_cost": -1.0}, "movement_cost must be at least 0, got -1"),
        ({"reachable": jnp.ones(5, bool)}, "`reachable` must have shape"),
        ({"graph": ViewGraph.from_points(fibonacci_sphere(10))}, "the tables have 12 views, the graph has 10"),
        ({"tables": tables_of(1)}, "needs an object and two classes"),
        ({"tables": jax.tree.map(lambda leaf: leaf[0], tables_of())}, "needs view tables with logits"),
        (
            {"tables": replace(tables_of(), logits=jnp.zeros((OBJECTS, 2, VIEWS, CLASSES)))},
            "needs view tables with logits",
        ),
    ],
)
def test_what_does_not_fit_together_is_refused(change, message):
    arguments = {"tables": tables_of(), "graph": GRAPH, "max_views": MAX_VIEWS} | change
    with pytest.raises(ValueError, match=message):
        ActiveRecognition(arguments.pop("tables"), arguments.pop("graph"), **arguments)


def test_what_an_episode_cannot_begin_or_go_on_with_is_refused():
    environment, key = ActiveRecognition(tables_of(), GRAPH, max_views=MAX_VIEWS), jax.random.key(0)
    for given, message in (
        ({"start": -1}, f"start must be from 0 to {VIEWS - 1}, got -1"),
        ({"start": VIEWS}, f"start must be from 0 to {VIEWS - 1}, got {VIEWS}"),
        ({"object_index": OBJECTS}, f"object_index must be from 0 to {OBJECTS - 1}, got {OBJECTS}"),
        ({"object_index": jnp.int32(-1)}, "object_index must be from 0"),
    ):
        with pytest.raises(ValueError, match=message):
            environment.reset(key, **given)
    state, observation = environment.reset(key, start=0)
    logits = observation.belief
    for action, message in (
        ({"action": 1}, r'an action is \{"action": index of the next view, "prediction": logits'),
        ({"action": 1, "prediction": logits[:-1]}, "a prediction is finite logits of shape"),
        ({"action": 1, "prediction": logits.at[0].set(jnp.inf)}, "finite logits of shape .* got inf"),
        ({"action": 1.5, "prediction": logits}, "an action is the index of a view, got 1.5"),
    ):
        with pytest.raises(ValueError, match=message):
            environment.step(key, state, action)
