"""The gradient of a product with weights, in the form for each platform."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax.models.product import product


@pytest.mark.parametrize("platform", ["tpu", "default"])
@pytest.mark.parametrize("shape", [(3, 5, 7, 4), (6, 4)])
def test_gradients_are_sums_over_all_rows(shape, platform, random, monkeypatch):
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *given, **programs: programs[platform](*given))
    x, kernel = (jnp.asarray(random.normal(size=size), jnp.float32) for size in (shape, (4, 2)))
    out, pull = jax.vjp(product, x, kernel)
    cotangent = jnp.asarray(random.normal(size=out.shape), jnp.float32)
    of_x, of_kernel = pull(cotangent)
    np.testing.assert_allclose(of_x, cotangent @ kernel.T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(of_kernel, x.reshape(-1, 4).T @ cotangent.reshape(-1, 2), rtol=1e-4, atol=1e-5)
