"""`ActiveRecognition` for Gymnasium, as the active classification environments of `ap_gym` (extra `gym`).

    environment = ActiveRecognition(tables, graph, max_views=5)
    env = ActiveRecognitionEnv(environment)
    envs = ActiveRecognitionVectorEnv(environment, num_envs=256)

Importing this module also registers both under the name `mevs_jax/ActiveRecognition-v0`, so that
`ap_gym.make("mevs_jax/ActiveRecognition-v0", environment=environment)` and `ap_gym.make_vec` work.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from typing import Any

import jax
import numpy as np

from mevs_jax.arguments import check, whole
from mevs_jax.environment.pure import ActiveRecognition, EnvironmentObservation, EnvironmentState, check_action

try:
    import ap_gym
    import gymnasium
except ImportError as error:
    raise ImportError(
        f"mevs_jax.gymnasium needs the packages gymnasium and ap-gym ({error}): install them with pip install 'mevs-jax[gym]'"
    ) from error

NAME = "mevs_jax/ActiveRecognition-v0"
"""The name that both environments are registered under."""
_NOT_DRAWN = "this environment draws nothing; mevs_jax.agent.viewing.view shows the walk of an agent"


class ActiveRecognitionEnv(ap_gym.ActiveClassificationEnv):
    """One episode after another, by the rules of `ActiveRecognition`.

    Observations are dictionaries with the fields of `EnvironmentObservation` that the tables have; masks are 0 or 1. The last
    step of an episode is `terminated`, none is `truncated`. `info` holds, besides what `ap_gym` puts into it, the `index` of the
    object, the `distance` travelled in radians, and whether the view is a `new_view`.

    Args:
        environment: the rules, the objects and the views.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as Gymnasium declares it

    def __init__(self, environment: ActiveRecognition):
        _check_rules(environment)
        super().__init__(environment.classes, gymnasium.spaces.Discrete(environment.views))
        self.environment = environment
        self.observation_space = _observation_space(environment)
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
        index, start = _drawn(self.environment, self.np_random, (), options)
        self._state, observation = _begin(self.environment, index, start)
        return _in_numpy(observation), {"index": int(index)}

    def _step(self, action: Any, prediction: Any) -> tuple[dict, float, bool, bool, dict[str, Any], np.int64]:
        self._state, observation, done, info, target = _move(self.environment, self._state, np.int32(action))
        base_reward = float(info.pop("base_reward"))
        self._info = {name: np.asarray(value).item() for name, value in info.items()}
        return _in_numpy(observation), base_reward, bool(done), False, {}, np.int64(target)

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
        _check_rules(environment)
        num_envs = whole(num_envs, "num_envs must be at least 1", 1, 2**31 - 1)
        super().__init__(num_envs, environment.classes, gymnasium.spaces.Discrete(environment.views))
        self.environment = environment
        self.single_observation_space = _observation_space(environment)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        if not environment.normalised:
            self.loss_fn = ap_gym.CrossEntropyLossFn(environment.classes)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict[str, Any]]:
        """Begins all episodes; arguments as of `ActiveRecognitionEnv.reset`, with one index for all episodes or one for each."""
        super().reset(seed=seed)
        index, start = _drawn(self.environment, self.np_random, (self.num_envs,), options)
        self._state, observation = _begin_all(self.environment, index, start)
        self._ended = np.zeros(self.num_envs, bool)
        return _in_numpy(observation), {"index": index.copy()}

    def _step(self, action: Any, prediction: Any) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict, np.ndarray]:
        count = self.num_envs
        begin = np.zeros(count, np.int64), np.zeros(count, np.int64)
        if self._ended.any():
            begin = _drawn(self.environment, self.np_random, (count,), None)
        self._state, observation, done, info, target = _move_all(
            self.environment, self._state, np.asarray(action, np.int32), self._ended, begin
        )
        self._ended = np.array(done)
        info = {name: np.array(value) for name, value in info.items()}
        base_reward = info.pop("base_reward")
        target = np.asarray(target, np.int64)
        return _in_numpy(observation), base_reward, self._ended.copy(), np.zeros(count, bool), info, target

    def step(self, action: Mapping[str, Any]) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """`ActiveRecognitionEnv.step` for all episodes."""
        _check(self, action, (self.num_envs,))
        return super().step(action)

    def render(self) -> None:
        """Raises `NotImplementedError`, as there is nothing to see."""
        raise NotImplementedError(_NOT_DRAWN)


def _observation_space(environment: ActiveRecognition) -> gymnasium.spaces.Dict:
    """The space of one observation; fields that the tables do not have are left out."""
    spaces = gymnasium.spaces
    tables = environment.tables
    parts: dict[str, gymnasium.Space] = {
        "log_probabilities": spaces.Box(-np.inf, 0, (environment.classes,)),
        "belief": spaces.Box(-np.inf, 0, (environment.classes,)),
        "view": spaces.Discrete(environment.views),
        "direction": spaces.Box(-1, 1, (3,)),
        "attempted": spaces.MultiBinary(environment.views),
        "steps": spaces.Discrete(environment.max_views, start=1),
    }
    if environment.reachable is not None:
        parts["reachable"] = spaces.MultiBinary(environment.views)
    optional = {"predicted_entropy": tables.predicted_entropy, "features": tables.features, "cloud": tables.clouds}
    for name, table in optional.items():
        if table is not None:
            parts[name] = spaces.Box(-np.inf, np.inf, table.shape[2:])
    return spaces.Dict(parts)


def _in_numpy(observation: EnvironmentObservation) -> dict[str, Any]:
    """The fields of an observation as new arrays of the types of their spaces."""
    found: dict[str, Any] = {}
    for field in fields(observation):
        if (value := getattr(observation, field.name)) is None:
            continue
        kind = {"b": np.int8, "i": np.int64}.get(np.dtype(value.dtype).kind, np.float32)
        found[field.name] = np.array(value, kind)[()]  # a number, if it has no axes
    np.clip(found["direction"], -1, 1, out=found["direction"])  # a unit vector may be longer by a rounding error
    return found


def _are_indices(size: int, values: np.ndarray) -> Any:
    return (values >= 0) & (values < size) & (values == np.floor(values))


def _drawn(
    environment: ActiveRecognition, random: np.random.Generator, shape: tuple[int, ...], options: dict[str, Any] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of objects and start views: those that `options` names, else random ones."""
    found = []
    for name, size in (("object_index", environment.objects), ("start", environment.views)):
        value = np.asarray(random.integers(size, size=shape))
        if options and (given := options.get(name)) is not None:
            check(
                given,
                f"the option {name!r} must be between 0 and {size - 1}",
                partial(_are_indices, size),
            )
            if np.shape(given) not in ((), shape):
                raise ValueError(
                    f"the option {name!r} must be one index or of shape {shape}, got shape {np.shape(given)}"
                )
            value = np.broadcast_to(np.asarray(given, np.int64), shape).copy()
        found.append(value)
    return found[0], found[1]


def _check(env: Any, action: Any, shape: tuple[int, ...]) -> None:
    """Raises the errors of `ActiveRecognitionEnv.step`."""
    environment: ActiveRecognition = env.environment
    if not hasattr(env, "_state"):
        raise gymnasium.error.ResetNeeded("step was called before reset: begin the first episode with reset")
    check_action(action, shape, environment.classes)
    view = np.asarray(action["action"])
    integers = view.shape == shape and np.issubdtype(view.dtype, np.integer)
    if not integers or not ((view >= 0) & (view < environment.views)).all():
        raise ValueError(f"an action is an index from 0 to {environment.views - 1}, of shape {shape}, got {view}")


def _check_rules(environment: Any) -> None:
    if not isinstance(environment, ActiveRecognition):
        raise ValueError(f"environment must be a mevs_jax.ActiveRecognition, got {environment!r:.80}")


_Moved = tuple[EnvironmentState, EnvironmentObservation, jax.Array, dict[str, jax.Array], jax.Array]


def _start_of(environment: ActiveRecognition, index: jax.Array, start: jax.Array) -> tuple[Any, Any]:
    return environment.reset(jax.random.key(0), index, start)  # the key is not used, as nothing is drawn


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
        begun = _start_of(environment, *begin)
        moved, seen = jax.tree.map(lambda new, old: jax.numpy.where(ended, new, old), begun, tuple(after))
        return moved, seen, done & ~ended, info | {"index": moved.object_index}, target

    return jax.vmap(one)(states, actions, ended, begin)


_begin = jax.jit(_start_of)
_begin_all = jax.jit(jax.vmap(_start_of, (None, 0, 0)))
_move = jax.jit(_moved)

if NAME not in gymnasium.registry:
    gymnasium.register(
        NAME,
        entry_point="mevs_jax.environment.gymnasium:ActiveRecognitionEnv",
        vector_entry_point="mevs_jax.environment.gymnasium:ActiveRecognitionVectorEnv",
    )
