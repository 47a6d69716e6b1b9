"""`ActiveRecognition` as the active classification environments of `ap_gym` (extra `ap-gym`): an action has a prediction.

    environment = ActiveRecognition(tables, graph, max_views=5)
    env = ActiveRecognitionEnv(environment)
    envs = ActiveRecognitionVectorEnv(environment, num_envs=256)

`ap_gym.make("mevs_jax/ActiveRecognition-v0", environment=environment)` and `ap_gym.make_vec` work once this module or
`mevs_jax.gymnasium` was imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from mevs_jax.arguments import whole
from mevs_jax.environment.gymnasium import (
    begin_episode,
    check_begun,
    check_rules,
    check_views,
    drawn,
    gymnasium,
    in_numpy,
    observation_space,
    start_of,
)
from mevs_jax.environment.pure import ActiveRecognition, EnvironmentObservation, EnvironmentState, check_action

try:
    import ap_gym
except ImportError as error:
    raise ImportError(
        f"environments with predictions need the package ap-gym ({error}): install it with pip install 'mevs-jax[ap-gym]'"
    ) from error

_NOT_DRAWN = "this environment draws nothing; ViewSelectionEnv does"


class ActiveRecognitionEnv(ap_gym.ActiveClassificationEnv):
    """One episode after another, by the rules of `ActiveRecognition`.

    Observations are dictionaries with the fields of `EnvironmentObservation` that the tables have; masks are 0 or 1. The last
    step of an episode is `terminated`, none is `truncated`. `info` holds, besides what `ap_gym` puts into it, the `index` of the
    object, the `distance` travelled in radians, and whether the view is a `new_view`.

    Args:
        environment: the rules, the objects and the views.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as Gymnasium declares it
    _state: EnvironmentState

    def __init__(self, environment: ActiveRecognition):
        check_rules(environment)
        super().__init__(environment.classes, gymnasium.spaces.Discrete(environment.views))
        self.environment = environment
        self.observation_space = observation_space(environment)
        if not environment.normalised:
            self.loss_fn = ap_gym.CrossEntropyLossFn(environment.classes)
        self._info: dict[str, Any] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: of the random generator that draws objects and start views.
            options: `object_index` and `start` name the object and the start view; what is not named is drawn.

        Raises:
            ValueError: for an index outside its range.
        """
        super().reset(seed=seed)
        return begin_episode(self, options)

    def _step(self, action: Any, prediction: Any) -> tuple[dict, float, bool, bool, dict[str, Any], np.int64]:
        self._state, observation, done, info, target = _move(self.environment, self._state, np.int32(action))
        base_reward = float(info.pop("base_reward"))
        self._info = {name: np.asarray(value).item() for name, value in info.items()}
        return in_numpy(observation), base_reward, bool(done), False, {}, np.int64(target)

    def step(self, action: Mapping[str, Any]) -> tuple[dict, float, bool, bool, dict[str, Any]]:
        """Scores the prediction, moves the camera and returns (observation, reward, terminated, truncated, info).

        Raises:
            ValueError: for an action without a view or prediction, a view outside its range, or a prediction that is not
                finite or of another shape than (classes,).
            gymnasium.error.ResetNeeded: before the first `reset`.
        """
        _check(self, action, ())
        observation, reward, terminated, truncated, info = super().step(action)
        # The method above returns `info` without what `_step` put into it.
        return observation, float(reward), terminated, truncated, self._info | info

    def render(self) -> None:
        """Raises `NotImplementedError`, as there is nothing to see."""
        raise NotImplementedError(_NOT_DRAWN)


class ActiveRecognitionVectorEnv(ap_gym.ActiveClassificationVectorEnv):
    """Many episodes at once, as one compiled program, by the rules of `ActiveRecognition`.

    Observations and `info` are those of `ActiveRecognitionEnv` with a leading axis of episodes. After an episode has ended, the
    next step begins another (Gymnasium's autoreset mode `NEXT_STEP`): its action is ignored, its base reward is 0, and its
    prediction is scored with the class of the object whose episode has ended. A learner leaves this step out.

    Args:
        environment: the rules, the objects and the views.
        num_envs: number of episodes at once.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(self, environment: ActiveRecognition, num_envs: int):
        check_rules(environment)
        num_envs = whole(num_envs, "num_envs must be at least 1", 1, 2**31 - 1)
        super().__init__(num_envs, environment.classes, gymnasium.spaces.Discrete(environment.views))
        self.environment = environment
        self.single_observation_space = observation_space(environment)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        if not environment.normalised:
            self.loss_fn = ap_gym.CrossEntropyLossFn(environment.classes)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict[str, Any]]:
        """Begins all episodes; arguments as of `ActiveRecognitionEnv.reset`, with one index for all episodes or one for each."""
        super().reset(seed=seed)
        index, start = drawn(self.environment, self.np_random, (self.num_envs,), options)
        self._state, observation = _begin_all(self.environment, index, start)
        self._ended = np.zeros(self.num_envs, bool)
        return in_numpy(observation), {"index": index.copy()}

    def _step(self, action: Any, prediction: Any) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict, np.ndarray]:
        count = self.num_envs
        begin = np.zeros(count, np.int64), np.zeros(count, np.int64)
        if self._ended.any():
            begin = drawn(self.environment, self.np_random, (count,), None)
        self._state, observation, done, info, target = _move_all(
            self.environment, self._state, np.asarray(action, np.int32), self._ended, begin
        )
        self._ended = np.array(done)
        info = {name: np.array(value) for name, value in info.items()}
        base_reward = info.pop("base_reward")
        target = np.asarray(target, np.int64)
        return in_numpy(observation), base_reward, self._ended.copy(), np.zeros(count, bool), info, target

    def step(self, action: Mapping[str, Any]) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """`ActiveRecognitionEnv.step` for all episodes."""
        _check(self, action, (self.num_envs,))
        return super().step(action)

    def render(self) -> None:
        """Raises `NotImplementedError`, as there is nothing to see."""
        raise NotImplementedError(_NOT_DRAWN)


def _check(env: Any, action: Any, shape: tuple[int, ...]) -> None:
    """Raises the errors of `ActiveRecognitionEnv.step`, for an action of one episode or of some."""
    check_begun(env)
    check_action(action, shape, env.environment.classes)
    check_views(env, action["action"], shape)


_Moved = tuple[EnvironmentState, EnvironmentObservation, jax.Array, dict[str, jax.Array], jax.Array]


def _moved(environment: ActiveRecognition, state: EnvironmentState, action: jax.Array) -> _Moved:
    """`environment.step` without the reward, which `ap_gym` computes: state, observation, whether it ended, info and class."""
    nothing = {"action": action, "prediction": jax.numpy.zeros(environment.classes)}
    state, observation, _, done, info = environment.step(jax.random.key(0), state, nothing)
    target = info.pop("prediction")["target"]
    return state, observation, done, info | {"index": state.object_index}, target


@jax.jit
def _move_all(environment: ActiveRecognition, states: Any, actions: Any, ended: Any, begin: Any) -> _Moved:
    """Moves all episodes that have not ended, and begins the others with the objects and at the views `begin`."""

    def one(state: EnvironmentState, action: jax.Array, ended: jax.Array, begin: tuple[jax.Array, jax.Array]) -> _Moved:
        *after, done, info, target = _moved(environment, state, action)
        info["base_reward"] = jax.numpy.where(ended, 0, info["base_reward"])
        begun = start_of(environment, *begin)
        moved, seen = jax.tree.map(lambda new, old: jax.numpy.where(ended, new, old), begun, tuple(after))
        return moved, seen, done & ~ended, info | {"index": moved.object_index}, target

    return jax.vmap(one)(states, actions, ended, begin)


_begin_all = jax.jit(jax.vmap(start_of, (None, 0, 0)))
_move = jax.jit(_moved)
