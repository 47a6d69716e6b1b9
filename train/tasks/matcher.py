"""Learns how views are compared with those of enrolled objects (`mevs_jax.gallery.matching.Matcher`), from procedural shapes.

What is learned is how views of *any* object differ from what its gallery predicts. Shapes of some kinds give the covariance of
these differences; shapes of other kinds, of which some are enrolled and some are not, say how far the result can be trusted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from itertools import product
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8
from scipy.linalg import eigh
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp

from data_pipeline.capture.casting import Rig, capture, rig_at
from data_pipeline.dataset.reality import RealityAugmentation, realistic_views
from data_pipeline.objects.mesh import ObjectEntry
from data_pipeline.objects.sources import furniture_families, load_object, strangers
from mevs_jax.gallery.colours import ColourMatcher
from mevs_jax.gallery.errors import KEPT, parted, unexplained
from mevs_jax.gallery.grid import HEIGHTS, STEPS, YAWS, interpolated
from mevs_jax.gallery.matching import PIXELS, WEIGHTS, Gallery, Matcher, small_image
from mevs_jax.gallery.meshes import images_of_mesh
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.geometry.sphere import turned
from mevs_jax.geometry.viewpoints import fibonacci_sphere, hull_edges
from mevs_jax.trained.description import FORM, UNKNOWN_OBJECT, DataDescription, Description, ImageInput
from mevs_jax.trained.parts import Parts
from mevs_jax.trained.system import TrainedSystem

AnyMatcher = TypeVar("AnyMatcher", Matcher, ColourMatcher)
_SPLITS = ("train", "val")
_RIDGE = 1e-5
"""Added to variances of differences, which are of images from 0 to 1."""
_QUANTILE = 0.1
"""What is not known counts as the quantile of the differences of wrong objects: neither like the object nor unlike it."""
_ENROLLED, _VIEWS = (0.05, 0.15, 0.4, 0.8), (1, 2, 3, 4, 8)
"""Shares of the shapes for calibration that are enrolled, and numbers of views of each."""


@dataclass(frozen=True)
class MatcherConfig:
    """Settings of the matcher and of what it learns from."""

    shapes: int = 1000
    """procedural shapes whose differences give the covariance, of all kinds for training, by turns"""
    calibration_shapes: int = 240
    """shapes of other kinds that calibrate it"""
    views: int = 24
    """views of each shape, around it at a random yaw"""
    features: int = 32
    """numbers that a view is reduced to"""
    size: float = 0.05
    """standard deviation of the logarithm of a measured radius"""
    reality: RealityAugmentation = RealityAugmentation(strength=1.0, sphere=0.05, floor=0.02, hidden=0.05, unseen=0.5)
    """the errors of the views"""


class Sighted(NamedTuple):
    """A shape in a gallery, and views of it.

    Attributes:
        gallery: from all directions.
        yaw: of the shape in its views, as the nearest of the gallery's.
        images, known: of the views, as `small_image`.
        directions: from the shape to the cameras, as they are believed.
        hit: which pixels of the views show the shape.
    """

    gallery: UInt8[np.ndarray, "heights yaws pixels"]
    yaw: int
    images: Float[np.ndarray, "views pixels"]
    known: Bool[np.ndarray, "views pixels"]
    directions: Float[np.ndarray, "views 3"]
    hit: Bool[np.ndarray, "views side side"] = np.zeros((0, 0, 0), bool)


def kinds_in_turn(split: str, count: int, seed: int) -> list[ObjectEntry]:
    """Procedural shapes of all kinds of a split, furniture and others, in a random order."""
    most = max(2, -(-count // 10))
    sources = furniture_families("furniture10-families", most, most), strangers(most, most)
    entries = [entry for source in sources for entry in source.entries if entry.split == split]
    order = np.random.default_rng([_SPLITS.index(split), seed]).permutation(len(entries))
    return [entries[place] for place in order[:count]]


def turned_rig(camera: ViewCamera, directions: Float[np.ndarray, "views 3"], yaw: float) -> Rig:
    """Cameras that see an upright object as those in some directions see it when it is turned by a yaw."""
    return rig_at(camera.around((directions @ turned(yaw)).astype(np.float32)))


def sighted(entries: Sequence[ObjectEntry], config: MatcherConfig, camera: ViewCamera, seed: int) -> Iterator[Sighted]:
    """Shapes with their galleries, and their views with the errors of real images."""
    directions = fibonacci_sphere(config.views).astype(np.float32)
    poses = camera.around(directions).pose

    @jax.jit
    def seen(key: Array, depth: Array) -> tuple[Array, ...]:
        batch = {"depth": depth, "pose": poses}
        real, placed = realistic_views(key, batch, camera, config.reality, config.views)
        images, known = jax.vmap(partial(small_image, distance=camera.distance))(real)
        away = placed[:, :3, 3]
        return images, known > 0, away / jnp.linalg.norm(away, axis=1, keepdims=True), real > 0

    random = np.random.default_rng(seed)
    for number, entry in enumerate(entries):
        mesh = load_object(entry)
        yaw = random.uniform(0, 2 * np.pi)
        depth = capture(mesh, turned_rig(camera, directions, yaw)).depth
        found = map(np.asarray, seen(jax.random.fold_in(jax.random.key(seed), number), jnp.asarray(depth)))
        images, _, _ = images_of_mesh(mesh.vertices, mesh.faces, camera)
        yield Sighted(images, round(yaw * YAWS / (2 * np.pi)) % YAWS, *found)


def fit_matcher(config: MatcherConfig, camera: ViewCamera, seed: int = 0) -> Matcher:
    """Learns a matcher; takes about a third of a second of one core for each shape."""
    train = sighted(kinds_in_turn("train", config.shapes, seed), config, camera, seed)
    projection = fit_projection(train, config.features)
    val = [*sighted(kinds_in_turn("val", config.calibration_shapes, seed), config, camera, seed + 1)]
    nothing = jnp.float32(1)
    blank = Matcher(projection, nothing, jnp.zeros(3), jnp.zeros(5), nothing, jnp.float32(config.size))
    return calibrated(blank, val, seed)


def fit_projection(shapes: Iterator[Sighted], features: int) -> Float[Array, "pixels features"]:
    """What makes differences between views and their predictions white, where different shapes differ most beside them.

    This is Fisher's linear discriminant: the leading generalised eigenvectors of the covariances of differences between images of
    two shapes, and of differences between an image and what is predicted of the same shape.
    """

    @jax.jit
    def differences(gallery: Array, yaw: Array, images: Array, known: Array, directions: Array) -> Array:
        predicted = jax.vmap(lambda direction: interpolated(gallery[None], direction)[0, yaw] / STEPS)(directions)
        return jnp.where(known, images - predicted, 0.0) * WEIGHTS

    products, images, count = np.zeros((PIXELS, PIXELS)), [], 0
    random = np.random.default_rng(0)
    for one in shapes:
        apart = np.asarray(differences(one.gallery, one.yaw, one.images, one.known, one.directions), float)
        products, count = products + apart.T @ apart, count + len(apart)
        turned = random.integers(0, YAWS, HEIGHTS)
        images.append(one.gallery[np.arange(HEIGHTS), turned] / STEPS * WEIGHTS)
    others = (np.stack(images) - np.roll(images, 1, axis=0)).reshape(-1, PIXELS)
    between, within = others.T @ others / len(others), products / count + _RIDGE * np.eye(PIXELS)
    _, axes = eigh(between, within, subset_by_index=(PIXELS - features, PIXELS - 1))
    return jnp.asarray(axes, jnp.float32)


class Walks(NamedTuple):
    """Evidence from walks around shapes; `details` of those that are enrolled, and which of them each shape is; −1 for none."""

    apart: Float[np.ndarray, "walks objects yaws"]
    shown: Float[np.ndarray, " walks"]
    details: Float[np.ndarray, " objects"]
    label: Int[np.ndarray, " walks"]


def calibrated(matcher: Matcher, shapes: Sequence[Sighted], seed: int) -> Matcher:
    """The matcher with powers of likelihoods and odds of unknown objects as shapes that it was not fitted on need them."""
    gallery = Gallery.of(matcher, np.stack([one.gallery for one in shapes]), np.zeros(len(shapes)))
    kept, shows = tables(gallery, shapes)
    wrong = kept[..., 0].min(axis=-1)[~np.eye(len(shapes), dtype=bool)[:, None].repeat(shows.shape[1], axis=1)]
    matcher = replace(matcher, unseen=jnp.float32(np.quantile(wrong, _QUANTILE)))
    walks = [*some_walks(kept, shows, gallery.details, seed)]

    def power(x: np.ndarray) -> float:
        return float(np.mean([_known_loss(with_power(matcher, x), walk) for walk in walks]))

    start, limits = np.array([1.6, 0.3, 0.0, -1.0]), [(-5, 5), (-2, 2), (-0.25, 0.25), (-4, 2)]
    found = minimize(power, start, method="Nelder-Mead", bounds=limits, options={"maxiter": 300}).x
    matcher = with_power(matcher, found)
    odds = fit_odds([_stranger_inputs(walk) for walk in walks])
    return replace(matcher, stranger=jnp.asarray(odds, jnp.float32))


def fit_odds(walks: Sequence[tuple[Float[np.ndarray, "walks numbers"], Bool[np.ndarray, " walks"]]]) -> np.ndarray:
    """Coefficients of the log-odds of what is unknown, by logistic regression.

    Args:
        walks: what the odds depend on, and which are of unknown objects. In each gallery both sorts have the same weight; if
            they had it in all of them together, the number of objects would tell how many are unknown.
    """
    inputs, unknown = (np.concatenate(arrays) for arrays in zip(*walks, strict=True))
    weights = np.concatenate([np.where(one, 0.5 / one.mean(), 0.5 / (1 - one.mean())) for _, one in walks])

    def loss(x: np.ndarray) -> float:
        return float(np.mean(weights * np.logaddexp(0, np.where(unknown, -1, 1) * (inputs @ x))))

    return minimize(loss, np.zeros(inputs.shape[1])).x


def tables(gallery: Gallery, shapes: Sequence[Sighted]) -> tuple[np.ndarray, np.ndarray]:
    """What is kept (shapes, views, objects, yaws, kept) of all views of all shapes, and what each view shows."""

    @jax.jit
    def of_shape(gallery: Gallery, images: Array, known: Array, directions: Array) -> Array:
        return jax.lax.map(lambda view: gallery.compared_image(*view), (images, known, directions))

    kept, shows = [], []
    for one in shapes:
        values = np.asarray(of_shape(gallery, one.images, one.known.astype(np.float32), one.directions))
        by_object = values[:, :-1].reshape(len(values), len(shapes), -1)[..., :-1]
        kept.append(by_object.reshape(*by_object.shape[:2], YAWS, KEPT).astype(np.float16))  # there are many
        shows.append(values[:, -1])
    return np.stack(kept), np.stack(shows)


def some_walks(kept: np.ndarray, shows: np.ndarray, details: Array, seed: int) -> Iterator[Walks]:
    """Random views of all shapes, of which some are enrolled."""
    random, (shapes, views) = np.random.default_rng(seed), shows.shape
    for share, count in product(_ENROLLED, _VIEWS):
        enrolled = np.sort(random.permutation(shapes)[: max(2, round(share * shapes))])
        label = np.full(shapes, -1)
        label[enrolled] = np.arange(len(enrolled))
        seen = np.argsort(random.random((shapes, views)), axis=1)[:, :count]
        weights = np.take_along_axis(shows, seen, axis=1)
        total = weights.sum(axis=1)
        apart = [
            _unexplained(kept[shape, views][:, enrolled], weights[shape] / total[shape], total[shape])
            for shape, views in enumerate(seen)
        ]
        yield Walks(np.stack(apart), total, np.asarray(details)[enrolled], label)


@jax.jit
def _unexplained(kept: Array, weights: Array, total: Array) -> Array:
    """`Evidence.apart` of a walk; colours, of which a square alone is kept, have no common error."""
    mean = jnp.einsum("v,voyk->oyk", weights, kept)
    return unexplained(*parted(mean), total) if mean.shape[-1] == KEPT else mean[..., 0]


def with_power(matcher: AnyMatcher, x: np.ndarray) -> AnyMatcher:
    return replace(matcher, heat=jnp.asarray(x[:3], jnp.float32), floor=jnp.float32(np.exp(x[3])))


def _log_probabilities(matcher: Matcher, walks: Walks) -> Float[np.ndarray, "walks objects"]:
    """Of the objects, if each is one of those enrolled."""
    likelihood = np.asarray(matcher.likelihood(walks.apart, walks.shown, walks.apart.shape[1]))
    return np.asarray(log_softmax(logsumexp(likelihood, axis=2), axis=1))


def _known_loss(matcher: Matcher, walks: Walks) -> float:
    known = walks.label >= 0
    return float(-_log_probabilities(matcher, walks)[known, walks.label[known]].mean())


def _stranger_inputs(walks: Walks) -> tuple[np.ndarray, np.ndarray]:
    """What the odds of an unknown object depend on, and whether it is one."""
    apart = walks.apart.reshape(len(walks.label), -1)
    detail = walks.details[apart.argmin(axis=1) // YAWS]
    inputs = Matcher.strangeness(apart.min(axis=1), detail, walks.shown, walks.apart.shape[1])
    return np.asarray(inputs, float).T, walks.label < 0


def objects_system(
    matcher: Matcher, camera: ViewCamera, views: int = 40, colours: ColourMatcher | None = None
) -> TrainedSystem:
    """The system that objects are enrolled with: without any yet. It compares colours if it is given a matcher of them."""
    points, learned = fibonacci_sphere(views), jax.tree.leaves((matcher, colours))
    nothing = np.zeros((0, HEIGHTS, YAWS, PIXELS), np.uint8)
    parts = Parts(
        encoder=None,
        viewpoints=jnp.asarray(points, jnp.float32),
        neighbours=jnp.asarray(hull_edges(points)),
        single=jnp.float32(1),
        temperatures={"random": jnp.ones(1)},
        gallery=Gallery.of(matcher, nothing, np.zeros(0), None if colours is None else colours.blank()),
    )
    description = Description(
        form=FORM,
        kind="gallery",
        classes=(UNKNOWN_OBJECT,),
        camera=camera,
        image=ImageInput("depth", 1),
        encoder=None,
        best="information_gain",
        best_unposed="information_gain",
        chosen_by="procedural shapes of kinds that nothing was fitted on",
        data=DataDescription("enrolled objects", "", {"enrolled": 0}),
        made_by=hashlib.sha256(b"".join(np.asarray(one).tobytes() for one in learned)).hexdigest()[:16],
        made_with={name: version(name) for name in ("jax", "mevs-jax")},
        colour=colours is not None,
    )
    return TrainedSystem(description, parts, "objects")
