"""Viewpoints from a file: what is read, what is refused, and what identifies them."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from data_pipeline.capture.casting import CaptureConfig, rig_for
from data_pipeline.capture.viewpoints import FILE, identified, read_viewpoints, viewpoints_of
from data_pipeline.dataset.builder import DataConfig, prepare
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from mevs_jax import ViewGraph, fibonacci_sphere
from tests.conftest import beside_the_checkout

DIRECTIONS = [[2, 0, 0], [0, 3, 0], [0, 0, 1], [-1, 0, 0], [0, -5, 0]]
RING = [[1, 0], [1, 2], [3, 2], [3, 4], [4, 0]]


def matrix(pairs, views=5):
    made = np.zeros((views, views), int)
    for a, b in pairs:
        made[a, b] = made[b, a] = 1
    return made.tolist()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", json.dumps(DIRECTIONS)),
        ("a.json", json.dumps({"viewpoints": DIRECTIONS, "name": "five", "description": "of a test"})),
        ("a.txt", "\ufeff" + json.dumps({"points": DIRECTIONS, "n": 5})),
        ("a.csv", "".join(f"{x},{y},{z}\n" for x, y, z in DIRECTIONS)),
        ("a.csv", "x;y;z\n\n# of a test\n" + "".join(f"{x};{y};{z}\n" for x, y, z in DIRECTIONS)),
        ("a.txt", "".join(f"{x} {y}  {z}\n" for x, y, z in DIRECTIONS)),
    ],
)
def test_directions_are_read_and_normalised(name, text, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    found = read_viewpoints(path)
    np.testing.assert_allclose(found.points, np.sign(DIRECTIONS), atol=1e-12)
    assert found.neighbours is None
    (tmp_path / "other.json").write_text(json.dumps({"viewpoints": np.sign(DIRECTIONS).tolist()}))
    assert read_viewpoints(tmp_path / "other.json").digest == found.digest  # of the content, not of its form


@pytest.mark.parametrize("adjacency", [RING, [*RING, [0, 1]], matrix(RING), np.array(matrix(RING), bool).tolist()])
def test_neighbours_are_pairs_or_a_matrix(adjacency, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"viewpoints": DIRECTIONS, "adjacency": adjacency}))
    found = read_viewpoints(path)
    assert found.neighbours == ((0, 1), (0, 4), (1, 2), (2, 3), (3, 4))
    graph = ViewGraph.from_points(found.points, found.neighbours)
    np.testing.assert_array_equal(graph.neighbours, np.array(matrix(RING), bool))
    path.write_text(json.dumps({"viewpoints": DIRECTIONS, "adjacency": []}))
    assert read_viewpoints(path).neighbours == ()  # none, which is not the same as unknown
    assert read_viewpoints(path).digest != found.digest


def test_the_files_of_the_thesis_are_read():
    path = beside_the_checkout("thesis", "view_graph_40.json")
    found = read_viewpoints(path)
    np.testing.assert_allclose(found.points, fibonacci_sphere(40), atol=1e-9)
    own = ViewGraph.from_points(found.points, found.neighbours)
    np.testing.assert_array_equal(own.neighbours, ViewGraph.from_points(fibonacci_sphere(40)).neighbours)


def two(first, second=(1, 0, 0)):
    return json.dumps([first, second])


def with_adjacency(adjacency):
    return json.dumps({"viewpoints": DIRECTIONS, "adjacency": adjacency})


LOPSIDED = matrix(RING)
LOPSIDED[4][0] = 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is no JSON"),
        ("[" * 100_000, "is no JSON"),
        ("3", "is neither a list of directions nor an object"),
        (json.dumps({"viewpoint": DIRECTIONS}), "an entry 'viewpoint', which is neither"),
        (json.dumps({"adjacency": RING}), 'must have one list of "viewpoints"'),
        (json.dumps({"viewpoints": DIRECTIONS, "points": DIRECTIONS}), 'must have one list of "viewpoints"'),
        (json.dumps({"viewpoints": "all"}), "no list of directions"),
        (two([1, 2]), "no list of directions"),
        (json.dumps([[1, 2], [3, 4]]), r"shape \[2, 2\], not directions"),
        (two(["a", 0, 0]), "no list of directions"),
        (two([None, 0, 0]), "viewpoint 0 of .* is not finite"),
        (f"[[1, 0, 0], [0, {10**400}, 0]]", "no list of directions"),
        ("[[1, 0, 0], [0, NaN, 0]]", "viewpoint 1 of .* is not finite"),
        ("[[Infinity, 0, 0], [0, 1, 0]]", "viewpoint 0 of .* is not finite"),
        (two([0, 0, 0]), "viewpoint 0 of .* is the zero vector"),
        (two([1e-12, 0, 0]), "viewpoint 0 of .* is the zero vector"),
        (two([1e300, 0, 0]), "viewpoints 0 and 1 of .* have the same direction"),
        (json.dumps([[1, 0, 0]]), "has 1 viewpoints, and choosing a next view needs at least 2"),
        ("[]", "array of shape"),
        (with_adjacency(LOPSIDED), "not symmetric: view 0 is a neighbour of 4, or the other way round"),
        (with_adjacency((2 * np.array(matrix(RING))).tolist()), "other entries than 0 and 1"),
        (with_adjacency((np.array(matrix(RING)) + np.eye(5, dtype=int)).tolist()), "view 0 a neighbour of itself"),
        (with_adjacency([[0, 5]]), "names view 5, and there are the views 0 to 4"),
        (with_adjacency([[0, -1]]), "names view -1"),
        (with_adjacency([[2, 2]]), "view 2 a neighbour of itself"),
        (with_adjacency([[0, 1.5]]), r"has shape \[1, 2\]"),
        (with_adjacency([[0, 1, 2]]), r"has shape \[1, 3\]"),
        (with_adjacency([[0, 1], [2]]), "neither a list of pairs nor a matrix"),
        (with_adjacency(["a", "b"]), "neither a list of pairs nor a matrix"),
        (with_adjacency({"0": [1]}), "neither a list of pairs nor a matrix"),
        (with_adjacency(3), "neither a list of pairs nor a matrix"),
    ],
)
def test_what_is_wrong_is_one_sentence(text, said, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(DataError, match=said) as error:
        read_viewpoints(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"1,2\n3,4\n", "line 1 of .* has 2 numbers, a direction has 3"),
        (b"x,y,z\n1,0,0\n0,one,0\n", "line 3 of .* is no direction: '0,one,0'"),
        (b"\xff\xfe\x00", "is not a text file of viewpoints"),
        (b"", "holds an array of shape"),
        (b"1,0,0\n1,nan,0\n", "viewpoint 1 of .* is not finite"),
    ],
)
def test_what_is_wrong_in_a_table_is_one_sentence(content, said, tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=said):
        read_viewpoints(path)
    with pytest.raises(DataError, match=r"nowhere.csv cannot be read \(No such file"):
        read_viewpoints(tmp_path / "nowhere.csv")


def test_cameras_stand_where_the_file_says(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(DIRECTIONS))
    config = CaptureConfig(views=5, lattice=f"{FILE}{tmp_path / 'a.json'}", resolution=8)
    np.testing.assert_allclose(rig_for(config).poses[:, :3, 3], 2 * np.sign(DIRECTIONS), atol=1e-6)
    with pytest.raises(DataError, match=r"has 5 viewpoints, and --views or --dataset.capture.views is 6; leave it out"):
        viewpoints_of(replace(config, views=6))
    assert viewpoints_of(CaptureConfig(views=10)).points.tolist() == fibonacci_sphere(10).tolist()
    with pytest.raises(ValueError, match="unknown lattice 'spiral': it is one of golden_angle"):
        viewpoints_of(CaptureConfig(lattice="spiral"))


def test_a_data_set_is_identified_by_its_viewpoints(tmp_path):
    """Not by the path of their file, which it does not need any more; and its statistics have the neighbours."""
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"viewpoints": DIRECTIONS, "adjacency": RING}))
    capture = CaptureConfig(views=5, lattice=f"{FILE}{path}", resolution=8)
    config = DataConfig(train_per_class=2, test_per_class=1, capture=capture)
    statistics = prepare(config, tmp_path / "data")
    assert statistics.camera.lattice == f"{FILE}{read_viewpoints(path).digest}" == identified(capture).lattice
    assert statistics.neighbours == [[0, 1], [0, 4], [1, 2], [2, 3], [3, 4]]
    np.testing.assert_array_equal(statistics.graph.neighbours, np.array(matrix(RING), bool))
    stored = json.loads((tmp_path / "data" / "config.json").read_text())
    assert stored["capture"] == asdict(identified(capture))
    moved = path.rename(tmp_path / "b.json")
    assert prepare(replace(config, capture=replace(capture, lattice=f"{FILE}{moved}")), tmp_path / "data") == statistics
    assert prepare(config, tmp_path / "data") == load_statistics(tmp_path / "data") == statistics  # without its file
    path.write_text(json.dumps({"viewpoints": DIRECTIONS, "adjacency": RING[:-1]}))
    with pytest.raises(DataError, match=r"other settings \(capture.lattice file:\w+, not file:\w+\)"):
        prepare(config, tmp_path / "data")


def test_viewpoints_without_a_graph_need_one(tmp_path):
    """A turntable: all viewpoints in one plane."""
    angle = np.arange(6) * np.pi / 3
    points = np.stack([np.cos(angle), np.sin(angle), np.full(6, 0.5)], axis=1).tolist()
    path = tmp_path / "ring.json"
    path.write_text(json.dumps(points))
    capture = CaptureConfig(views=6, lattice=f"{FILE}{path}", resolution=8)
    config = DataConfig(train_per_class=2, test_per_class=1, capture=capture)
    with pytest.raises(DataError, match=r"in one plane have no view graph: give the neighbours in .*ring.json"):
        prepare(config, tmp_path / "data")
    path.write_text(json.dumps({"viewpoints": points, "adjacency": [[i, (i + 1) % 6] for i in range(6)]}))
    graph = prepare(config, tmp_path / "data").graph
    assert np.asarray(graph.neighbours).sum(axis=1).tolist() == [2] * 6
