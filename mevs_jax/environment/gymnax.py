"""`ActiveRecognition` in the form of gymnax (extra `gymnax`): `observation, state = reset(key, params)`.

    env = ViewSelection(ActiveRecognition.from_run("runs/demo"))
    observation, state = env.reset(key, env.default_params)

An action is the next view, and the belief is the prediction. gymnax's base class resets an episode in the step that ends it.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.environment.pure import ActiveRecognition, EnvironmentState

try:
    from gymnax.environments import environment, spaces
except ImportError as error:
    raise ImportError(
        f"mevs_jax.environment.gymnax needs the package gymnax ({error}): install it with pip install 'mevs-jax[gymnax]'"
    ) from error


class ViewSelection(environment.Environment):
    """Active recognition as an environment of gymnax.

    An observation is a vector: probabilities of the classes after all views seen, those after the current view alone, the
    direction of the camera, for each view whether it was seen, and the share of the episode that is over. Rewards and `info` are
    those of `ActiveRecognition.step`. The state is an `EnvironmentState`.

    Args:
        rules: the objects and the views.
    """

    def __init__(self, rules: ActiveRecognition):
        super().__init__()
        self.rules = rules

    @property
    def default_params(self) -> environment.EnvParams:
        """The length of an episode, which is that of the rules."""
        return environment.EnvParams(max_steps_in_episode=self.rules.max_views)

    @property
    def name(self) -> str:
        """As it is registered for Gymnasium."""
        return "mevs_jax/ViewSelection"

    @property
    def num_actions(self) -> int:
        """Number of views."""
        return self.rules.views

    def reset_env(self, key: Array, params: Any) -> tuple[Float[Array, " numbers"], EnvironmentState]:
        """Begins an episode with a random object and start view."""
        state, _ = self.rules.reset(key)
        return self.get_obs(state, params), state

    def step_env(self, key: Array, state: EnvironmentState, action: Any, params: Any) -> tuple[Any, ...]:
        """Scores the belief and moves to the view `action`: observation, state, reward, whether the episode is over, `info`."""
        chosen = {"action": action, "prediction": self.rules.observe(state).belief}
        state, _, reward, done, info = self.rules.step(key, state, chosen)
        info["discount"] = 1.0 - done
        return self.get_obs(state, params), state, reward, done, info

    def get_obs(
        self, state: EnvironmentState, params: Any = None, key: Array | None = None
    ) -> Float[Array, " numbers"]:
        """The observation of a state; see the class."""
        seen = self.rules.observe(state)
        parts = (
            jnp.exp(seen.belief),
            jnp.exp(seen.log_probabilities),
            seen.direction,
            seen.attempted.astype(jnp.float32),
        )
        return jnp.concatenate([*parts, seen.steps[None] / self.rules.max_views])

    def is_terminated(self, state: EnvironmentState, params: Any) -> Array:
        """Whether the next step ends the episode."""
        return state.steps >= self.rules.max_views

    def is_terminal(self, state: EnvironmentState, params: Any) -> Array:
        """`is_terminated`, as gymnax before 1.0 calls it."""
        return self.is_terminated(state, params)

    def is_truncated(self, state: EnvironmentState, params: Any) -> Array:
        """Never: an episode ends by its last prediction."""
        return jnp.zeros((), bool)

    def action_space(self, params: Any = None) -> spaces.Discrete:
        """Indices of the views."""
        return spaces.Discrete(self.rules.views)

    def observation_space(self, params: Any = None) -> spaces.Box:
        """Vectors of probabilities, a direction and masks."""
        return spaces.Box(-1.0, 1.0, (2 * self.rules.classes + 3 + self.rules.views + 1,), jnp.float32)

    def state_space(self, params: Any = None) -> spaces.Dict:
        """The numbers of an `EnvironmentState`."""
        views, most = self.rules.views, self.rules.max_views
        whole = {"object_index": self.rules.objects, "view": views, "steps": most + 1, "count": most + 1}
        return spaces.Dict(
            {name: spaces.Discrete(size) for name, size in whole.items()}
            | {
                "attempted": spaces.Box(0, 1, (views,), jnp.bool_),
                "views": spaces.Box(-1, views - 1, (most,), jnp.int32),
                "belief": spaces.Box(-jnp.inf, jnp.inf, (self.rules.classes,), jnp.float32),
            }
        )
