"""The environments whose actions are views alone, for Gymnasium and gymnax: their checkers, and the episodes of the pure one."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax import ActiveRecognition
from tests.mevs_jax.environment.test_environment import CLASSES, GRAPH, MAX_VIEWS, OBJECTS, VIEWS, environment_of


@pytest.fixture(scope="module")
def gym():
    pytest.importorskip("gymnasium", reason="Gymnasium is not installed (extra `gym`)")
    import mevs_jax.gymnasium

    return mevs_jax.gymnasium


def played(rules: ActiveRecognition, state, view: int):
    """The pure environment's step to a view, with the belief as the prediction."""
    action = {"action": view, "prediction": rules.observe(state).belief}
    return rules.step(jax.random.key(0), state, action)


def test_the_environment_passes_the_checker_of_gymnasium(gym):
    import gymnasium
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make(gym.VIEW_SELECTION, environment=environment_of(), render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_episodes_are_those_of_the_pure_environment_with_the_belief_as_prediction(gym):
    rules, random = environment_of(movement_cost=0.1), np.random.default_rng(0)
    env = gym.ViewSelectionEnv(rules)
    observation, info = env.reset(seed=1, options={"start": 3})
    state, _ = rules.reset(jax.random.key(0), info["index"], 3)
    ended = False
    for _ in range(MAX_VIEWS):
        assert not ended
        view = int(random.integers(VIEWS))
        right = bool(np.argmax(rules.observe(state).belief) == rules.tables.label[info["index"]])
        observation, reward, ended, truncated, said = env.step(view)
        state, expected, score, done, _ = played(rules, state, view)
        assert (ended, truncated) == (bool(done), False)
        assert reward == pytest.approx(float(score), rel=1e-4)
        assert said["right"] is right
        assert said["index"] == info["index"]
        np.testing.assert_allclose(observation["belief"], expected.belief, atol=1e-5)
        assert observation["view"] == expected.view
    assert ended


def test_a_drawing_shows_the_current_view_and_the_belief(gym):
    rules = environment_of()
    env = gym.ViewSelectionEnv(rules, render_mode="rgb_array")
    observation, _ = env.reset(seed=0, options={"start": 3})
    picture = env.render()
    assert picture.shape == (96, 192, 3)
    red, _ = np.nonzero((picture == (220, 30, 30)).all(axis=2))
    z = float(GRAPH.points[3, 2])
    assert red.mean() == pytest.approx(1.5 + (1 - z) / 2 * 91, abs=1)
    bars = (picture[:, 96:] == (40, 90, 200)).all(axis=2).sum(axis=0).reshape(CLASSES, -1).max(axis=1)
    np.testing.assert_allclose(bars / 94, np.exp(observation["belief"]), atol=0.02)
    text = gym.ViewSelectionEnv(rules, render_mode="ansi")
    text.reset(seed=0, options={"start": 3})
    assert text.render().startswith(f"view 3, 1 of {VIEWS} seen: class {observation['belief'].argmax()} with ")
    assert gym.ViewSelectionEnv(rules).render() is None


def test_misuse_is_one_sentence(gym, tmp_path):
    import gymnasium

    env = gym.ViewSelectionEnv(environment_of(), render_mode="ansi")
    for call in (lambda: env.step(0), env.render):
        with pytest.raises(gymnasium.error.ResetNeeded, match="begin the first one with reset"):
            call()
    env.reset(seed=0)
    for view in (VIEWS, -1, 1.5, None, {"action": 1}):
        with pytest.raises(ValueError, match=f"an action is an index from 0 to {VIEWS - 1}"):
            env.step(view)
    with pytest.raises(ValueError, match="render_mode must be one of"):
        gym.ViewSelectionEnv(environment_of(), render_mode="human")


def test_a_folder_without_tables_is_refused(tmp_path):
    with pytest.raises(ValueError, match="make them with: mevs run --out"):
        ActiveRecognition.from_run(tmp_path)


def test_gymnax_has_the_same_episodes_and_resets_in_the_step_that_ends_one():
    pytest.importorskip("gymnax", reason="gymnax is not installed (extra `gymnax`)")
    from gymnax.wrappers.purerl import LogWrapper

    from mevs_jax.environment.gymnax import ViewSelection

    rules, key = environment_of(movement_cost=0.1), jax.random.key(4)
    env = ViewSelection(rules)
    params = env.default_params
    observation, state = env.reset(key, params)
    assert env.observation_space(params).contains(observation)
    for view in range(MAX_VIEWS):
        found = env.step(key, state, view, params)
        pure, expected, score, done, _ = played(rules, state, view)
        assert found[2] == pytest.approx(float(score), rel=1e-4)
        assert bool(found[3]) is bool(done) is (view == MAX_VIEWS - 1)
        if not done:
            np.testing.assert_allclose(found[0][:CLASSES], jnp.exp(expected.belief), atol=1e-5)
            assert int(found[1].view) == int(pure.view) == view
        observation, state = found[:2]
    assert int(state.steps) == 1  # of another episode
    assert env.num_actions == env.action_space(params).n == VIEWS
    assert 0 <= int(env.state_space(params).sample(key)["object_index"]) < OBJECTS

    logged = LogWrapper(env)

    def step(carry, key):
        found = logged.step(key, carry[1], env.action_space(params).sample(key), params)
        return found[:2], (found[2], found[3], found[-1]["returned_episode_returns"])

    start = jax.jit(logged.reset)(key, params)
    _, (rewards, ends, returns) = jax.lax.scan(step, start, jax.random.split(key, 2 * MAX_VIEWS))
    assert np.flatnonzero(ends).tolist() == [MAX_VIEWS - 1, 2 * MAX_VIEWS - 1]
    np.testing.assert_allclose(returns[-1], rewards[MAX_VIEWS:].sum(), rtol=1e-4)
