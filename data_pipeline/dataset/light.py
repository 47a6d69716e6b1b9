"""Colours of images as cameras see them in changing light: exposure, white balance, shading, tone, noise and misalignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from data_pipeline.dataset.reality import RealityAugmentation, keys_of, seen_anew, sphere_error
from mevs_jax.geometry.cameras import ViewCamera


@dataclass(frozen=True)
class LightConfig:
    """How light and cameras change from image to image; numbers are standard deviations unless they say something else."""

    exposure: float = 0.35
    """of the logarithm of the brightness"""
    balance: float = 0.15
    """of the logarithm of each channel's gain"""
    tone: float = 0.15
    """of the logarithm of the exponent of the camera's tone curve"""
    shading: float = 0.8
    """largest share of the light that comes from one direction"""
    gloss: float = 0.3
    """largest brightness of a highlight"""
    noise: float = 0.03
    """of a pixel's colour"""
    shift: float = 0.7
    """of the colours against the depth, in pixels along each axis"""


@partial(jax.jit, static_argnames=("camera", "reality", "light", "views"))
def realistic_colours(
    key: Array,
    of_light: Array,
    batch: Mapping[str, Array],
    camera: ViewCamera,
    reality: RealityAugmentation,
    light: LightConfig,
    views: int,
) -> Float[Array, "batch side side 3"]:
    """The colours of the images that `realistic_views` returns for the same key.

    Each image has another light. The wrong sphere is that of the depth. Colours are known where the object was.

    Args:
        key: as of `realistic_views`.
        of_light: key of the light.
        batch: `colours` (batch, side, side, 3) of the surface itself, NaN where there is none; `normals` of the same shape, in
            the object's frame; and `pose` (batch, 4, 4).
        camera, reality: as there.
        light: how it changes.
        views: number of views of each object in the batch.
    """
    _, objects, _ = keys_of(key, len(batch["pose"]), views)
    keys = jax.random.split(of_light, len(batch["pose"]))

    def one(key: Array, of_object: Array, colours: Array, normals: Array, pose: Array) -> Array:
        lit = in_light(key, colours, normals, pose, light)
        *_, pixel, inside = seen_anew(len(lit), pose, camera, *sphere_error(of_object, reality))
        return jnp.where(inside[..., None], lit[pixel[..., 1], pixel[..., 0]], jnp.nan)

    return jax.vmap(one)(keys, objects, batch["colours"], batch["normals"], batch["pose"])


@partial(jax.jit, static_argnames="light")
def in_light(
    key: Array,
    colours: Float[Array, "side side 3"],
    normals: Float[Array, "side side 3"],
    pose: Float[Array, "4 4"],
    light: LightConfig,
) -> Float[Array, "side side 3"]:
    """Colours of a surface in one random light, as one camera sees them; from 0 to 1."""
    bright, gains, curve, share, where, shine, grain, moved = jax.random.split(key, 8)
    directed = light.shading * jax.random.uniform(share)
    away = pose[:3, 3] / jnp.linalg.norm(pose[:3, 3])
    source = jax.random.normal(where, (3,)) + away + jnp.array([0.0, 0.0, 1.0])
    source = source / jnp.linalg.norm(source)
    half = (source + away) / jnp.linalg.norm(source + away)
    facing = jnp.clip(normals @ source, 0, 1)
    highlight = light.gloss * jax.random.uniform(shine) * jnp.clip(normals @ half, 0, 1) ** 30
    gain = jnp.exp(light.exposure * jax.random.normal(bright) + light.balance * jax.random.normal(gains, (3,)))
    lit = (colours * (1 - directed + directed * facing)[..., None] + highlight[..., None]) * gain
    lit = jnp.maximum(lit, 1e-4) ** jnp.exp(light.tone * jax.random.normal(curve))
    lit = jnp.clip(lit + light.noise * jax.random.normal(grain, lit.shape), 0, 1)
    steps = jnp.round(light.shift * jax.random.normal(moved, (2,))).astype(jnp.int32)
    return jnp.roll(lit, steps, axis=(0, 1))
