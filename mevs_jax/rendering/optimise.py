"""Finds the best views by gradient ascent over the sphere from many start poses.

A step is a vector to the camera's right and downwards (`orbit`). There are no poles, and the moments of the optimiser rotate with
the camera. Gradients are computed in forward mode by default, which suits two parameters and stores no intermediate results.
"""

from __future__ import annotations

from collections.abc import Callable

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
    rates = optax.cosine_decay_schedule(rate, steps, 0.1)
    optimiser = optax.adam(rates, b1=0.8, b2=0.95)
    here = jnp.zeros(2, starts.dtype)

    def value_and_slope(pose: Array) -> tuple[Array, Array]:
        if not forwards:
            return jax.value_and_grad(lambda step: objective(orbit(pose, step)))(here)
        along = lambda push: jax.jvp(lambda step: objective(orbit(pose, step)), (here,), (push,))  # noqa: E731
        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(2, dtype=here.dtype))

    def one(start: Array) -> _Walk:
        def unfinished(walk: _Walk) -> Bool[Array, ""]:
            return (walk.step < steps) & (walk.calm < patience)

        def climb(walk: _Walk) -> _Walk:
            value, slope = value_and_slope(walk.pose)
            # The scale of slopes differs between objectives. Adam normalises it, and a slope of zero stays zero.
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
        walk = jax.lax.while_loop(unfinished, climb, walk)
        # The objective at the last pose has not been evaluated yet.
        last = objective(walk.pose)
        better = last > walk.best_value
        return walk.replace(  # type: ignore[attr-defined]
            best=jnp.where(better, walk.pose, walk.best),
            best_value=jnp.where(better, last, walk.best_value),
            path_values=jnp.where(jnp.arange(steps + 1) >= walk.step, last, walk.path_values),
        )

    if at_once is None:
        at_once = 1 if jax.default_backend() == "cpu" else len(starts)
    # A batch of one is a `vmap` too, in which both branches of a `cond` are computed; None avoids that.
    walks = jax.lax.map(one, starts, batch_size=at_once if at_once > 1 else None)
    return Ascent(walks.best, walks.best_value, walks.path, walks.path_values, walks.step)


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
