"""Where a camera sees best: gradient ascent over the sphere from many starts at once.

A start is a pose; a step goes to the camera's right and downwards (`orbit`), so there are no poles, and what the
optimiser remembers of earlier steps turns with the camera. Gradients go forwards: two parameters, no memory.
"""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.cameras import orbit

Objective = Callable[[Float[Array, "4 4"]], Float[Array, ""]]


@flax.struct.dataclass
class Ascent:
    """Where the starts ended.

    Attributes:
        poses: (starts, 4, 4) of the best point on each way.
        values: (starts,) of the objective there.
        path: (starts, steps + 1, 3) camera positions; the last again once a start has ended.
        path_values: (starts, steps + 1) of the objective on the way.
        steps: (starts,) how many each took.
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
    """Climbs from every start until it has not risen for a while.

    Args:
        objective: of a camera's pose.
        starts: poses that look at the origin.
        rate: of Adam, in tangents on the unit sphere at first; it falls to a tenth over `steps` (cosine).
        steps: at most so many for each start.
        tolerance: a relative gain that counts as one.
        patience: steps without one after which a start ends; ended ones wait for the others of their batch.
        forwards: how the gradient is calculated; in reverse for objectives that know no other, as `render_silhouette`.
        at_once: starts in one batch; all of them unless given, on a CPU one after the other.
    """
    rates = optax.cosine_decay_schedule(rate, steps, 0.1)
    optimiser = optax.adam(rates, b1=0.8, b2=0.95)
    here = jnp.zeros(2, starts.dtype)

    def value_and_slope(pose: Array) -> tuple[Array, Array]:
        if not forwards:
            return jax.value_and_grad(lambda step: objective(orbit(pose, step)))(here)
        along = lambda push: jax.jvp(lambda step: objective(orbit(pose, step)), (here,), (push,))  # noqa: E731
        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(2, dtype=here.dtype))

    def one(start: Array) -> _Walk:
        def goes_on(walk: _Walk) -> Bool[Array, ""]:
            return (walk.step < steps) & (walk.calm < patience)

        def climb(walk: _Walk) -> _Walk:
            value, slope = value_and_slope(walk.pose)
            # A slope's size says nothing across objectives; Adam takes its direction, and a slope of nothing stays one.
            update, moments = optimiser.update(-slope, walk.moments)
            gain = value - walk.best_value > tolerance * jnp.abs(value)
            better = value > walk.best_value
            pose = orbit(walk.pose, update)
            return _Walk(
                pose=pose,
                moments=moments,
                best=jnp.where(better, walk.pose, walk.best),
                best_value=jnp.where(better, value, walk.best_value),
                calm=jnp.where(gain, 0, walk.calm + 1),
                step=walk.step + 1,
                path=jnp.where(jnp.arange(steps + 1)[:, None] > walk.step, pose[:3, 3], walk.path),
                path_values=jnp.where(jnp.arange(steps + 1) >= walk.step, value, walk.path_values),
            )

        walk = _Walk(
            pose=start,
            moments=optimiser.init(here),
            best=start,
            best_value=jnp.array(-jnp.inf, start.dtype),
            calm=jnp.int32(0),
            step=jnp.int32(0),
            path=jnp.broadcast_to(start[:3, 3], (steps + 1, 3)),
            path_values=jnp.zeros(steps + 1, start.dtype),
        )
        walk = jax.lax.while_loop(goes_on, climb, walk)
        # The last point was stepped to and not looked at yet.
        last = objective(walk.pose)
        better = last > walk.best_value
        return walk.replace(  # type: ignore[attr-defined]
            best=jnp.where(better, walk.pose, walk.best),
            best_value=jnp.where(better, last, walk.best_value),
            path_values=jnp.where(jnp.arange(steps + 1) >= walk.step, last, walk.path_values),
        )

    if at_once is None:
        at_once = 1 if jax.default_backend() == "cpu" else len(starts)
    # Not in batches of one, in which a branch that is not taken is calculated all the same.
    walks = jax.lax.map(one, starts, batch_size=at_once if at_once > 1 else None)
    return Ascent(walks.best, walks.best_value, walks.path, walks.path_values, walks.step)


def distinct_optima(
    poses: Float[Array, "starts 4 4"], values: Float[Array, " starts"], angle: float = 0.2
) -> tuple[Int[Array, " starts"], Bool[Array, " starts"]]:
    """Starts from the best value to the worst, and which of them are not within `angle` radians of a better one that is kept."""
    order = jnp.argsort(-values, stable=True)
    directions = poses[order, :3, 3]
    directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    near = directions @ directions.T > jnp.cos(angle)
    before = jnp.arange(len(values))

    def keep(kept: Array, index: Array) -> tuple[Array, None]:
        return kept.at[index].set(~jnp.any(near[index] & kept & (before < index))), None

    kept, _ = jax.lax.scan(keep, jnp.zeros(len(values), bool), before)
    return order, kept
