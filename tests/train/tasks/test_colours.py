"""The matcher of colours learns to tell paints of one shape apart in changing light."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import mevs_jax
from mevs_jax.gallery.colours import Colours
from train.tasks.colours import ColourConfig, fit_colour_matcher, painted_shapes, random_paint
from train.tasks.matcher import MatcherConfig, kinds_in_turn


def test_paints_are_colours_and_differ() -> None:
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    paints = [random_paint(np.random.default_rng(seed))(points) for seed in range(30)]
    assert min(paint.min() for paint in paints) >= 0
    assert max(paint.max() for paint in paints) <= 1
    means = np.array([paint.mean(axis=0) for paint in paints])
    assert np.linalg.norm(means[:, None] - means, axis=-1)[~np.eye(30, dtype=bool)].min() > 0.005
    assert np.mean([paint.std(axis=0).max() > 0.05 for paint in paints]) > 0.5  # most are not plain


@pytest.mark.slow
def test_what_is_learned_tells_two_paints_apart_on_other_shapes() -> None:
    system = mevs_jax.load("objects")
    camera, gallery = system.description.camera, system.parts.gallery
    config = ColourConfig(shapes=12, calibration_shapes=8, views=replace(MatcherConfig(), views=8))
    matcher = fit_colour_matcher(config, gallery.matcher, camera)
    assert all(np.isfinite(np.asarray(value)).all() for value in vars(matcher).values())
    right = []
    for shape in painted_shapes(kinds_in_turn("val", 12, 1)[8:], config, camera, 5):
        colours = Colours.of(matcher, shape.colours, np.arange(2))
        for number, views in enumerate(shape.seen):
            for seen, direction in zip(views, shape.shape.directions, strict=True):
                if np.isfinite(seen).mean() > 0.02:
                    apart = colours.compared(jnp.asarray(seen), jnp.asarray(direction), 2)[:-1].reshape(2, -1)
                    right.append(int(apart[:, shape.shape.yaw].argmin()) == number)
    assert len(right) > 30
    assert np.mean(right) > 0.8
