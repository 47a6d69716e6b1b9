"""Recogniser: an encoder of single views and a fusion network for sets of views, trained together."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.calling import TrainedByCall
from mevs_jax.models.resnet import ResNet
from mevs_jax.models.set_fusion import SetFusion


class Recogniser(TrainedByCall):
    """An encoder and a fusion network.

    Trained together, the encoder learns features that complement those of other views.

    Args:
        encoder: computes the features of a view and, by its own head, the logits.
        fusion: computes logits from the features and directions of any set of views.
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
        """Logits of every single view, and of the present views of each object together.

        Args:
            images: of every view.
            directions: unit vectors from the object to the cameras.
            present: True for the views to fuse.
            train: whether batch norm uses the statistics of the batch.
            key: PRNG key for dropout in the fusion; no dropout without.

        Returns:
            Logits of single views; fused logits for a known pose; fused logits for an unknown pose.
        """
        features = self.encoder.features(images, train=train)
        posed, unposed = (self.fusion(features, directions, present, key, posed=known) for known in (True, False))
        return self.encoder.head(features), posed, unposed

    def see(self, images: Float[AnyArray, "*batch height width channels"]) -> Float[Array, "*batch both"]:
        """Features and logits of single views, concatenated: the data that is stored of a view."""
        features = self.encoder.features(images)
        return jnp.concatenate([features, self.encoder.head(features)], axis=-1)
