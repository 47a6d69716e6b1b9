"""The Gymnasium environments: the checkers of Gymnasium and ap_gym, and the same episodes as the pure environment."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax import ActiveRecognition, ViewGraph, ViewTable, fibonacci_sphere

VIEWS, CLASSES, OBJECTS, MAX_VIEWS = 12, 4, 7, 4
GRAPH = ViewGraph.from_points(fibonacci_sphere(VIEWS))
WITHOUT = """
import sys
sys.modules[{package!r}] = None
try:
    import mevs_jax.environment.{module}
except ImportError as error:
    print(error)
"""


def environment_of(**options) -> ActiveRecognition:
    random = np.random.default_rng(2)
    tables = ViewTable(
        logits=jnp.asarray(random.normal(0, 1.5, (OBJECTS, VIEWS, CLASSES)), jnp.float32),
        predicted_entropy=jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS, VIEWS)), jnp.float32),
        entropy=None,
        label=jnp.asarray(random.integers(0, CLASSES, OBJECTS), jnp.int32),
    )
    return ActiveRecognition(tables, GRAPH, **{"max_views": MAX_VIEWS, "movement_cost": 0.1} | options)


@pytest.mark.parametrize(
    ("package", "module", "extra"),
    [
        ("gymnasium", "gymnasium", "gym"),
        ("ap_gym", "active_perception", "ap-gym"),
        ("gymnax.environments", "gymnax", "gymnax"),
    ],
)
def test_without_a_package_one_sentence_says_what_to_install(package, module, extra):
    if package == "ap_gym":
        pytest.importorskip("gymnasium", reason="Gymnasium is not installed (extra `gym`)")
    program = WITHOUT.format(package=package, module=module)
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=True)
    assert ended.stdout.count("\n") == 1, ended.stderr
    assert f"pip install 'mevs-jax[{extra}]'" in ended.stdout


@pytest.fixture(scope="module")
def gym():
    """The module; it and its packages are imported by the tests that need them alone."""
    pytest.importorskip("gymnasium", reason="Gymnasium is not installed (extra `gym`)")
    pytest.importorskip("ap_gym", reason="ap-gym is not installed (extra `ap-gym`)")
    import mevs_jax.gymnasium

    return mevs_jax.gymnasium


@pytest.fixture(scope="module")
def ap_gym(gym):
    import ap_gym

    return ap_gym


KINDS = ({}, {"reachable": jnp.arange(VIEWS) < 8}, {"normalised": False}, {"max_views": 2})


@pytest.mark.parametrize("options", KINDS)
def test_the_environment_passes_the_checkers(options, gym, ap_gym):
    from gymnasium.utils.env_checker import check_env

    env = ap_gym.make(gym.NAME, environment=environment_of(**options))  # with the passive checks of every call
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings(
            "ignore", message=".*A Box .* space m.*imum value is .*infinity"
        )  # logits have no bounds
        warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
        check_env(env.unwrapped)
        for seed in range(3):
            observation, _ = env.reset(seed=seed)
            ended = False
            while not ended:
                assert observation in env.observation_space
                observation, _, ended, truncated, _ = env.step(env.action_space.sample())
                assert not truncated
            assert observation in env.observation_space


def test_it_is_an_environment_of_ap_gym(gym, ap_gym):
    environment = environment_of()
    env, envs = gym.ActiveRecognitionEnv(environment), gym.ActiveRecognitionVectorEnv(environment, 3)
    assert ap_gym.ensure_active_perception_env(env) is env
    assert ap_gym.ensure_active_perception_vector_env(envs) is envs
    assert isinstance(env.prediction_space, ap_gym.LogitSpace)
    assert env.prediction_space.shape == (CLASSES,)
    assert env.inner_action_space.n == VIEWS
    assert env.prediction_target_space.n == CLASSES
    assert env.loss_fn.blind_guessing_expected_value == pytest.approx(1)
    in_nats = gym.ActiveRecognitionEnv(environment_of(normalised=False))
    assert in_nats.loss_fn.blind_guessing_expected_value == pytest.approx(np.log(CLASSES))


def compare(observation: dict, other, index=()) -> None:
    """Compares an observation of Gymnasium with one of the pure environment."""
    named = {field.name: getattr(other, field.name) for field in fields(other)}
    assert observation.keys() == {name for name, value in named.items() if value is not None}
    for name, value in observation.items():
        np.testing.assert_allclose(np.asarray(value)[index], named[name], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("options", KINDS)
def test_episodes_are_those_of_the_pure_environment(options, gym, random):
    environment = environment_of(**options)
    env = gym.ActiveRecognitionEnv(environment)
    observation, info = env.reset(seed=3)
    state, expected = environment.reset(jax.random.key(0), info["index"], int(observation["view"]))
    compare(observation, expected)
    for _ in range(environment.max_views):
        action = {"action": random.integers(VIEWS), "prediction": random.normal(size=CLASSES).astype(np.float32)}
        observation, reward, terminated, truncated, info = env.step(action)
        state, expected, expected_reward, done, expected_info = environment.step(jax.random.key(0), state, action)
        compare(observation, expected)
        assert isinstance(reward, float)
        np.testing.assert_allclose(reward, expected_reward, rtol=1e-4)
        assert (terminated, truncated) == (bool(done), False)
        assert info.keys() == {"base_reward", "prediction", "distance", "new_view", "index"}
        assert info["prediction"].keys() == expected_info["prediction"].keys()
        np.testing.assert_allclose(info["prediction"]["loss"], expected_info["prediction"]["loss"], rtol=1e-4)
        assert info["prediction"]["target"] == expected_info["prediction"]["target"]
        for name in ("base_reward", "distance", "new_view"):
            np.testing.assert_allclose(info[name], expected_info[name], rtol=1e-5)
    assert terminated


def test_options_name_the_object_and_the_start_view(gym):
    environment = environment_of()
    env, envs = gym.ActiveRecognitionEnv(environment), gym.ActiveRecognitionVectorEnv(environment, 3)
    observation, info = env.reset(options={"object_index": 4, "start": 9})
    assert (info["index"], observation["view"]) == (4, 9)
    observation, info = envs.reset(options={"object_index": [1, 2, 3], "start": 9})
    assert info["index"].tolist() == [1, 2, 3]
    assert observation["view"].tolist() == [9, 9, 9]
    with pytest.raises(ValueError, match="option 'object_index' must be between 0 and 6, got 7"):
        env.reset(options={"object_index": 7})


def test_the_vector_environment_is_single_environments_side_by_side(gym, random):
    environment, count = environment_of(), 5
    envs = gym.ActiveRecognitionVectorEnv(environment, count)
    singles = [gym.ActiveRecognitionEnv(environment) for _ in range(count)]
    observations, info = envs.reset(seed=1)
    alone = [
        env.reset(options={"object_index": info["index"][one], "start": observations["view"][one]})[0]
        for one, env in enumerate(singles)
    ]
    objects = [info["index"]]
    for step in range(3 * (MAX_VIEWS + 1) + 2):
        assert observations in envs.observation_space
        for name, value in observations.items():
            np.testing.assert_array_equal(value, [observation[name] for observation in alone])
        action = {
            "action": random.integers(VIEWS, size=count),
            "prediction": random.normal(size=(count, CLASSES)).astype(np.float32),
        }
        before = info
        observations, rewards, terminated, truncated, info = envs.step(action)
        assert not truncated.any()
        assert terminated.tolist() == [step % (MAX_VIEWS + 1) == MAX_VIEWS - 1] * count
        np.testing.assert_allclose(rewards, info["base_reward"] - info["prediction"]["loss"], rtol=1e-6)
        if step % (MAX_VIEWS + 1) == MAX_VIEWS:  # autoreset in the step after the end
            assert (info["base_reward"] == 0).all()
            np.testing.assert_array_equal(info["prediction"]["target"], before["prediction"]["target"])
            starts = observations["view"]
            chosen = [{"object_index": info["index"][one], "start": starts[one]} for one in range(count)]
            alone = [env.reset(options=options)[0] for env, options in zip(singles, chosen, strict=True)]
            objects.append(info["index"])
            continue
        found = [
            env.step({"action": action["action"][one], "prediction": action["prediction"][one]})
            for one, env in enumerate(singles)
        ]
        alone = [one[0] for one in found]
        np.testing.assert_allclose(rewards, [one[1] for one in found], rtol=1e-5)
        assert terminated.tolist() == [one[2] for one in found]
        np.testing.assert_array_equal(info["index"], objects[-1])
    assert len({tuple(one) for one in objects}) > 1


def test_a_seed_gives_the_same_episodes(gym):
    environment = environment_of()

    def walk(seed: int) -> list:
        envs = gym.ActiveRecognitionVectorEnv(environment, 4)
        envs.action_space.seed(0)
        found = [envs.reset(seed=seed)[0]]
        return found + [envs.step(envs.action_space.sample())[:2] for _ in range(2 * MAX_VIEWS + 3)]

    for one, other in zip(jax.tree.leaves(walk(5)), jax.tree.leaves(walk(5)), strict=True):
        np.testing.assert_array_equal(one, other)
    assert (walk(5)[0]["view"] != walk(6)[0]["view"]).any()


def test_wrappers_of_ap_gym_log_the_accuracy(gym, ap_gym):
    environment = environment_of()
    env = ap_gym.ActiveClassificationLogWrapper(gym.ActiveRecognitionEnv(environment))
    observation, _ = env.reset(seed=0)
    right = []
    for _ in range(MAX_VIEWS):
        prediction = observation["belief"]
        observation, _, ended, _, info = env.step({"action": 1, "prediction": prediction})
        right.append(prediction.argmax() == info["prediction"]["target"])
    assert ended
    assert info["stats"]["scalar"]["avg_accuracy"] == pytest.approx(np.mean(right))
    envs = ap_gym.ActiveClassificationVectorLogWrapper(gym.ActiveRecognitionVectorEnv(environment, 3))
    envs.reset(seed=0)
    ends = [envs.step(envs.action_space.sample()) for _ in range(2 * (MAX_VIEWS + 1))]
    assert ["stats" in end[4] for end in ends] == ([False] * (MAX_VIEWS - 1) + [True, False]) * 2


@pytest.mark.parametrize(
    ("action", "prediction", "message"),
    [
        (12, np.zeros(CLASSES), "an action is an index from 0 to 11"),
        (-1, np.zeros(CLASSES), "an action is an index from 0 to 11"),
        (1.5, np.zeros(CLASSES), "an action is an index from 0 to 11"),
        (0, np.full(CLASSES, np.nan), r"finite logits of shape \(4,\), got nan"),
        (0, np.array([0, 0, np.inf, 0]), r"finite logits of shape \(4,\), got inf"),
        (0, np.array([0, 0, -np.inf, 0]), r"finite logits of shape \(4,\), got -inf"),
        (0, np.zeros(3), r"logits of shape \(4,\)"),
    ],
)
def test_an_action_outside_its_space_is_refused(action, prediction, message, gym):
    env = gym.ActiveRecognitionEnv(environment_of())
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step({"action": action, "prediction": prediction})


def test_misuse_is_one_sentence(gym):
    import gymnasium

    environment = environment_of()
    for env, shape in (
        (gym.ActiveRecognitionEnv(environment), ()),
        (gym.ActiveRecognitionVectorEnv(environment, 2), (2,)),
    ):
        whole = {"action": np.zeros(shape, int), "prediction": np.zeros((*shape, CLASSES))}
        with pytest.raises(gymnasium.error.ResetNeeded, match="begin the first one with reset"):
            env.step(whole)
        for options, message in (
            ({"start": "a"}, "'start' must be between 0 and 11, got 'a'"),
            ({"start": 2.5}, "'start' must be between 0 and 11, got 2.5"),
            ({"object_index": -1}, "'object_index' must be between 0 and 6, got -1"),
            ({"start": [1, 2, 3]}, r"'start' must be one index or of shape"),
        ):
            with pytest.raises(ValueError, match=message):
                env.reset(options=options)
        env.reset(seed=0)
        for action in ({}, {"action": whole["action"]}, {"prediction": whole["prediction"]}):
            with pytest.raises(
                ValueError, match=r'an action is \{"action": index of the next view, "prediction": logits'
            ):
                env.step(action)
        with pytest.raises(NotImplementedError, match="this environment draws nothing"):
            env.render()
        assert np.isfinite(env.step(whole)[1]).all()
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        gym.ActiveRecognitionVectorEnv(environment, 0)
