"""The walks that the report shows, the surfaces they are around, and what the viewer is given."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.capture.casting import CaptureConfig
from eval.numbers.study import Setting
from eval.report.scenes import _which, nats
from eval.report.surface import MOST_POINTS, seen_by, surface_of
from eval.report.walks import OF_EACH, Walks, walks_of
from eval.tables import ViewTables
from eval.walks.grid import GridConfig
from mevs_jax import fibonacci_sphere, look_at_origin
from mevs_jax.beliefs.entropy import DEPTH_SCALE
from mevs_jax.policies import policy_record
from tests.reference.evaluation import CLASSES, OBJECTS, VIEWS, some_statistics, some_tables

STEPS = 4
TEMPERATURES = np.array([2.0, 1.5, 1.0, 1.0])


@pytest.fixture(scope="module")
def tables():
    return some_tables()


def walks_within(tables: ViewTables, reachable: np.ndarray) -> Walks:
    return walks_of(tables, tables, some_statistics(tables).graph, reachable, TEMPERATURES)


@pytest.fixture(scope="module")
def walks(tables):
    return walks_within(tables, np.ones(VIEWS, bool))


def test_walks_are_those_of_the_evaluation(tables, walks):
    setting = Setting.of(some_statistics(tables).graph, tables, GridConfig(max_views=STEPS))
    evaluated = setting.walk(tables.stacked(), [policy_record("information_gain")])["information_gain"]
    starts = np.arange(OBJECTS) % VIEWS
    np.testing.assert_array_equal(walks.views, np.asarray(evaluated.views)[0, np.arange(OBJECTS), starts, 0])


def test_the_next_view_has_the_highest_gain_of_those_left(walks):
    for views, gains in zip(walks.views, walks.gains, strict=True):
        for step in range(1, STEPS):
            left = np.setdiff1d(np.arange(VIEWS), views[:step])
            assert views[step] == left[gains[step - 1][left].argmax()]


def test_probabilities_are_calibrated_sums_of_logits(tables, walks):
    logits = tables.logits[np.arange(OBJECTS)[:, None], walks.views].cumsum(axis=1)
    logits /= TEMPERATURES[:, None]
    np.testing.assert_allclose(walks.probabilities, jax.nn.softmax(jnp.asarray(logits)), atol=1e-5)


def test_views_out_of_reach_are_not_visited(tables):
    reachable = np.arange(VIEWS) % 3 != 0
    found = walks_within(tables, reachable)
    assert set(np.unique(found.views)) <= set(np.flatnonzero(reachable).tolist())


def walks_with(right: list[list[int]]) -> Walks:
    """Walks whose answers are right (1) or wrong (0) after each step; the true classes take turns."""
    answers, steps = np.array(right), len(right[0])
    labels = np.arange(len(right)) % CLASSES
    said = np.where(answers == 1, labels[:, None], (labels[:, None] + 1) % CLASSES)
    return Walks(np.zeros((len(right), steps), int), np.zeros((len(right), steps, 2)), np.eye(CLASSES)[said], labels)


def test_every_walk_is_of_one_kind(walks, random):
    for some in (walks, walks_with(random.integers(0, 2, (40, 4)).tolist())):
        assert (sum(members.astype(int) for members in some.kinds().values()) == 1).all()


def test_the_first_objects_of_each_kind_are_shown():
    saved, lost, right, wrong = [0, 1, 1], [1, 0, 0], [1, 1, 1], [0, 1, 0]
    shown = walks_with([saved, right, saved, saved, lost, right, wrong, [0, 0, 1]]).chosen()
    kinds: dict[str, list[int]] = {}
    for index, kind in shown.items():
        kinds.setdefault(kind, []).append(index)
    assert list(kinds.values()) == [[0, 2], [6], [4], [1, 5]]  # object 3 is of the class of 0, which is shown already
    assert all(len(members) <= OF_EACH for members in kinds.values())
    assert [kind.split()[0] for kind in kinds] == ["wrong", "wrong", "right", "right"]


def test_some_walk_is_always_shown():
    """Also where no walk is of a kind that is shown first."""
    assert list(walks_with([[0, 0, 1], [1, 0, 1], [0, 1, 0]]).chosen()) == [2]
    corrected = walks_with([[0, 0, 1], [1, 0, 1], [1, 0, 1]])
    assert list(corrected.chosen()) == [0, 1]
    assert "no failure to show" in _which(corrected)
    assert "more frequent" in _which(walks_with([[0, 0, 1], [0, 1, 0]]))


def ball(radius: float, views: int = 12, side: int = 48) -> tuple[dict, CaptureConfig]:
    """Captures of a ball, by the formula of a ray and a sphere."""
    config = CaptureConfig(views=views, resolution=side)
    poses = np.stack([np.asarray(look_at_origin(jnp.asarray(2 * point))) for point in fibonacci_sphere(views)])
    offset = (np.arange(side) + 0.5 - side / 2) * np.tan(np.radians(30)) / (side / 2)
    ray = np.stack([*np.meshgrid(offset, offset), np.ones((side, side))], axis=-1)
    a, b, c = (ray**2).sum(axis=-1), -4 * ray[..., 2], 4 - radius**2
    root = b**2 - 4 * a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / (2 * a), 0)
    stored = np.round(depth * DEPTH_SCALE).astype(np.uint16)
    return {"depth": np.repeat(stored[None], views, axis=0), "pose": poses.astype(np.float32)}, config


def test_a_surface_is_the_union_of_what_views_show():
    example, config = ball(0.8)
    surface = surface_of(example, config)
    assert 300 < len(surface.points) <= MOST_POINTS
    np.testing.assert_allclose(np.linalg.norm(surface.points, axis=1), 0.8, atol=0.03)
    outwards = (surface.normals * surface.points).sum(axis=1) / 0.8
    assert np.quantile(outwards, 0.1) > 0.9


def test_a_view_shows_the_side_that_faces_it():
    example, config = ball(0.8)
    surface = surface_of(example, config)
    height = surface.points @ (example["pose"][3][:3, 3] / 2)  # the horizon of a ball from 2 radii is at 0.8 · 0.8 / 2
    seen = seen_by(surface, example["depth"][3], example["pose"][3], config)
    assert seen[height > 0.45].mean() > 0.98
    assert not seen[height < 0.2].any()


def test_a_thin_plate_is_not_seen_through():
    """The other side of a plate is nearer than the tolerance of depth, but faces away."""
    example, config = ball(0.8)
    surface = surface_of(example, config)
    turned = replace(surface, normals=-surface.normals)
    facing = surface.points @ (example["pose"][3][:3, 3] / 2) > 0.45
    assert not seen_by(turned, example["depth"][3], example["pose"][3], config)[facing].any()


@pytest.mark.parametrize(("gain", "text"), [(0.12345, "0.123 nats"), (-0.0001, "0.000 nats"), (-0.08, "−0.080 nats")])
def test_gains_are_written_in_nats(gain, text):
    assert nats(gain) == text


def test_the_page_holds_what_the_viewer_draws(whole):
    page = (whole / "report" / "index.html").read_text()
    data = json.loads(re.search(r'<script type="application/json" id="scenes">(.*?)</script>', page, re.DOTALL)[1])
    metrics = json.loads((whole / "metrics.json").read_text())
    views = metrics["views"]
    assert len(data["directions"]) == len(data["reachable"]) == views
    assert 1 <= len(data["scenes"]) <= 4 * OF_EACH
    assert page.count('class="walk"') == len(data["scenes"])
    for scene in data["scenes"]:
        packed = base64.b64decode(scene["points"])
        assert len(packed) == scene["count"] * (3 * 2 + 3 + 1)
        points = np.frombuffer(packed[: 6 * scene["count"]], "<i2").reshape(-1, 3) / 20_000
        assert 0.9 < np.linalg.norm(points, axis=1).max() < 1.05
        first = np.frombuffer(packed[9 * scene["count"] :], np.uint8)
        assert first.max() <= len(scene["stops"])
        assert (first == 1).mean() > 0.05
        assert len({stop["view"] for stop in scene["stops"]}) == len(scene["stops"])
        assert all(scene["truth"] in dict(stop["bars"]) for stop in scene["stops"])
        assert all(len(stop["gains"]) == views for stop in scene["stops"])
    assert "<noscript>" in page
    assert all("alt=" in tag for tag in re.findall(r"<img[^>]*>", page))
    assert re.search(r'(?:src|href)="(?!data:|#)', page) is None
