"""Finds the best views by gradient ascent over the sphere from many start poses.

A step is a vector to the camera's right and downwards (`orbit`). There are no poles, and the moments of the optimiser rotate with
the camera. Gradients are computed in forward mode by default, which suits two parameters and stores no intermediate results.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.geometry.cameras import orbit

Objective = Callable[[Float[Array, "4 4"]], Float[Array, ""]]
"""A function of a camera's pose, to be maximised."""


@flax.struct.dataclass
class Ascent:
    """The result of gradient ascent from several starts.

    Attributes:
        poses: (starts, 4, 4) pose at the best point of each path.
        values: (starts,) objective at that pose.
        path: (starts, steps + 1, 3) camera positions; the last position is repeated after a path has ended.
        path_values: (starts, steps + 1) objective along the path.
        steps: (starts,) number of steps of each path.
    """

    poses: Float[Array, "*batch starts 4 4"]
    values: Float[Array, "*batch starts"]
    path: Float[Array, "*batch starts points 3"]
    path_values: Float[Array, "*batch starts points"]
    steps: Int[Array, "*batch starts"]


@flax.struct.dataclass
class _Walk:
    pose: Array
    moments: optax.OptState
    best: Array
    best_value: Array
    calm: Array  # steps since the best value last rose by more than the tolerance
    step: Array
    path: Array
    path_values: Array

    @classmethod
    def begun(cls, start: Array, moments: optax.OptState, steps: int) -> _Walk:
        none, path = jnp.int32(0), jnp.broadcast_to(start[:3, 3], (steps + 1, 3))
        worst = jnp.array(-jnp.inf, start.dtype)
        return cls(start, moments, start, worst, none, none, path, jnp.zeros(steps + 1, start.dtype))

    def valued(self, value: Array) -> _Walk:
        """With the objective at its pose, which is kept if it is the best, and until the path's end."""
        better = value > self.best_value
        return replace(
            self,
            best=jnp.where(better, self.pose, self.best),
            best_value=jnp.where(better, value, self.best_value),
            path_values=jnp.where(jnp.arange(len(self.path_values)) >= self.step, value, self.path_values),
        )


def ascend(
    objective: Objective,
    starts: Float[Array, "starts 4 4"],
    *,
    rate: float = 0.1,
    steps: int = 40,
    tolerance: float = 1e-3,
    patience: int = 6,
    at_once: int | None = None,
    forwards: bool = True,
) -> Ascent:
    """Gradient ascent from every start until the objective no longer rises.

    Args:
        objective: to be maximised, of a camera's pose.
        starts: poses that look at the origin.
        rate: initial learning rate of Adam, in tangents on the unit sphere; it decays to a tenth over `steps` (cosine).
        steps: largest number of steps per start.
        tolerance: smallest relative gain that counts as progress.
        patience: steps without progress after which a path ends. Paths that have ended wait for the others of their batch.
        at_once: starts per batch; by default all of them, on CPU one.
        forwards: whether to compute gradients in forward mode; False for objectives that have reverse-mode gradients only, such
            as those on `render_silhouette`.
    """
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps, 0.1), b1=0.8, b2=0.95)
    here = jnp.zeros(2, starts.dtype)
    value_and_slope = _forward_slope if forwards else jax.value_and_grad

    def climb(walk: _Walk) -> _Walk:
        value, slope = value_and_slope(lambda step: objective(orbit(walk.pose, step)))(here)
        # The scale of slopes differs between objectives. Adam normalises it, and a slope of zero stays zero.
        update, moments = optimiser.update(-slope, walk.moments)
        gain = value - walk.best_value > tolerance * jnp.abs(value)
        pose = orbit(walk.pose, update)
        return replace(
            walk.valued(value),
            pose=pose,
            moments=moments,
            calm=jnp.where(gain, 0, walk.calm + 1),
            step=walk.step + 1,
            path=jnp.where(jnp.arange(steps + 1)[:, None] > walk.step, pose[:3, 3], walk.path),
        )

    def climb_from(start: Array) -> _Walk:
        begun = _Walk.begun(start, optimiser.init(here), steps)
        walk = jax.lax.while_loop(lambda walk: (walk.step < steps) & (walk.calm < patience), climb, begun)
        return walk.valued(objective(walk.pose))  # the objective at the last pose has not been evaluated yet

    def climb_all(starts: Array, at_once: int) -> _Walk:
        # A batch of one is a `vmap` too, in which both branches of a `cond` are computed; None avoids that.
        return jax.lax.map(climb_from, starts, batch_size=at_once if at_once > 1 else None)

    if at_once is not None:
        walks = climb_all(starts, at_once)
    else:
        every = partial(climb_all, at_once=len(starts))
        walks = jax.lax.platform_dependent(starts, cpu=partial(climb_all, at_once=1), default=every)
    return Ascent(walks.best, walks.best_value, walks.path, walks.path_values, walks.step)


def _forward_slope(function: Callable[[Array], Array]) -> Callable[[Array], tuple[Array, Array]]:
    """As `jax.value_and_grad`, in forward mode."""

    def value_and_slope(here: Array) -> tuple[Array, Array]:
        along = lambda push: jax.jvp(function, (here,), (push,))  # noqa: E731
        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(here), dtype=here.dtype))

    return value_and_slope


def distinct_optima(
    poses: Float[Array, "starts 4 4"], values: Float[Array, " starts"], angle: float = 0.2
) -> tuple[Int[Array, " starts"], Bool[Array, " starts"]]:
    """Sorts the results of an ascent and marks those that are distinct.

    Args:
        poses: at the end of each path.
        values: of the objective at these poses.
        angle: in radians; results nearer than that to a better result that is kept are not kept.

    Returns:
        The indices of the results from the best value to the worst; and, in this order, True for those that are kept.
    """
    order = jnp.argsort(-values, stable=True)
    directions = poses[order, :3, 3]
    directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    near = directions @ directions.T > jnp.cos(angle)
    before = jnp.arange(len(values))

    def keep(kept: Array, index: Array) -> tuple[Array, None]:
        return kept.at[index].set(~jnp.any(near[index] & kept & (before < index))), None

    kept, _ = jax.lax.scan(keep, jnp.zeros(len(values), bool), before)
    return order, kept
