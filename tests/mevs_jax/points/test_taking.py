"""Rows taken by products, as on a TPU, beside NumPy's indexing."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax.points.taking import take_rows


@pytest.mark.parametrize(("rows", "columns", "taken"), [(300, 3, 90), (70, 130, 200), (5, 1, 4), (128, 6, 1)])
def test_products_take_the_same_rows_and_add_the_same_gradients(rows, columns, taken, random, monkeypatch):
    values = random.normal(size=(2, rows, columns)).astype(np.float32) * 10.0 ** random.integers(
        -9, 9, (2, rows, columns)
    )
    values, indices = jnp.asarray(values, jnp.float32), random.integers(0, rows, (2, taken)).astype(np.int32)
    cotangent = random.normal(size=(2, taken, columns)).astype(np.float32)
    added = np.zeros(values.shape)
    for cloud in range(2):
        np.add.at(added[cloud], indices[cloud], cotangent[cloud])
    for platform in ("default", "tpu"):
        with monkeypatch.context() as patched:
            patched.setattr(jax.lax, "platform_dependent", lambda *given, of=platform, **programs: programs[of](*given))
            found, pull = jax.vjp(jax.vmap(lambda cloud, of_cloud: take_rows(cloud, of_cloud)), values, indices)
            gradient = pull(cotangent)[0]
        np.testing.assert_array_equal(found, np.stack([values[cloud][indices[cloud]] for cloud in range(2)]))
        np.testing.assert_allclose(gradient, added, rtol=1e-5, atol=1e-6)


def test_only_a_tpu_takes_rows_by_products():
    shapes = jax.ShapeDtypeStruct((40, 3), jnp.float32), jax.ShapeDtypeStruct((9,), jnp.int32)
    traced = jax.jit(take_rows).trace(*shapes)
    for platform, gathers in (("cpu", True), ("cuda", True), ("tpu", False)):
        text = traced.lower(lowering_platforms=(platform,)).as_text()
        assert ("stablehlo.gather" in text or "stablehlo.dynamic_gather" in text) == gathers, platform
        assert ("stablehlo.dot_general" in text) != gathers, platform
