"""Where climbs end becomes an order of candidate views, and tables of it that the evaluation reads."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.sources import load_object
from eval.rendering.policies import RenderingConfig, chosen_objects, scores_of_object, view_scores
from eval.walks.ladder import BY_ASCENT
from mevs_jax import cameras_at, fibonacci_sphere, rendering
from tests.conftest import open3d_or_skip

VIEWS = 12


def test_distinct_optima_come_first_in_their_order_each_as_its_nearest_candidate(random):
    points, scored = fibonacci_sphere(VIEWS), jax.jit(view_scores)
    for _ in range(20):
        optima = random.normal(size=(5, 3))
        optima /= np.linalg.norm(optima, axis=1, keepdims=True)
        twins = np.concatenate([optima, optima + random.normal(scale=1e-3, size=optima.shape)])
        values = np.concatenate([random.permutation(5), np.full(5, -1.0)])
        scores = np.asarray(scored(cameras_at(twins).pose, jnp.asarray(values), jnp.asarray(points)))
        kept, expected = [], []
        for at in np.argsort(-values, kind="stable"):
            if all(np.arccos(np.clip(twins[at] @ twins[other], -1, 1)) > 0.2 for other in kept):
                kept.append(at)
                nearest = np.argsort(-(points @ twins[at]))
                expected.append(next(int(view) for view in nearest if view not in expected))
        rest = [int(view) for view in np.argsort(-(points @ twins[kept[0]])) if view not in expected]
        assert np.argsort(-scores, kind="stable").tolist() == [*expected, *rest]


def test_objects_are_spread_evenly_and_never_twice():
    assert chosen_objects(RenderingConfig(objects=3), 11).tolist() == [0, 5, 10]
    assert chosen_objects(RenderingConfig(objects=30), 4).tolist() == [0, 1, 2, 3]


def views_of(mesh: Mesh, views: int, side: int) -> tuple[np.ndarray, np.ndarray]:
    cameras = cameras_at(fibonacci_sphere(views), resolution=side)
    images, render_depth = [], jax.jit(rendering.render_depth)
    for pose in cameras.pose:
        depth = np.asarray(render_depth(mesh.vertices[mesh.faces], cameras.replace(pose=pose)).depth)
        images.append(np.where(np.isfinite(depth), depth, 0))
    return np.stack(images), np.asarray(cameras.pose)


@pytest.mark.slow
def test_an_object_gets_a_row_for_every_view_and_what_shows_nothing_is_counted():
    open3d_or_skip()
    views = 6
    mesh = load_object(ObjectEntry("chair", 0, "test", FurniturePiece("chair", 3)))
    depth, poses = views_of(mesh, views, 32)
    depth[4] = 0  # as if the object were out of sight
    config = RenderingConfig(starts=2, resolution=16, faces=64)
    found = scores_of_object(mesh, depth, poses, np.pi / 3, jnp.asarray(fibonacci_sphere(views)), config)
    assert found.pop("without_surface") == 1
    assert set(found) == {policy.name for policy in BY_ASCENT}
    for name, rows in found.items():
        assert rows.shape == (views, views)
        assert np.isfinite(rows).all()
        same = (np.argmax(rows, axis=1) == np.argmax(rows[0])).all()
        assert same == name.endswith("_whole")  # the whole object is the same after every view
