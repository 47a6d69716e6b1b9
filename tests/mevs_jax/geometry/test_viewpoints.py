"""Lattices, view graphs and local maxima, against the thesis's own and against loops."""

from __future__ import annotations

import inspect
import json
from typing import get_args

import numpy as np
import pytest

from data_pipeline.capture.casting import CaptureConfig
from mevs_jax import (
    ViewGraph,
    fibonacci_sphere,
    local_maxima,
    nested_lattice,
    platonic_solid,
    ring_lattice,
    viewpoint_lattice,
)
from mevs_jax.geometry.viewpoints import SOLIDS, Lattice
from tests.reference import numpy_rules

# The spherical Delaunay graph of the published 10-view lattice, checked by hand against the hull's 3n − 6 = 24 edges.
EDGES_10 = "0-1 0-2 0-3 0-4 0-5 1-3 1-4 1-6 2-4 2-5 2-7 3-5 3-6 3-8 4-6 4-7 4-9 5-7 5-8 5-9 6-8 6-9 7-9 8-9"
# Thesis Fig. 21: nodes A..J with these weights and edges has the maxima E, D, C and I.
FIGURE_21_WEIGHTS = dict(zip("ABCDEFGHIJ", (5, 8, 31, 7, 35, 6, 4, 24, 11, 10), strict=True))
FIGURE_21_EDGES = "AB AC AD BC BE CF CG DG EF EH EJ FI GJ"
# The author's measured 10-view map: θ and φ in degrees, entropy in bits.
AUTHOR_MAP_10 = [
    (156, 36, 1.37922013867174),
    (90, 180, 0.52175277589393),
    (90, 360, 0.45548316492884),
    (80, 96, 1.82280544551979),
    (102, 323, 1.73852709715075),
    (58, 278, 2.2881577521407),
    (138, 240, 1.54942298195957),
    (42, 35, 1.68800060774538),
    (34, 187, 0.99259078663013),
    (115, 149, 1.70055628535647),
]


def edges_of(graph: ViewGraph) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in np.argwhere(np.triu(np.asarray(graph.neighbours)))}


def points_at(angles: np.ndarray) -> np.ndarray:
    theta, phi = np.radians(angles).T
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


def test_the_default_lattice_is_the_published_codes():
    points = fibonacci_sphere(10)
    np.testing.assert_allclose(points[[0, -1]], [[1, 0, 0], [-1, 0, 0]], atol=1e-12)  # poles on ±x
    np.testing.assert_allclose(points[1], [0.777777777778, -0.463465363489, 0.424572237954], atol=1e-9)


@pytest.mark.parametrize("variant", ["golden_angle", "equation8"])
@pytest.mark.parametrize("count", [2, 10, 40, 200])
def test_lattices_are_unit_vectors_evenly_spread(variant, count):
    points = fibonacci_sphere(count, variant)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-12)
    if count >= 40:
        distances = np.arccos(np.clip(points @ points.T, -1, 1)) + 10 * np.eye(count)
        nearest = distances.min(axis=1)
        assert nearest.min() > 0.5 * np.sqrt(4 * np.pi / count)
        assert nearest.max() < 1.5 * np.sqrt(4 * np.pi / count)


def test_equation_8_is_the_formula_of_the_text():
    n, golden = 7, (1 + np.sqrt(5)) / 2
    for i, point in enumerate(fibonacci_sphere(n, "equation8")):
        x, y = i / n, i / golden
        theta, phi = np.arccos(2 * x - 1) - np.pi / 2, 2 * np.pi * y
        expected = [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)]
        np.testing.assert_allclose(point, expected, atol=1e-12)


@pytest.mark.parametrize(("name", "edge_count"), [("tetrahedron", 6), ("octahedron", 12), ("icosahedron", 30)])
def test_solids_of_triangles_have_their_own_edges(name, edge_count):
    graph = ViewGraph.from_points(platonic_solid(name))
    assert len(edges_of(graph)) == edge_count
    assert len(set(np.asarray(graph.neighbours).sum(axis=1))) == 1


@pytest.mark.parametrize("name", list(SOLIDS))
def test_solids_look_the_same_from_every_corner(name):
    corners = platonic_solid(name)
    assert corners.shape == (SOLIDS[name], 3)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), 1, atol=1e-12)
    distances = np.sort(np.linalg.norm(corners[:, None] - corners[None], axis=-1), axis=1)
    np.testing.assert_allclose(distances, np.tile(distances[:1], (len(corners), 1)), atol=1e-9)
    assert (np.diff(corners[:, 2]) <= 1e-9).all()
    graph = ViewGraph.from_points(corners)
    assert len(edges_of(graph)) == 3 * len(corners) - 6  # flat faces are cut into triangles


def test_rings_are_level_and_evenly_spaced():
    points = ring_lattice(60).reshape(5, 12, 3)
    np.testing.assert_allclose(
        np.degrees(np.arcsin(points[:, :, 2])), np.tile([[60], [30], [0], [-30], [-60]], 12), atol=1e-9
    )
    turn = np.degrees(np.arctan2(points[:, :, 1], points[:, :, 0])) % 360
    np.testing.assert_allclose(turn, np.tile(30 * np.arange(12), (5, 1)), atol=1e-9)


def test_nested_lattices_are_each_others_beginnings_and_well_spread():
    forty = nested_lattice(40)
    for count in (2, 10, 25):
        np.testing.assert_array_equal(nested_lattice(count), forty[:count])
    for count in (10, 40):
        nearest, even = (
            (np.linalg.norm(points[:, None] - points[None], axis=-1) + 10 * np.eye(count)).min()
            for points in (forty[:count], fibonacci_sphere(count))
        )
        assert nearest > 0.8 * even


@pytest.mark.parametrize(
    ("count", "lattice", "message"),
    [
        (10, "cube", "8 viewpoints, not 10"),
        (12, "rings", "multiple of 5"),
        (1, "nested", "between 2"),
    ],
)
def test_impossible_lattices_are_described(count, lattice, message):
    with pytest.raises(ValueError, match=message):
        viewpoint_lattice(count, lattice)


def test_the_capture_settings_offer_every_lattice():
    described = inspect.getsource(CaptureConfig).split("lattice: str")[1].split("turned: bool")[0]
    assert all(name.replace("rings", "five rings") in described for name in get_args(Lattice))


def test_the_10_view_graph():
    expected = {tuple(map(int, edge.split("-"))) for edge in EDGES_10.split()}
    assert edges_of(ViewGraph.from_points(fibonacci_sphere(10))) == expected


@pytest.mark.parametrize("count", [5, 10, 40])
def test_the_graph_is_the_convex_hull(count):
    points = fibonacci_sphere(count)
    edges = edges_of(ViewGraph.from_points(points))
    assert edges == numpy_rules.hull_edges(points)
    assert len(edges) == 3 * count - 6


@pytest.mark.parametrize("count", [10, 40])
def test_the_graph_equals_the_thesis_files(count, thesis_files):
    stored = json.loads((thesis_files / f"view_graph_{count}.json").read_text())
    np.testing.assert_allclose(fibonacci_sphere(count), stored["points"], atol=1e-9)
    edges = edges_of(ViewGraph.from_points(fibonacci_sphere(count)))
    assert edges == {tuple(sorted(edge)) for edge in stored["edges"]}


def test_distances_are_great_circles():
    graph = ViewGraph.from_points(np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0]]))
    np.testing.assert_allclose(graph.distances, np.array([[0, 0.5, 1], [0.5, 0, 0.5], [1, 0.5, 0]]) * np.pi, atol=1e-6)
    assert np.asarray(graph.neighbours).sum() == 6


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.array([[1.0, 0, 0]]), "at least 2"),
        (np.array([[1.0, 0, 0], [0, 2, 0]]), "unit"),
        (np.array([[1.0, 0, 0], [1, 0, 0]]), "coincide"),
        (np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]), "plane"),
    ],
)
def test_unusable_viewpoints_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        ViewGraph.from_points(points)


def test_local_maxima_of_figure_21():
    names = list(FIGURE_21_WEIGHTS)
    neighbours = np.zeros((10, 10), bool)
    for a, b in FIGURE_21_EDGES.split():
        i, j = names.index(a), names.index(b)
        neighbours[i, j] = neighbours[j, i] = True
    maxima = local_maxima(np.array(list(FIGURE_21_WEIGHTS.values()), np.float32), neighbours)
    assert {name for name, is_maximum in zip(names, maxima, strict=True) if is_maximum} == set("EDCI")


def test_local_maxima_of_the_authors_10_view_map():
    angles, weights = np.array(AUTHOR_MAP_10)[:, :2], np.array(AUTHOR_MAP_10)[:, 2].astype(np.float32)
    graph = ViewGraph.from_points(points_at(angles))
    maxima = np.asarray(local_maxima(weights, graph.neighbours))
    np.testing.assert_array_equal(maxima, numpy_rules.local_maxima(weights, np.asarray(graph.neighbours)))
    assert maxima[np.argmax(weights)]


def test_local_maxima_of_both_of_the_authors_maps(thesis_files):
    for rows in json.loads((thesis_files / "author_entropy_maps.json").read_text()).values():
        angles, weights = np.array(rows)[:, :2], np.array(rows)[:, 2].astype(np.float32)
        graph = ViewGraph.from_points(points_at(angles))
        maxima = np.asarray(local_maxima(weights, graph.neighbours))
        np.testing.assert_array_equal(maxima, numpy_rules.local_maxima(weights, np.asarray(graph.neighbours)))
        assert 1 <= maxima.sum() <= len(rows) // 3


def test_equal_neighbours_exclude_each_other():
    neighbours = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], bool)
    np.testing.assert_array_equal(
        local_maxima(np.array([2.0, 2.0, 1.0], np.float32), neighbours), [False, False, False]
    )
    np.testing.assert_array_equal(local_maxima(np.array([2.0, 1.0, 2.0], np.float32), neighbours), [True, False, True])


def test_local_maxima_where_only_one_of_two_views_counts_the_other(random):
    """As where a neighbour cannot be reached."""
    for _ in range(20):
        weights, neighbours = random.random(9).astype(np.float32), random.random((9, 9)) < 0.3
        np.testing.assert_array_equal(local_maxima(weights, neighbours), numpy_rules.local_maxima(weights, neighbours))


@pytest.mark.parametrize("lowest", [-0.1, 0.0, 0.3])
def test_opposite_views_of_a_hemisphere_are_no_neighbours(lowest):
    """The hull of viewpoints on one side is closed by faces that are none of the sphere."""
    points = fibonacci_sphere(80, "equation8")
    points = points[points[:, 2] > lowest]
    graph = ViewGraph.from_points(points)
    apart = np.asarray(graph.distances)[np.asarray(graph.neighbours)]
    whole = ViewGraph.from_points(fibonacci_sphere(80, "equation8"))
    widest = np.asarray(whole.distances)[np.asarray(whole.neighbours)].max()
    assert apart.max() < 2.5 * widest
    assert np.asarray(graph.neighbours).any(axis=1).all()
    np.testing.assert_array_equal(graph.neighbours, np.asarray(graph.neighbours).T)


def test_a_ring_on_the_equator_below_a_cap_keeps_its_own_edges():
    angle = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1)
    graph = ViewGraph.from_points(np.concatenate([ring, [[0, 0, 1]]]))
    expected = {(i, 8) for i in range(8)} | {(i, i + 1) for i in range(7)} | {(0, 7)}
    assert edges_of(graph) == expected


@pytest.mark.parametrize("variant", ["golden_angle", "equation8", "nested"])
@pytest.mark.parametrize("count", [4, 5, 6, 7, 9, 13, 40])
def test_viewpoints_all_around_have_all_edges_of_their_hull(variant, count):
    """Also so few that faces of the hull are as far around as the origin."""
    assert len(edges_of(ViewGraph.from_points(viewpoint_lattice(count, variant)))) == 3 * count - 6


@pytest.mark.parametrize("pair", [(0, 0), (0, 5), (-1, 2)])
def test_neighbours_that_do_not_exist_are_refused(pair):
    with pytest.raises(ValueError, match="cannot be neighbours: the 5 views are 0 to 4"):
        ViewGraph.from_points(fibonacci_sphere(5), [pair])
