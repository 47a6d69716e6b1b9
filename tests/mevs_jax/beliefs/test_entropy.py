"""Depth entropy equal to scikit-image's on the same quantised images."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from skimage.measure import shannon_entropy as skimage_entropy

from data_pipeline.capture import casting as capture
from mevs_jax import depth_entropy, depth_levels, quantise_depth, shannon_entropy
from mevs_jax.beliefs.entropy import DEPTH_SCALE


def depth_image(random: np.random.Generator) -> np.ndarray:
    depth = random.uniform(1, 3, (48, 48)).astype(np.float32)
    depth[random.uniform(size=(48, 48)) < 0.6] = 0
    return depth


def test_equal_to_scikit_image_on_the_thesis_levels(random):
    for _ in range(20):
        depth = depth_image(random)
        sixteen_bit = np.floor(depth * np.float32(10_000)).astype(np.uint16)  # as the PNG is written
        eight_bit = (sixteen_bit >> 8).astype(np.uint8)  # as it is read back
        assert float(depth_entropy(depth)) == pytest.approx(skimage_entropy(eight_bit), abs=1e-5)
        seen = eight_bit[eight_bit > 0]
        assert float(depth_entropy(depth, "foreground")) == pytest.approx(skimage_entropy(seen), abs=1e-5)


def test_a_stretch_of_the_grey_values_only_renames_levels(random):
    """The published code stretches to 0..255 after reading; with the background at 0 that changes no entropy."""
    levels = np.asarray(depth_levels(depth_image(random)))
    stretched = np.round(levels * (255 / levels.max())).astype(np.uint8)
    assert len(np.unique(stretched)) == len(np.unique(levels))
    assert skimage_entropy(stretched) == pytest.approx(skimage_entropy(levels))


def test_levels_are_0_0256_apart_and_background_is_zero():
    depth = np.array([[0.0, np.inf, 1.0, 1.0256, 2.9999]], np.float32)
    np.testing.assert_array_equal(depth_levels(depth), [[0, 0, 39, 40, 117]])
    np.testing.assert_array_equal(quantise_depth(np.array([[9.0]], np.float32)), [[65535]])


def test_extremes():
    assert float(depth_entropy(np.zeros((8, 8), np.float32))) == 0
    assert float(depth_entropy(np.full((8, 8), 2, np.float32))) == 0
    assert float(depth_entropy(np.zeros((8, 8), np.float32), "foreground")) == 0
    half = np.zeros((8, 8), np.float32)
    half[:4] = 2
    assert float(depth_entropy(half)) == pytest.approx(1)
    assert float(shannon_entropy(np.ones(256, np.float32))) == pytest.approx(8)
    with pytest.raises((ValueError, TypeError), match="renyi"):
        depth_entropy(half, "renyi")  # type: ignore[arg-type]


def test_capture_stores_depth_as_the_entropy_reads_it():
    assert capture.DEPTH_SCALE == DEPTH_SCALE


def test_stored_depth_is_refused():
    """Integers are stored depth, whose entropy as metric depth would be that of a saturated image."""
    stored = np.full((4, 4), 20_000, np.uint16)
    said = r"depth must be metric, in floating point, got uint16: divide stored depth by 10,000"
    with pytest.raises(ValueError, match=said):
        inspect.unwrap(quantise_depth)(stored)  # without the check of types in tests; the other functions call it
