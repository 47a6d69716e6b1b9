"""What messages of functions advise works: a call fails, and the call that follows its advice does not."""

from __future__ import annotations

import shutil
import urllib.request
from dataclasses import replace
from pathlib import Path
from urllib.error import URLError

import numpy as np
import pytest

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.builder import SUMMARY, DataConfig, prepare
from data_pipeline.dataset.origin import open_objects
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from data_pipeline.frames.reading import read_frames
from data_pipeline.lock import locked
from eval.checks.agent import AgentConfig, recognised
from eval.checks.compiling import CompileCheck, grown
from eval.learned.measure import check_parts
from eval.runs import tasks
from eval.settings import TINY
from mevs_jax import ViewGraph, canonical_view, fibonacci_sphere, read_mesh
from mevs_jax.environment.pure import ActiveRecognition
from tests.advice.listing import matched
from tests.data_pipeline.frames import bagging, forms, test_bags
from tests.data_pipeline.objects.making import box, dae, glb, members, obj, off, ply, stl, threemf, write, zipped
from tests.mevs_jax.geometry.test_canonical import CAMERA, data_set_shot
from tests.mevs_jax.trained import making
from tests.reference.evaluation import some_statistics, some_tables
from train.loop import load_best
from train.tasks.size import SizeConfig, check_sizes

MADE = {".off": off, ".obj": obj, ".stl": stl, ".ply": ply, ".glb": glb, ".dae": dae, ".3mf": threemf}
K = np.array([90.0, 91, 40.5, 28.5])


def refused(told: str, call) -> None:
    with pytest.raises((DataError, ValueError)) as caught:
        call()
    assert matched(told, str(caught.value))


@pytest.mark.parametrize("suffix", MADE)
def test_a_mesh_that_is_exported_again(suffix, tmp_path):
    """As all messages on files of meshes say in some words."""
    path, whole = tmp_path / f"box{suffix}", MADE[suffix](*box())
    path.write_bytes(whole[: len(whole) // 2] + b"f 1 x 3" * (suffix == ".obj"))
    with pytest.raises(DataError, match=r"export it again|repair it|fetch or export"):
        read_mesh(path, "z")
    path.write_bytes(whole)
    assert len(read_mesh(path, "z")[1]) == 12


SHOT = data_set_shot()
RIGHT = {"depth": np.full((64, 64), 2.0, np.float32), "K": SHOT.K, "T_world_camera": SHOT.T_world_camera}
GIVEN = [
    ("convert it, for example depth.astype(np.float32) / 1000 from millimetres",
     "depth", RIGHT["depth"].astype(np.uint16) * 1000, lambda depth: depth.astype(np.float32) / 1000),
    ("check the units of depth (metres), the pose and the mask", "depth", RIGHT["depth"] * 1000, lambda depth: depth / 1000),
    ("depth is a masked array, whose mask would be lost; give depth.filled(numpy.nan)",
     "depth", np.ma.masked_less(RIGHT["depth"], 1), lambda depth: depth.filled(np.nan)),
    ("give True for the pixels of the object and False for the others",
     "mask", np.full((64, 64), 7), lambda mask: mask == 7),
    ("in pixels with positive fx and fy; check that it is not transposed", "K", SHOT.K.T, np.transpose),
    ("for an image of …×… pixels; give K of this resolution", "K", SHOT.K * [[4], [4], [1]], lambda K: K / [[4], [4], [1]]),
    ("is …, not (0, 0, 0, 1); check that the matrix is not transposed", "T_world_camera", SHOT.T_world_camera.T, np.transpose),
    ("take scale and shear out of the pose",
     "T_world_camera", SHOT.T_world_camera @ np.diag([2.0, 2, 2, 1]), lambda pose: pose @ np.diag([0.5, 0.5, 0.5, 1])),
    ("so it mirrors; use right-handed axes (x right, y down, z forward)",
     "T_world_camera", SHOT.T_world_camera @ np.diag([1.0, 1, -1, 1]), lambda pose: pose @ np.diag([1.0, 1, -1, 1])),
    ("check center, T_world_camera (camera → world, not its inverse) and K", "center", (0.0, 0.0, 50.0), lambda _: SHOT.center),
    ("inside its sphere of radius … m; check the poses' units (metres), or give a smaller radius", "radius", 2.5, lambda _: 1.0),
]  # fmt: skip
"""What is said of an argument of `canonical_view`, the argument, and what makes of it what is asked for."""


@pytest.mark.parametrize(("told", "name", "wrong", "mend"), GIVEN)
def test_an_image_that_is_given_as_it_is_asked_for(told, name, wrong, mend):
    options = RIGHT | {"center": SHOT.center, "radius": 1.0, "camera": CAMERA}
    refused(told, lambda: canonical_view(**options | {name: wrong}))
    assert canonical_view(**options | {name: mend(wrong)}).depth.any()


def test_viewpoints_of_other_lengths_and_twice():
    points = 3 * fibonacci_sphere(8)
    refused("viewpoints must be unit vectors: divide each by its length", lambda: ViewGraph.from_points(points))
    twice = np.concatenate([points, points[:1]]) / 3
    refused("two viewpoints coincide: remove one of them", lambda: ViewGraph.from_points(twice))
    assert len(ViewGraph.from_points(twice[:-1]).points) == 8


def test_a_bag_without_a_camera(tmp_path):
    """Of no camera, and of one that cannot be used."""
    for told, plant in (
        (
            "… has no … for the images of … (it has …); record it, or give --intrinsics FX FY CX CY",
            test_bags._without(test_bags.INFO),
        ),
        ("…: …; give --intrinsics FX FY CX CY of rectified images", test_bags._info(K=np.zeros((3, 3)))),
    ):
        whole = bagging.contents(test_bags.ROS2)
        path = bagging.write(tmp_path / told[-5:] / "bag", plant(whole), test_bags.ROS2)
        refused(told, lambda path=path: read_frames(path))
        assert len(read_frames(path, intrinsics=K).depth)
    assert len(read_frames(bagging.write(tmp_path / "recorded", whole, test_bags.ROS2)).depth)


def test_clouds_of_few_points(tmp_path):
    path = forms.clouds(tmp_path / "clouds")
    few = sorted(path.glob("*.pcd"))[0]
    content = few.read_bytes()
    start = content.index(b"DATA binary\n") + 12
    points = np.frombuffer(content[start:], "<f4").copy()
    points[300:] = np.nan
    few.write_bytes(content[:start] + points.tobytes())
    told = "… has … points in front of the camera; give --intrinsics FX FY CX CY, or leave it out"
    refused(told, lambda: read_frames(path))
    assert len(read_frames(path, intrinsics=forms.K[[0, 1, 0, 1], [0, 1, 2, 2]]).depth)
    few.unlink()
    assert len(read_frames(path).depth)


def test_a_run_that_is_in_use(tmp_path):
    def work(out: Path) -> None:
        with locked(out, "mevs train"):
            pass

    with locked(tmp_path, "mevs run"):
        refused("wait until it ends, or choose another --out", lambda: work(tmp_path))
        (tmp_path / "other").mkdir()
        work(tmp_path / "other")
    work(tmp_path)


def test_an_archive_that_cannot_be_downloaded(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise URLError("no network")

    monkeypatch.setattr(urllib.request, "urlopen", fails)
    monkeypatch.setenv("TFDS_DATA_DIR", str(tmp_path))
    refused(
        "download … by other means and pass the file with --archive",
        lambda: open_objects(DataConfig(source="modelnet10")),
    )
    archive = tmp_path / "ModelNet10.zip"
    archive.write_bytes(zipped(members(prefix="ModelNet10/")))
    assert len(open_objects(DataConfig(source="modelnet10", archive=str(archive))).entries) == 6


def test_a_source_that_has_changed_since(tmp_path, capsys):
    """It is said; and where the data set is damaged, it cannot be made again."""
    config = DataConfig(source=str(write(tmp_path / "set", members())), capture=CaptureConfig(views=3, resolution=16))
    prepare(config, tmp_path / "data")
    shutil.copytree(tmp_path / "set", tmp_path / "before")
    write(tmp_path / "set", {"rack/train/rack_9.off": off(*box((2, 1, 1)))})
    told = "… has changed since its data set was made (…); … keeps the objects as they were: delete it, or choose another --out"
    prepare(config, tmp_path / "data")
    assert matched(told, capsys.readouterr().err)
    prepare(config, tmp_path / "other")
    assert not matched(told, capsys.readouterr().err)
    (tmp_path / "data" / SUMMARY).write_text("{")
    shutil.copytree(tmp_path / "data", tmp_path / "deleted")
    told = "has changed since (…); restore either, or delete … to capture the objects as they are now, or choose another --out"
    refused(told, lambda: prepare(config, tmp_path / "data"))
    shutil.rmtree(tmp_path / "deleted")
    assert prepare(config, tmp_path / "deleted").counts["train"]["rack"] == 2
    shutil.rmtree(tmp_path / "set")
    (tmp_path / "before").rename(tmp_path / "set")
    assert prepare(config, tmp_path / "data").counts["train"]["rack"] == 1


def test_a_network_of_another_data_set(whole):
    statistics = load_statistics(whole / "data")
    other = replace(statistics, classes=[*statistics.classes, "lamp"])
    told = "was trained for … …, the data set has …; train a new one with another --out, or evaluate this one on its own data set"
    refused(told, lambda: load_best(tasks(TINY, other)[0], whole / "classifier"))
    assert load_best(tasks(TINY, statistics)[0], whole / "classifier")


def test_an_environment_of_a_run_without_tables(whole, tmp_path):
    told = "… has no view tables … of a run; make them with: mevs run --out …"
    refused(told, lambda: ActiveRecognition.from_run(tmp_path))
    assert ActiveRecognition.from_run(whole)  # which that command has made


def test_sizes_that_were_not_stored(whole):
    told = "was made by a version that did not store radii, so that ….metres cannot be used; choose another --out"
    refused(told, lambda: check_sizes(SizeConfig(metres=1.0), [{"depth": 0}], "--classifier.size"))
    check_sizes(SizeConfig(metres=1.0), [{"radius": 1.0}], "--classifier.size")  # as every data set has them now


def test_numbers_of_checks(whole):
    system = making.system()
    told = "--agent.distances must be above 1 radius and below 100, got …"
    refused(told, lambda: recognised(system, [], AgentConfig(distances=(1.0,))))
    recognised(system, [], AgentConfig(distances=()))
    made = {name: CompileCheck(name, 1, {}, {}, {}) for name in ("gpu:h100", "tpu:v5e:2x2")}
    told = "the figures to compare with are of …, not of …; name their --target"
    refused(told, lambda: grown(made["tpu:v5e:2x2"], made["gpu:h100"]))
    assert grown(made["gpu:h100"], made["gpu:h100"]) == []
    statistics = some_statistics(some_tables())
    told = "the data set has …; raise --dataset.validation-share, or give more objects"
    refused(told, lambda: check_parts(replace(statistics, counts=statistics.counts | {"val": {"a": 1}})))
    check_parts(replace(statistics, counts=statistics.counts | {"val": {"a": 2}}))


def test_a_study_of_ranges(whole):
    pytest.importorskip("optuna")
    from train.many.study import _open
    from train.many.sweep import SweepConfig

    task, statistics = tasks(TINY, load_statistics(whole / "data"))[1], load_statistics(whole / "data")
    told = "--sweep.trials draws from ranges; leave out --sweep.grid and --sweep.list"
    given = SweepConfig(grid=("dropout=0.1",), trials=2)
    refused(told, lambda: _open(task, statistics, whole / "study", given))
    assert _open(task, statistics, whole / "study", replace(given, grid=()))
