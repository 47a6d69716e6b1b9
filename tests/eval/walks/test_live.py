"""With the networks inside the loop, the same views are walked as from tables."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from data_pipeline.capture.casting import CaptureConfig
from eval.walks.knowledge import learn
from eval.walks.live import Captures, Networks, walk_each
from mevs_jax import POLICIES, ViewGraph, ViewTable, fibonacci_sphere, select_from_table
from mevs_jax.selection.walks import walk_key
from train.tasks.classifier import ClassifierConfig, ClassifierTask, ResNetConfig
from train.tasks.entropy import EntropyConfig, EntropyTask, PointNet2Config

OBJECTS, VIEWS, CLASSES, SIDE, POINTS = 512, 8, 4, 8, 24
CAMERA = CaptureConfig(views=VIEWS, resolution=SIDE)


class Flat(nnx.Module):
    """One layer over everything, whatever its shape: compiled in no time, and every pixel or point counts."""

    def __init__(self, inputs: int, outputs: int, scale: float, seed: int):
        self.layer = nnx.Linear(inputs, outputs, rngs=nnx.Rngs(seed))
        self.scale = scale

    def __call__(self, batch: jax.Array) -> jax.Array:
        return self.scale * self.layer(batch.reshape(batch.shape[0], -1))


@pytest.fixture(scope="module")
def networks() -> Networks:
    classify = ClassifierTask.of(ClassifierConfig(network=ResNetConfig(channels=1)), CLASSES, CAMERA)
    predict = EntropyTask.of(EntropyConfig(network=PointNet2Config(points=POINTS)), VIEWS, 5.0, CAMERA)
    # Scaled up: untrained, it would say nearly the same of every view, and rounding would choose.
    return Networks(classify, Flat(SIDE * SIDE, CLASSES, 5.0, 0), predict, Flat(6 * POINTS, VIEWS, 1.0, 1))


@pytest.fixture(scope="module")
def captures() -> Captures:
    random = np.random.default_rng(0)
    depth = random.integers(15_000, 35_000, (OBJECTS, VIEWS, SIDE, SIDE)).astype(np.uint16)
    pixels = random.integers(0, SIDE * SIDE, (OBJECTS, VIEWS, POINTS)).astype(np.int32)
    seen = np.take_along_axis(depth.reshape(OBJECTS, VIEWS, -1), pixels, axis=-1)
    pose = np.tile(np.eye(4, dtype=np.float32), (OBJECTS, VIEWS, 1, 1))
    return Captures(
        jnp.asarray(depth), jax.tree.map(jnp.asarray, {"pixels": pixels, "pixel_depth": seen, "pose": pose})
    )


@pytest.fixture(scope="module")
def tables(networks, captures) -> ViewTable:
    """Made as the study makes them: all views of one object in a batch."""

    def look(captured: Captures):
        logits = networks.classifier(networks.classify.inputs({networks.classify.images: captured.images}))
        return logits, networks.predictor(networks.predict.inputs(captured.clouds))

    random = np.random.default_rng(1)
    logits, predicted_entropy = jax.jit(lambda captures: jax.lax.map(look, captures))(captures)
    return ViewTable(
        logits,
        predicted_entropy,
        jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS)), jnp.float32),
        jnp.asarray(random.integers(0, CLASSES, OBJECTS), jnp.int32),
    )


def both_ways(networks, captures, tables, policy, threshold=None):
    graph = ViewGraph.from_points(fibonacci_sphere(VIEWS))
    knowledge = learn(tables.logits[:100], tables.label[:100])
    numbers, key = jnp.arange(OBJECTS, dtype=jnp.int32), jax.random.key(0)
    starts = numbers % VIEWS
    scenes = jax.vmap(lambda table: table.scene(graph, knowledge))(tables)
    limits = {"max_views": 5, "threshold": threshold}
    some = numbers, captures, scenes, starts
    live = walk_each(key, some, POLICIES[policy], networks, at_once=OBJECTS, **limits)

    @jax.jit
    @jax.vmap
    def by_table(number, table, start):
        own, scene = walk_key(key, number, start, 0), table.scene(graph, knowledge)
        return select_from_table(own, table, scene, POLICIES[policy], start, **limits)

    return live, by_table(numbers, tables, starts)


@pytest.mark.parametrize("policy", [name for name in POLICIES if not name.startswith("diff_")])
def test_live_and_table_walk_the_same_views(networks, captures, tables, policy):
    """Networks round other in batches of another size, which decides between views of nearly equal scores: one walk in 200."""
    live, stored = both_ways(networks, captures, tables, policy)
    same = np.all(np.asarray(live.views == stored.views), axis=1)
    assert same.mean() > 0.99
    np.testing.assert_allclose(live.confidences[same], stored.confidences[same], atol=1e-5)
    assert (np.asarray(live.count) == 5).all()


def test_live_walks_stop_when_they_are_sure(networks, captures, tables):
    middle = float(np.median(both_ways(networks, captures, tables, "predicted_entropy")[1].confidences[:, 2]))
    live, stored = both_ways(networks, captures, tables, "predicted_entropy", threshold=middle)
    assert np.all(np.asarray(live.views == stored.views), axis=1).mean() > 0.99
    assert len(set(np.asarray(live.count).tolist())) > 2


def test_live_walks_look_at_the_images_and_clouds(networks, captures, tables):
    """Other captures, other walks: nothing is read from the tables but what oracles are told."""
    other = Captures(captures.images[::-1], jax.tree.map(lambda leaf: leaf[::-1], captures.clouds))
    live, stored = both_ways(networks, other, tables, "predicted_entropy")
    assert (np.asarray(live.views) != np.asarray(stored.views)).any(axis=1).mean() > 0.3
    assert np.abs(np.asarray(live.confidences) - np.asarray(stored.confidences)).max() > 1e-3
