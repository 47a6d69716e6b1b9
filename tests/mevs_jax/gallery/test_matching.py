"""What a gallery predicts, and what follows from views, beside slow and plain computations of the same."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from data_pipeline.capture.casting import capture
from data_pipeline.objects.mesh import normalise
from mevs_jax.agent.looking import look
from mevs_jax.enrolment import enrol
from mevs_jax.gallery.errors import DEVIATIONS, ERRORS, HELD, KEPT, likeliest, parted, slopes, unexplained
from mevs_jax.gallery.grid import HEIGHTS, SIDE, STEPS, UNKNOWN, YAWS, grid_directions, grid_rotations, interpolated
from mevs_jax.gallery.matching import (
    PIXELS,
    WEIGHTS,
    Gallery,
    Matcher,
    differences_by_turn,
    small_image,
    stored_image,
    symmetry_of,
)
from mevs_jax.geometry.cameras import look_at_origin
from mevs_jax.policies.base import Observation, Scene, SelectionState
from mevs_jax.trained import TrainedSystem
from tests.mevs_jax.gallery.conftest import CAMERA
from train.tasks.matcher import turned_rig


def test_small_images_are_means_of_known_pixels() -> None:
    random = np.random.default_rng(0)
    depth = np.where(random.random((64, 64)) < 0.3, 0.0, random.uniform(1, 3, (64, 64))).astype(np.float32)
    depth[random.random((64, 64)) < 0.4] = np.nan
    depth[:8, :8] = np.nan
    image, known = (np.asarray(part).reshape(2, SIDE, SIDE) for part in small_image(depth, 2.0))
    for row in range(SIDE):
        for column in range(SIDE):
            block = depth[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
            told = block[~np.isnan(block)]
            assert known[0, row, column] == known[1, row, column] == (len(told) >= 8)
            if len(told):
                near = np.where(told > 0, (3 - told) / 2, 0)
                np.testing.assert_allclose(image[:, row, column], [near.mean(), (told > 0).mean()], atol=1e-6)
    stored = np.asarray(stored_image(depth, 2.0)).reshape(2, SIDE, SIDE)
    assert (stored[:, :2, :2] == UNKNOWN).all()
    assert (stored[known.astype(bool)] <= STEPS).all()


def test_predictions_are_the_images_of_the_grid_and_mixtures_between() -> None:
    grid = np.random.default_rng(1).random((2, HEIGHTS, YAWS, 3)).astype(np.float32)
    directions = grid_directions().reshape(HEIGHTS, YAWS, 3)
    for height, azimuth in ((6, 0), (3, 35), (12, 7), (0, 20)):
        predicted = np.asarray(interpolated(jnp.asarray(grid), jnp.asarray(directions[height, azimuth], jnp.float32)))
        for yaw in range(YAWS):  # an object that is turned to the left is seen from further to its right
            level = {0: 0.4 / 60, 12: 12 - 0.4 / 60}.get(height, height)  # the outermost images are 0.1° from the poles
            low, up = int(level), level - int(level)
            rows = (1 - up) * grid[:, low] + up * grid[:, min(low + 1, HEIGHTS - 1)]
            np.testing.assert_allclose(predicted[:, yaw], rows[:, (azimuth - yaw) % YAWS], atol=1e-3)
    between = np.array([np.cos(np.radians(5)), np.sin(np.radians(5)), 0], np.float32)
    half = (grid[:, 6, 0] + grid[:, 6, 1]) / 2
    np.testing.assert_allclose(np.asarray(interpolated(jnp.asarray(grid), jnp.asarray(between)))[:, 0], half, atol=1e-4)


def test_a_view_from_a_pole_is_predicted_with_the_roll_that_cameras_have_there(known: TrainedSystem, shapes) -> None:
    gallery = known.parts.gallery
    assert gallery is not None
    mesh = normalise(*shapes["knob"], "knob")
    for height in (-1.0, 1.0):
        direction = np.array([0, 0, height], np.float32)
        depth = capture(mesh, turned_rig(CAMERA, direction[None], 0.0)).depth[0] * np.float32(1e-4)
        told = np.asarray(gallery.compared(jnp.asarray(depth), jnp.asarray(direction), 2.0, jnp.float32(jnp.nan)))
        assert told[:-1].reshape(3, -1)[0, : YAWS * KEPT : KEPT].argmin() == 0


def _compared_slowly(gallery: Gallery, depth: np.ndarray, direction: np.ndarray, radius: float) -> np.ndarray:
    image, known = (np.asarray(part) for part in small_image(depth, 2.0))
    matcher, images = gallery.matcher, np.asarray(gallery.images)
    predicted = np.asarray(interpolated(jnp.asarray(images, jnp.float32), jnp.asarray(direction)))
    hidden = np.asarray(interpolated(jnp.asarray(images == UNKNOWN, jnp.float32), jnp.asarray(direction))) > 0
    changes = np.asarray(interpolated(gallery.slopes.reshape(*gallery.slopes.shape[:3], -1), jnp.asarray(direction)))
    changes = changes.reshape(len(images), YAWS, ERRORS, -1)
    rows = []
    for object_ in range(len(images)):
        row = []
        for yaw in range(YAWS):
            both = (known > 0) & ~hidden[object_, yaw]
            apart = np.where(both, (predicted[object_, yaw] / STEPS - image) * WEIGHTS, 0)
            white = apart @ np.asarray(matcher.projection)
            shared, slope = both.sum() / max(known.sum(), 1), changes[object_, yaw]
            square = shared * np.mean(white**2) / both.mean() + (1 - shared) * float(matcher.unseen)
            gram = slope @ slope.T / len(white)
            row += [
                square,
                *(shared * slope @ white / len(white) / np.sqrt(both.mean())),
                *gram[np.triu_indices(ERRORS)],
            ]
        own = float(gallery.radii[object_])
        told = own > 0 and radius > 0
        row.append((np.log(radius / own) / float(matcher.size)) ** 2 if told else 1.0)
        rows.append(row)
    return np.append(np.ravel(rows), known.mean())


def test_views_are_compared_where_both_are_known(matcher: Matcher) -> None:
    random = np.random.default_rng(2)
    images = random.integers(0, STEPS + 1, (3, HEIGHTS, YAWS, PIXELS), dtype=np.uint8)
    images[1, :, :18, : SIDE * SIDE // 2] = UNKNOWN
    gallery = Gallery.of(matcher, images, np.array([0.1, 0.0, 0.2]))
    depth = random.uniform(1, 3, (64, 64)).astype(np.float32)
    depth[:, :20] = np.nan
    direction = np.array([0.48, -0.6, 0.64], np.float32)
    for radius in (0.15, np.nan):
        told = gallery.compared(jnp.asarray(depth), jnp.asarray(direction), 2.0, jnp.float32(radius))
        expected = _compared_slowly(gallery, depth, direction, radius)
        np.testing.assert_allclose(told, expected, rtol=2e-3, atol=2e-4 * np.abs(expected).max())


def test_images_change_with_the_sphere_and_the_yaw_as_expected(blank: TrainedSystem, shapes) -> None:
    """Beside images of the object moved, made larger and turned; at edges, images change less smoothly than assumed."""
    mesh = normalise(*shapes["knob"], "knob")
    direction = np.array([0.6, 0.48, 0.64], np.float32)
    rotation = np.asarray(look_at_origin(2 * direction))[:3, :3]

    def seen(moved: np.ndarray | tuple[float, ...] = (0, 0, 0), scale: float = 1.0, yaw: float = 0.0) -> np.ndarray:
        other = replace(mesh, vertices=(mesh.vertices * scale + rotation @ moved).astype(np.float32))
        depth = capture(other, turned_rig(CAMERA, direction[None], yaw)).depth[0] * np.float32(1e-4)
        return np.asarray(small_image(depth, 2.0)[0])

    step = 0.06
    expected = [(seen(moved=step * axis) - seen(moved=-step * axis)) / (2 * step) for axis in rotation]
    expected.append((seen(scale=1 + step) - seen(scale=1 - step)) / (2 * step))
    expected.append((seen(yaw=np.radians(-10)) - seen(yaw=np.radians(10))) / np.radians(20))
    images = enrol({"knob": shapes["knob"]}, blank).parts.gallery.images[0] / STEPS
    changes = slopes(images, grid_rotations()).reshape(1, HEIGHTS, YAWS, -1)
    found = np.asarray(interpolated(changes, jnp.asarray(direction))).reshape(YAWS, ERRORS, -1)[0]
    for one, other in zip(found / DEVIATIONS[:, None], expected, strict=True):
        assert np.corrcoef(one, other)[0, 1] > 0.7
        assert 0.5 < np.linalg.norm(one) / np.linalg.norm(other) < 1.2


def test_a_common_error_explains_what_it_does_by_least_squares() -> None:
    random = np.random.default_rng(8)
    slope, apart = random.normal(size=(3, ERRORS, 7)), random.normal(size=(3, 7))
    square = np.mean(apart**2)
    lean = np.einsum("vef,vf->e", slope, apart) / apart.size
    gram = np.einsum("vaf,vbf->ab", slope, slope) / apart.size
    kept = jnp.asarray(lean), jnp.asarray(gram[np.triu_indices(ERRORS)]), 3
    found = unexplained(jnp.asarray(square), *kept)
    flat, extra = slope.transpose(1, 0, 2).reshape(ERRORS, -1).T, np.sqrt(HELD / 3 * apart.size) * np.eye(ERRORS)
    rows, wanted = np.concatenate([flat, extra]), np.append(apart, np.zeros(ERRORS))
    error = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    assert float(found) == pytest.approx(np.sum((rows @ error - wanted) ** 2) / apart.size, rel=1e-4)
    np.testing.assert_allclose(likeliest(*kept), error, rtol=1e-4, atol=1e-5)


def test_views_with_one_wrong_sphere_are_explained_and_views_with_several_are_not(known: TrainedSystem, shapes) -> None:
    gallery, mesh = known.parts.gallery, normalise(*shapes["knob"], "knob")
    assert gallery is not None
    directions = np.asarray(known.viewpoints[[5, 18, 30]], np.float32)

    def apart(moves: np.ndarray) -> float:
        rows = []
        for direction, move in zip(directions, moves, strict=True):
            moved = replace(mesh, vertices=mesh.vertices + move.astype(np.float32))
            depth = capture(moved, turned_rig(CAMERA, direction[None], 0.0)).depth[0] * np.float32(1e-4)
            rows.append(gallery.compared(jnp.asarray(depth), jnp.asarray(direction), 2.0, jnp.float32(jnp.nan)))
        return float(gallery.evidence(jnp.stack(rows), jnp.ones(3, bool), posed=True).apart[0, 0])

    move = 0.05 * np.array([0.6, -0.64, 0.48])
    assert apart(np.stack([move, move, move])) < 0.75 * apart(np.stack([move, -move, move[[1, 2, 0]]]))


def _kept(compared: np.ndarray, objects: int) -> tuple[np.ndarray, np.ndarray]:
    """What is kept of each hypothesis, and of each object's size."""
    values = compared[:, :-1].reshape(len(compared), objects, -1)
    return values[..., :-1].reshape(len(compared), objects, YAWS, KEPT), values[0, :, -1]


def _made_up(views: int, objects: int, seed: int) -> np.ndarray:
    """Comparisons of views that show everything."""
    random = np.random.default_rng(seed)
    slope, white = random.normal(size=(views, objects, YAWS, ERRORS, 9)), random.normal(size=(views, objects, YAWS, 9))
    gram = np.einsum("...af,...bf->...ab", slope, slope)[..., *np.triu_indices(ERRORS)] / 9
    square, lean = np.mean(white**2, axis=-1), np.einsum("...f,...ef->...e", white, slope) / 9
    kept = np.concatenate([square[..., None], lean, gram], axis=-1).reshape(views, objects, -1)
    size = np.broadcast_to(random.uniform(0.5, 3, (objects, 1)), (views, objects, 1))
    return np.append(np.concatenate([kept, size], axis=-1).reshape(views, -1), np.ones((views, 1)), axis=1).astype(
        np.float32
    )


def _apart_slowly(compared: np.ndarray, objects: int) -> np.ndarray:
    shows, kept = compared[:, -1], _kept(compared, objects)[0]
    square, lean, gram = (np.asarray(part) for part in parted(jnp.einsum("v,voyk->oyk", shows / shows.sum(), kept)))
    full = np.zeros((*gram.shape[:-1], ERRORS, ERRORS))
    full[..., *np.triu_indices(ERRORS)] = gram
    full += np.swapaxes(np.triu(full, 1), -1, -2) + HELD / shows.sum() * np.eye(ERRORS)
    return square - np.einsum("...a,...a", lean, np.linalg.solve(full, lean[..., None])[..., 0])


def _beliefs_slowly(gallery: Gallery, compared: np.ndarray, posed: bool) -> tuple[np.ndarray, np.ndarray]:
    matcher, objects = gallery.matcher, len(gallery.radii)
    shows, size = compared[:, -1], _kept(compared, objects)[1]
    apart = _apart_slowly(compared, objects)
    numbers = np.array([1, np.log(shows.sum()), np.log(objects)])
    power = np.exp(np.asarray(matcher.heat) @ numbers)
    weights = np.exp(-0.5 * size[:, None]) / (apart + float(matcher.floor)) ** power
    if posed:
        weights[:, 1:] = 0
    weights /= weights.sum()
    best = np.unravel_index(weights.argmax(), weights.shape)
    change = np.square(np.asarray(gallery.slopes)[best[0]]).mean(axis=(0, 1, 3)).sum()
    inputs = [*numbers, np.log(apart[best]), np.log(change + 0.2)]
    odds = np.asarray(matcher.stranger) @ inputs + (size[best[0]] - 1) / 2
    unknown = 1 / (1 + np.exp(-odds))
    return np.append(weights.sum(axis=1) * (1 - unknown), unknown), weights


@pytest.mark.parametrize("posed", [False, True])
def test_beliefs_are_those_of_all_hypotheses(matcher: Matcher, posed: bool) -> None:
    images = (
        np.random.default_rng(4).integers(0, 255, (4, HEIGHTS, YAWS, PIXELS)) * np.arange(4).reshape(4, 1, 1, 1) // 4
    )
    detailed = replace(matcher, stranger=jnp.array([-1.0, 0.2, 0.1, 2.0, -0.7]))
    gallery = Gallery.of(detailed, images.astype(np.uint8), np.zeros(4))
    compared = _made_up(3, 4, seed=3)
    compared[:, -1] = [1.0, 0.4, 0.7]
    shown = jnp.concatenate([jnp.asarray(compared), jnp.full((2, compared.shape[1]), jnp.inf)])  # slots without a view
    evidence = gallery.evidence(jnp.where(jnp.isinf(shown), 9.0, shown), jnp.arange(5) < 3, posed)
    expected, weights = _beliefs_slowly(gallery, compared, posed)
    np.testing.assert_allclose(np.exp(gallery.beliefs(evidence)), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(np.exp(gallery.hypotheses(evidence)), weights, rtol=1e-3, atol=1e-6)


def test_programs_of_galleries_call_no_library(known: TrainedSystem) -> None:
    """JAX's solver of many small systems waits on a CPU's threads for its parts, so two programs side by side wait for ever."""
    gallery = known.parts.gallery
    assert gallery is not None

    def program(compared: Array, directions: Array) -> tuple[Array, Array]:
        evidence = gallery.evidence(compared, jnp.ones(1, bool), False)
        return gallery.beliefs(evidence), gallery.gains(evidence, directions)

    given = jnp.asarray(_made_up(1, 3, seed=4)), jnp.asarray(known.viewpoints[:6], jnp.float32)
    assert "lapack" not in jax.jit(program).lower(*given).as_text()


def test_gains_are_those_of_every_hypothesis_taken_as_true(known: TrainedSystem) -> None:
    gallery = known.parts.gallery
    assert gallery is not None
    compared = _made_up(1, 3, seed=4)
    kept = _kept(compared, 3)[0]  # a view of its memory
    kept[..., 0] += 30.0  # but for a few hypotheses, so that all that count are among the likeliest
    for object_, yaw in ((0, 0), (0, 9), (1, 0), (1, 18), (2, 5)):
        kept[0, object_, yaw, 0] -= 29.0
    compared[:, -1] = 1.0
    directions = np.asarray(known.viewpoints[:6], np.float32)
    evidence = gallery.evidence(jnp.asarray(compared), jnp.ones(1, bool), False)
    gains = np.asarray(gallery.gains(evidence, jnp.asarray(directions)))

    def entropy(weights: np.ndarray) -> float:
        by_object = weights.sum(axis=1)
        return float(-np.sum(by_object * np.log(np.maximum(by_object, 1e-30))))

    now = np.exp(np.asarray(gallery.hypotheses(evidence)))
    least, floor = float(np.asarray(evidence.apart).min()), float(gallery.matcher.floor)
    power = float(gallery.matcher.power(jnp.float32(2), 3))
    square, lean, gram = (np.asarray(part) for part in parted(jnp.asarray(_kept(compared, 3)[0][0])))
    changes = gallery.slopes.reshape(*gallery.slopes.shape[:3], -1)
    for gain, direction in zip(gains, directions, strict=True):
        seen = np.asarray(interpolated(gallery.features, jnp.asarray(direction)))
        slope = np.asarray(interpolated(changes, jnp.asarray(direction))).reshape(*seen.shape[:2], ERRORS, -1)
        grams = np.einsum("oyaf,oybf->oyab", slope, slope)[..., *np.triu_indices(ERRORS)] / seen.shape[-1]
        expected = entropy(now)
        for object_, yaw in np.argwhere(now > 1e-7):
            matrix = np.zeros((ERRORS, ERRORS))
            matrix[np.triu_indices(ERRORS)] = gram[object_, yaw]
            matrix += np.triu(matrix, 1).T + HELD * np.eye(ERRORS)
            off = np.linalg.solve(matrix, lean[object_, yaw])
            apart = seen - (seen[object_, yaw] - off @ slope[object_, yaw])
            squares = square + np.mean(apart**2, axis=-1) + least
            leans = lean + np.einsum("oyf,oyef->oye", apart, slope) / seen.shape[-1]
            left = unexplained(jnp.asarray(squares / 2), jnp.asarray(leans / 2), jnp.asarray((gram + grams) / 2), 2)
            after = np.exp(-0.5 * np.asarray(evidence.size)[:, None]) / (np.asarray(left) + floor) ** power
            expected -= now[object_, yaw] * entropy(after / after.sum())
        assert gain == pytest.approx(expected, abs=2e-3)


def test_differences_by_turn_are_those_of_turned_images() -> None:
    features = np.random.default_rng(5).normal(size=(3, HEIGHTS, YAWS, 2))
    features[2] = np.roll(features[0], 12, axis=1)
    found = differences_by_turn(features)
    for turn in (0, 5, 24):
        slowly = np.mean((features[0, 1:] - np.roll(features[1, 1:], turn, axis=1)) ** 2)
        assert found[0, 1, turn] == pytest.approx(slowly)
    assert found[0, 2].argmin() == 24
    assert found[0, 2, 24] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("turns", [1, 2, 3, 4, 12, 36])
def test_symmetries_are_equal_turns(turns: int) -> None:
    part = np.random.default_rng(turns).normal(size=(HEIGHTS, YAWS // turns, 3))
    assert symmetry_of(np.tile(part, (1, turns, 1))) == turns


def test_views_of_what_tells_objects_apart_are_worth_most(known: TrainedSystem, shapes) -> None:
    """From the left, a box with a knob on its right looks like one without: the camera goes to the right."""
    gallery = known.parts.gallery
    assert gallery is not None
    left = np.array([[-0.96, 0, 0.28]], np.float32)
    depth = capture(normalise(*shapes["knob"], "knob"), turned_rig(CAMERA, left, 0.0)).depth[0] * np.float32(1e-4)
    told = gallery.compared(jnp.asarray(depth), jnp.asarray(left[0]), 2.0, jnp.float32(jnp.nan))
    evidence = gallery.evidence(told[None], jnp.ones(1, bool), posed=True)
    gains = np.asarray(jax.jit(gallery.gains)(evidence, jnp.asarray(known.viewpoints)))
    assert known.viewpoints[gains.argmax()][0] > 0
    assert gains.max() > 2 * max(gains[known.viewpoints[:, 0] < -0.8].max(), 0.0)


def test_oracles_see_the_beliefs_after_each_view(known: TrainedSystem) -> None:
    gallery = known.parts.gallery
    assert gallery is not None
    every = _made_up(len(known.viewpoints), 3, seed=6)
    nothing, seen = jnp.zeros(4), Observation(jnp.zeros((4, 4)), features=jnp.asarray(every[[3, 5, 0, 0]]))
    latest = Observation(nothing, features=jnp.asarray(every[5]))
    views = jnp.array([3, 5, -1, -1])
    state = SelectionState(
        jnp.int32(2), views[1], jnp.isin(jnp.arange(len(every)), views), nothing, latest, views, seen
    )
    scene = Scene(known.graph, features=jnp.asarray(every))
    scores = known.policy("belief_oracle", posed=False)(jax.random.key(0), state, scene)

    def belief(views: list[int]) -> np.ndarray:
        return _beliefs_slowly(gallery, every[views], posed=False)[0]

    final = belief([*range(len(every))])
    after = np.array([belief([3, 5, view]) for view in range(len(every))])
    np.testing.assert_allclose(scores, np.log(after) @ final, rtol=2e-3)
    gains = known.policy("gain_oracle", posed=False)(jax.random.key(0), state, scene)
    np.testing.assert_allclose(gains, np.sum(after * np.log(after), axis=1), rtol=2e-3)


def test_one_object_is_looked_at_from_all_sides(blank: TrainedSystem, shapes) -> None:
    """There is nothing to tell it apart from but what is unknown."""
    alone = enrol({"knob": shapes["knob"]}, blank)
    walks = [
        look(alone, *shapes["tall"], policy=policy, first=7, stop=0.999999, max_views=5)
        for policy in ("information_gain", "farthest")
    ]
    assert walks[0].views == walks[1].views
    assert len(walks[0].views) == 5
