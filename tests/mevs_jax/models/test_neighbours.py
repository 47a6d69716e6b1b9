"""The kernel of a level of PointNet++ gives what the array program gives, and its gradient."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax.models.neighbours import largest_by_kernel, largest_of_neighbours
from mevs_jax.points import kernels


@pytest.mark.parametrize(
    ("columns", "passed", "widths"),
    [(3, False, (16, 32, 32)), (6, False, (16, 128)), (32, True, (32, 16, 128)), (64, True, (64, 256))],
)
def test_the_kernel_gives_the_same_maxima(columns, passed, widths, random):
    """Interpreted, since there need not be a GPU; batched as in the networks."""
    draw = lambda *shape: random.normal(0, 1, shape).astype(np.float32)  # noqa: E731
    points, offsets = draw(2, 50, columns), draw(2, 7, columns)
    neighbours = random.integers(0, 50, (2, 7, 16)).astype(np.int32)
    sizes = [columns, *widths]
    layers = [array for a, b in zip(sizes, widths, strict=False) for array in (draw(a, b), draw(b), draw(b))]
    given = [jnp.asarray(array) for array in (points, offsets, neighbours, *layers[passed:])]
    on = lambda function: jax.vmap(lambda *own: function(*own, *given[3:]))(*given[:3])  # noqa: E731
    expected = on(partial(largest_of_neighbours, k=int(passed)))
    np.testing.assert_allclose(
        on(partial(kernels.largest_of_neighbours, k=int(passed), interpret=True)), expected, rtol=1e-5, atol=1e-4
    )
    np.testing.assert_allclose(on(partial(largest_by_kernel, int(passed))), expected, rtol=1e-5, atol=1e-4)
    alone = [array[0] for array in given[:3]] + given[3:]
    moved = lambda f: jax.jit(jax.grad(lambda *given: jnp.sum(f(*given))))(*alone)  # noqa: E731
    slopes = moved(partial(largest_by_kernel, int(passed))), moved(partial(largest_of_neighbours, k=int(passed)))
    np.testing.assert_allclose(*slopes, rtol=1e-5, atol=1e-4)
