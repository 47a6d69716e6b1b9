"""What is known about objects of unknown yaw, or in any rotation: evidence of each view about the pose, and expected views."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mevs_jax.arrays import AnyArray
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.models.pose import PoseHead, yaw_evidence
from mevs_jax.models.rotation import nearest_rotations
from mevs_jax.policies.base import Knowledge
from mevs_jax.trained.parts import Network


@flax.struct.dataclass
class UnknownPose:
    """What is known about objects in unknown poses that share candidate views.

    Attributes:
        head: a recogniser's `PoseHead`.
        by_pose: expected views; see `Knowledge`.
        nearest: for any rotation, as of `nearest_rotations`; None for an unknown yaw.
        offset: of the yaws, in radians.
    """

    head: Network
    by_pose: Float[Array, "classes poses views classes"]
    nearest: Int[Array, "views poses"] | None = None
    offset: float = flax.struct.field(pytree_node=False, default=0.0)

    @property
    def hypotheses(self) -> int:
        """Number of pairs of class and pose."""
        return self.by_pose.shape[0] * self.by_pose.shape[1]

    @property
    def knowledge(self) -> Knowledge:
        """What policies are given."""
        return Knowledge(by_pose=self.by_pose)

    def evidence(
        self, features: Float[Array, "views features"], directions: Float[Array, "views 3"]
    ) -> Float[Array, "views classes poses"]:
        """What each view of an object says about its pose; see `Observation`.

        Args:
            features: of its views; if they are longer than those of the head, it is given the last ones.
            directions: unit vectors from the object to the cameras, in the world.
        """
        head = self.head.module
        found = head(features[:, -head.norm.num_features :], directions[:, 2])
        if self.nearest is None:
            return yaw_evidence(found, directions, self.offset)
        return jnp.take_along_axis(found, self.nearest[:, None], axis=-1)


def of_unknown_yaw(head: PoseHead, expected: ExpectedViews, directions: Float[AnyArray, "views 3"]) -> UnknownPose:
    """What is known about upright objects of unknown yaw.

    Objects of a data set have yaw 0. The yaws that are distinguished are therefore moved by half a step: the true one is as far
    from the nearest of them as it can be.

    Args:
        head: finds azimuths.
        expected: of the recogniser.
        directions: unit vectors from the object to the candidate cameras, in the world.
    """
    count = head.shape[1]
    offset = float(np.pi / count)
    return UnknownPose(Network.of(head), expected.by_yaw(directions, count, offset), offset=offset)


def of_any_rotation(head: PoseHead, expected: ExpectedViews, directions: Float[AnyArray, "views 3"]) -> UnknownPose:
    """What is known about objects in any rotation.

    Args:
        head: finds rotations.
        expected, directions: as of `of_unknown_yaw`.
    """
    return UnknownPose(Network.of(head), expected.by_rotation(directions), nearest_rotations(directions))
