"""The networks as Flax NNX modules."""

from mevs_jax.models.batch_norm import BatchNorm
from mevs_jax.models.counting import count_parameters
from mevs_jax.models.pointnet2 import THESIS_ABSTRACTIONS, Abstraction, PointNet2
from mevs_jax.models.recogniser import Recogniser
from mevs_jax.models.resnet import ResNet
from mevs_jax.models.view_policy import ViewPolicy

__all__ = [
    "THESIS_ABSTRACTIONS",
    "Abstraction",
    "BatchNorm",
    "PointNet2",
    "Recogniser",
    "ResNet",
    "ViewPolicy",
    "count_parameters",
]
