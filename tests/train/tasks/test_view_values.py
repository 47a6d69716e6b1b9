"""Values of views equal slow references."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax.geometry.cameras import ViewCamera
from train.tasks.view_values import EDGE, FLOOR, confidence_of_truth, edge_content, mean_gain, visible_area

CAMERA = ViewCamera(12)


def some_depth(random) -> np.ndarray:
    """An image with steps of every size and background."""
    depth = 2 + np.cumsum(random.normal(0, 0.08, (12, 12)), axis=1)
    return np.where(random.random((12, 12)) < 0.2, 0, depth).astype(np.float32)


def differ(a: float, b: float) -> bool:
    return (a > 0) != (b > 0) or abs(a - b) > EDGE


def test_edge_content_counts_pairs_of_adjacent_pixels(random):
    depth = some_depth(random)
    pairs = [(depth[r, c], depth[r, c + 1]) for r in range(12) for c in range(11)]
    pairs += [(depth[r, c], depth[r + 1, c]) for r in range(11) for c in range(12)]
    expected = np.mean([differ(*pair) for pair in pairs])
    assert 0.2 < expected < 0.9
    assert float(edge_content(depth)) == pytest.approx(expected, abs=1e-6)
    assert float(edge_content(np.zeros((12, 12), np.float32))) == 0


def test_visible_area_is_that_of_quads_of_one_surface(random):
    depth, focal = some_depth(random), 6 / np.tan(np.pi / 6)
    point = {(r, c): depth[r, c] * np.array([(c - 5.5) / focal, (r - 5.5) / focal, 1]) for r, c in np.ndindex(12, 12)}
    expected = 0.0
    for r, c in np.ndindex(11, 11):
        corners = [(r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)]
        sides = zip(corners, [*corners[1:], corners[0]], strict=True)
        if all(depth[one] > 0 for one in corners) and not any(differ(depth[a], depth[b]) for a, b in sides):
            a, b, c_, d = (point[one] for one in corners)
            expected += np.linalg.norm(np.cross(c_ - a, d - b)) / 2
    assert expected > 0.05
    assert float(visible_area(depth, CAMERA)) == pytest.approx(expected, rel=1e-4)


def test_a_tilted_plane_has_its_own_area_and_not_that_of_its_image():
    camera, tilt = ViewCamera(64), np.radians(30)
    offset = (np.arange(64) - 31.5) / (32 / np.tan(np.pi / 6))
    depth = np.broadcast_to(2 / (1 - np.tan(tilt) * offset), (64, 64)).astype(np.float32)  # z = 2 + tan(tilt) x
    x = depth * offset
    step = np.diff(x, axis=1)[:-1]  # trapezia between pixel columns, whose heights grow with depth
    heights = (depth[0, 1:] + depth[0, :-1]) / 2 * (offset[1] - offset[0])
    expected = float((step * heights).sum() / np.cos(tilt))
    assert float(visible_area(depth, camera)) == pytest.approx(expected, rel=1e-3)


def test_confidence_and_gain_equal_sums_over_pairs_of_views(random):
    logits, label = random.normal(0, 2, (5, 3)).astype(np.float32), 1

    def probability(belief: np.ndarray) -> float:
        return float(np.exp(belief[label]) / np.exp(belief).sum())

    single = [probability(one) for one in logits]
    np.testing.assert_allclose(confidence_of_truth(logits, jnp.int32(label)), single, rtol=1e-5)
    expected = [
        np.mean(
            [
                np.log(probability(logits[first] + logits[second]) + FLOOR) - np.log(single[first] + FLOOR)
                for first in range(5)
                if first != second
            ]
        )
        for second in range(5)
    ]
    np.testing.assert_allclose(mean_gain(logits, jnp.int32(label)), expected, atol=1e-5)
