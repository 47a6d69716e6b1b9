"""Errors of real depth cameras, on the device: what a sensor would have measured in place of a perfect image.

Two kinds of sensor. *Structured light* has the noise that Nguyen, Izadi and Lovell measured ("Modeling Kinect sensor noise for
improved 3D reconstruction and tracking", 3DIMPVT 2012): along the optical axis growing with distance and with the angle at which
a surface is seen, and across it a displacement of about a pixel. *Stereo* has noise of its disparity, after Intel's
"Best-known-methods for tuning Intel RealSense D400 depth cameras": an error in depth that grows with the square of the distance.
Both round disparity to steps of their own, leave surfaces unmeasured that are seen at a grazing angle, near edges or dark, and
mix near and far at edges into points that float between them ("flying pixels").

Noise and steps are as published; shares of missing and flying pixels are ours, chosen to look like recorded images. Functions
take one image: `jax.vmap` them over views and objects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import ViewCamera, partial_cloud, pixel_directions
from mevs_jax.geometry.inputs import depth_and_normals

Kind = Literal["none", "structured-light", "stereo"]


@dataclass(frozen=True)
class SensorConfig:
    """The errors of a depth camera."""

    kind: Kind = "none"
    """the sensor: structured-light (Kinect), stereo (RealSense D435), or none"""
    strength: float = 1.0
    """magnitude of all errors: 0 for none, 1 as published, more for a worse sensor"""
    distance: float = 1.0
    """metres from the camera to the object's centre: errors grow with it"""
    radius: float | Array | None = None
    """metres of the object's radius; None: so many that the sensor is as many radii away as the camera of the images. Of a small
    object far away, errors are larger in radii"""


@dataclass(frozen=True)
class Triangulation:
    """How a sensor triangulates.

    Attributes:
        focal: in pixels of the sensor.
        baseline: in metres.
        step: smallest step of disparity, in pixels of the sensor.
    """

    focal: float
    baseline: float
    step: float


KINECT = Triangulation(focal=585.0, baseline=0.075, step=1 / 8)
"""Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data", Sensors 2012."""
REALSENSE = Triangulation(focal=424.0, baseline=0.050, step=1 / 32)
"""A D435 at 848×480, 90° wide."""
SUBPIXEL = 0.08
"""Standard deviation of a D435's disparity on a textured surface, in pixels."""

_GRAZING, _GRAZING_WIDTH = math.radians(78), math.radians(3)
_AT_EDGE, _FLYING, _DARK = 0.3, 0.2, 0.05
_FAR = 0.3
"""Metres between an edge and what is behind it, where nothing of the object is."""
_JUMP = 0.05
"""Difference between neighbours that is an edge, as a share of the depth."""
_STEEPEST = math.radians(85)
_WAVES = 8
"""Plane waves of the random field whose peaks are dark."""


def axial_deviation(
    depth: Float[AnyArray, "height width"], angle: Float[AnyArray, "height width"], kind: Kind
) -> Float[Array, "height width"]:
    """Returns the standard deviation of depth, in metres, before it is rounded.

    Args:
        depth: along the optical axis, in metres.
        angle: between the surface's normal and the line of sight, in radians.
        kind: the sensor.
    """
    depth, angle = jnp.asarray(depth), jnp.minimum(jnp.asarray(angle), _STEEPEST)
    if kind == "stereo":
        return jnp.square(depth) * SUBPIXEL / (REALSENSE.focal * REALSENSE.baseline)
    steep = 1e-4 / jnp.sqrt(jnp.maximum(depth, 0.1)) * jnp.square(angle / (jnp.pi / 2 - angle))
    return 0.0012 + 0.0019 * jnp.square(depth - 0.4) + jnp.where(angle > math.radians(60), steep, 0.0)


def lateral_deviation(angle: Float[AnyArray, "height width"]) -> Float[Array, "height width"]:
    """Returns the standard deviation, in pixels of the sensor, across the line of sight (structured light)."""
    angle = jnp.minimum(jnp.asarray(angle), _STEEPEST)
    return 0.8 + 0.035 * angle / (jnp.pi / 2 - angle)


def sense(
    key: Array,
    depth: Float[AnyArray, "height width"],
    pose: Float[AnyArray, "4 4"],
    camera: ViewCamera,
    config: SensorConfig,
    strength: float | Array | None = None,
    surface: Array | None = None,
) -> Float[Array, "height width"]:
    """Returns what a depth camera would have measured, in radii, 0 where it measured nothing.

    Args:
        key: of this image.
        depth: along the optical axis, in radii, 0 where nothing is hit.
        pose: camera to object.
        config: the sensor, and the size of the object.
        strength: overrides `config.strength`.
        surface: key of the object's dark areas, the same for all of its views; other areas in every view if left out.
    """
    depth = jnp.asarray(depth, jnp.float32)
    if config.kind == "none":
        return depth
    strength = jnp.asarray(config.strength if strength is None else strength, jnp.float32)
    keys = dict(zip(("across", "along", "mix", "mixed", "lost", "dark"), jax.random.split(key, 6), strict=True))
    near = config.distance / camera.distance  # the radius of an object that looks as large from there
    scale = near if config.radius is None else config.radius  # metres in a radius
    shift = config.distance - camera.distance * scale
    metres, angle = jnp.where(depth > 0, depth * scale + shift, 0.0), _angle(depth, camera)
    sensor = REALSENSE
    if config.kind == "structured-light":
        sensor = KINECT
        metres, angle = _displaced(keys["across"], metres, angle, strength * near / scale, camera)
    found = metres + strength * axial_deviation(metres, angle, config.kind) * jax.random.normal(
        keys["along"], depth.shape
    )
    behind, edge = _behind(metres)
    mixed = edge & jax.random.bernoulli(keys["mix"], _share(_FLYING, strength), depth.shape)
    found = jnp.where(mixed, found + jax.random.uniform(keys["mixed"], depth.shape) * (behind - metres), found)
    found = _rounded(found, sensor, strength)
    kept = (1 - _share(_AT_EDGE, strength) * edge) * (
        1 - _share(jax.nn.sigmoid((angle - _GRAZING) / _GRAZING_WIDTH), strength)
    )
    dark = _dark(keys["dark"] if surface is None else surface, depth, pose, camera, _share(_DARK, strength))
    seen = (metres > 0) & ~dark & (jax.random.uniform(keys["lost"], depth.shape) < kept) & (found > 0)
    return jnp.where(seen, (found - shift) / scale, 0.0)


def _share(share: float | Array, strength: Array) -> Array:
    """A probability, grown with the strength."""
    return jnp.clip(strength * share, 0.0, 1.0)


def _angle(depth: Float[Array, "height width"], camera: ViewCamera) -> Float[Array, "height width"]:
    """Angle between normal and line of sight; 0 where there is no normal."""
    normals = depth_and_normals(depth, camera)[..., 1:]
    rays = pixel_directions(camera.at(jnp.eye(4), len(depth)))
    cosine = jnp.abs(jnp.sum(normals * rays, axis=-1)) / jnp.linalg.norm(rays, axis=-1)
    return jnp.where(jnp.any(normals != 0, axis=-1), jnp.arccos(jnp.clip(cosine, 0.0, 1.0)), 0.0)


def _displaced(
    key: Array,
    metres: Float[Array, "height width"],
    angle: Float[Array, "height width"],
    strength: Array,
    camera: ViewCamera,
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """Depth and angle of a place beside each pixel: what lateral noise of a strength shows there."""
    side = len(metres)
    pixels_of_sensor = camera.at(jnp.eye(4), side).focal_length / KINECT.focal
    offset = strength * pixels_of_sensor * lateral_deviation(angle) * jax.random.normal(key, (2, side, side))
    rows, columns = jnp.meshgrid(jnp.arange(side), jnp.arange(side), indexing="ij")
    place = jnp.round(jnp.stack([rows, columns]) + offset).astype(jnp.int32)
    row, column = jnp.clip(place, 0, side - 1)
    return metres[row, column], angle[row, column]


def _behind(metres: Float[Array, "height width"]) -> tuple[Float[Array, "height width"], Bool[Array, "height width"]]:
    """Depth of the farthest neighbour of each pixel, and whether it is so much farther that there is an edge."""
    around = jnp.pad(metres, 1)
    farthest = metres
    for row, column in ((0, 1), (2, 1), (1, 0), (1, 2)):
        other = around[row : row + metres.shape[0], column : column + metres.shape[1]]
        farthest = jnp.maximum(farthest, jnp.where(other > 0, other, metres + _FAR))
    return farthest, (metres > 0) & (farthest - metres > _JUMP * metres)


def _rounded(
    metres: Float[Array, "height width"], sensor: Triangulation, strength: Array
) -> Float[Array, "height width"]:
    """Depth of the nearest step of disparity; steps grow with the strength, and vanish with it."""
    constant = sensor.focal * sensor.baseline
    step = jnp.maximum(strength * sensor.step, 1e-9)
    disparity = jnp.round(constant / jnp.maximum(metres, 1e-3) / step) * step
    return jnp.where((metres > 0) & (strength > 0), constant / jnp.maximum(disparity, step), metres)


def _dark(
    key: Array, depth: Float[Array, "height width"], pose: Float[AnyArray, "4 4"], camera: ViewCamera, share: Array
) -> Bool[Array, "height width"]:
    """Pixels of areas too dark to be measured: where a smooth random field over the object's space is largest."""
    waves, phases = jax.random.split(key)
    points, hit = partial_cloud(depth, camera.at(jnp.asarray(pose, jnp.float32), len(depth)))
    angles = points @ (3.0 * jax.random.normal(waves, (3, _WAVES))) + jax.random.uniform(
        phases, (_WAVES,), maxval=2 * jnp.pi
    )
    field = jnp.sqrt(2 / _WAVES) * jnp.sum(jnp.cos(angles), axis=-1)  # about normal with variance 1
    dark = hit & (field > jax.scipy.stats.norm.isf(jnp.clip(share, 1e-12, 1 - 1e-7))) & (share > 0)
    return dark.reshape(depth.shape)
