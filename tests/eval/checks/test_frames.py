"""Faults planted in a recording of a room are noticed by name, one by one; without one, none is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipeline.errors import DataError
from data_pipeline.frames import agreement
from data_pipeline.frames.recording import Recording
from eval.checks.frames import check_frames, draw_check

WIDTH, HEIGHT, IMAGES = 80, 60, 40
K = np.array([[70.0, 0, 41], [0, 70, 28], [0, 0, 1]])
BALLS = np.array(
    [
        [0.6, 0.3, 0.5, 0.5],
        [-0.8, 0.9, 0.4, 0.4],
        [0.2, -1.0, 0.7, 0.3],
        [-0.5, -0.6, 0.25, 0.25],
        [1.2, -0.4, 1.0, 0.3],
    ]
)
"""Centres and radii of what stands in a room of 4 m × 5 m × 2.5 m."""
LOW, HIGH = np.array([-2.0, -2.5, 0]), np.array([2.0, 2.5, 2.5])


def path_of_camera() -> np.ndarray:
    """A hand that goes round an eighth of the room, with every kind of turn."""
    time = np.linspace(0, 1, IMAGES)
    eyes = np.stack([1.6 * np.cos(0.9 * time), 1.6 * np.sin(0.9 * time), 1.3 + 0.3 * np.sin(5 * time)], axis=1)
    poses = np.tile(np.eye(4), (IMAGES, 1, 1))
    for pose, eye, at in zip(poses, eyes, time, strict=True):
        forward = np.array([0.3 * np.sin(7 * at), 0.4 * np.cos(4 * at), 0.4]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", 0.3 * np.sin(9 * at)).as_matrix()
        pose[:3, 3] = eye
    return poses


def room(poses: np.ndarray, K: np.ndarray = K) -> np.ndarray:
    """Depth by rays: the nearest wall or ball."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    depths = []
    for pose in poses:
        ray, eye = rays @ pose[:3, :3].T, pose[:3, 3]
        with np.errstate(divide="ignore"):
            depth = np.where(ray > 0, (HIGH - eye) / ray, (LOW - eye) / ray).min(axis=-1)
        for *center, radius in BALLS:
            away = np.array(center) - eye
            along, square = ray @ away, (ray**2).sum(axis=-1)
            inside = along**2 - square * (away @ away - radius**2)
            near = (along - np.sqrt(np.maximum(inside, 0))) / square
            depth = np.where((inside > 0) & (near > 0), np.minimum(depth, near), depth)
        depths.append(depth)
    noise = 1 + 0.002 * np.random.default_rng(0).standard_normal((len(poses), HEIGHT, WIDTH))
    return (np.stack(depths) * noise).astype(np.float32)


@pytest.fixture(scope="module")
def sound() -> Recording:
    poses = path_of_camera()
    return Recording(
        room(poses), np.tile(K, (IMAGES, 1, 1)), poses, tuple(map(str, range(IMAGES))), times=np.arange(IMAGES) / 10
    )


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(agreement, "ANCHORS", 16)


def poses(change):
    return lambda one: replace(one, T_world_camera=change(one.T_world_camera))


def depth(change):
    return lambda one: replace(one, depth=np.ascontiguousarray(change(one.depth)))


def intrinsics(change):
    return lambda one: replace(one, K=np.stack([change(K) for K in one.K]))


def stretched(fx, fy):
    return intrinsics(lambda K: K * [[fx, 1, 1], [1, fy, 1], [1, 1, 1]])


def swapped(poses):
    """Quaternions that were written w, x, y, z and read as x, y, z, w."""
    changed = poses.copy()
    true = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    changed[:, :3, :3] = Rotation.from_quat(np.roll(true, 1, axis=1)).as_matrix()
    return changed


def turned(rotation, move=(0, 0, 0)):
    offset = np.eye(4)
    offset[:3, :3], offset[:3, 3] = rotation, move
    return poses(lambda them: them @ offset)


def along_rays(depth):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    return depth * np.linalg.norm(rays, axis=-1).astype(np.float32)


def held(values, steps=4):
    """Each value as long as several images."""
    return values[np.arange(len(values)) // steps * steps]


MIRROR = np.diag([1.0, -1, 1, 1])
FAULTS = {
    "K of half the resolution": (
        intrinsics(lambda K: K * [[0.5], [0.5], [1]]),
        "intrinsics of another resolution",
        "by 2",
    ),
    "cx and cy swapped": (
        intrinsics(lambda K: np.array([[70, 0, 28], [0, 70, 41.0], [0, 0, 1]])),
        "swapped principal point",
        "exchange cx and cy",
    ),
    "fx a fifth too long": (
        intrinsics(lambda K: np.array([[84, 0, 41], [0, 70, 28.0], [0, 0, 1]])),
        "focal length",
        "fx is to be",
    ),
    "millimetres as metres": (depth(lambda them: 1000 * them), "implausible depth", "millimetres were read as metres"),
    "poses in millimetres": (
        poses(lambda them: them * np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]])),
        "another unit of depth",
        "by 1000",
    ),
    "depth along rays": (depth(along_rays), "depth along the rays", "divide it"),
    "1 / depth": (depth(lambda them: 1 / them), "inverse depth", "take 1 / depth"),
    "inverse poses": (poses(np.linalg.inv), "inverse poses", "invert them"),
    "a left-handed world": (
        poses(lambda them: MIRROR @ them @ MIRROR),
        "poses of a left-handed frame",
        "from the right",
    ),
    "quaternions swapped": (poses(swapped), "quaternions in another order", "w x y z"),
    "a pose one image late": (
        poses(lambda them: np.concatenate([them[:1], them[:-1]])),
        "poses of other times",
        "images later",
    ),
    "one pose for all": (
        poses(lambda them: np.tile(them[:1], (IMAGES, 1, 1))),
        "one pose for all images",
        "its own pose",
    ),
    "rolled by 90°": (turned(Rotation.from_euler("z", 90, degrees=True).as_matrix()), "cameras rolled by", "-90"),
    "axes of OpenGL": (turned(np.diag([1.0, -1, -1])), "axes of OpenGL", "z backwards"),
    "depth a tenth too far": (depth(lambda them: 1.1 * them), "scale of depth", "multiply depth by 0.9"),
    "depth a tenth too near": (depth(lambda them: 0.9 * them), "scale of depth", "multiply depth by 1.1"),
    "images upside down": (depth(lambda them: them[:, ::-1]), "images flipped upside down", "flip"),
    "images turned by 180°": (depth(lambda them: them[:, ::-1, ::-1]), "images rotated by 180°", "flip"),
    "focal lengths a tenth too short": (
        intrinsics(lambda K: K * [[0.9, 1, 1], [1, 0.9, 1], [1, 1, 1]]),
        "focal length",
        "by 1.111",
    ),
    "fy 1.3 times fx": (stretched(1, 1.3), "focal length", "fx is to be"),
    "principal point aside": (
        intrinsics(lambda K: K + np.outer((4, 0, 0), (0, 0, 1))),
        "principal point",
        "by -4.0 pixels",
    ),
    "cameras turned aside": (
        turned(Rotation.from_euler("y", 5, degrees=True).as_matrix()),
        "hand–eye error",
        "calibrate",
    ),
    "cameras too near": (turned(np.eye(3), (0, 0, 0.1)), "hand–eye error", "0.10"),
    "transposed images": (depth(lambda them: np.swapaxes(them, 1, 2)), "transposed images", "swap rows and columns"),
    "images flipped": (depth(lambda them: them[:, :, ::-1]), "images flipped left-right", "flip"),
    "stale poses": (poses(held), "stale poses", "30 images"),
    "stale images": (depth(held), "stale images", "30 images"),
    "stale times": (lambda one: replace(one, times=held(one.times)), "stale times", "30 images"),
    "a hand–eye error": (
        turned(Rotation.from_euler("xyz", (2, -3, 1.5), degrees=True).as_matrix(), (0.04, -0.03, 0.05)),
        "hand–eye error",
        "calibrate hand and eye",
    ),
}


ESTIMATED = {
    "focal lengths a tenth too short",
    "fy 1.3 times fx",
    "principal point aside",
    "cameras turned aside",
    "cameras too near",
    "depth a tenth too near",
    "fx a fifth too long",
    "a hand–eye error",
    "stale images",
    "stale times",
    "cx and cy swapped",
}
"""Which take some seconds each, since the sizes of faults are estimated."""


@pytest.mark.parametrize(
    "fault", [pytest.param(fault, marks=[pytest.mark.slow] * (fault in ESTIMATED)) for fault in FAULTS]
)
def test_faults_are_noticed_by_name(fault, sound):
    plant, name, said = FAULTS[fault]
    findings = {finding.name: finding.said for finding in check_frames(plant(sound)).findings}
    found = next((one for one in findings if one.startswith(name)), None)
    assert found, findings
    assert said in found + findings[found]


def test_a_sound_recording_has_no_fault_and_its_surfaces_agree(sound, tmp_path):
    found = check_frames(sound)
    assert not found.findings
    assert not found.notes
    near, far = found.levels[0], found.levels[-1]
    assert (near.agree > 0.95, near.through < 0.02, near.error < 0.01) == (True, True, True)
    assert near.degrees < far.degrees
    draw_check(sound, tmp_path / "check.png")
    assert (tmp_path / "check.png").stat().st_size > 10_000


@pytest.mark.slow
def test_estimates_are_near_what_was_planted(sound):
    offset = np.array([0.04, -0.03, 0.05])
    rotation = Rotation.from_euler("xyz", (2, -3, 1.5), degrees=True).as_matrix()
    said = check_frames(turned(rotation, offset)(sound)).findings[0].said
    metres = np.array(eval(said[said.index("([") + 1 : said.index("])") + 1]))
    np.testing.assert_allclose(metres, -rotation.T @ offset, atol=0.01)
    lens = check_frames(FAULTS["fx a fifth too long"][0](sound)).findings[0].said
    assert float(lens.split(" by ")[1].split(",")[0]) == pytest.approx(1 / 1.2, abs=0.02)


def test_upward_is_compared_with_the_largest_surface_from_above(sound):
    (note,) = check_frames(sound, np.array([0.0, -1, 0])).notes
    direction = np.array(note.split("--upward ")[1].split(), float)
    np.testing.assert_allclose(direction, (0, 0, 1), atol=0.03)


def test_a_camera_that_stands_still_for_a_while_is_no_fault(sound):
    still = sound.T_world_camera.copy()
    still[10:20] = still[10]
    assert not check_frames(replace(sound, depth=room(still), T_world_camera=still)).findings


def test_one_lost_image_is_named_in_a_note(sound):
    lost = sound.T_world_camera.copy()
    lost[0, :3, 3] += 1.0
    found = check_frames(replace(sound, T_world_camera=lost))
    assert not found.findings
    assert "do not agree with those near them: 0" in found.notes[0]


def test_images_that_cannot_be_compared_are_one_sentence(sound):
    one = replace(sound, depth=sound.depth[:1], K=sound.K[:1], T_world_camera=sound.T_world_camera[:1], times=None)
    with pytest.raises(DataError, match="there is one image"):
        check_frames(one)
    away = sound.T_world_camera[:2] @ np.stack([np.eye(4), np.diag([-1.0, 1, -1, 1])])
    with pytest.raises(DataError, match="no two cameras look the same way"):
        check_frames(replace(one, depth=sound.depth[:2], K=sound.K[:2], T_world_camera=away))
