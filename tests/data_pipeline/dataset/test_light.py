"""Light changes colours and nothing else, and colours stay where the depth is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.dataset.light import LightConfig, in_light, realistic_colours
from data_pipeline.dataset.reality import RealityAugmentation, realistic_views
from mevs_jax.geometry.cameras import ViewCamera

CAMERA = ViewCamera(64, 60.0, 2.0)


def test_without_shading_and_noise_light_is_a_gain_of_each_channel() -> None:
    random, plain = np.random.default_rng(0), LightConfig(tone=0, shading=0, gloss=0, noise=0, shift=0)
    colours = random.uniform(0.1, 0.3, (64, 64, 3)).astype(np.float32)
    pose = CAMERA.around(np.array([[1.0, 0, 0]], np.float32)).pose[0]
    lit = np.asarray(in_light(jax.random.key(4), colours, np.zeros_like(colours), pose, plain))
    gains = lit / colours
    np.testing.assert_allclose(gains, np.broadcast_to(gains[0, 0], gains.shape), rtol=1e-4)
    assert np.ptp(gains[0, 0]) > 0.01


def test_light_is_that_of_a_slow_reference() -> None:
    """Pixel by pixel, with the random numbers of the same keys: shading, then highlight, gains, tone, and what a camera clips."""
    random, light, side = np.random.default_rng(1), LightConfig(gloss=0.6, noise=0.05), 8
    colours = random.uniform(0, 1, (side, side, 3)).astype(np.float32)
    normals = random.normal((2, 0, 1), size=(side, side, 3))
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    pose = CAMERA.around(np.array([[0.8, 0, 0.6]], np.float32)).pose[0]
    away = np.asarray(pose)[:3, 3] / np.linalg.norm(np.asarray(pose)[:3, 3])
    for number in range(3):
        key = jax.random.key(number)
        bright, gains, curve, share, where, shine, grain, moved = jax.random.split(key, 8)
        source = np.asarray(jax.random.normal(where, (3,))) + away + [0, 0, 1]
        source /= np.linalg.norm(source)
        half = (source + away) / np.linalg.norm(source + away)
        directed, gloss = 0.8 * float(jax.random.uniform(share)), 0.6 * float(jax.random.uniform(shine))
        noise, tone = np.asarray(jax.random.normal(grain, colours.shape)), float(jax.random.normal(curve))
        exposure, balance = float(jax.random.normal(bright)), np.asarray(jax.random.normal(gains, (3,)))
        expected = np.zeros_like(colours)
        right, down = np.round(0.7 * np.asarray(jax.random.normal(moved, (2,)))).astype(int)[::-1]
        for row in range(side):
            for column in range(side):
                facing = min(max(normals[row, column] @ source, 0), 1)
                highlight = gloss * min(max(normals[row, column] @ half, 0), 1) ** 30
                for channel in range(3):
                    value = colours[row, column, channel] * (1 - directed + directed * facing) + highlight
                    value = value * np.exp(0.35 * exposure + 0.15 * balance[channel])
                    value = max(value, 1e-4) ** np.exp(0.15 * tone) + 0.05 * noise[row, column, channel]
                    expected[(row + down) % side, (column + right) % side, channel] = min(max(value, 0), 1)
        found = in_light(key, jnp.asarray(colours), jnp.asarray(normals), jnp.asarray(pose), light)
        np.testing.assert_allclose(found, expected, atol=2e-5)


def test_colours_are_where_the_depth_of_the_same_key_is() -> None:
    """Colours that are a code of the pixel's depth, around a wrong sphere."""
    poses = CAMERA.around(np.array([[1.0, 0, 0], [0, 0.8, 0.6]], np.float32)).pose
    across = np.abs(np.stack(np.meshgrid(*[np.linspace(-1, 1, 64)] * 2))).max(axis=0)
    depth = np.where(across < 0.5, 1.6 + 0.4 * across, 0).astype(np.float32)
    batch = {"depth": jnp.asarray(np.stack([depth] * 2) * 10_000).astype(jnp.uint16), "pose": poses}
    colours = np.where(depth[..., None] > 0, (depth[..., None] - 1.5) * np.ones(3), np.nan).astype(np.float32)
    given = {"colours": jnp.asarray(np.stack([colours] * 2)), "normals": jnp.zeros((2, 64, 64, 3)), "pose": poses}
    reality = RealityAugmentation(1.0, sensor="none", sphere=0.1, floor=0, hidden=0)
    dark = LightConfig(0, 0, 0, 0, 0, 0, 0)
    for number in range(3):
        key = jax.random.key(number)
        real, placed = realistic_views(key, batch, CAMERA, reality, 2)
        lit = np.asarray(realistic_colours(key, key, given, CAMERA, reality, dark, 2))
        hit = np.asarray(real) > 0
        assert not np.isnan(lit[hit]).any()
        for view in range(2):  # depth is a linear function of the code, the same for all pixels
            code, found = lit[view, hit[view], 0] + 1.5, np.asarray(real)[view, hit[view]]
            assert np.corrcoef(code, found)[0, 1] > 0.95
        assert not np.allclose(np.asarray(placed), np.asarray(poses))
