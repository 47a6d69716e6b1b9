"""mevs_jax: where should a camera look next?

Everything takes *one* object, cloud or view; put `jax.vmap` on for many. No files, no printing, no globals.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

__version__ = "0.2.0"

_MODULES = {
    "agent": (
        "Agent",
        "Belief",
        "History",
        "Step",
        "Walk",
        "load_history",
        "look",
        "replay",
    ),
    "beliefs.fusing": (
        "CalibratedFusion",
        "confidence",
        "discounted",
        "mean_of_probabilities",
    ),
    "beliefs.calibration": (
        "calibration_error_by_chance",
        "expected_calibration_error",
        "fit_exponent",
        "fit_temperature",
        "negative_log_likelihood",
        "reliability",
    ),
    "geometry.cameras": (
        "Camera",
        "ViewCamera",
        "cameras_at",
        "look_at_origin",
        "orbit",
        "partial_cloud",
        "pixel_directions",
        "unproject",
    ),
    "geometry.canonical": (
        "CanonicalView",
        "canonical_view",
    ),
    "deploy.compiled": ("keep_compiled",),
    "selection.decisions": (
        "Decision",
        "NextView",
    ),
    "beliefs.entropy": (
        "depth_entropy",
        "depth_levels",
        "level_entropy",
        "quantise_depth",
        "shannon_entropy",
    ),
    "environment.pure": (
        "ActiveRecognition",
        "EnvironmentObservation",
        "EnvironmentState",
    ),
    "beliefs.metrics": (
        "accuracy",
        "bootstrap_interval",
        "bootstrap_means",
        "class_accuracy",
        "confusion_matrix",
    ),
    "models": (
        "Abstraction",
        "PointNet2",
        "Recogniser",
        "ResNet",
        "ViewPolicy",
        "count_parameters",
    ),
    "models.pretrained": (
        "pointnet2_from_torch",
        "resnet_from_torch",
    ),
    "models.set_fusion": ("SetFusion",),
    "points.ops": (
        "ball_query",
        "farthest_point_sample",
    ),
    "policies.base": (
        "Knowledge",
        "Observation",
        "Policy",
        "Scene",
        "SelectionState",
        "candidates",
        "maxima_first",
        "with_movement",
    ),
    "policies.learned": ("learned",),
    "policies.oracles": ("fused_oracle",),
    "policies.registry": ("POLICIES", "policy_named", "register_policy"),
    "selection.loop": (
        "sum_of_logits",
        "Episode",
        "ViewTable",
        "by_attention",
        "select_from_table",
        "select_views",
    ),
    "geometry.source_view": ("DepthImage",),
    "geometry.sphere": (
        "Sphere",
        "estimate_sphere",
    ),
    "trained": (
        "TrainedSystem",
        "UnreadableSystem",
        "from_pretrained",
        "load",
    ),
    "geometry.viewpoints": (
        "ViewGraph",
        "fibonacci_sphere",
        "local_maxima",
        "nested_lattice",
        "platonic_solid",
        "ring_lattice",
        "viewpoint_lattice",
    ),
}
"""The public names, by the module that defines them. A module is imported when one of its names is first used (PEP 562), so that
importing the package takes a moment and needs no JAX. Modules and folders of the package are reached the same way."""
_HOMES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(import_module(f"mevs_jax.{_HOMES[name]}"), name)
    elif not name.startswith("_") and find_spec(f"mevs_jax.{name}"):
        value = import_module(f"mevs_jax.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
