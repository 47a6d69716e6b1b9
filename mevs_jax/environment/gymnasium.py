"""`ActiveRecognition` for Gymnasium (extra `gym`): views are actions, and the prediction is the belief.

    env = ViewSelectionEnv(ActiveRecognition.from_run("runs/demo"))

Importing this module registers it as `mevs_jax/ViewSelection-v0`, for `gymnasium.make(name, environment=environment)`, and the
environments of `mevs_jax.environment.active_perception` as `mevs_jax/ActiveRecognition-v0`.
"""

from __future__ import annotations

from dataclasses import fields
from functools import partial
from typing import Any

import jax
import numpy as np

from mevs_jax.arguments import check
from mevs_jax.environment.pure import ActiveRecognition, EnvironmentObservation, EnvironmentState

try:
    import gymnasium
except ImportError as error:
    raise ImportError(
        f"mevs_jax.gymnasium needs the package gymnasium ({error}): install it with pip install 'mevs-jax[gym]'"
    ) from error

NAME = "mevs_jax/ActiveRecognition-v0"
"""The name that the environments with predictions are registered under."""
VIEW_SELECTION = "mevs_jax/ViewSelection-v0"
"""The name that `ViewSelectionEnv` is registered under."""
_MOST = float(np.finfo(np.float32).max) / 2
"""Largest number of an observation: a bound, as checkers ask for."""
_SIDE = 96
"""Rows of a drawing, and columns of each of its halves."""


class ViewSelectionEnv(gymnasium.Env):
    """One episode after another, by the rules of `ActiveRecognition`; an action is the next view alone.

    The belief is the prediction of every step. Observations are dictionaries with the fields of `EnvironmentObservation` that the
    tables have; masks are 0 or 1. The last step of an episode is `terminated`, none is `truncated`. `info` holds the `index` of
    the object, its class `target`, the `loss` of the belief, whether it is `right`, the `distance` travelled in radians, and
    whether the view is a `new_view`.

    Args:
        environment: the rules, the objects and the views.
        render_mode: `ansi` for a line of text; `rgb_array` for a picture of (96, 192, 3) pixels: left the views by azimuth and
            height, seen ones black and the current one red, right a bar for the probability of each class; None for neither.
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 2}  # noqa: RUF012  # as Gymnasium declares it
    _state: EnvironmentState

    def __init__(self, environment: ActiveRecognition, render_mode: str | None = None):
        check_rules(environment)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be one of {self.metadata['render_modes']} or None, got {render_mode!r}")
        self.environment, self.render_mode = environment, render_mode
        self.action_space = gymnasium.spaces.Discrete(environment.views)
        self.observation_space = observation_space(environment)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: of the random generator that draws objects and start views.
            options: `object_index` and `start` name the object and the start view; what is not named is drawn.

        Raises:
            ValueError: for an index outside its range.
        """
        super().reset(seed=seed)
        self._seen, info = begin_episode(self, options)
        return self._seen, info

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict[str, Any]]:
        """Scores the belief, moves the camera and returns (observation, reward, terminated, truncated, info).

        Raises:
            ValueError: for a view outside its range.
            gymnasium.error.ResetNeeded: before the first `reset`.
        """
        check_begun(self)
        check_views(self, action, ())
        believed = int(self._seen["belief"].argmax())
        self._state, observation, reward, done, info = _played(self.environment, self._state, np.int32(action))
        self._seen = in_numpy(observation)
        target, loss = (np.asarray(info["prediction"][name]).item() for name in ("target", "loss"))
        moved = {name: np.asarray(info[name]).item() for name in ("distance", "new_view")}
        said = {"index": int(self._state.object_index), "target": target, "loss": loss, "right": believed == target}
        return self._seen, float(reward), bool(done), False, said | moved

    def render(self) -> str | np.ndarray | None:
        """What `render_mode` says; see the class."""
        if self.render_mode is None:
            return None
        check_begun(self)
        probabilities = np.exp(self._seen["belief"])
        view, seen = int(self._seen["view"]), int(self._seen["attempted"].sum())
        if self.render_mode == "ansi":
            likeliest = int(probabilities.argmax())
            return f"view {view}, {seen} of {self.environment.views} seen: class {likeliest} with {probabilities[likeliest]:.0%}"
        picture = np.full((_SIDE, 2 * _SIDE, 3), 255, np.uint8)
        x, y, z = np.asarray(self.environment.graph.points).T
        rows = np.round((1 - z) / 2 * (_SIDE - 5)).astype(int)
        columns = np.round((np.arctan2(y, x) / (2 * np.pi) + 0.5) * (_SIDE - 5)).astype(int)
        for at in (*np.flatnonzero(np.arange(len(rows)) != view), view):  # the current one last, above the others
            colour = (220, 30, 30) if at == view else (0, 0, 0) if self._seen["attempted"][at] else (200, 200, 200)
            picture[rows[at] : rows[at] + 4, columns[at] : columns[at] + 4] = colour
        for label, height in enumerate(np.round(probabilities * (_SIDE - 2)).astype(int)):
            left, right = (_SIDE + (label + edge) * _SIDE // len(probabilities) for edge in (0, 1))
            picture[_SIDE - 1 - height :, left + 1 : right] = (40, 90, 200)
        return picture


def observation_space(environment: ActiveRecognition) -> gymnasium.spaces.Dict:
    """The space of one observation; fields that the tables do not have are left out."""
    spaces = gymnasium.spaces
    tables = environment.tables
    parts: dict[str, gymnasium.Space] = {
        "log_probabilities": spaces.Box(-_MOST, 0, (environment.classes,)),
        "belief": spaces.Box(-_MOST, 0, (environment.classes,)),
        "view": spaces.Discrete(environment.views),
        "direction": spaces.Box(-1, 1, (3,)),
        "attempted": spaces.MultiBinary(environment.views),
        "steps": spaces.Discrete(environment.max_views + 1),
    }
    if environment.reachable is not None:
        parts["reachable"] = spaces.MultiBinary(environment.views)
    optional = {"predicted_entropy": tables.predicted_entropy, "features": tables.features, "cloud": tables.clouds}
    for name, table in optional.items():
        if table is not None:
            parts[name] = spaces.Box(-_MOST, _MOST, table.shape[2:])
    return spaces.Dict(parts)


def in_numpy(observation: EnvironmentObservation) -> dict[str, Any]:
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


def drawn(
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


def begin_episode(env: Any, options: dict[str, Any] | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Begins an episode of an environment for one; its observation and `info`."""
    index, start = drawn(env.environment, env.np_random, (), options)
    env._state, observation = _begin(env.environment, index, start)
    return in_numpy(observation), {"index": int(index)}


def check_begun(env: Any) -> None:
    """Raises `ResetNeeded` before the first `reset`."""
    if not hasattr(env, "_state"):
        raise gymnasium.error.ResetNeeded("there is no episode before reset: begin the first one with reset")


def check_views(env: Any, views: Any, shape: tuple[int, ...]) -> None:
    """Raises `ValueError` unless there is a next view for one episode, or for each of some."""
    environment: ActiveRecognition = env.environment
    view = np.asarray(views)
    integers = view.shape == shape and np.issubdtype(view.dtype, np.integer)
    if not integers or not ((view >= 0) & (view < environment.views)).all():
        raise ValueError(f"an action is an index from 0 to {environment.views - 1}, of shape {shape}, got {view}")


def check_rules(environment: Any) -> None:
    if not isinstance(environment, ActiveRecognition):
        raise ValueError(f"environment must be a mevs_jax.ActiveRecognition, got {environment!r:.80}")


def start_of(environment: ActiveRecognition, index: jax.Array, start: jax.Array) -> tuple[Any, Any]:
    return environment.reset(jax.random.key(0), index, start)  # the key is not used, as nothing is drawn


def _play(environment: ActiveRecognition, state: EnvironmentState, view: jax.Array) -> tuple[Any, ...]:
    """`environment.step` to a view, with the belief as the prediction."""
    action = {"action": view, "prediction": environment.observe(state).belief}
    return environment.step(jax.random.key(0), state, action)


_begin = jax.jit(start_of)
_played = jax.jit(_play)

for name, home, single in (
    (VIEW_SELECTION, "gymnasium", "ViewSelectionEnv"),
    (NAME, "active_perception", "ActiveRecognitionEnv"),
):
    if name not in gymnasium.registry:
        many = f"mevs_jax.environment.{home}:ActiveRecognitionVectorEnv" if name == NAME else None
        gymnasium.register(name, f"mevs_jax.environment.{home}:{single}", vector_entry_point=many)
