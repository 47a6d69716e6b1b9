"""What one view says about the pose of an object, and what several say together.

The yaw of upright objects is here. An object that stands upright may be turned about the vertical axis by an unknown yaw. What is
known about views of a class from each direction can be used only with a belief about that yaw. Objects in any rotation are the
subject of `mevs_jax.models.rotation`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arguments import check
from mevs_jax.arrays import AnyArray
from mevs_jax.models.set_fusion import dropped


class PoseHead(nnx.Module):
    """A distribution over the pose of the object relative to the camera, for each class that the object may be of.

    Args:
        features: length of a view's feature vector.
        classes: number of classes.
        poses: number of poses that are distinguished: azimuths of the camera in the object's frame (`yaws`), or rotations.
        width: of the hidden layer.
        dropout: rate of the features in training, in [0, 1).
        rngs: source of the initial weights.
    """

    def __init__(
        self,
        features: int,
        classes: int,
        *,
        poses: int = 24,
        width: int = 256,
        dropout: float = 0.2,
        rngs: nnx.Rngs,
    ):
        check(dropout, "dropout must be a probability below 1", lambda rate: (rate >= 0) & (rate < 1))
        self.shape, self.dropout, self.width = (classes, poses), dropout, width
        self.norm = nnx.LayerNorm(features, rngs=rngs)
        self.layer1 = nnx.Linear(features + 1, width, rngs=rngs)
        self.layer2 = nnx.Linear(width, classes * poses, rngs=rngs)

    def __call__(
        self,
        features: Float[AnyArray, "*batch features"],
        height: Float[AnyArray, "*batch"],
        key: Array | None = None,
    ) -> Float[Array, "*batch classes poses"]:
        """Log-probabilities of the poses, for each class.

        Args:
            features: of each view.
            height: of the camera: the vertical component, in [−1, 1], of the unit vector from the object to it.
            key: PRNG key for dropout in training; no dropout without.
        """
        normed = dropped(key, self.dropout, self.norm(jnp.asarray(features)))
        hidden = jax.nn.gelu(self.layer1(jnp.concatenate([normed, jnp.asarray(height)[..., None]], axis=-1)))
        logits = self.layer2(hidden)
        return jax.nn.log_softmax(logits.reshape(*logits.shape[:-1], *self.shape), axis=-1)


def yaws(count: int) -> Float[np.ndarray, " {count}"]:
    """The yaws, or azimuths, that are distinguished, in radians: evenly spaced from 0."""
    return np.arange(count) * 2 * np.pi / count


def azimuth_of(directions: Float[AnyArray, "*batch 3"]) -> Float[Array, "*batch"]:
    """The azimuth of directions in radians, in (−π, π].

    Straight above and below it is the one whose camera has the same roll (`mevs_jax.look_at_origin`): −π/2 and π/2.
    """
    x, y, z = jnp.moveaxis(jnp.asarray(directions), -1, 0)
    return jnp.where(jnp.abs(z) > 1 - 1e-6, -jnp.sign(z) * jnp.pi / 2, jnp.arctan2(y, x))


def _between(angle: Float[Array, "*batch"], count: int) -> tuple[Array, Array, Array]:
    """The indices of the two of `count` evenly spaced angles that an angle is between, and the weight of the second."""
    place = angle / (2 * jnp.pi) * count
    lower = jnp.floor(place)
    index = lower.astype(jnp.int32)
    return index % count, (index + 1) % count, place - lower


def azimuth_weights(azimuth: Float[AnyArray, "*batch"], count: int) -> Float[Array, "*batch {count}"]:
    """Weights of `count` evenly spaced azimuths, linear between the two that an azimuth is between; their sum is 1."""
    lower, upper, share = _between(jnp.asarray(azimuth), count)
    first, second = (jax.nn.one_hot(index, count) for index in (lower, upper))
    return first * (1 - share)[..., None] + second * share[..., None]


def yaw_evidence(
    azimuths: Float[AnyArray, "*views classes azimuths"], directions: Float[AnyArray, "*views 3"], offset: float = 0.0
) -> Float[Array, "*views classes azimuths"]:
    """What each view says about the yaw of the object: its log-probability for every class and yaw, up to a constant.

    A camera at azimuth a of the world is at azimuth a − yaw in the frame of the object.

    Args:
        azimuths: log-probabilities of the azimuth of each view in the object's frame, as of `PoseHead`.
        directions: unit vectors from the object to the cameras, in the world.
        offset: radians added to the yaws (`yaws`).
    """
    azimuths, count = jnp.asarray(azimuths), azimuths.shape[-1]
    yaw = jnp.asarray(yaws(count) + offset, jnp.float32)
    lower, upper, share = _between(azimuth_of(directions)[..., None] - yaw, count)

    def at(index: Array) -> Array:
        return jnp.take_along_axis(azimuths, jnp.broadcast_to(index[..., None, :], azimuths.shape), axis=-1)

    return at(lower) * (1 - share)[..., None, :] + at(upper) * share[..., None, :]


_DEPENDENCE = 0.75
"""Exponent of the evidence of each view about the pose; below 1 since views are not independent."""


def pose_log_probabilities(
    evidence: Float[AnyArray, "views classes poses"], present: Bool[AnyArray, " views"]
) -> Float[Array, "classes poses"]:
    """Log-probabilities of the poses of an object, for each class that it may be of, after some views.

    Args:
        evidence: of each view, as of `yaw_evidence`.
        present: True for the views to use.
    """
    together = jnp.sum(jnp.where(jnp.asarray(present)[:, None, None], jnp.asarray(evidence), 0.0), axis=0)
    return jax.nn.log_softmax(_DEPENDENCE * together, axis=-1)
