"""mevs_jax: where should a camera look next?

Everything takes *one* object, cloud or view; put `jax.vmap` on for many. No files, no printing, no globals.
"""

from mevs_jax.beliefs import (
    CalibratedFusion,
    confidence,
    discounted,
    mean_of_probabilities,
)
from mevs_jax.calibration import (
    calibration_error_by_chance,
    expected_calibration_error,
    fit_exponent,
    fit_temperature,
    negative_log_likelihood,
    reliability,
)
from mevs_jax.cameras import Camera, cameras_at, look_at_origin, orbit, partial_cloud, pixel_directions, unproject
from mevs_jax.decisions import Decision, NextView
from mevs_jax.entropy import depth_entropy, depth_levels, level_entropy, quantise_depth, shannon_entropy
from mevs_jax.metrics import (
    accuracy,
    bootstrap_interval,
    bootstrap_means,
    class_accuracy,
    confusion_matrix,
)
from mevs_jax.models import Abstraction, PointNet2, Recogniser, ResNet, ViewPolicy, count_parameters
from mevs_jax.models.pretrained import pointnet2_from_torch, resnet_from_torch
from mevs_jax.models.set_fusion import SetFusion
from mevs_jax.points.ops import ball_query, farthest_point_sample
from mevs_jax.policies.base import (
    Knowledge,
    Observation,
    Policy,
    Scene,
    SelectionState,
    candidates,
    maxima_first,
    with_movement,
)
from mevs_jax.policies.learned import learned
from mevs_jax.policies.oracles import fused_oracle
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection import (
    Episode,
    ViewTable,
    by_attention,
    select_from_table,
    select_views,
    sum_of_logits,
)
from mevs_jax.viewpoints import (
    ViewGraph,
    fibonacci_sphere,
    local_maxima,
    nested_lattice,
    platonic_solid,
    ring_lattice,
    viewpoint_lattice,
)

__version__ = "0.1.0"

__all__ = [
    "POLICIES",
    "Abstraction",
    "CalibratedFusion",
    "Camera",
    "Decision",
    "Episode",
    "Knowledge",
    "NextView",
    "Observation",
    "PointNet2",
    "Policy",
    "Recogniser",
    "ResNet",
    "Scene",
    "SelectionState",
    "SetFusion",
    "ViewGraph",
    "ViewPolicy",
    "ViewTable",
    "accuracy",
    "ball_query",
    "bootstrap_interval",
    "bootstrap_means",
    "by_attention",
    "calibration_error_by_chance",
    "cameras_at",
    "candidates",
    "class_accuracy",
    "confidence",
    "confusion_matrix",
    "count_parameters",
    "depth_entropy",
    "depth_levels",
    "discounted",
    "expected_calibration_error",
    "farthest_point_sample",
    "fibonacci_sphere",
    "fit_exponent",
    "fit_temperature",
    "fused_oracle",
    "learned",
    "level_entropy",
    "local_maxima",
    "look_at_origin",
    "maxima_first",
    "mean_of_probabilities",
    "negative_log_likelihood",
    "nested_lattice",
    "orbit",
    "partial_cloud",
    "pixel_directions",
    "platonic_solid",
    "pointnet2_from_torch",
    "quantise_depth",
    "reliability",
    "resnet_from_torch",
    "ring_lattice",
    "select_from_table",
    "select_views",
    "shannon_entropy",
    "sum_of_logits",
    "unproject",
    "viewpoint_lattice",
    "with_movement",
]
