"""What a matcher learns from views whose errors are known."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax.gallery.grid import HEIGHTS, STEPS, YAWS, grid_directions
from mevs_jax.gallery.matching import PIXELS, WEIGHTS, Gallery, Matcher
from mevs_jax.geometry.cameras import ViewCamera
from train.tasks.matcher import Sighted, calibrated, fit_odds, fit_projection, kinds_in_turn, objects_system

FEATURES = 6


def made_up(count: int, noise: float, seed: int) -> list[Sighted]:
    """Shapes whose images are mixtures of a few patterns (so in one dimension less), seen with correlated errors."""
    random = np.random.default_rng(seed)
    patterns = np.random.default_rng(0).uniform(0, 1, (FEATURES, PIXELS))
    errors = np.random.default_rng(1).normal(size=(FEATURES, FEATURES)) @ patterns
    shapes = []
    for _ in range(count):
        mixture = random.dirichlet(np.ones(FEATURES), (HEIGHTS, YAWS))
        gallery = np.round(STEPS * mixture @ patterns).astype(np.uint8)
        cells, yaw = random.integers(0, HEIGHTS * YAWS, 12), int(random.integers(YAWS))
        heights, azimuths = np.unravel_index(cells, (HEIGHTS, YAWS))
        seen = gallery[heights, (azimuths - yaw) % YAWS] / STEPS
        amount = noise * random.uniform(0.2, 1)
        images = seen + amount * random.normal(size=(12, FEATURES)) @ errors
        known = np.ones((12, PIXELS), bool)
        shapes.append(Sighted(gallery, yaw, images.astype(np.float32), known, _level(cells)))
    return shapes


def _level(cells: np.ndarray) -> np.ndarray:
    return grid_directions()[cells].astype(np.float32)


def test_differences_become_white():
    shapes = made_up(40, 0.06, 2)
    projection = np.asarray(fit_projection(iter(shapes), FEATURES - 2))
    apart = []
    for one in shapes:
        heights, azimuths = np.unravel_index(
            [np.abs(grid_directions() - direction).sum(axis=1).argmin() for direction in one.directions],
            (HEIGHTS, YAWS),
        )
        middle = (heights > 0) & (heights < HEIGHTS - 1)  # the outermost images are 0.1° from the poles
        predicted = one.gallery[heights, (azimuths - one.yaw) % YAWS] / STEPS
        apart.append(((one.images - predicted) * WEIGHTS @ projection)[middle])
    covariance = np.cov(np.concatenate(apart).T)
    np.testing.assert_allclose(covariance, np.eye(FEATURES - 2), atol=0.25)


def test_calibration_makes_probabilities_true_and_strangers_unknown():
    train, val, test = made_up(40, 0.03, 3), made_up(30, 0.03, 4), made_up(30, 0.03, 5)
    one = jnp.float32(1)
    blank = Matcher(fit_projection(iter(train), FEATURES), one, jnp.zeros(3), jnp.zeros(5), one, 0.05 * one)
    matcher = calibrated(blank, val, 0)
    assert float(matcher.unseen) > 0
    assert float(matcher.stranger[3]) > 0.3  # the larger the difference, the stranger
    gallery = Gallery.of(matcher, np.stack([shape.gallery for shape in test[:20]]), np.zeros(20))
    right, chance, strange = [], [], []
    for label, shape in enumerate(test):
        rows = [
            gallery.compared_image(jnp.asarray(image), jnp.ones(PIXELS), jnp.asarray(direction))
            for image, direction in zip(shape.images[:2], shape.directions[:2], strict=True)
        ]
        evidence = gallery.evidence(jnp.stack(rows), jnp.ones(2, bool), False)
        belief = np.exp(np.asarray(gallery.beliefs(evidence)))
        strange.append(belief[-1])
        if label < 20:
            named = belief[:-1] / belief[:-1].sum()
            right.append(named.argmax() == label)
            chance.append(named.max())
    assert np.mean(right) > 0.9
    assert np.mean(chance) == pytest.approx(np.mean(right), abs=0.15)
    assert np.mean(strange[20:]) > np.mean(strange[:20]) + 0.25


def test_how_many_are_unknown_in_a_gallery_says_nothing_of_its_size():
    random, walks = np.random.default_rng(6), []
    for objects, share in ((10, 0.95), (100, 0.6), (200, 0.2)):
        unknown = random.random(4000) < share
        apart = random.normal(np.where(unknown, 1.0, -1.0))
        walks.append((np.stack([np.ones(4000), np.full(4000, np.log(objects)), apart], axis=1), unknown))
    np.testing.assert_allclose(fit_odds(walks), [0, 0, 2], atol=0.2)


def test_kinds_for_calibration_are_others_than_for_fitting():
    train, val = (
        {entry.name.rsplit("_", 2)[0] for entry in kinds_in_turn(split, 400, 0)} for split in ("train", "val")
    )
    assert len(train) > 60
    assert len(val) > 20
    assert not train & val


def test_a_system_without_objects_can_be_written(tmp_path):
    matcher = Matcher(jnp.ones((PIXELS, 3)), jnp.float32(1), jnp.zeros(3), jnp.zeros(5), jnp.float32(1), jnp.float32(1))
    made = objects_system(matcher, ViewCamera(64))
    made.save(tmp_path / "objects")
    from mevs_jax import load

    again = load(tmp_path / "objects")
    assert again.classes == ("unknown object",)
    assert again == replace(made, name=again.name)
