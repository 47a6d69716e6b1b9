"""Recogniser: an encoder of single views and a fusion network for sets of views, trained together."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.inputs import SizeInput
from mevs_jax.models.calling import TrainedByCall
from mevs_jax.models.pose import PoseHead
from mevs_jax.models.resnet import ResNet
from mevs_jax.models.set_fusion import SetFusion


class Recogniser(TrainedByCall):
    """An encoder and a fusion network.

    Trained together, the encoder learns features that complement those of other views.

    Args:
        encoder: computes the features of a view and, by its own head, the logits.
        fusion: computes logits from the features and directions of any set of views.
        size: how the object's radius is used: a vector that depends on it is added to the features of its views. None: not at
            all.
        pose: from the features of a view to the pose of the object relative to the camera; None: it is not estimated.
    """

    def __init__(self, encoder: ResNet, fusion: SetFusion, size: SizeInput | None = None, pose: PoseHead | None = None):
        self.encoder, self.fusion, self.size_input, self.pose = encoder, fusion, size, pose
        shape = (size.steps, encoder.head.in_features) if size else None
        self.size = nnx.Param(jnp.zeros(shape)) if shape else None

    def features(
        self,
        images: Float[AnyArray, "*batch height width channels"],
        radius: Float[AnyArray, "*batch"] | None = None,
        *,
        train: bool = False,
    ) -> Float[Array, "*batch features"]:
        """Features of single views.

        Args:
            images: of every view.
            radius: of the object of every view, in metres, NaN where it is unknown; all are unknown by default.
            train: whether batch norm uses the statistics of the batch.
        """
        features = self.encoder.features(images, train=train)
        if self.size is None or self.size_input is None or radius is None:
            return features
        return features + self.size_input.code(radius) @ self.size[...]

    def __call__(
        self,
        images: Float[AnyArray, "*batch views height width channels"],
        directions: Float[AnyArray, "*batch views 3"],
        present: Bool[AnyArray, "*batch views"],
        radius: Float[AnyArray, "*batch views"] | None = None,
        *,
        train: bool = False,
        key: Array | None = None,
    ) -> tuple[
        Float[Array, "*batch views classes"],
        Float[Array, "*batch classes"],
        Float[Array, "*batch classes"],
        Float[Array, "*batch views classes poses"] | None,
    ]:
        """Logits of every single view, and of the present views of each object together.

        Args:
            images: of every view.
            directions: unit vectors from the object to the cameras.
            present: True for the views to fuse.
            radius: of the object, for each of its views; as of `features`.
            train: whether batch norm uses the statistics of the batch.
            key: PRNG key for dropout in the fusion; no dropout without.

        Returns:
            Logits of single views; fused logits for a known pose; fused logits for an unknown pose; log-probabilities of the
            pose in each view, None without such a head.
        """
        features = self.features(images, radius, train=train)
        posed, unposed = (self.fusion(features, directions, present, key, posed=known) for known in (True, False))
        pose = None
        if self.pose is not None:
            drop = None if key is None else jax.random.fold_in(key, 1)
            pose = self.pose(features, jnp.asarray(directions)[..., 2], drop)
        return self.encoder.head(features), posed, unposed, pose

    def see(
        self, images: Float[AnyArray, "*batch height width channels"], radius: Float[AnyArray, "*batch"] | None = None
    ) -> Float[Array, "*batch both"]:
        """Features and logits of single views, concatenated: the data that is stored of a view. Arguments as of `features`."""
        features = self.features(images, radius)
        return jnp.concatenate([features, self.encoder.head(features)], axis=-1)
