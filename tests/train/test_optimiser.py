"""Update rules against Optax and linear algebra, and schedules at their ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from optax.contrib import muon

from eval.settings import TINY
from train.optimiser import OptimiserConfig, _as_matrix, descent, learning_rate
from train.step import samples_before
from train.tasks.entropy import EntropyTask


def test_muon_steps_are_as_long_in_all_directions_of_a_matrix(random):
    """Against the singular value decomposition, and Adam, with Nesterov's momentum, for what is no matrix."""
    shapes = {"kernel": (3, 3, 8, 32), "matrix": (40, 24), "head": (40, 10), "bias": (24,)}
    gradients = {name: jnp.asarray(random.normal(size=shape), jnp.float32) for name, shape in shapes.items()}
    weights = jax.tree.map(jnp.ones_like, gradients)
    of_muon, nadam = descent(OptimiserConfig(method="muon")), optax.scale_by_adam(nesterov=True)
    found, expected = (method.update(gradients, method.init(weights), weights)[0] for method in (of_muon, nadam))
    for name in ("head", "bias"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-5)
    for name, rows in (("kernel", 72), ("matrix", 40)):
        step, gradient = (np.asarray(tree[name]).reshape(rows, -1) for tree in (found, gradients))
        left, _, right = np.linalg.svd(gradient, full_matrices=False)
        along = left.T @ step @ right.T / (0.2 * np.sqrt(rows))
        assert (np.diag(along) > 0.6).all()  # Newton and Schulz's five steps come near 1, not closer
        assert (np.diag(along) < 1.3).all()
        np.testing.assert_allclose(along - np.diag(np.diag(along)), 0, atol=0.02)


def test_muon_steps_are_those_of_optax(random):
    """Also where a matrix is wide, and where its singular values are far apart."""
    shapes = {"tall": (3, 3, 8, 32), "wide": (40, 90), "bias": (24,)}
    weights = {name: jnp.zeros(shape) for name, shape in shapes.items()}
    ours = descent(OptimiserConfig(method="muon"))
    theirs = muon(-1.0, consistent_rms=0.2, muon_weight_dimension_numbers=lambda tree: jax.tree.map(_as_matrix, tree))
    states = ours.init(weights), theirs.init(weights)
    assert jax.tree.structure(states[0]) == jax.tree.structure(states[1])
    for _ in range(3):
        spread = np.logspace(0, -4, 24)
        gradients = {
            name: jnp.asarray(random.normal(size=shape) * np.resize(spread, shape[-1]), jnp.float32)
            for name, shape in shapes.items()
        }
        (found, mine), (expected, other) = (
            method.update(gradients, state, weights) for method, state in zip((ours, theirs), states, strict=True)
        )
        states = mine, other
        for name in shapes:
            np.testing.assert_allclose(found[name], expected[name], atol=1e-3)


def test_schedules_end_where_they_are_beyond_two_thousand_million_samples():
    task = EntropyTask.of(TINY.entropy, 6, 5.0, TINY.dataset.capture)
    rate = learning_rate(OptimiserConfig(batch_size=64, schedule="steps"), 0)
    for step in (2**25, 2**26, 2**31 - 1):
        samples = samples_before(jnp.int32(step), 64)
        assert int(samples) == min(step * 64, (2**31 - 1) // 64 * 64)
        assert float(task.momentum(samples)) == pytest.approx(0.01)
        assert float(rate(jnp.int32(step), 1e-3)) == pytest.approx(1e-5)


def test_schedules():
    steps = learning_rate(OptimiserConfig(batch_size=32, schedule="steps"), 0)
    assert float(steps(jnp.int32(0), 1e-3)) == pytest.approx(1e-3)
    assert float(steps(jnp.int32(20_000 // 32 - 1), 1e-3)) == pytest.approx(1e-3)
    assert float(steps(jnp.int32(20_000 // 32 + 1), 1e-3)) == pytest.approx(0.7e-3)
    assert float(steps(jnp.int32(10**6), 1e-3)) == pytest.approx(1e-5)
    cosine = learning_rate(OptimiserConfig(schedule="cosine"), 1000)
    assert float(cosine(jnp.int32(1000), 1e-3)) == pytest.approx(0, abs=1e-9)
    assert float(cosine(jnp.int32(100), 1e-3)) == pytest.approx(1e-3)
    assert float(cosine(jnp.int32(100), 1e-2)) == pytest.approx(1e-2)
    assert float(learning_rate(OptimiserConfig(), 10)(jnp.int32(7), 1e-2)) == pytest.approx(1e-2)
    task = EntropyTask.of(TINY.entropy, 6, 4.0, TINY.dataset.capture)
    assert float(task.momentum(jnp.int32(0))) == 0.5
    assert float(task.momentum(jnp.int32(45_000))) == 0.125
    assert float(task.momentum(jnp.int32(10**6))) == pytest.approx(0.01)
