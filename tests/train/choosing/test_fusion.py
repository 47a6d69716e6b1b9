"""Training the fusion: the sets it sees, and that it learns what no view shows alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from eval.learned.study import random_sets_study
from mevs_jax.models.set_fusion import SetFusion
from train.choosing.averaged import AveragedConfig, Fitting, fit_together
from train.choosing.calibrated import calibrated
from train.choosing.features import Features, sets_of_size
from train.tasks.set_fusion import SetFusionConfig, new_fusion, random_sets


def test_training_sets_have_every_size_small_ones_more_often_and_views_as_often():
    sets = np.asarray(random_sets(jax.random.key(0), 20_000, 6, 4))
    sizes = np.bincount(sets.sum(axis=1), minlength=7) / len(sets)
    expected = np.log([2 / 1, 3 / 2, 4 / 3, 5 / 4]) / np.log(5)
    np.testing.assert_allclose(sizes, [0, *expected, 0, 0], atol=0.02)
    np.testing.assert_allclose(sets.mean(axis=0), expected @ [1, 2, 3, 4] / 6, atol=0.02)
    tried = sets_of_size(50, 6, 2, 8)
    assert (tried.sum(axis=-1) == 2).all()
    assert (tried[0] != tried[1]).any()
    np.testing.assert_array_equal(tried, sets_of_size(50, 6, 2, 8))


def made_up(objects: int, seed: int) -> Features:
    """Objects whose class is the parity of two signs that no single view shows both of: single-view logits say nothing."""
    random = np.random.default_rng(seed)
    signs = random.choice([-1.0, 1.0], (objects, 2))
    features = random.normal(0, 0.3, (objects, 4, 6))
    features[:, 0::2, 0] += 2 * signs[:, :1]
    features[:, 1::2, 1] += 2 * signs[:, 1:]
    labels = (signs.prod(axis=1) > 0).astype(np.int32)
    logits = random.normal(0, 0.1, (objects, 4, 2))
    directions = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    return Features(
        *(jnp.asarray(a, jnp.float32) for a in (features, logits)),
        jnp.asarray(labels),
        jnp.broadcast_to(jnp.asarray(directions), (objects, 4, 3)),
    )


def trained(train: Features) -> SetFusion:
    """A set fusion trained on random sets of views."""
    shape = SetFusionConfig(width=32, heads=2, blocks=1, dropout=0.0)
    structure, parameters = nnx.split(new_fusion(shape, train.features.shape[-1], 2, nnx.Rngs(0)))

    def loss_of(parameters: nnx.State, some: Features, key: jax.Array) -> jax.Array:
        present = random_sets(key, len(some.labels), 4, 4)
        logits = nnx.merge(structure, parameters)(some.features, some.directions, present)
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, some.labels))

    config = AveragedConfig(epochs=25, batch_size=64, learning_rate=3e-3, weight_decay=0.05)
    ((weights, history),) = fit_together(config, loss_of, [Fitting(0, parameters, train, None, "fusion")])
    assert len(history) == 25
    return nnx.merge(structure, weights)


@pytest.mark.slow
def test_what_no_view_shows_alone_is_learned_and_reported():
    train, validation, test = (made_up(objects, seed) for seed, objects in enumerate((512, 128, 256)))
    fusion = calibrated(trained(train), validation, jnp.zeros(2))
    assert fusion.temperatures.shape == (4,)
    rows = {row["views"]: row for row in random_sets_study(fusion, validation, test)}
    assert list(rows) == [1, 2, 3, 4]
    assert rows[1]["learned"]["accuracy"] < 0.6  # one sign says nothing
    assert rows[4]["learned"]["accuracy"] > 0.95
    assert rows[4]["sum"]["accuracy"] < 0.65
    assert rows[4]["difference_interval"][0] > 0.25
    # Two of four views show both signs in four cases of six, in the others one guesses.
    assert 0.75 < rows[2]["learned"]["accuracy"] < 0.88
    assert rows[2]["learned"]["calibration_error"] < 0.1
