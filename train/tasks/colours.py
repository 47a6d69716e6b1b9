"""Learns how colours of views are compared with those of enrolled objects (`mevs_jax.gallery.colours.ColourMatcher`).

It learns from procedural shapes, each painted in two ways, in changing light. The two differ in nothing but their colours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from scipy.linalg import eigh
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp

from data_pipeline.dataset.light import LightConfig, realistic_colours
from data_pipeline.dataset.reality import RealityAugmentation
from data_pipeline.objects.mesh import ObjectEntry
from data_pipeline.objects.sources import load_object
from mevs_jax.gallery.colours import (
    LEAST,
    NUMBERS,
    ColourMatcher,
    Colours,
    decoded,
    differences,
    parted,
    small_colours,
)
from mevs_jax.gallery.grid import HEIGHTS, YAWS
from mevs_jax.gallery.matching import Gallery, Matcher
from mevs_jax.gallery.meshes import caster_of, images_of_triangles, painted, seen_of
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.geometry.sphere import turned
from mevs_jax.geometry.viewpoints import fibonacci_sphere
from mevs_jax.meshes.paint import Colouring
from mevs_jax.trained import TrainedSystem
from train.tasks.matcher import (
    MatcherConfig,
    Sighted,
    fit_matcher,
    fit_odds,
    kinds_in_turn,
    objects_system,
    sighted,
    some_walks,
    tables,
    turned_rig,
    with_power,
)

_RIDGE = 1e-3
"""Added to variances of differences of logarithms."""
_QUANTILE = 0.1
"""As of `train.tasks.matcher`."""
_PAINTS = 2
"""Paints of a shape."""
_LIGHT = 7
"""What keys of lights are made with, so that they are others than those of `realistic_views`."""


@dataclass(frozen=True)
class ColourConfig:
    """Settings of the matcher of colours and of what it learns from."""

    shapes: int = 300
    """procedural shapes, each painted in two ways, whose differences give the covariance"""
    calibration_shapes: int = 96
    """shapes of other kinds that calibrate it"""
    features: int = 48
    """numbers that a view's colours are reduced to"""
    views: MatcherConfig = field(default_factory=MatcherConfig)
    """the number of views, and their errors"""
    light: LightConfig = field(default_factory=LightConfig)
    """how the light changes"""


class PaintedShape(NamedTuple):
    """A shape with two paints in galleries, and views of it in changing light.

    Attributes:
        shape: its depth.
        colours: each paint from all directions.
        seen: `small_colours` of the views, with each paint.
    """

    shape: Sighted
    colours: UInt8[np.ndarray, "paints heights yaws colours"]
    seen: Float[np.ndarray, "paints views side side 3"]


def random_paint(random: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """A function from points in the unit sphere (n, 3) to their colours (n, 3): a plain colour, with patches, stripes,
    blobs, fine print and coarse pictures of other colours, each or none of them."""
    base = _colour(random)
    layers = [_layer(random) for _ in range(random.choice([0, 1, 2, 4, 8], p=[0.15, 0.2, 0.25, 0.2, 0.2]))]
    grain = random.normal(size=(4, 3)) * 5, random.uniform(0, 2 * np.pi, 4), random.uniform(0, 0.08)

    def paint(points: np.ndarray) -> np.ndarray:
        colours = np.tile(base, (len(points), 1))
        for inside, other in layers:
            colours = np.where(inside(points)[:, None], other, colours)
        rough = np.sin(points @ grain[0].T + grain[1]).mean(axis=1)
        return np.clip(colours * (1 + grain[2] * rough[:, None]), 0, 1)

    return paint


def _colour(random: np.random.Generator) -> np.ndarray:
    """A random colour: a quarter of them are printing inks and their mixtures, a quarter are about grey."""
    if random.random() < 0.25:
        return random.choice([0.02, 0.9], 3) + random.uniform(0, 0.1, 3)
    grey = random.uniform(0.03, 0.97)
    saturation = random.choice([0.08, 0.5, 1.0]) * random.random(3)
    return np.clip(grey * (1 - saturation) + random.random(3) * saturation, 0, 1)


def _layer(random: np.random.Generator) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Where a layer of paint is, and its colour."""
    colour, sort = _colour(random), random.integers(5)
    axis, phase = random.normal(size=3), random.uniform(0, 2 * np.pi)
    low = random.uniform(-0.9, 0.5, 3)
    high = low + random.uniform(0.2, 1.2, 3) * np.where(random.random(3) < 0.3, 5, 1)
    waves, phases = random.normal(size=(5, 3)) * random.uniform(1.5, 5), random.uniform(0, 2 * np.pi, 5)
    fine, threshold = random.normal(size=(6, 3)) * 25, random.uniform(-0.5, 1)
    cell, share = random.uniform(0.05, 0.3), random.uniform(0.2, 0.7)

    def inside(points: np.ndarray) -> np.ndarray:
        box = np.asarray(((points > low) & (points < high)).all(axis=1))
        if sort == 0:
            return box
        if sort == 1:
            return np.asarray(np.sin(points @ axis * 4 + phase) > threshold)
        if sort == 2:
            return np.asarray(np.sin(points @ waves.T + phases).sum(axis=1) > threshold)
        if sort == 3:
            return np.asarray(box & (np.sin(points @ fine.T + phases[0]).sum(axis=1) > 0))
        scattered = np.sin(np.floor(points / cell) @ axis * 78.233) * 43758.5453
        return np.asarray(box & (scattered % 1 < share))

    return inside, colour


def painted_shapes(
    entries: Sequence[ObjectEntry], config: ColourConfig, camera: ViewCamera, seed: int
) -> Iterator[PaintedShape]:
    """Shapes with two paints each, in galleries and in views with the errors of real images."""
    directions, random = fibonacci_sphere(config.views.views), np.random.default_rng([seed, 1])
    yaws = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(entries))  # those of `sighted`
    for number, (entry, one) in enumerate(zip(entries, sighted(entries, config.views, camera, seed), strict=True)):
        mesh = load_object(entry)
        triangles = mesh.vertices[mesh.faces]
        paints = [_everywhere(random_paint(random)) for _ in range(_PAINTS)]
        key = jax.random.fold_in(jax.random.key(seed), number)
        lit = lit_views(
            triangles, paints, directions, float(yaws[number]), key, camera, config.views.reality, config.light
        )
        seen = small_colours(np.where(one.hit[..., None], lit, np.nan))
        yield PaintedShape(one, images_of_triangles(triangles, camera, paints)[1], np.asarray(seen))


def _everywhere(paint: Callable[[np.ndarray], np.ndarray]) -> Colouring:
    return lambda _, points: paint(points)


def lit_views(
    triangles: Float[np.ndarray, "faces 3 3"],
    paints: Sequence[Colouring],
    directions: Float[np.ndarray, "views 3"],
    yaw: float,
    key: Array,
    camera: ViewCamera,
    reality: RealityAugmentation,
    light: LightConfig,
) -> Float[np.ndarray, "paints views side side 3"]:
    """Colours of the views that `realistic_views` makes with a key, each in another light; NaN where there is no surface.

    Args:
        triangles: in the unit sphere.
        paints: of them.
        directions: of the cameras.
        yaw: of the object.
        key, camera, reality: as there.
        light: how it changes.
    """
    poses = np.asarray(camera.around(directions.astype(np.float32)).pose)
    _, hit, points = seen_of(caster_of(triangles), turned_rig(camera, directions, yaw).poses, camera)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals = np.where((hit >= 0)[..., None], across[hit], 0.0) @ turned(yaw).T
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    normals[np.einsum("vhwk,vk->vhw", normals, poses[:, :3, 3]) < 0] *= -1  # faces may be either way round
    batch, given = {"normals": normals.astype(np.float32), "pose": poses}, (camera, reality, light, len(poses))
    lights = jax.random.split(jax.random.fold_in(key, _LIGHT), len(paints))
    return np.stack(
        [
            np.asarray(realistic_colours(key, one, batch | {"colours": painted(paint, hit, points)}, *given))
            for one, paint in zip(lights, paints, strict=True)
        ]
    )


def objects_fitted(shapes: int) -> TrainedSystem:
    """The system that objects are enrolled with, learned from a number of procedural shapes."""
    camera = ViewCamera(resolution=64)
    matcher = fit_matcher(MatcherConfig(shapes=shapes, calibration_shapes=shapes // 4), camera)
    painted = ColourConfig(shapes=shapes // 3, calibration_shapes=shapes // 12)
    return objects_system(matcher, camera, colours=fit_colour_matcher(painted, matcher, camera))


def fit_colour_matcher(config: ColourConfig, matcher: Matcher, camera: ViewCamera, seed: int = 0) -> ColourMatcher:
    """Learns a matcher of colours beside one of depth; takes about a second of one core for each shape."""
    train = painted_shapes(kinds_in_turn("train", config.shapes, seed), config, camera, seed)
    nothing = jnp.float32(1)
    blank = ColourMatcher(fit_projection(train, config.features), nothing, jnp.zeros(3), jnp.zeros(6), nothing)
    val = [*painted_shapes(kinds_in_turn("val", config.calibration_shapes, seed), config, camera, seed + 1)]
    return calibrated(blank, matcher, val, seed)


@jax.jit
def _of_views(stored: Array, yaw: Array, seen: Array, directions: Array) -> tuple[Array, Array]:
    """Differences of views from what is predicted of the same object, and the share that both show."""
    numbers, share = jax.vmap(partial(differences, stored[None]))(seen, directions)
    return numbers[:, 0, yaw], share[:, 0, yaw]


@jax.jit
def _of_images(stored: Array, other: Array) -> tuple[Array, Array]:
    """The same of images of galleries, from the same directions."""
    (a, there), (b, here) = decoded(stored), decoded(other)
    return parted(a - b, there & here)


def fit_projection(shapes: Iterator[PaintedShape], features: int) -> Float[Array, "numbers features"]:
    """What makes differences of colours white, where different objects differ most beside them; see `train.tasks.matcher`.

    Different objects are two paints of one shape, or any two shapes.
    """
    random, products, counts = np.random.default_rng(0), np.zeros((2, NUMBERS, NUMBERS)), np.zeros(2)

    def add(place: int, found: tuple[Array, Array]) -> None:
        numbers, share = (np.asarray(one, float) for one in found)
        enough = numbers[share > LEAST]
        products[place] += enough.T @ enough
        counts[place] += len(enough)

    before: np.ndarray | None = None
    for one in shapes:
        for colours, seen in zip(one.colours, one.seen, strict=True):
            add(0, _of_views(colours, one.shape.yaw, seen, one.shape.directions))
        turns = np.arange(HEIGHTS), random.integers(0, YAWS, HEIGHTS)
        add(1, _of_images(one.colours[0][turns], one.colours[1][turns]))
        if before is not None:
            add(1, _of_images(one.colours[0][turns], before[turns]))
        before = one.colours[1]
    within, between = products / counts[:, None, None]
    axes = eigh(between, within + _RIDGE * np.eye(NUMBERS), subset_by_index=(NUMBERS - features, NUMBERS - 1))[1]
    return jnp.asarray(axes, jnp.float32)


def calibrated(colours: ColourMatcher, matcher: Matcher, shapes: Sequence[PaintedShape], seed: int) -> ColourMatcher:
    """The matcher with its weight beside that of depth, and odds of unknown objects, as shapes that it was not fitted on need
    them. Each paint of a shape is an object of its own."""
    gallery = Gallery.of(matcher, np.stack([one.shape.gallery for one in shapes]), np.zeros(len(shapes)))
    depth, shows = tables(gallery, [one.shape for one in shapes])
    depth, shows = depth.repeat(_PAINTS, axis=0).repeat(_PAINTS, axis=2), shows.repeat(_PAINTS, axis=0)
    apart, coloured, details = _colour_tables(colours, shapes)
    wrong = apart.min(axis=-1)[~np.eye(len(apart), dtype=bool)[:, None].repeat(shows.shape[1], axis=1)]
    unseen = np.float32(np.quantile(wrong, _QUANTILE))
    colours = replace(colours, unseen=jnp.asarray(unseen))
    apart = np.where(coloured[..., None, None] > 0, apart, unseen)[..., None]
    of_shapes = [*some_walks(depth, shows, details, seed)]
    of_paints = [*some_walks(apart, np.maximum(coloured, 1e-3), details, seed)]
    by_shape = [np.asarray(matcher.likelihood(one.apart, one.shown, one.apart.shape[1])) for one in of_shapes]

    def weighed(x: np.ndarray) -> ColourMatcher:
        # The power by the number of objects is not determined by what these shapes say: halves of them have opposite signs.
        return with_power(colours, np.insert(x, 2, 0.0))

    def joint(x: np.ndarray) -> Iterator[np.ndarray]:
        now = weighed(x)
        for found, one in zip(by_shape, of_paints, strict=True):
            yield found + np.asarray(now.likelihood(one.apart, one.shown, one.apart.shape[1]))

    def loss(x: np.ndarray) -> float:
        losses = []
        for found, one in zip(joint(x), of_paints, strict=True):
            known, objects = one.label >= 0, log_softmax(logsumexp(found, axis=2), axis=1)
            losses.append(-objects[known, one.label[known]].mean())
        return float(np.mean(losses))

    start, limits = np.array([1.0, 0.3, -1.0]), [(-5, 5), (-2, 2), (-8, 2)]
    found = minimize(loss, start, method="Nelder-Mead", bounds=limits, options={"maxiter": 200}).x
    inputs = []
    for both, *pair in zip(joint(found), of_shapes, of_paints, strict=True):
        best = both.reshape(len(both), -1).argmax(axis=1)
        shape, paint = (one.apart.reshape(len(best), -1)[np.arange(len(best)), best] for one in pair)
        given = pair[1].details[best // YAWS], pair[1].shown, both.shape[1]
        inputs.append(np.asarray(ColourMatcher.strangeness(shape, paint, *given), float).T)
    odds = fit_odds([*zip(inputs, (one.label < 0 for one in of_paints), strict=True)])
    return replace(weighed(found), stranger=jnp.asarray(odds, jnp.float32))


def _colour_tables(matcher: ColourMatcher, shapes: Sequence[PaintedShape]) -> tuple[np.ndarray, np.ndarray, Array]:
    """Squared differences (objects, views, objects, yaws) of all views of all objects, what each view shows, and details."""
    images = np.concatenate([one.colours for one in shapes])
    colours = Colours.of(matcher, images, np.arange(len(images)))

    @jax.jit
    def of_views(colours: Colours, seen: Array, directions: Array) -> Array:
        return jax.lax.map(lambda view: colours.compared(view[0], view[1], len(images)), (seen, directions))

    found = [of_views(colours, seen, one.shape.directions) for one in shapes for seen in one.seen]
    values = np.stack([np.asarray(one) for one in found])
    return values[..., :-1].reshape(*values.shape[:2], len(images), YAWS), values[..., -1], colours.details
