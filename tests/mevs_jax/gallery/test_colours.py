"""Two boxes of one shape are told apart by their colours, in any light, and nothing changes without colours."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mevs_jax
from data_pipeline.dataset.light import LightConfig, in_light
from data_pipeline.objects.furniture.solids import box, joined
from mevs_jax.agent import Frames
from mevs_jax.agent.looking import replay
from mevs_jax.enrolment import AlikeWarning, alike, enrol, remove
from mevs_jax.gallery.colours import (
    COLOURS,
    NUMBERS,
    ColourEvidence,
    ColourMatcher,
    Colours,
    decoded,
    differences,
    parted,
    stored_colours,
)
from mevs_jax.gallery.grid import HEIGHTS, SIDE, YAWS, grid_directions
from mevs_jax.gallery.meshes import caster_of, images_of_mesh, painted, seen_of
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.geometry.triangles import centred_triangles
from mevs_jax.meshes.paint import Paint
from mevs_jax.trained import TrainedSystem
from tests.mevs_jax.gallery.conftest import CAMERA
from train.tasks.matcher import objects_system


@pytest.fixture(scope="module")
def eyes(matcher) -> TrainedSystem:
    """A system without objects, which compares colours by random numbers in which errors of about 10 % are 1."""
    random = np.random.default_rng(1).normal(size=(NUMBERS, 48))
    projection = np.linalg.qr(random)[0] * 12
    one = jnp.float32(1)
    stranger = jnp.array([-6.0, 0.0, 0.0, 0.1, 3.0, 0.0])
    colours = ColourMatcher(
        jnp.asarray(projection, jnp.float32), 0.1 * one, jnp.array([2.0, 0.3, 0.0]), stranger, 4 * one
    )
    return objects_system(matcher, CAMERA, colours=colours)


@pytest.fixture(scope="module")
def boxes() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Two cartons of one shape: red with a white top, and green with a blue one; colours of the triangles."""
    solid = joined([box(0.2, 0.14, 0.16)])
    vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
    top = (vertices[faces][..., 2].min(axis=1) > vertices[:, 2].max() - 1e-6)[:, None]
    return {
        "milk": (vertices, faces, np.where(top, (0.9, 0.9, 0.9), (0.8, 0.1, 0.1))),
        "juice": (vertices, faces, np.where(top, (0.1, 0.2, 0.8), (0.1, 0.7, 0.2))),
    }


@pytest.fixture(scope="module")
def cartons(eyes: TrainedSystem, boxes) -> TrainedSystem:
    return enrol(boxes, eyes)


def view_of(shape, pose: np.ndarray, light: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Depth in radii, and colours, maybe in one of several lights."""
    vertices, faces, colours = shape
    triangles = centred_triangles(vertices, faces)[0]
    depth, hit, points = seen_of(caster_of(triangles), pose[None], CAMERA)
    seen = painted(Paint.of(colours, faces, len(vertices)).on(vertices, faces), hit, points)[0]
    if light is not None:
        config = LightConfig(shift=0)
        seen = np.asarray(in_light(jax.random.key(light), seen, np.zeros_like(seen), jnp.asarray(pose), config))
    return depth[0].astype(np.float32), seen


def test_boxes_of_one_shape_are_told_apart_by_colours_alone(cartons: TrainedSystem, boxes) -> None:
    for name, shape in boxes.items():
        for light in range(4):
            agent = cartons.agent()
            agent.reset(center=(0, 0, 0), radius=1.0, true_size=False)
            pose = cartons.poses[3 + light]
            depth, colours = view_of(shape, pose, light)
            belief = agent.observe_view(depth, pose, colours)
            assert belief.name == name
            assert belief.confidence > 0.99 * belief.probabilities[:2].sum()
            without = cartons.agent()
            without.reset(center=(0, 0, 0), radius=1.0, true_size=False)
            belief = without.observe_view(view_of(shape, pose)[0], pose)
            known = belief.probabilities[:2] / belief.probabilities[:2].sum()
            np.testing.assert_allclose(known, 0.5, atol=0.02)  # depth cannot tell


def test_a_box_of_other_colours_is_unknown_and_the_same_without_them_is_not(cartons: TrainedSystem, boxes) -> None:
    vertices, faces, _ = boxes["milk"]
    other = vertices, faces, np.random.default_rng(2).random((len(faces), 3))
    pose = cartons.poses[5]
    depth, colours = view_of(other, pose)
    odds = []
    for seen in (colours, None):
        agent = cartons.agent()
        agent.reset(center=(0, 0, 0), radius=1.0, true_size=False)
        odds.append(agent.observe_view(depth, pose, seen).probabilities[-1])
    assert odds[0] > 0.9
    assert odds[1] < 0.5


def test_the_odds_of_an_unknown_object_count_details_where_its_colours_are_known(eyes, boxes, shapes) -> None:
    gallery = enrol({"knob": shapes["knob"]}, enrol(boxes, eyes)).parts.gallery
    colours = replace(gallery.colours, matcher=replace(gallery.colours.matcher, stranger=jnp.arange(1.0, 7.0)))
    evidence, by_shape = ColourEvidence(jnp.full((3, YAWS), 0.3), jnp.float32(0.5)), jnp.float32(-2.0)
    for number in range(2):
        change = np.square(np.asarray(colours.slopes[number])).mean(axis=(0, 1, 3)).sum()
        numbers = [1, np.log(0.5), np.log(3), np.log(0.2), np.log(0.3), np.log(change + 0.2)]
        odds = colours.strange_odds(evidence, jnp.int32(number * YAWS + 5), jnp.float32(0.2), by_shape, 3)
        assert float(odds) == pytest.approx(np.dot(numbers, np.arange(1, 7)), rel=1e-4)
    assert float(colours.strange_odds(evidence, jnp.int32(2 * YAWS), jnp.float32(0.2), by_shape, 3)) == -2.0
    unseen = replace(evidence, count=jnp.float32(0))
    assert float(colours.strange_odds(unseen, jnp.int32(0), jnp.float32(0.2), by_shape, 3)) == -2.0


def test_objects_without_colours_are_recognised_as_before(eyes, blank, shapes, boxes) -> None:
    plain, coloured = enrol(shapes, blank), enrol(shapes, eyes)
    pose = plain.poses[7]
    depth, colours = view_of((*shapes["knob"], np.full((len(shapes["knob"][1]), 3), 0.5)), pose)
    expected = np.asarray(plain.observe(depth, pose).logits)
    np.testing.assert_allclose(np.asarray(coloured.observe(depth, pose).logits), expected, atol=1e-4)
    np.testing.assert_allclose(np.asarray(plain.observe(depth, pose, colours=colours).logits), expected, atol=1e-6)


def test_shifts_of_an_image_and_its_light_hardly_count(eyes: TrainedSystem) -> None:
    def printed(right: float, down: float, size: float = 1.0) -> np.ndarray:
        """A print that looks the same from everywhere, moved by some pixels."""
        at = (np.arange(SIDE) - (SIDE - 1) / 2) / size
        x, y = np.meshgrid(at - right, at - down)
        return np.stack(
            [0.5 + 0.3 * np.sin(0.5 * x), 0.5 + 0.3 * np.cos(0.4 * y), 0.5 + 0.3 * np.sin((x + y) / 3)], axis=-1
        )

    assert eyes.parts.gallery is not None
    assert eyes.parts.gallery.colours is not None
    still = np.broadcast_to(printed(0, 0), (HEIGHTS, YAWS, SIDE, SIDE, 3)).astype(np.float32)
    matcher = eyes.parts.gallery.colours.matcher
    colours = Colours.of(matcher, stored_colours(still)[None], np.arange(1))
    step = 0.05
    moves = [
        (printed(step, 0), printed(-step, 0)),
        (printed(0, step), printed(0, -step)),
        (printed(0, 0, 1 + step), printed(0, 0, 1 - step)),
        (printed(0, 0) * np.exp(-step), printed(0, 0) * np.exp(step)),
        (printed(0, 0) ** np.exp(-step), printed(0, 0) ** np.exp(step)),
    ]
    across = np.linspace(-1, 1, 2 * SIDE + 1)[1::2]
    for lit in (across[:, None], across[:, None, None]):
        moves.append((printed(0, 0) * np.exp(-step * lit), printed(0, 0) * np.exp(step * lit)))
    for number, (more, less) in zip((0, 1, 2, 5, 6, 7, 8), moves, strict=True):
        change = (np.log(less / 0.08 + 1) - np.log(more / 0.08 + 1)) / (2 * step)  # of an image, as the camera moves
        scaled = change * (0.3, 0.3, 0.03, 0.05, 0.05, 0.35, 0.15, 0.3, 0.3)[number]
        expected = np.asarray(
            parted(jnp.asarray(scaled.reshape(-1, 3)), jnp.ones(SIDE**2, bool))[0] @ matcher.projection
        )
        found = np.asarray(colours.slopes[0, 4, 7, number])
        assert np.corrcoef(expected, found)[0, 1] > 0.95
        np.testing.assert_allclose(np.linalg.norm(found), np.linalg.norm(expected), rtol=0.2)
    np.testing.assert_allclose(colours.slopes[0, :, :, 3:5], 0, atol=1e-4)  # all directions look the same

    def apart(seen: np.ndarray) -> float:
        return float(colours.compared(jnp.asarray(seen, jnp.float32), jnp.array([1.0, 0, 0]), 1)[0])

    def plain(seen: np.ndarray) -> float:
        numbers = differences(colours.images, jnp.asarray(seen, jnp.float32), jnp.array([1.0, 0, 0]))[0]
        return float(jnp.mean(jnp.square(numbers @ matcher.projection)[0, 0]))

    for image in (printed(0.3, 0.0), printed(0.0, -0.3), printed(0.2, 0.2), 0.7 * printed(0, 0), printed(0, 0) ** 1.2):
        assert apart(image) < 0.28 * plain(image)
    assert apart(printed(5, 3)) > 0.3 * plain(printed(5, 3))  # another print


def test_a_difference_is_that_of_a_slow_reference() -> None:
    random = np.random.default_rng(0)
    images = random.random((HEIGHTS, YAWS, SIDE, SIDE, 3)).astype(np.float32)
    images[random.random(images.shape[:-1]) < 0.2] = np.nan
    cell, yaw = (8, 5), 3  # an object at this yaw looks from azimuth 5 as an unturned one from azimuth 2
    seen = random.random((SIDE, SIDE, 3)).astype(np.float32)
    seen[random.random((SIDE, SIDE)) < 0.3] = np.nan
    direction = grid_directions().reshape(HEIGHTS, YAWS, 3)[cell]
    numbers, share = differences(stored_colours(images)[None], jnp.asarray(seen), jnp.asarray(direction, jnp.float32))
    apart = np.log(images[8, 2] / 0.08 + 1) - np.log(seen / 0.08 + 1)
    both = ~np.isnan(apart).any(axis=-1)
    mean = apart[both].mean(axis=0)
    rest = np.where(both[..., None], apart - mean, 0)
    np.testing.assert_allclose(share[0, yaw], both.mean(), atol=1e-6)
    np.testing.assert_allclose(numbers[0, yaw, :COLOURS], rest.reshape(-1) / np.sqrt(both.mean()), atol=0.03)
    np.testing.assert_allclose(numbers[0, yaw, COLOURS:], mean, atol=0.01)


def test_a_system_with_colours_is_saved_and_its_objects_come_and_go(cartons, boxes, shapes, tmp_path) -> None:
    more = enrol({"knob": shapes["knob"]}, cartons)  # without colours
    more.save(tmp_path / "known")
    assert mevs_jax.load(tmp_path / "known") == more
    size = sum(file.stat().st_size for file in (tmp_path / "known").iterdir())
    assert size / 3 < 1e6
    left = remove(more, "milk")
    colours = left.parts.gallery.colours
    assert np.asarray(colours.objects).tolist() == [0]
    np.testing.assert_array_equal(colours.images[0], cartons.parts.gallery.colours.images[1])


def test_twins_are_those_of_the_same_colours_too(cartons, boxes) -> None:
    assert alike(cartons) == []
    with pytest.warns(AlikeWarning, match="milk and skimmed are equal"):
        enrol({"skimmed": boxes["milk"]}, cartons)


def test_the_next_view_is_where_the_colours_differ(eyes, boxes) -> None:
    """Two boxes differ in one side alone: from the other side, the camera goes around."""
    vertices, faces, _ = boxes["milk"]
    left = (vertices[faces][..., 0].max(axis=1) < vertices[:, 0].min() + 1e-6)[:, None]
    pair = {
        "one": (vertices, faces, np.where(left, (0.9, 0.1, 0.1), (0.5, 0.5, 0.5))),
        "two": (vertices, faces, np.where(left, (0.1, 0.1, 0.9), (0.5, 0.5, 0.5))),
    }
    system = enrol(pair, eyes)
    agent = system.agent()
    agent.reset(center=(0, 0, 0), radius=1.0, yaw=0.0, true_size=False)
    first = int(system.viewpoints[:, 0].argmax())
    depth, colours = view_of(pair["one"], system.poses[first])
    agent.observe_view(depth, system.poses[first], colours)
    assert system.viewpoints[agent.decide().index, 0] < -0.3


def frames_of(shape, radius: float, directions: np.ndarray) -> list[DepthImage]:
    """Images in metres, with colours and masks, around the origin."""
    images = []
    for pose in np.asarray(CAMERA.around(directions.astype(np.float32)).pose):
        depth, colours = view_of(shape, pose)
        placed = pose.astype(float)
        placed[:3, 3] *= radius
        image = (np.nan_to_num(colours) * 255).astype(np.uint8)
        images.append(
            DepthImage((depth * radius).astype(np.float32), CAMERA.intrinsics, placed, mask=depth > 0, image=image)
        )
    return images


AROUND = np.array([[0.8, 0, 0.6], [-0.4, 0.7, 0.6], [-0.4, -0.7, 0.6], [0, 0.8, -0.6], [0, -0.8, -0.6]])


def test_an_agent_reads_images_of_a_colour_camera(cartons, boxes) -> None:
    for name, shape in boxes.items():
        agent = cartons.agent()
        agent.reset(center=(0, 0, 0), radius=0.15, true_size=False)
        image = frames_of(shape, 0.15, AROUND)[0]
        belief = agent.observe(image.depth, image.K, image.pose, mask=image.mask, image=image.image)
        assert belief.probabilities[:2].argmax() == list(boxes).index(name)
        expected = view_of(shape, np.asarray(CAMERA.around(AROUND[:1].astype(np.float32)).pose)[0])[1]
        off = np.abs(agent.history.colours[0] - expected)
        assert np.mean(off[~np.isnan(off)] < 0.02) > 0.95
        assert [one.label for one in replay(agent.history, cartons.agent())] == [belief.label]


def test_objects_are_enrolled_from_images_with_colours(eyes, boxes) -> None:
    frames = {name: frames_of(shape, 0.15, AROUND) for name, shape in boxes.items()}
    stacked = {
        name: np.stack([getattr(one, own) for one in frames["juice"]])
        for name, own in {
            "depth": "depth",
            "K": "K",
            "T_world_camera": "pose",
            "mask": "mask",
            "image": "image",
        }.items()
    }
    known = enrol({"milk": frames["milk"], "juice": Frames.of(stacked)}, eyes)
    colours = known.parts.gallery.colours
    assert np.asarray(colours.objects).tolist() == [0, 1]
    for found, shape in zip(colours.images, boxes.values(), strict=True):
        vertices, faces, painted_as = shape
        _, expected, _ = images_of_mesh(vertices, faces, CAMERA, Paint.of(painted_as, faces, len(vertices)))
        (logs, shown), (true, there) = decoded(found), decoded(jnp.asarray(expected))
        both = np.asarray(shown & there)[3:10]  # of cameras that are not above or below all that was seen
        assert both.sum() > 0.7 * np.asarray(there)[3:10].sum()
        assert np.abs(np.asarray(logs - true)[3:10][both]).mean() < 0.1  # a step from red to white is 1.6


def test_images_that_do_not_fit_are_refused(boxes) -> None:
    image = frames_of(boxes["milk"], 0.15, AROUND)[0]
    given = image.depth, image.K, image.pose
    with pytest.raises(ValueError, match="register the colour camera's image to the depth first"):
        DepthImage(*given, image=np.zeros((480, 640, 3), np.uint8))
    with pytest.raises(ValueError, match="red, green and blue along the last axis"):
        DepthImage(*given, image=np.zeros((64, 64, 4), np.uint8))
