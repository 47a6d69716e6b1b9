"""Small systems with random weights, whose numbers mean nothing."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from flax import nnx

from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.geometry.inputs import SizeInput
from mevs_jax.geometry.viewpoints import ViewGraph, fibonacci_sphere
from mevs_jax.models import Abstraction
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.models.shapes import PointNet2Shape, PoseShape, ResNetShape, SetFusionShape, ViewPolicyShape
from mevs_jax.policies.base import Knowledge
from mevs_jax.trained import (
    CloudInput,
    DataDescription,
    Description,
    ImageInput,
    Network,
    Parts,
    TrainedSystem,
    fit_strangeness,
)
from mevs_jax.trained.description import FORM, UNKNOWN_OBJECT

CLASSES = ("bed", "chair", "sofa", "table")
VIEWS = 12


def description(kind: str, **changes) -> Description:
    """A description of a small system."""
    recogniser = kind == "recogniser"
    shape = ViewPolicyShape(16, 2, 1, True, "log", 0.01)
    given = {
        "form": FORM,
        "kind": kind,
        "classes": CLASSES,
        "camera": ViewCamera(32, 60.0, 2.0),
        "image": ImageInput("depth_and_normals", 4) if recogniser else ImageInput("depth", 1),
        "encoder": ResNetShape(10, 8, 4 if recogniser else 1, False, "patches"),
        "best": "learned" if recogniser else "information_gain",
        "best_unposed": "expected_views" if recogniser else "farthest",
        "chosen_by": "nothing",
        "data": DataDescription("made up", "0", {"val": 30}),
        "made_by": "0",
        "made_with": {"jax": "0"},
        "fusion": SetFusionShape(16, 2, 1) if recogniser else None,
        "pose": PoseShape(8, 16) if recogniser else None,
        "entropy": None if recogniser else PointNet2Shape((Abstraction(16, 0.4, 8, (8, 16)),), (32,), (16,)),
        "cloud": None if recogniser else CloudInput(64, "world", True),
        "view_policies": {"learned": shape, "learned_unposed": ViewPolicyShape(16, 2, 1, False, "log", 0.01)}
        if recogniser
        else {},
        "evaluation": {"objects": 10, "after_views": {"random": [0.5, 0.6], "farthest": [0.5, 0.7]}},
    }
    return Description(**(given | changes))  # type: ignore[arg-type]


def system(kind: str = "classifier", seed: int = 0) -> TrainedSystem:
    """A small system; its networks are random, and sure of what they see.

    Args:
        kind: `classifier`, `recogniser`, `sized`, a recogniser that uses the size of objects, or `parts`, one that is told what
            is unknown and has a class of unknown objects in place of tables.
        seed: of its weights.
    """
    rngs, random = nnx.Rngs(seed), np.random.default_rng(seed)
    of = description(kind if kind == "classifier" else "recogniser")
    if kind == "sized":
        of = replace(of, size=SizeInput())
    if kind == "parts":
        image, encoder = ImageInput("depth_and_normals", 5), replace(of.encoder, channels=5)
        of = replace(of, image=image, encoder=encoder, classes=(*CLASSES[:-1], UNKNOWN_OBJECT))
    classes, graph = len(CLASSES), ViewGraph.from_points(fibonacci_sphere(VIEWS))
    encoder = of.encoder.network(classes, rngs)
    encoder.head.kernel.set_value(8 * encoder.head.kernel[...])
    features = 8 * of.encoder.width
    temperatures = {name: jnp.linspace(1, 2, 6) for name in ("random", "farthest", "information_gain")}
    fusion, policies, pose, expected = {}, {}, None, None
    if of.pose is not None:
        temperatures["expected_views_unposed"] = jnp.linspace(1.5, 3, 6)
    if of.fusion is not None:
        structure, weights = nnx.split(of.fusion.network(features, classes, rngs))
        prior = jnp.log(jnp.asarray([0.1, 0.2, 0.3, 0.4]))
        fusion = {
            name: CalibratedFusion(
                structure, weights, prior, jnp.linspace(1, 1.5, 5), jnp.float32(1.2), name == "posed"
            )
            for name in ("posed", "unposed")
        }
        for name, shape in of.view_policies.items():
            policy = shape.network(classes, rngs)
            policy.log_odds_if.kernel.set_value(jnp.asarray(random.normal(size=(16, classes)), jnp.float32))
            policies[name] = Network.of(policy)
            temperatures[name] = jnp.ones(6)
    table = random.normal(size=(classes, VIEWS, classes)) + 2 * np.eye(classes)[:, None]
    if of.pose is not None:
        pose = of.pose.network(features, classes, rngs)
        pose.layer2.kernel.set_value(8 * pose.layer2.kernel[...])
        expected = ExpectedViews(jnp.asarray(random.normal(size=(classes, 16, classes)), jnp.float32))
        table, pose = np.asarray(expected.at(graph.points)), Network.of(pose)
    strange = fit_strangeness(9 + random.normal(size=(30, VIEWS, classes)), VIEWS)
    parts = Parts(
        encoder=Network.of(encoder),
        viewpoints=graph.points,
        neighbours=graph.neighbours,
        single=jnp.float32(1.2),
        size=None if of.size is None else jnp.asarray(random.normal(size=(of.size.steps, features)), jnp.float32),
        entropy=Network.of(of.entropy.network(VIEWS, rngs)) if of.entropy is not None else None,
        fusion=fusion,
        view_policies=policies,
        pose=pose,
        expected=expected,
        knowledge=Knowledge(jnp.asarray(random.permutation(VIEWS), jnp.float32), jnp.asarray(table, jnp.float32)),
        temperatures=temperatures,
        strangeness=strange,
    )
    return TrainedSystem(of, parts, "made up")


def depth_of_ball(
    direction: np.ndarray, side: int = 32, centre=(0.1, -0.2, 0.15), radius: float = 0.6, notch: bool = True
) -> np.ndarray:
    """Depth image of a ball in the unit sphere, by the camera of the system, and with a notch so that views differ."""
    from mevs_jax.geometry.cameras import ViewCamera as Camera
    from mevs_jax.geometry.cameras import look_at_origin, pixel_directions

    pose = np.asarray(look_at_origin(jnp.asarray(direction) * 2.0))
    rays = np.asarray(pixel_directions(Camera(side, 60.0, 2.0).at(jnp.asarray(pose))))
    offset = pose[:3, 3] - np.asarray(centre)
    a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - radius**2
    root = b**2 - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    hit = pose[:3, 3] + rays * depth[..., None]
    return np.where((root > 0) & ((hit[..., 0] < 0.4) | (not notch)), depth, 0).astype(np.float32)
