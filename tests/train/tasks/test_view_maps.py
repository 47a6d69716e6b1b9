"""Outputs and layers of predictors equal slow references, and training reads the values that are meant."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from data_pipeline.dataset.batches import ViewBatches, target_path, train_batches, validation_batches
from data_pipeline.dataset.index import read_index
from mevs_jax import ViewGraph, fibonacci_sphere
from mevs_jax.models import Abstraction
from train.results.kept import kept_array
from train.tasks.vector_neurons import VectorPointNet2
from train.tasks.view_maps import DEGREE, GraphOutput, HarmonicOutput

VIEWS = 8
POINTS = fibonacci_sphere(VIEWS)
VIEWPOINTS = tuple(map(tuple, POINTS.tolist()))


def real_harmonic(n: int, m: int, point: np.ndarray) -> float:
    value = sph_harm_y(n, abs(m), np.arccos(point[2]), np.arctan2(point[1], point[0]))
    return float(value.real if m == 0 else np.sqrt(2) * (value.real if m > 0 else value.imag))


def test_harmonics_are_summed_with_predicted_coefficients(random):
    output = HarmonicOutput(6, VIEWPOINTS, rngs=nnx.Rngs(0))
    x = random.normal(size=(3, 6)).astype(np.float32)
    layer = output.coefficients
    coefficients = x @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])
    orders = [(n, m) for n in range(DEGREE + 1) for m in range(-n, n + 1)]
    expected = [
        [sum(c * real_harmonic(*order, point) for c, order in zip(row, orders, strict=True)) for point in POINTS]
        for row in coefficients
    ]
    np.testing.assert_allclose(output(jnp.asarray(x)), expected, atol=1e-5)


def test_views_hear_the_mean_of_their_neighbours(random):
    graph = ViewGraph.from_points(POINTS)
    output = GraphOutput(6, VIEWPOINTS, tuple(map(tuple, np.asarray(graph.neighbours).tolist())), rngs=nnx.Rngs(1))
    x = random.normal(size=(2, 6)).astype(np.float32)

    def apply(layer: nnx.Linear, values: np.ndarray) -> np.ndarray:
        out = values @ np.asarray(layer.kernel[...])
        return out if layer.bias is None else out + np.asarray(layer.bias[...])

    def relu(values: np.ndarray) -> np.ndarray:
        return np.maximum(values, 0)

    for cloud, found in zip(x, np.asarray(output(jnp.asarray(x))), strict=True):
        places = [
            np.array([real_harmonic(n, m, point) for n in range(4) for m in range(-n, n + 1)]) for point in POINTS
        ]
        nodes = [relu(apply(output.cloud, cloud) + apply(output.place, place)) for place in places]
        for own, heard in zip(output.own, output.heard, strict=True):
            means = [
                np.mean([nodes[other] for other in np.flatnonzero(graph.neighbours[v])], axis=0) for v in range(VIEWS)
            ]
            nodes = [
                node + relu(apply(own, node) + apply(heard, mean)) for node, mean in zip(nodes, means, strict=True)
            ]
        np.testing.assert_allclose(found, [apply(output.out, node)[0] for node in nodes], atol=1e-4)


@pytest.mark.filterwarnings("ignore:scatter inputs have incompatible types")  # statistics stay float32
@pytest.mark.parametrize("train", [True, False])
def test_vector_neurons_turn_with_the_cloud(train, random):
    network = VectorPointNet2(
        viewpoints=VIEWPOINTS,
        abstractions=(Abstraction(24, 0.6, 8, (12, 18)), Abstraction(8, 1.0, 8, (18, 24))),
        global_layers=(24, 36),
        head_layers=(24, 18),
        dropout=0.0,
        rngs=nnx.Rngs(2),
    )
    cloud = random.normal(size=(3, 80, 2, 3))
    cloud /= np.linalg.norm(cloud, axis=-1, keepdims=True)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()

    def hidden(points: np.ndarray, directions: np.ndarray, **how) -> np.ndarray:
        return np.asarray(network.hidden(jnp.asarray(points.reshape(3, 80, 6)), jnp.asarray(directions), **how))

    with jax.enable_x64(True):  # lengths of vectors of length zero, as from a point to itself, are all rounding
        hidden(cloud, POINTS, train=True, momentum=0.7)  # for statistics that are not the initial ones
        expected = hidden(cloud, POINTS, train=train)
        np.testing.assert_allclose(hidden(cloud @ turn.T, POINTS @ turn.T, train=train), expected, atol=1e-6)
        assert np.abs(hidden(cloud @ turn.T, POINTS, train=train) - expected).max() > 0.05
    single = jnp.asarray(cloud.reshape(3, 80, 6), jnp.float32)
    assert network(single, train=train, key=jax.random.key(0)).shape == (3, VIEWS)


def test_training_reads_other_values_of_the_same_views(data, tmp_path):
    folder = shutil.copytree(data, tmp_path / "data")
    for split in ("train", "val"):
        values = 2 * read_index(folder, split, "entropy")["entropy"] + 1
        kept_array(target_path(folder, "double", split), "made up", lambda values=values: values)
    thesis = ViewBatches(batch_size=8, views_per_object=2, points=16)
    other = replace(thesis, target="double")
    for read in (
        lambda config: islice(train_batches(folder, config), 9),
        lambda config: validation_batches(folder, config, 2),
    ):
        for was, now in zip(read(thesis), read(other), strict=True):
            np.testing.assert_allclose(now.pop("entropy"), 2 * was.pop("entropy") + 1, rtol=1e-6)
            for name, array in was.items():
                np.testing.assert_array_equal(now[name], array)
