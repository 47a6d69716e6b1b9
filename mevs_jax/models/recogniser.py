"""Recogniser: an encoder that looks at single views, and a set fusion that puts together what it saw."""

from __future__ import annotations

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.resnet import ResNet
from mevs_jax.models.set_fusion import SetFusion


class Recogniser(nnx.Module):
    """Both, trained together: so views learn to say what other views do not.

    Args:
        encoder: each view to its features, and by its own head to logits.
        fusion: features and directions of any set of views to logits.
    """

    def __init__(self, encoder: ResNet, fusion: SetFusion):
        self.encoder, self.fusion = encoder, fusion

    def __call__(
        self,
        images: Float[AnyArray, "*batch views height width channels"],
        directions: Float[AnyArray, "*batch views 3"],
        present: Bool[AnyArray, "*batch views"],
        *,
        train: bool = False,
        key: Array | None = None,
    ) -> tuple[Float[Array, "*batch views classes"], Float[Array, "*batch classes"], Float[Array, "*batch classes"]]:
        """Logits of every view alone, and of those of each object that are `present` together: its pose known, and unknown.

        Args:
            directions: unit vectors from the object to the cameras.
            train: normalise over the batch.
            key: for dropout in the fusion; nothing is dropped without.
        """
        features = self.encoder.features(images, train=train)
        posed, unposed = (self.fusion(features, directions, present, key, posed=known) for known in (True, False))
        return self.encoder.head(features), posed, unposed

    def see(self, images: Float[AnyArray, "*batch height width channels"]) -> Float[Array, "*batch both"]:
        """Features and logits of single views, side by side: what is kept of a view."""
        features = self.encoder.features(images)
        return jnp.concatenate([features, self.encoder.head(features)], axis=-1)
