"""Bags of ROS 1 and ROS 2 are read to the numbers that they were written from; what cannot be used is named."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from data_pipeline.errors import DataError
from data_pipeline.frames.reading import read_frames
from tests.data_pipeline.frames import forms
from tests.data_pipeline.frames.test_reading import same_images

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install rosbags")
from tests.data_pipeline.frames.bagging import DEPTH, INFO, Messages, contents, write

ROS1, ROS2 = Messages(True), Messages(False)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "mono16"])
@pytest.mark.parametrize("form", ["ros1", "SQLITE3", "MCAP", "file.mcap"])
def test_images_have_the_interpolated_transform_of_their_time(form, encoding, tmp_path):
    messages = ROS1 if form == "ros1" else ROS2
    name, storage = ("scan.bag", "") if form == "ros1" else ("scan", form if form.isupper() else "MCAP")
    path = write(tmp_path / name, contents(messages, encoding), messages, storage)
    recording = read_frames(next(path.glob("*.mcap")) if form == "file.mcap" else path)
    same_images(recording)
    np.testing.assert_allclose(recording.times, forms.TIMES)
    assert recording.notes == ("1 of 4 images have no pose of their time, and are left out",)
    np.testing.assert_allclose(read_frames(path, every=2).T_world_camera, forms.poses()[::2], atol=1e-9)


@pytest.mark.parametrize(("encoding", "error"), [("16UC1", 1e-6), ("32FC1", 0.03)])
def test_compressed_depth_is_read(encoding, error, tmp_path):
    true = forms.depth_and_mask()[0]
    images = [ROS2.compressed(time, depth, encoding) for time, depth in zip(forms.TIMES, true, strict=True)]
    found = [(DEPTH + "/compressedDepth", time, image) for time, image in zip(forms.TIMES, images, strict=True)]
    recording = read_frames(write(tmp_path / "bag", [*_without(DEPTH)(contents(ROS2)), *found], ROS2))
    np.testing.assert_array_equal(recording.depth > 0, true > 0)
    np.testing.assert_allclose(recording.depth, true, atol=error)
    np.testing.assert_allclose(recording.K[0], forms.K)


def test_distortion_is_undone_where_images_are_not_rectified(tmp_path):
    """Against images that are sampled through OpenCV's own model, written out for one point."""
    given = (0.1, -0.05, 0.002, -0.003, 0.01)
    found = [one if one[0] != INFO else (INFO, 99.5, ROS2.info(distortion=given)) for one in contents(ROS2)]
    recording = read_frames(write(tmp_path / "bag", found, ROS2))
    bent = forms.depth_and_mask()[0][0]
    for row, column in ((10, 12), (30, 40), (50, 70), (0, 0)):
        x, y = (column - 40.5) / 90, (row - 28.5) / 91
        r = x * x + y * y
        radial = 1 + 0.1 * r - 0.05 * r**2 + 0.01 * r**3
        u = 90 * (x * radial + 2 * 0.002 * x * y - 0.003 * (r + 2 * x * x)) + 40.5
        v = 91 * (y * radial + 0.002 * (r + 2 * y * y) - 2 * 0.003 * x * y) + 28.5
        inside = -0.5 < u < forms.WIDTH - 0.5 and -0.5 < v < forms.HEIGHT - 0.5
        expected = bent[round(v), round(u)] if inside else 0
        assert recording.depth[0, row, column] == pytest.approx(expected, abs=1e-6)
    rectified = [(topic.replace("image_raw", "image_rect_raw"), *rest) for topic, *rest in found]
    same_images(read_frames(write(tmp_path / "rectified", rectified, ROS2)))


def test_poses_of_a_topic_stand_in_for_transforms(tmp_path):
    found = [one for one in contents(ROS2) if not one[0].startswith("/tf")]
    found += [("/vicon", time, ROS2.pose(time, pose)) for time, pose in zip(forms.TIMES, forms.poses(), strict=True)]
    recording = read_frames(write(tmp_path / "bag", found, ROS2))
    same_images(recording)
    assert "/vicon does not say of which frame it is the pose" in recording.notes[0]
    found.append(("/other", 100.0, ROS2.pose(100.0, np.eye(4))))
    two = write(tmp_path / "two", found, ROS2)
    with pytest.raises(DataError, match=r"it has 2: /other, /vicon; choose one as .*#IMAGES,POSES"):
        read_frames(two)
    same_images(read_frames(f"{two}#{DEPTH},/vicon"))


def _only(*topics):
    return lambda found: [one for one in found if one[0] in topics]


def _without(topic):
    return lambda found: [one for one in found if not one[0].startswith(topic)]


def _info(**changed):
    return lambda found: [*_without(INFO)(found), (INFO, 99.5, ROS2.info(**changed))]


FAULTS = {
    "no depth": (_without(DEPTH), "should have one topic of depth images, it has none"),
    "two depths": (
        lambda found: [*found, *[("/other" + topic, *rest) for topic, *rest in found if topic == DEPTH]],
        "choose one as .*#TOPIC",
    ),
    "no CameraInfo": (_without(INFO), "has no /cam/depth/camera_info .*give --intrinsics"),
    "no poses": (_only(DEPTH, INFO), "should have one topic of poses of the camera"),
    "no transform in time": (
        lambda found: [one for one in found if one[0] != "/tf" or one[1] < 99.97],
        "no image of .* has a pose of its time",
    ),
    "CameraInfo of another size": (_info(width=160), "images have 80×60 pixels, their CameraInfo is of 160×60"),
    "an uncalibrated camera": (_info(K=np.zeros((3, 3))), "camera_info: K is not"),
    "an unknown lens": (
        _info(distortion=(0.1,) * 14, model="rational_polynomial"),
        "with 14 coefficients cannot be undone",
    ),
    "a short image": (
        lambda found: [*_without(DEPTH)(found), (DEPTH, 100.0, _short())],
        "has 10 bytes",
    ),
    "a quaternion of another length": (
        lambda found: [*found, ("/tf_static", 99.1, _long())],
        "other in map .*length 2",
    ),
}


def _short():
    image = ROS2.image(100.0, forms.depth_and_mask()[0][0], "16UC1")
    image.data = image.data[:10]
    return image


def _long():
    one = ROS2.transform(99.0, "map", "other", np.eye(4))
    one.transform.rotation.w = 2.0
    return ROS2.make("tf2_msgs/msg/TFMessage", transforms=[one])


@pytest.mark.parametrize("fault", FAULTS)
def test_what_a_bag_lacks_is_named(fault, tmp_path):
    plant, message = FAULTS[fault]
    path = write(tmp_path / "bag", plant(contents(ROS2)), ROS2)
    with pytest.raises(DataError, match=message) as raised:
        read_frames(path)
    assert "\n" not in str(raised.value)


def test_a_damaged_bag_and_a_missing_package_are_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "half.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\0" * 40)
    with pytest.raises(DataError, match=r"half.mcap cannot be read"):
        read_frames(tmp_path / "half.mcap")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(DataError, match=r"pip install 'mevs-jax\[ros\]'"):
        read_frames(tmp_path / "half.mcap")
