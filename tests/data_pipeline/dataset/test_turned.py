"""Data sets whose objects are each turned: cameras, records, folds and balanced batches."""

from __future__ import annotations

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from data_pipeline.capture.casting import CaptureConfig, rig_for
from data_pipeline.dataset.batches import ViewBatches, equally_often, fold_of, train_batches
from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.statistics import load_statistics
from mevs_jax.geometry.cameras import Camera, look_at_origin, pixel_directions

CAMERA = CaptureConfig(views=6, resolution=48)


def test_cameras_are_turned_by_the_objects_name_and_look_as_they_should():
    config = replace(CAMERA, turned=True)
    straight, rig = rig_for(CAMERA), rig_for(config)
    assert straight.around("a") is straight
    one, other = rig.around("chair/1"), rig.around("chair/2")
    np.testing.assert_array_equal(one.poses, rig.around("chair/1").poses)
    assert np.abs(one.poses - other.poses).max() > 0.1
    for pose, rays in zip(one.poses, one.directions, strict=True):
        np.testing.assert_allclose(pose, look_at_origin(pose[:3, 3]), atol=1e-5)
        camera = Camera(jnp.asarray(pose), math.radians(60), 48)
        np.testing.assert_allclose(rays, pixel_directions(camera), atol=1e-5)
    # Turned as one: the cameras stand to each other as before.
    before, after = (rig.poses[:, :3, 3] @ rig.poses[:, :3, 3].T for rig in (straight, one))
    np.testing.assert_allclose(before, after, atol=1e-4)


def test_turned_views_are_stored_with_their_own_poses(turned):
    examples = [open_split(turned, "train")[index] for index in range(2)]
    names = [example["name"].decode() for example in examples]
    rig = rig_for(load_statistics(turned).camera)
    for name, example in zip(names, examples, strict=True):
        np.testing.assert_allclose(example["pose"], rig.around(name).poses, atol=1e-6)
    assert np.abs(examples[0]["pose"] - examples[1]["pose"]).max() > 0.1


def test_a_part_put_aside_is_never_trained_on(turned):
    names = [open_split(turned, "train")[index]["name"] for index in range(len(open_split(turned, "train")))]
    assert (np.bincount(fold_of(len(names), 3)) >= len(names) // 3).all()
    poses = np.stack([open_split(turned, "train")[index]["pose"][:, 0, 3] for index in range(len(names))])
    aside = fold_of(len(names), 3) == 1
    config = ViewBatches(12, 3, images="depth", fold=(1, 3))
    batches, seen = train_batches(turned, config), set()
    for _ in range(16):
        for x in next(batches)["pose"][:, 0, 3]:
            seen.add(int(np.abs(poses - x).min(axis=1).argmin()))
    assert seen == set(np.flatnonzero(~aside).tolist())


def test_rare_classes_come_as_often_as_others(turned):
    labels = np.array([5, 5, 2, 5, 7, 5, 5, 7])
    drawn = equally_often(np.arange(10, 18), labels)
    np.testing.assert_array_equal(np.bincount(labels[drawn - 10])[[2, 5, 7]], [5, 5, 5])
    assert set(drawn) == set(range(10, 18))
    np.testing.assert_array_equal(np.sort(drawn[labels[drawn - 10] == 5]), [10, 11, 13, 15, 16])
    counts = load_statistics(turned).counts["train"].values()
    batches = train_batches(turned, ViewBatches(20, 2, images="depth", balanced=True))
    in_a_pass = np.concatenate([next(batches)["label"] for _ in range(max(counts))])
    np.testing.assert_array_equal(np.bincount(in_a_pass), [2 * max(counts)] * len(counts))
