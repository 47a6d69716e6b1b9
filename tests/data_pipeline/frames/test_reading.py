"""Recordings are read to the numbers that they were written from, whatever their form; each fault of a file is named."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from data_pipeline.errors import DataError
from data_pipeline.frames import reading
from data_pipeline.frames.reading import read_frames
from mevs_jax.agent import Frames
from tests.data_pipeline.frames import forms


def same_images(recording, poses=None):
    depth, _ = forms.depth_and_mask()
    np.testing.assert_allclose(recording.depth, depth, atol=1e-6)
    np.testing.assert_array_equal(recording.depth == 0, depth == 0)
    np.testing.assert_allclose(recording.K, np.broadcast_to(forms.K, (3, 3, 3)))
    np.testing.assert_allclose(recording.T_world_camera, forms.poses() if poses is None else poses, atol=1e-9)


def test_an_npz_is_read_with_what_it_says_of_the_object(tmp_path):
    recording = read_frames(forms.npz(tmp_path))
    same_images(recording)
    np.testing.assert_array_equal(recording.mask, forms.depth_and_mask()[1])
    assert recording.known == {"floor": 0.1}
    assert recording.names == ("0", "1", "2")


@pytest.mark.parametrize("above", [False, True])
def test_seven_scenes_in_millimetres_with_the_camera_in_the_folder_or_above(above, tmp_path):
    folder = forms.seven_scenes(tmp_path / "seq-01")
    if above:
        (folder / "camera-intrinsics.txt").rename(tmp_path / "camera-intrinsics.txt")
    recording = read_frames(folder)
    same_images(recording)
    assert recording.mask is None
    assert recording.times is None
    assert recording.names == tuple(f"frame-00000{number}.depth.png" for number in range(3))


def test_tum_images_have_the_nearest_pose_and_those_without_one_are_left_out(tmp_path):
    recording = read_frames(forms.tum(tmp_path / "tum"))
    same_images(recording)
    np.testing.assert_array_equal(recording.times, forms.TIMES)
    assert recording.notes == ("1 of 4 images have no pose within 0.02 s, and are left out",)


def test_an_object_of_a_bop_scene_has_its_masks_and_from_them_its_sphere(tmp_path):
    recording = read_frames(f"{forms.bop(tmp_path / 'scene')}#5")
    same_images(recording)
    np.testing.assert_array_equal(recording.mask, forms.depth_and_mask()[1])
    sphere = Frames.of(recording.arrays()).sphere
    assert np.linalg.norm(sphere.position - forms.CENTER) < 0.1 * forms.RADIUS
    assert abs(sphere.radius / forms.RADIUS - 1) < 0.15


def test_the_sphere_of_an_object_is_that_of_its_model_where_the_data_set_has_models(tmp_path):
    """The model's frame is turned by 0.3 about z against the world, and its box lies off the frame's origin."""
    scene = forms.bop(tmp_path / "test" / "000001")
    (tmp_path / "models").mkdir()
    box = {f"min_{axis}": low for axis, low in zip("xyz", (-100, -200, -200), strict=True)}
    model = box | dict.fromkeys(("size_x", "size_y", "size_z"), 400) | {"diameter": 410}
    (tmp_path / "models" / "models_info.json").write_text(json.dumps({"5": model}))
    sphere = Frames.of(read_frames(f"{scene}#5").arrays()).sphere
    assert sphere.radius == pytest.approx(0.205)
    expected = forms.CENTER + 0.1 * np.array([np.cos(0.3), np.sin(0.3), 0])
    np.testing.assert_allclose(sphere.position, expected, atol=1e-9)
    with pytest.raises(DataError, match=r"models_info.json has no object 1"):
        read_frames(f"{scene}#1")


def test_without_places_of_the_cameras_the_world_is_the_frame_of_the_object(tmp_path):
    folder = forms.bop(tmp_path / "scene", placed=False)
    poses = read_frames(f"{folder}#5").T_world_camera
    relative, true = (np.linalg.inv(each[0]) @ each for each in (poses, forms.poses()))
    np.testing.assert_allclose(relative, true, atol=1e-9)
    np.testing.assert_allclose(
        poses[:, :3, 3] ** 2 @ np.ones(3), ((forms.poses()[:, :3, 3] - forms.CENTER) ** 2).sum(1)
    )
    with pytest.raises(DataError, match="has no cam_R_w2c and cam_t_w2c; choose an object"):
        read_frames(folder)


def test_images_without_the_object_or_that_hide_it_are_left_out(tmp_path):
    folder = forms.bop(tmp_path / "scene")
    truth = json.loads((folder / "scene_gt.json").read_text())
    truth["0"].pop()
    (folder / "scene_gt.json").write_text(json.dumps(truth))
    hidden = np.zeros((forms.HEIGHT, forms.WIDTH), np.uint8)
    Image.fromarray(hidden).save(folder / "mask_visib" / "000002_000001.png")
    recording = read_frames(f"{folder}#5")
    assert recording.names == ("000001.png",)
    assert [note.split(",")[0] for note in recording.notes] == [
        "1 of 3 images have no object 5",
        "1 of 2 images do not show the object",
    ]


@pytest.mark.parametrize("viewpoint", [False, True])
def test_organised_clouds_have_the_camera_that_their_points_say(viewpoint, tmp_path):
    recording = read_frames(forms.clouds(tmp_path / "clouds", viewpoint))
    depth, _ = forms.depth_and_mask()
    np.testing.assert_allclose(recording.depth, depth, atol=1e-6)
    np.testing.assert_allclose(recording.K, np.broadcast_to(forms.K, (3, 3, 3)), rtol=1e-4)
    np.testing.assert_allclose(recording.T_world_camera, forms.poses(), atol=1e-6)
    halved = read_frames(tmp_path / "clouds", metres=0.5, intrinsics=np.array([50.0, 51.0, 39.0, 29.0]))
    np.testing.assert_allclose(halved.depth, depth / 2, atol=1e-6)
    assert halved.K[0, 0, 0] == 50


@pytest.mark.parametrize("unknown", [0, 65535])
def test_images_without_a_measured_pixel_are_left_out_and_counted(unknown, tmp_path):
    folder = forms.seven_scenes(tmp_path / "seq-01")
    for number in (0, 2):
        _image(f"frame-00000{number}.depth.png", np.full_like(DEPTH, unknown))(folder)
    recording = read_frames(folder)
    assert recording.names == ("frame-000001.depth.png",)
    np.testing.assert_allclose(recording.T_world_camera, forms.poses()[1:2], atol=1e-12)
    assert recording.notes == ("2 of 3 images have no measured pixel, and are left out",)
    _image(IMAGE, np.full_like(DEPTH, unknown))(folder)
    with pytest.raises(DataError, match=r"no image such as .* has a measured pixel"):
        read_frames(folder)


def test_frames_of_an_npz_without_a_measured_pixel_are_left_out_and_counted(tmp_path):
    path = forms.npz(tmp_path)
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["depth"][1] = np.nan
    np.savez(path, **arrays)
    recording = read_frames(path)
    assert recording.names == ("0", "2")
    np.testing.assert_array_equal(recording.mask, forms.depth_and_mask()[1][[0, 2]])
    assert recording.notes == ("1 of 3 images have no measured pixel, and are left out",)


def test_every_other_image_another_unit_and_another_camera(tmp_path):
    folder = forms.seven_scenes(tmp_path / "seq-01")
    (folder / "camera-intrinsics.txt").unlink()
    recording = read_frames(folder, every=2, metres=0.002, intrinsics=np.array([50.0, 51.0, 39.0, 29.0]))
    np.testing.assert_allclose(recording.depth, 2 * forms.depth_and_mask()[0][::2], atol=1e-6)
    assert recording.K[1].tolist() == [[50, 0, 39], [0, 51, 29], [0, 0, 1]]
    np.testing.assert_allclose(recording.T_world_camera, forms.poses()[::2], atol=1e-12)


def test_more_images_than_are_read_are_refused_with_the_number_to_give(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MOST_FRAMES", 2)
    with pytest.raises(DataError, match="has 3 images, and at most 2 are read; give --every 2"):
        read_frames(forms.seven_scenes(tmp_path / "seq-01"))
    assert len(read_frames(tmp_path / "seq-01", every=2).depth) == 2


def _text(name, change):
    """Changes a text file of a folder."""

    def apply(folder):
        (folder / name).write_text(change((folder / name).read_text()))

    return apply


def _numbers(name, change):
    """Changes a file of numbers."""

    def apply(folder):
        np.savetxt(folder / name, change(np.loadtxt(folder / name)))

    return apply


def _json(name, change):
    def apply(folder):
        content = json.loads((folder / name).read_text())
        change(content)
        (folder / name).write_text(json.dumps(content))

    return apply


def _image(name, pixels):
    return lambda folder: Image.fromarray(pixels).save(folder / name)


def _mirrored(pose):
    return pose @ np.diag([-1.0, 1, 1, 1])


POSE, IMAGE = "frame-000001.pose.txt", "frame-000001.depth.png"
DEPTH = np.ones((forms.HEIGHT, forms.WIDTH), np.uint16)
FAULTS = {
    "a missing pose": (forms.seven_scenes, lambda one: (one / POSE).unlink(), f"{IMAGE} has no pose beside it"),
    "more poses than images": (forms.seven_scenes, lambda one: (one / IMAGE).unlink(), f"{POSE} has no depth image"),
    "a left-handed pose": (forms.seven_scenes, _numbers(POSE, _mirrored), f"{POSE}: the rotation .* mirrors"),
    "a pose with scale": (
        forms.seven_scenes,
        _numbers(POSE, lambda pose: pose * [[2], [2], [2], [1]]),
        f"{POSE}: .*orthogonal",
    ),
    "a lost pose": (
        forms.seven_scenes,
        _numbers(POSE, lambda pose: pose * np.nan),
        f"{POSE}: .*not finite.*leave out its frame",
    ),
    "half a pose": (forms.seven_scenes, _numbers(POSE, lambda pose: pose[:3]), rf"{POSE}: .*\(3, 4\)"),
    "words in a pose": (forms.seven_scenes, _text(POSE, lambda text: "one " + text), f"{POSE} is no table of numbers"),
    "no intrinsics": (
        forms.seven_scenes,
        lambda one: (one / "camera-intrinsics.txt").unlink(),
        "give --intrinsics FX FY CX CY",
    ),
    "K of another resolution": (
        forms.seven_scenes,
        _numbers("camera-intrinsics.txt", lambda K: K * [[8], [8], [1]]),
        r"camera-intrinsics.txt: the principal point \(324, 228\) is outside of the images of 80×60",
    ),
    "K transposed": (
        forms.seven_scenes,
        _numbers("camera-intrinsics.txt", np.transpose),
        "camera-intrinsics.txt: K is not",
    ),
    "distortion": (
        forms.seven_scenes,
        _text("camera-intrinsics.txt", lambda _: "90 90 40 30 0.1 0 0 0 0"),
        "camera-intrinsics.txt has distortion.*undistort",
    ),
    "images of two sizes": (
        forms.seven_scenes,
        _image(IMAGE, DEPTH[:, :-1]),
        f"{IMAGE} has 79×60 pixels, images before it 80×60",
    ),
    "an image of 8 bits": (
        forms.seven_scenes,
        _image(IMAGE, DEPTH.astype(np.uint8)),
        f"{IMAGE} is no depth image of 16 bits",
    ),
    "a damaged image": (
        forms.seven_scenes,
        lambda one: (one / IMAGE).write_bytes(b"\x89PNG"),
        f"{IMAGE} cannot be read",
    ),
    "a quaternion of another length": (
        forms.tum,
        _text("groundtruth.txt", lambda text: "\n".join(_longer(text))),
        "groundtruth.txt, time 100.0.*quaternion has length",
    ),
    "no poses of TUM": (
        forms.tum,
        lambda one: (one / "groundtruth.txt").unlink(),
        "there is no file .*groundtruth.txt",
    ),
    "poses of another clock": (
        forms.tum,
        _text("depth.txt", lambda text: text.replace("10", "90").replace("20", "80")),
        "within 0.02 s; both need the times of one clock",
    ),
    "no calibration": (forms.tum, lambda one: (one / "calibration.txt").unlink(), "give --intrinsics FX FY CX CY"),
    "distortion of TUM": (
        forms.tum,
        _text("calibration.txt", lambda text: text.strip() + " 0.2 -0.1"),
        "has distortion",
    ),
    "a listed image that is missing": (
        forms.tum,
        lambda one: (one / "depth/100.500000.png").unlink(),
        "there is no image .*100.5",
    ),
    "a list without files": (
        forms.tum,
        _text("depth.txt", lambda _: "100.0"),
        "depth.txt has no lines of a time and a file",
    ),
    "a camera without an image": (
        forms.bop,
        lambda one: (one / "depth/000001.png").unlink(),
        "there is no image .*000001.png",
    ),
    "an image without a camera": (
        forms.bop,
        _json("scene_camera.json", lambda cameras: cameras.pop("1")),
        "scene_camera.json has no camera of depth/000001.png",
    ),
    "no scale": (
        forms.bop,
        _json("scene_camera.json", lambda cameras: cameras["1"].pop("depth_scale")),
        "scene_camera.json, image 1 has no depth_scale",
    ),
    "no mask": (
        forms.bop,
        lambda one: (one / "mask_visib/000001_000000.png").unlink(),
        "there is no image .*000001_000000.png",
    ),
    "distortion of BOP": (
        forms.bop,
        _json("scene_camera.json", lambda cameras: cameras["1"].update(cam_dist=[0.1, 0])),
        "image 1 has distortion",
    ),
    "an object that moves": (
        forms.bop,
        _json("scene_gt.json", lambda truth: truth["1"][0].update(cam_t_m2c=[0, 0, 1500.0])),
        "object 5 of .* moves by",
    ),
    "a cloud that is a list": (
        forms.clouds,
        lambda one: _header(one, "WIDTH 80\nHEIGHT 60", "WIDTH 4800\nHEIGHT 1"),
        "scan1.pcd is a list of 4800 points",
    ),
    "a cloud of another shape": (
        forms.clouds,
        lambda one: _header(one, "WIDTH 80\nHEIGHT 60", "WIDTH 60\nHEIGHT 80"),
        "scan1.pcd: points are not on the rays of their pixels",
    ),
    "half a cloud": (
        forms.clouds,
        lambda one: (one / "scan1.pcd").write_bytes((one / "scan1.pcd").read_bytes()[:4000]),
        "scan1.pcd has .* points that can be read",
    ),
    "clouds without poses": (
        forms.clouds,
        lambda one: [path.unlink() for path in one.glob("*.pose.txt")],
        "has one pose for all clouds",
    ),
    "two of one object": (
        forms.bop,
        _json("scene_gt.json", lambda truth: truth["1"][1].update(obj_id=5)),
        "image 1 has object 5 2 times",
    ),
}


def _header(folder, old, new):
    content = (folder / "scan1.pcd").read_bytes()
    (folder / "scan1.pcd").write_bytes(content.replace(old.encode(), new.encode()))


def _longer(text):
    """Lines of poses whose first number of the quaternion is 1 more."""
    for line in text.splitlines():
        words = line.split()
        yield line if line[0] == "#" else " ".join([*words[:4], str(float(words[4]) + 1), *words[5:]])


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_files_are_named(fault, tmp_path):
    write, plant, message = FAULTS[fault]
    folder = write(tmp_path / "recording")
    path = f"{folder}#5" if write is forms.bop else folder
    read_frames(path)
    plant(folder)
    with pytest.raises(DataError, match=message) as raised:
        read_frames(path)
    assert "\n" not in str(raised.value)


def test_other_files_and_numbers_of_objects_are_refused(tmp_path):
    folder, scene = forms.seven_scenes(tmp_path / "seq-01"), forms.bop(tmp_path / "scene")
    (tmp_path / "empty").mkdir()
    for path, message in (
        (tmp_path / "none", "there is no file or folder"),
        (tmp_path / "empty", "is no recording; known forms are"),
        (f"{folder}#5", "is no BOP scene"),
        (f"{scene}#7", "has no object 7; it has 1, 5"),
        (folder / POSE, "is no .npz"),
    ):
        with pytest.raises(DataError, match=message):
            read_frames(path)
    assert read_frames(scene).mask is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": np.array([[90.0, 0, 200], [0, 90, 20], [0, 0, 1]])}, "principal point"),
        ({"distortion": np.array([0.1, 0])}, "distortion has distortion"),
        ({"depth": np.zeros((3, forms.HEIGHT, forms.WIDTH))}, "no frame has a measured pixel"),
        ({"depth": np.ones((3, forms.HEIGHT, forms.WIDTH), np.uint16)}, "floating type"),
        ({"T_world_camera": np.stack([np.diag([1.0, 1, -1, 1])] * 3)}, "mirrors"),
        ({"T_world_camera": np.eye(4)}, r"must be \(3, 4, 4\)"),
    ],
)
def test_faults_of_an_npz_are_named(change, message, tmp_path):
    path = forms.npz(tmp_path)
    with np.load(path) as stored:
        np.savez(path, **{**stored, **change})
    with pytest.raises(DataError, match=message):
        read_frames(path)
