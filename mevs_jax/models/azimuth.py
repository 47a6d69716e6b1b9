"""From one view to the azimuth of the camera in the object's own frame; from several views to the object's yaw.

An object that stands upright may be turned about the vertical axis by an unknown yaw. What is known about views of a class from
each direction can be used only with a belief about that yaw.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray


def yaws(count: int) -> Float[np.ndarray, " {count}"]:
    """The yaws that are told apart, in radians: evenly spaced from 0."""
    return np.arange(count) * 2 * np.pi / count


def azimuth_of(directions: Float[AnyArray, "*batch 3"]) -> Float[Array, "*batch"]:
    """The azimuth of directions in radians, in (−π, π]."""
    directions = jnp.asarray(directions)
    return jnp.arctan2(directions[..., 1], directions[..., 0])


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


class AzimuthHead(nnx.Module):
    """A distribution over the camera's azimuth in the object's frame, for each class that the object may be of.

    Args:
        features: length of a view's feature vector.
        classes: number of classes.
        azimuths: number of azimuths, evenly spaced from 0.
        width: of the hidden layer.
        dropout: rate of the features in training, in [0, 1).
        rngs: source of the initial weights.
    """

    def __init__(
        self,
        features: int,
        classes: int,
        *,
        azimuths: int = 24,
        width: int = 256,
        dropout: float = 0.2,
        rngs: nnx.Rngs,
    ):
        self.shape, self.dropout, self.width = (classes, azimuths), dropout, width
        self.norm = nnx.LayerNorm(features, rngs=rngs)
        self.layer1 = nnx.Linear(features + 1, width, rngs=rngs)
        self.layer2 = nnx.Linear(width, classes * azimuths, rngs=rngs)

    def __call__(
        self,
        features: Float[AnyArray, "*batch features"],
        height: Float[AnyArray, "*batch"],
        key: Array | None = None,
    ) -> Float[Array, "*batch classes azimuths"]:
        """Log-probabilities of the azimuths, for each class.

        Args:
            features: of each view.
            height: of the camera: the vertical component, in [−1, 1], of the unit vector from the object to it.
            key: PRNG key for dropout in training; no dropout without.
        """
        normed = self.norm(jnp.asarray(features))
        if key is not None and self.dropout:
            kept = jax.random.bernoulli(key, 1 - self.dropout, normed.shape)
            normed = jnp.where(kept, normed / (1 - self.dropout), 0.0)
        hidden = jax.nn.gelu(self.layer1(jnp.concatenate([normed, jnp.asarray(height)[..., None]], axis=-1)))
        logits = self.layer2(hidden)
        return jax.nn.log_softmax(logits.reshape(*logits.shape[:-1], *self.shape), axis=-1)


_DEPENDENCE = 0.75
"""Exponent of the evidence of each view about the yaw; below 1 since views are not independent."""


def yaw_log_probabilities(
    azimuths: Float[AnyArray, "views classes azimuths"],
    directions: Float[AnyArray, "views 3"],
    present: Bool[AnyArray, " views"],
) -> Float[Array, "classes azimuths"]:
    """Log-probabilities of the yaws of an object, for each class that it may be of, after some views.

    A camera at azimuth a of the world is at azimuth a − yaw in the frame of the object.

    Args:
        azimuths: log-probabilities of the azimuth of each view, as of `AzimuthHead`.
        directions: unit vectors from the object to the cameras, in the world.
        present: True for the views to use.
    """
    azimuths, present, count = jnp.asarray(azimuths), jnp.asarray(present), azimuths.shape[-1]
    lower, upper, share = _between(azimuth_of(directions)[:, None] - jnp.asarray(yaws(count), jnp.float32), count)

    def at(index: Array) -> Array:
        return jnp.take_along_axis(azimuths, jnp.broadcast_to(index[:, None], azimuths.shape), axis=-1)

    evidence = at(lower) * (1 - share)[:, None] + at(upper) * share[:, None]
    return jax.nn.log_softmax(_DEPENDENCE * jnp.sum(jnp.where(present[:, None, None], evidence, 0.0), axis=0), axis=-1)
