"""The arrays of a trained system, and what its networks compute from one view."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int

from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.beliefs.strangeness import Strangeness
from mevs_jax.gallery.matching import Gallery
from mevs_jax.geometry.inputs import depth_and_normals, depth_image, mirrored, normal_image, view_cloud
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.models.pose import yaw_evidence
from mevs_jax.policies.base import Knowledge, Observation
from mevs_jax.trained.description import Description


@flax.struct.dataclass
class Network:
    """A network as an array tree: its structure is static, so that it can be an argument of compiled functions."""

    structure: nnx.GraphDef = flax.struct.field(pytree_node=False)
    weights: nnx.State

    @classmethod
    def of(cls, module: nnx.Module) -> Network:
        """Splits a module."""
        return cls(*nnx.split(module))

    @property
    def module(self) -> Any:
        """The module."""
        return nnx.merge(self.structure, self.weights)


@flax.struct.dataclass
class Parts:
    """Everything of a trained system that is made of arrays.

    Attributes:
        encoder: from an image to features and logits; None for a gallery.
        viewpoints: (views, 3) unit vectors from the object to the candidate cameras.
        neighbours: (views, views) True for neighbours on the view graph.
        entropy: PointNet++, from a cloud to the entropies of all views.
        size: (steps, features) of a recogniser that uses the object's radius; see `Recogniser`.
        fusion: of a recogniser, for a known and for an unknown yaw: `posed` and `unposed`.
        single: temperature of the logits of a single view.
        view_policies: networks that score views, by name of the policy.
        pose: of a recogniser, from the features of a view to the azimuth of the camera in the frame of an object of unknown yaw.
        knowledge: statistics over other objects at the viewpoints, for policies that use them.
        expected: what a recogniser is expected to say of each class from any direction.
        temperatures: by name of the policy, (views,): temperature of the belief after 1, 2, … views of its walks.
        strangeness: compares logits with those of known objects.
        gallery: enrolled objects, which views are compared with in place of an encoder.
    """

    encoder: Network | None
    viewpoints: Float[Array, "views 3"]
    neighbours: Array
    single: Float[Array, ""]
    entropy: Network | None = None
    size: Float[Array, "steps features"] | None = None
    fusion: dict[str, CalibratedFusion] = flax.struct.field(default_factory=dict)
    view_policies: dict[str, Network] = flax.struct.field(default_factory=dict)
    pose: Network | None = None
    knowledge: Knowledge | None = None
    expected: ExpectedViews | None = None
    temperatures: dict[str, Array] = flax.struct.field(default_factory=dict)
    strangeness: Strangeness | None = None
    gallery: Gallery | None = None

    def knowledge_by_pose(self, directions: Float[Array, "views 3"]) -> Knowledge | None:
        """What is known about views in directions of the world for objects of unknown yaw; None if nothing is."""
        if self.expected is None or self.pose is None:
            return None
        return Knowledge(by_pose=self.expected.by_yaw(directions, self.pose.module.shape[1]))


@lru_cache(maxsize=8)
def _priorities(pixels: int) -> Int[np.ndarray, " pixels"]:
    """A fixed random order of the pixels of an image."""
    return np.argsort(np.random.default_rng(0).permutation(pixels)).astype(np.int32)


def sample_pixels(depth: Float[Array, "side side"], points: int) -> Int[Array, " {points}"]:
    """Flat indices (points,) of pixels that hit the object, in a fixed random order, repeated if there are too few.

    All indices are 0 for an image in which nothing is hit.
    """
    flat = depth.reshape(-1)
    order = jnp.argsort(jnp.where(flat > 0, _priorities(flat.shape[0]), flat.shape[0]))
    return order[jnp.arange(points) % jnp.maximum(jnp.sum(flat > 0), 1)].astype(jnp.int32)


def image_of(depth: Float[Array, "side side"], of: Description) -> Float[Array, "side side channels"]:
    """The input of the encoder for a depth image in radii, 0 where nothing is hit and NaN where unknown."""
    if of.image.content == "depth_and_normals":
        return depth_and_normals(depth, of.camera, of.image.channels)
    if of.image.content == "normals":
        return normal_image(depth, of.camera)
    return depth_image(depth, of.camera, of.image.channels)


def logits_of(parts: Parts, features: Float[Array, "*batch features"]) -> Float[Array, "*batch classes"]:
    """The logits of single views; all classes are equally likely before the first view."""
    assert parts.encoder is not None
    logits = parts.encoder.module.head(features)
    return logits - parts.fusion["posed"].prior if parts.fusion else logits


def features_of(
    parts: Parts, depth: Float[Array, "*batch side side"], radius: Float[Array, "*batch"], of: Description
) -> tuple[Float[Array, "*batch features"], Float[Array, "*batch features"]]:
    """The features of single views, and those of the images as they are, which the pose can be read from.

    They differ where features are means over an image and its mirror image. Arguments as of `observe`.
    """
    images = jnp.vectorize(lambda one: image_of(one, of), signature="(h,w)->(h,w,c)")(depth)
    assert parts.encoder is not None
    given = jnp.stack([images, mirrored(images)]) if of.image.mirrored else images[None]
    features = parts.encoder.module.features(given)
    if of.size is not None and parts.size is not None:
        features = features + of.size.code(radius) @ parts.size
    return jnp.mean(features, axis=0), features[0]


def observe(
    parts: Parts,
    depth: Float[Array, "side side"],
    pose: Float[Array, "4 4"],
    radius: Float[Array, ""],
    of: Description,
    with_entropy: bool = True,
    colours: Float[Array, "side side 3"] | None = None,
) -> Observation:
    """What the networks compute from one view.

    Args:
        parts: of the system.
        depth: along the optical axis, in radii of the object; 0 where nothing is hit.
        pose: from the camera to the object's frame, whose unit is the radius.
        radius: of the object in metres; NaN if it is unknown.
        of: the description of the system.
        with_entropy: whether predicted entropies are needed, if it has them.
        colours: of the surface at the same pixels, from 0 to 1, NaN where unknown; None if there are none.
    """
    direction = pose[:3, 3] / jnp.linalg.norm(pose[:3, 3])
    if parts.gallery is not None:
        compared = parts.gallery.compared(depth, direction, of.camera.distance, radius, colours)
        evidence = parts.gallery.evidence(compared[None], jnp.ones(1, bool), posed=False)
        return Observation(parts.gallery.beliefs(evidence), features=compared)
    features, as_it_is = features_of(parts, depth, radius, of)
    cloud, entropies, yaws = of.cloud, None, None
    if with_entropy and cloud is not None and parts.entropy is not None:
        pixels = sample_pixels(depth, cloud.points)
        seen = view_cloud(pixels, depth.reshape(-1)[pixels], pose, of.camera, cloud.frame, cloud.directions)
        entropies = parts.entropy.module(seen)
    if parts.pose is not None:
        yaws = yaw_evidence(parts.pose.module(as_it_is, direction[2]), direction)
    return Observation(logits_of(parts, features), entropies, features, pose_evidence=yaws)
