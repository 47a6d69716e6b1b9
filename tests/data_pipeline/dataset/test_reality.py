"""Training views as real images would be: beside `canonical_view` with a wrong sphere, and what is removed where."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from data_pipeline.capture.casting import default_caster
from data_pipeline.dataset.reality import (
    RealityAugmentation,
    around_another_sphere,
    as_in_reality,
    hidden,
    realistic_views,
    unseen_part,
    used_reality,
    without_floor,
)
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import normalise
from data_pipeline.objects.recipes import FurniturePiece
from eval.checks.camera import cast_canonical
from eval.settings import TINY
from mevs_jax import canonical_view
from mevs_jax.geometry.cameras import ViewCamera, cameras_at, in_sphere, partial_cloud, pixel_directions
from mevs_jax.geometry.inputs import depth_and_normals
from train.results.identity import content_of
from train.tasks.classifier import ClassifierTask
from train.tasks.recogniser import RecogniserTask

CAMERA = ViewCamera(resolution=64)
DIRECTIONS = np.array([[1, 0.2, 0.4], [-0.6, -0.7, 0.1], [0.3, -0.9, -0.5]])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
POSES = np.asarray(cameras_at(DIRECTIONS.astype(np.float32), distance=CAMERA.distance).pose)


@pytest.fixture(scope="module")
def chair():
    return default_caster()(normalise(*FurniturePiece("chair", 4).load(), "chair"))


@pytest.fixture(scope="module")
def images(chair):
    return np.stack([cast_canonical(chair, direction, CAMERA) for direction in DIRECTIONS])


def test_a_wrong_sphere_gives_what_the_agent_would_see(chair, images):
    """The agent's own image of a camera of four times the resolution, which knows nothing of pixels."""
    fine = replace(CAMERA, resolution=256)
    offset, factor = np.array([0.06, -0.05, 0.04], np.float32), 1.08
    changed = jax.jit(around_another_sphere, static_argnums=2)
    for direction, pose, image in zip(DIRECTIONS, POSES, images, strict=True):
        depth = cast_canonical(chair, direction, fine)
        shown = canonical_view(
            np.where(depth > 0, depth, np.inf).astype(np.float32),
            fine.intrinsics,
            pose.astype(float),
            center=offset,
            radius=factor,
            camera=CAMERA,
        )
        found = np.asarray(changed(image, jnp.asarray(pose), CAMERA, jnp.asarray(offset), factor))
        both = (found > 0) & (shown.depth > 0)
        overlap = both.sum() / ((found > 0) | (shown.depth > 0)).sum()
        before = ((image > 0) & (shown.depth > 0)).sum() / ((image > 0) | (shown.depth > 0)).sum()
        assert overlap > max(0.75, before + 0.1)
        assert np.median(np.abs(found - shown.depth)[both]) < 0.01


def test_the_true_sphere_changes_nothing(images):
    for pose, image in zip(POSES, images, strict=True):
        found = around_another_sphere(jnp.asarray(image), jnp.asarray(pose), CAMERA, jnp.zeros(3), 1.0)
        assert (np.abs(np.asarray(found) - image) < 1e-5).mean() > 0.99


def test_one_side_is_hidden_by_at_most_the_share(images):
    told = []
    for seed in range(8):
        kept = np.asarray(hidden(jax.random.key(seed), jnp.asarray(images[0]), 0.4))
        told.append(np.isnan(kept).any())
        gone = (images[0] > 0) & ~(kept > 0)
        np.testing.assert_array_equal(kept[kept > 0], images[0][kept > 0])
        rest, lost = np.argwhere((images[0] > 0) & ~gone), np.argwhere(gone)
        angles = np.radians(np.arange(360))
        across = np.stack([np.cos(angles), np.sin(angles)])
        apart = (lost @ across).max(axis=0, initial=-1e9) < (rest @ across).min(axis=0) + 0.1
        assert apart.any()  # some straight line separates what is gone from what is kept
        width = np.ptp(np.argwhere(images[0] > 0) @ across, axis=0)
        assert (np.ptp(rest @ across, axis=0) >= 0.55 * width)[apart].any()
    assert 0 < sum(told) < 8
    np.testing.assert_array_equal(hidden(jax.random.key(0), jnp.asarray(images[0]), 0.0), images[0])


def test_the_lowest_part_is_cut_off(images):
    for pose, image in zip(POSES, images, strict=True):
        camera = CAMERA.at(jnp.asarray(pose))
        kept = np.asarray(without_floor(jax.random.key(1), jnp.asarray(image), jnp.asarray(pose), CAMERA, 0.5))
        points, hit = map(np.asarray, partial_cloud(image, camera))
        left = kept.reshape(-1) > 0
        assert 0 < (hit & ~left).sum() < hit.sum()
        assert points[hit & ~left, 2].max() <= points[left, 2].min()
        assert points[left, 2].min() <= points[hit, 2].min() + 0.5


def test_errors_grow_with_the_strength(images):
    def errors(strength: float) -> float:
        config = RealityAugmentation(strength)

        def one(key):
            return as_in_reality(key, key, images[0], POSES[0], CAMERA, config, "stereo")[0]

        found = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 32)))
        near, far = CAMERA.distance - 1.2, CAMERA.distance + 1.2
        assert ((found == 0) | np.isnan(found) | ((found > near) & (found < far))).all()
        return float(np.abs(np.nan_to_num(found) - images[0]).mean())

    assert errors(1e-3) < 0.2 * errors(1.0)


def test_half_of_the_images_show_a_part_of_the_sphere(images):
    square = np.sum(np.asarray(pixel_directions(CAMERA.at(jnp.eye(4)))) ** 2, axis=-1)
    disc = square * (CAMERA.distance**2 - 1) <= CAMERA.distance**2
    np.testing.assert_array_equal(in_sphere(CAMERA, 64), disc)

    def one(key):
        return as_in_reality(key, key, images[0], POSES[0], CAMERA, RealityAugmentation(unseen=0.9), "stereo")[0]

    found = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 256)))
    unknown = np.isnan(found)
    assert not (unknown & ~disc).any()
    same = np.abs(found - images[0]) < 1e-5  # sampled again from the nearest pixel
    assert same[~unknown].mean() > 0.99
    background = unknown[:, disc & (images[0] == 0)].all(axis=1)
    assert 0.08 < background.mean() < 0.25
    shares = np.sort(unknown[~background][:, disc].mean(axis=1))
    assert 0.4 < (shares == 0).mean() < 0.6
    np.testing.assert_allclose(np.quantile(shares[shares > 0], (0.25, 0.5, 0.75)), (0.225, 0.45, 0.675), atol=0.1)
    assert shares.max() < 0.95


def test_the_shares_do_not_depend_on_the_object_and_its_images_are_told_apart():
    keys = jax.random.split(jax.random.key(1), 64)
    parts = np.asarray(jax.vmap(lambda key: unseen_part(key, in_sphere(CAMERA, 32), 0.8))(keys))
    assert len({part.tobytes() for part in parts if part.any()}) == (parts.any(axis=(1, 2))).sum()
    assert not np.asarray(jax.vmap(lambda key: unseen_part(key, in_sphere(CAMERA, 32), 0.0))(keys)).any()


def test_a_fifth_channel_says_what_is_unknown(images):
    image = jnp.asarray(images[0]).at[10:30, 20:40].set(jnp.nan)
    known = jnp.where(jnp.isnan(image), 0.0, image)
    five, four = depth_and_normals(image, CAMERA, 5), depth_and_normals(image, CAMERA)
    np.testing.assert_array_equal(five[..., :4], four)
    np.testing.assert_array_equal(four, depth_and_normals(known, CAMERA))
    np.testing.assert_array_equal(five[..., 4], np.isnan(image))


@pytest.mark.parametrize("kind", ["classifier", pytest.param("recogniser", marks=pytest.mark.slow)])
def test_networks_train_on_it(kind, images):
    task, group = {
        "classifier": (ClassifierTask, TINY.classifier),
        "recogniser": (RecogniserTask, TINY.learned.recogniser),
    }[kind]
    optimiser = replace(group.optimiser, views_per_object=3)
    camera = replace(TINY.dataset.capture, resolution=64)
    plain = task.of(replace(group, optimiser=optimiser), 10, camera)
    changed = task.of(replace(group, optimiser=optimiser, reality=RealityAugmentation(1.0)), 10, camera)
    assert plain.reality is None
    assert "reality" not in content_of(plain)  # as version 0.1 kept it
    assert content_of(changed)["reality"]["strength"] == 1.0
    batch = {
        "depth": jnp.asarray(images * 10_000).astype(jnp.uint16),
        "pose": jnp.asarray(POSES),
        "label": jnp.zeros(3, jnp.int32),
    }
    network = plain.network(nnx.Rngs(0))

    def loss(task) -> float:
        return float(nnx.jit(task.loss)(network, batch, jax.random.key(0), jnp.arange(3), task.hyperparameters)[0])

    losses = [loss(plain), loss(changed)]
    assert np.isfinite(losses).all()
    assert abs(losses[0] - losses[1]) > 1e-4  # the same draws otherwise


def test_views_of_an_object_share_its_wrong_sphere(images):
    """The believed poses of three views are those around one centre, and each object has a centre of its own."""
    batch = {"depth": jnp.asarray(np.tile(images, (2, 1, 1)) * 10_000).astype(jnp.uint16)}
    batch["pose"] = jnp.asarray(np.tile(POSES, (2, 1, 1)))
    config = RealityAugmentation(1.0, sensor="stereo", sphere=0.3)
    change = jax.jit(lambda key, batch: realistic_views(key, batch, CAMERA, config, views=3))
    depth, poses = change(jax.random.key(3), batch)
    assert depth.shape == batch["depth"].shape
    eyes, centres = np.asarray(POSES)[:, :3, 3].astype(float), []
    for believed in np.asarray(poses, float).reshape(2, 3, 4, 4):
        towards = believed[:, :3, 3] / np.linalg.norm(believed[:, :3, 3], axis=1, keepdims=True)
        # The centre lies on each line from a camera against its believed direction: least squares of the three lines.
        across = np.eye(3) - towards[:, :, None] * towards[:, None, :]
        centre = np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, eyes))
        np.testing.assert_allclose(np.einsum("vij,vj->vi", across, eyes - centre), 0, atol=1e-5)
        centres.append(centre)
    assert 0.01 < np.linalg.norm(centres, axis=1).max() < 0.3
    assert np.linalg.norm(centres[0] - centres[1]) > 0.01


def test_numbers_out_of_range_are_refused():
    assert used_reality(RealityAugmentation(), "--x") is None
    for name, value in (
        ("strength", -1.0),
        ("sphere", 0.6),
        ("hidden", 1.0),
        ("floor", float("nan")),
        ("distance", 0.0),
    ):
        with pytest.raises(DataError, match=rf"--x\.{name} .* is not from"):
            used_reality(replace(RealityAugmentation(1.0), **{name: value}), "--x")
    for changes in ({"strength": 4.0, "sphere": 0.3}, {"strength": 3.0, "floor": 0.5}):
        with pytest.raises(DataError, match="nothing of some objects would be left"):
            used_reality(RealityAugmentation(**changes), "--x")
    config = replace(TINY.classifier, images="image", reality=RealityAugmentation(1.0))
    with pytest.raises(DataError, match="for images of depth"):
        ClassifierTask.of(config, 10, TINY.dataset.capture)
