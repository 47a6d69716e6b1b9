"""Beliefs along the walks of the learned study."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.learned.walks import beliefs_of
from tests.reference.choosing import VIEWS, some_features


@pytest.mark.parametrize("posed", [True, False])
def test_beliefs_along_walks_are_those_of_the_views_seen(fusion, posed):
    """Two walks of four views; the fusion is asked for the views of each step, among absent ones."""
    data, fusion = some_features(3), replace(fusion, posed=posed)
    views = np.stack(
        [[np.random.default_rng((at, walk)).permutation(VIEWS)[:4] for walk in range(2)] for at in range(3)]
    )
    found = beliefs_of(fusion, data, views)
    assert found.shape == (3, 2, 4, data.logits.shape[-1])
    ask = jax.jit(lambda *views: fusion(*views))  # the fusion itself cannot be hashed
    for at, walk, step in np.ndindex(3, 2, 4):
        order = jnp.asarray(views[at, walk])
        expected = ask(data.features[at][order], data.directions[at][order], jnp.arange(4) <= step)
        np.testing.assert_allclose(found[at, walk, step], expected, atol=1e-5)
