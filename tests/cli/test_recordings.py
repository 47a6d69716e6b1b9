"""Folders of recorded depth images by the command line: `mevs look --depth`, `mevs enrol NAME=PATH`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mevs_jax.trained import load, save
from tests.cli.conftest import ended
from tests.data_pipeline.frames import forms
from tests.data_pipeline.objects.test_recorded import recorded
from tests.eval.checks import test_frames as rooms
from tests.mevs_jax.gallery.conftest import CAMERA, matcher  # noqa: F401
from tests.mevs_jax.trained import making
from train.tasks.matcher import objects_system

SPHERE = ("--center", *forms.CENTER, "--radius", forms.RADIUS)
TO_THE_END = ("--stop", 2, "--unknown", 1, "--policy", "farthest", "--json")


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings") / "system"
    save(making.system(), folder)
    return folder


@pytest.fixture
def scan(tmp_path):
    """The ball as of 7-Scenes, and a last image from behind the first camera, which looks away from the ball."""
    folder = forms.seven_scenes(tmp_path / "scan")
    away = forms.poses()[0]
    away[:3, :3] = away[:3, :3] @ np.diag([-1.0, 1, -1])
    np.savetxt(folder / "frame-000003.pose.txt", away)
    forms.write_png(folder / "frame-000003.depth.png", forms.depth_and_mask()[0][0], 0.001)
    return folder


def test_a_folder_is_looked_at_as_the_same_images_in_an_npz(system, scan, at_once, tmp_path):
    depth, _ = forms.depth_and_mask()
    np.savez(
        tmp_path / "same.npz",
        depth=depth.astype(np.float32),
        K=forms.K,
        T_world_camera=forms.poses(),
        floor=np.array(0.7),
        center=forms.CENTER,
        radius=np.array(forms.RADIUS),
    )
    result = at_once("look", "--system", system, "--depth", scan, *SPHERE, "--floor", 0.7, *TO_THE_END)
    walk = json.loads(ended(result).splitlines()[-1])
    other = json.loads(ended(at_once("look", "--system", system, "--depth", tmp_path / "same.npz", *TO_THE_END)))
    assert "1 of 4 images do not show at least 50 % of the object" in result.stderr
    assert walk["views"] == other["views"]
    assert sorted(walk["views"]) == [0, 1, 2]
    assert walk["frames"] == [f"frame-{view:06d}.depth.png" for view in walk["views"]]
    for mine, theirs in zip(walk["beliefs"], other["beliefs"], strict=True):
        np.testing.assert_allclose(mine["probabilities"], theirs["probabilities"], atol=1e-4)


def test_options_go_before_what_an_npz_says(system, at_once, tmp_path, refuses):
    look = ("look", "--system", system, "--depth", forms.npz(tmp_path), *TO_THE_END)
    assert sorted(json.loads(ended(at_once(*look)))["views"]) == [0, 1, 2]
    assert "sphere is not in the image" in refuses(*look, "--center", -50, 0, 0, "--radius", 0.1)


def test_an_object_of_a_scene_is_enrolled_and_recognised_by_its_masks(matcher, at_once, tmp_path):  # noqa: F811
    objects_system(matcher, CAMERA).save(tmp_path / "blank")
    scene, known = forms.bop(tmp_path / "scene"), tmp_path / "known"
    ended(at_once("enrol", f"ball={scene}#5", "--system", tmp_path / "blank", "--to", known))
    assert load(known).classes == ("ball", "unknown object")
    assert float(load(known).parts.gallery.radii[0]) == pytest.approx(forms.RADIUS, rel=0.15)
    seen = ended(at_once("look", "--system", known, "--depth", f"{scene}#5", "--stop", 2))
    assert seen.splitlines()[0] == "scene#5"


def test_images_that_do_not_show_the_object_are_left_out_of_it(matcher, scan, at_once, refuses, tmp_path):  # noqa: F811
    objects_system(matcher, CAMERA).save(tmp_path / "blank")
    start = ("enrol", f"ball={scan}", "--system", tmp_path / "blank", "--to", tmp_path / "known")
    result = at_once(*start, *SPHERE)
    assert "Enrolled: ball" in ended(result)
    assert "Note: 1 of 4 images do not show the object, and are left out" in result.stderr
    assert "no frame shows anything within the object's sphere" in refuses(*start, *SPHERE, "--floor", 9)
    assert "one at a time" in refuses(*start[:2], f"other={scan}", *start[2:], *SPHERE)


def test_what_is_no_recording_is_one_sentence(system, scan, refuses, tmp_path):
    look = ("look", "--system", system)
    assert "images do not say where the object is; give --center" in refuses(*look, "--depth", scan)
    assert "center and radius of the object belong together" in refuses(*look, "--depth", scan, *SPHERE[:4])
    assert "there is no file or folder" in refuses(*look, "--depth", tmp_path / "none", *SPHERE)
    assert "--every, --depth-unit and --intrinsics are for folders" in refuses(
        *look, "--depth", forms.npz(tmp_path), "--every", 2
    )
    assert "--floor is for recorded depth images" in refuses(*look, "--mesh", "chair.obj", "--floor", 1)
    (scan / "frame-000001.pose.txt").unlink()
    sentence = refuses(*look, "--depth", scan, *SPHERE)
    assert sentence.count("frame-000001") == 1
    assert "has no pose beside it; add it" in sentence


def test_a_recording_is_checked_and_its_fault_named(at_once, refuses, tmp_path):
    poses = rooms.path_of_camera()[::4]
    np.savez(tmp_path / "room.npz", depth=rooms.room(poses), K=rooms.K, T_world_camera=poses)
    check = ("check", "frames", tmp_path / "room.npz")
    said = ended(at_once(*check, "--draw", tmp_path / "check.png"))
    assert said.splitlines()[-1] == "No fault was found."
    assert (tmp_path / "check.png").exists()
    assert "give --upward" in ended(at_once(*check, "--upward", 0, -1, 0))
    np.savez(tmp_path / "room.npz", depth=rooms.room(poses), K=rooms.K, T_world_camera=np.linalg.inv(poses))
    assert "room.npz: inverse poses: they are world to camera: invert them" in refuses(*check)
    assert "no two cameras look the same way" in refuses("check", "frames", forms.seven_scenes(tmp_path / "scan"))
    assert "check.txt is no .png" in refuses(*check, "--draw", tmp_path / "check.txt")


@pytest.mark.slow
def test_a_data_set_is_made_of_recordings(tmp_path, at_once):
    for number in range(6):
        path = tmp_path / "in" / ("ball", "globe")[number % 2] / f"{number}.npz"
        recorded(path, radius=np.array((1.2 + number / 20) * forms.RADIUS))
    command = (
        "data",
        "--preset",
        "tiny",
        "--frames",
        tmp_path / "in",
        "--out",
        tmp_path / "run",
        "--dataset.split",
        0.7,
    )
    said = ended(at_once(*command))
    assert "Fused 18 images into 6 meshes" in said
    assert said.count("1 of 4 images do not show the object") == 6
    assert "objects of 2 classes" in said
