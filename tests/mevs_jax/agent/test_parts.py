"""Images that show a part of the object, for a system that is told what is unknown."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from mevs_jax.agent import Agent, replay
from mevs_jax.trained import TrainedSystem
from tests.mevs_jax.agent.test_agent import CENTER, LYING, RADIUS, K, begun, in_metres, pose_at, views_of
from tests.mevs_jax.trained import making


@pytest.fixture(scope="module")
def parts() -> TrainedSystem:
    return making.system("parts")


def half(image: np.ndarray, number: int) -> np.ndarray:
    """The left, right, upper or lower half of an image; the rest was not measured."""
    turned = np.rot90(image, number)
    shown = np.where(np.arange(len(image)) < len(image) // 2, turned, np.nan)
    return np.rot90(shown, -number)


def test_parts_from_about_one_direction_are_one_view(parts):
    direction = np.array([0.6, -0.48, 0.64])
    whole, agent = begun(parts, max_views=5), begun(parts, max_views=5)
    expected = whole.observe(*in_metres(making.depth_of_ball(direction), pose_at(*direction)))
    for number, side in enumerate((0, 2)):  # opposite halves
        aside = direction + 0.05 * np.array([np.cos(number), np.sin(number), 0]) * (number > 0)
        aside /= np.linalg.norm(aside)
        depth, K, pose = in_metres(making.depth_of_ball(aside), pose_at(*aside))
        belief = agent.observe(half(depth, side), K, pose)
        assert (belief.views, belief.images) == (1, number + 1)
        shown = (0.5, 1.0)[number]
        assert belief.evidence == pytest.approx(shown, abs=0.1)
        assert belief.unseen == pytest.approx(1 - shown, abs=0.1)
    np.testing.assert_allclose(belief.probabilities, expected.probabilities, atol=0.15)
    other = agent.observe(*in_metres(*views_of(parts)[0]))
    assert other.views == 2
    assert other.evidence > 1.8


def test_confidence_without_evidence_is_not_sure(parts):
    depth, K, pose = in_metres(*views_of(parts)[3])
    small, at = np.full_like(depth, np.nan), np.argwhere(np.isfinite(depth))[::8]
    small[tuple(at.T)] = depth[tuple(at.T)]
    agent = begun(parts, stop=1e-9, max_views=3)
    assert agent.observe(small, K, pose).evidence < 0.15
    assert agent.decide().reason == ""
    agent.observe(depth, K, pose)
    assert agent.decide().reason in ("sure", "unknown object")


def test_an_image_that_shows_next_to_nothing_is_refused(parts):
    depth, _, pose = in_metres(*views_of(parts)[3])
    one = np.full_like(depth, np.nan)
    middle = len(one) // 2
    one[middle, middle] = depth[middle, middle]
    agent = begun(parts)
    with pytest.raises(ValueError, match="pixels of its sphere; aim the camera"):
        agent.observe(one, K, pose)
    assert agent.history.views == 0


def test_the_class_of_unknown_objects_is_an_answer_of_its_own(parts):
    label = parts.description.unknown_class
    assert parts.classes[label] == "unknown object"
    assert Agent(parts).unknown is None
    fusion = {
        name: replace(fusion, prior=fusion.prior.at[label].set(-30.0)) for name, fusion in parts.parts.fusion.items()
    }
    stranger = replace(parts, parts=replace(parts.parts, fusion=fusion))  # all is unknown to it
    for stop, reasons in ((0.9, ["unknown object"]), (2.0, ["", "unknown object"])):
        agent = begun(stranger, stop=stop, max_views=2)
        for index, reason in enumerate(reasons):
            belief = agent.observe_view(*views_of(parts)[index])
            assert (belief.name, belief.known) == ("unknown object", False)
            assert agent.decide().reason == reason


def test_a_part_takes_nothing_from_a_whole_view_and_a_whole_view_ends_a_part(parts):
    agent = begun(parts, max_views=6)
    depth, K, pose = in_metres(*views_of(parts)[3])
    whole = agent.observe(depth, K, pose)
    again = agent.observe(half(depth, 0), K, pose)
    assert (again.views, again.evidence) == (1, whole.evidence)
    np.testing.assert_allclose(again.probabilities, whole.probabilities, atol=0.05)
    other, K, there = in_metres(*views_of(parts)[0])
    part = agent.observe(half(other, 0), K, there)
    ended = agent.observe(other, K, there)
    assert (part.views, ended.views) == (2, 2)
    assert part.evidence + 0.3 < ended.evidence


def test_a_candidate_that_became_a_part_of_another_view_is_not_chosen_again(parts):
    direction = np.array([0.6, -0.48, 0.64])
    aside = direction + np.array([0.3, 0, 0])
    aside /= np.linalg.norm(aside)
    agent, shots = begun(parts, max_views=6), []
    for number, one in enumerate((direction, aside)):
        depth, K, pose = in_metres(making.depth_of_ball(one), pose_at(*one))
        shots.append(pose)
        belief = agent.observe(half(depth, number), K, pose)
    assert (belief.views, belief.images) == (1, 2)
    far = in_metres(making.depth_of_ball(-direction), pose_at(*-direction))[2]
    assert agent.decide(candidates=np.stack([*shots, far])).index == 2


def test_beliefs_of_parts_are_repeated_from_their_history(parts):
    agent = begun(parts, max_views=6)
    for index, number in ((3, 0), (3, 1), (0, 2), (5, 0)):
        depth, K, pose = in_metres(*views_of(parts)[index])
        agent.observe(half(depth, number), K, pose)
    again = replay(agent.history, Agent(parts, stop=2, max_views=6))
    for one, other in zip(agent.history.beliefs, again, strict=True):
        np.testing.assert_array_equal(one["probabilities"], other.probabilities)
        assert (one["evidence"], one["unseen"]) == (other.evidence, other.unseen)


def test_parts_of_an_object_of_unknown_size_are_combined_too(parts):
    points = CENTER + RADIUS * np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    agent = Agent(parts, stop=2, max_views=6)
    agent.reset_from_points(points)
    depth, K, pose = in_metres(*views_of(parts)[3])
    for number, side in enumerate((0, 2)):
        shown = half(depth, side)
        belief = agent.observe(shown, K, pose, mask=np.isfinite(shown))
        assert (belief.views, belief.images) == (1, number + 1)
    assert belief.evidence <= 1


@pytest.mark.parametrize("kind", ["parts", "recogniser", "classifier"])
def test_one_pixel_is_refused_by_every_system(kind):
    depth, pose = views_of(making.system(kind))[3]
    one = np.zeros_like(depth)
    middle = tuple(np.argwhere(depth > 0)[40])
    one[middle] = depth[middle]
    with pytest.raises(ValueError, match=r"depth shows the object at only 1 of the .* pixels"):
        begun(making.system(kind)).observe_view(one, pose)


def test_what_an_image_does_not_show_matters(parts, recogniser):
    """A system that is not told takes it for background."""
    depth, pose = views_of(parts)[2]
    unknown = np.where(np.arange(len(depth)) < 0.4 * len(depth), np.nan, depth).astype(np.float32)
    for system, equal in ((parts, False), (recogniser, True)):
        given, taken = (
            begun(system).observe_view(image, pose).probabilities for image in (unknown, np.nan_to_num(unknown))
        )
        assert np.allclose(given, taken, atol=1e-6) == equal


def test_parts_need_no_compilation_after_the_warm_up(parts):
    agent, events = Agent(parts, stop=2, max_views=4), []
    agent.warm_up()

    def listen(event, *_, **__):
        if "compile" in event:
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        agent.begin(LYING)
        depth, K, pose = in_metres(*views_of(parts)[3])
        for number in (0, 2):
            belief = agent.observe(half(depth, number), K, pose)
        assert (belief.views, belief.images) == (1, 2)
        assert events == []
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
