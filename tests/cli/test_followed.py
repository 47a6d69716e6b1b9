"""What messages advise works: a command says something, and then its advice is followed, word for word."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.frames import reading
from data_pipeline.objects.furniture import furniture
from mevs_jax.trained import save
from tests.cli.conftest import ended
from tests.data_pipeline.frames import forms
from tests.data_pipeline.objects.making import box, members, off, write
from tests.eval.checks import test_frames as rooms
from tests.mevs_jax.gallery.conftest import CAMERA, matcher  # noqa: F401
from tests.mevs_jax.trained import making
from train.tasks.matcher import objects_system

BALL = " --center 0.5 0.1 0.8 --radius 0.2"
"""Where the recorded ball is."""


@pytest.fixture(scope="module")
def paths(matcher, tmp_path_factory) -> dict[str, Path]:  # noqa: F811
    """A system, one that objects are enrolled in and one with an object, meshes, recordings and folders of meshes."""
    names = ["system", "blank", "known", "chair.off", "scan", "bare", "room.npz", "set", "unsplit", "damaged", "run"]
    made = {name: tmp_path_factory.mktemp("advice") / name for name in names}
    save(making.system(), made["system"])
    blank = objects_system(matcher, CAMERA)
    blank.save(made["blank"])
    piece = furniture("chair", 3)
    made["chair.off"].write_bytes(off(piece.vertices, piece.faces))
    made["npz"] = forms.npz(made["chair.off"].parent)
    forms.seven_scenes(made["scan"])
    forms.seven_scenes(made["bare"])
    (made["bare"] / "camera-intrinsics.txt").unlink()
    poses = rooms.path_of_camera()[::4]
    np.savez(made["room.npz"], depth=rooms.room(poses), K=rooms.K, T_world_camera=poses)
    write(made["set"], members())
    write(
        made["unsplit"], {f"{kind}/{at}.off": off(*box((1, 1, 1 + at))) for kind in ("mug", "rack") for at in range(5)}
    )
    write(made["damaged"], members() | {"rack/train/rack_9.off": off(*box())[:50]})
    return {name.partition(".")[0]: path for name, path in made.items()}


LOOK = "look --system {system} --max-views 2"
DATA = "data --out {to} --views 3 --dataset.capture.resolution 16 --data "
FOLLOWED = {
    "an object": (LOOK, "--mesh FILE or --depth FILE, one of them", LOOK + " --mesh {chair}"),
    "one object": (
        LOOK + " --mesh {chair} --depth {npz}",
        "--mesh FILE or --depth FILE, one of them",
        LOOK + " --depth {npz}" + BALL,
    ),
    "no sizes": (LOOK + " --mesh {chair} --metres 0.001", "leave out --metres", LOOK + " --mesh {chair}"),
    "images in metres": (
        LOOK + " --depth {npz} --metres 0.001" + BALL,
        "--metres is the metres in one unit of a --mesh",
        LOOK + " --depth {npz}" + BALL,
    ),
    "the floor of a mesh": (
        LOOK + " --mesh {chair} --floor 1",
        "--floor is for recorded depth images.*; leave it out",
        LOOK + " --mesh {chair}",
    ),
    "upward of a mesh": (
        LOOK + " --mesh {chair} --upward 0 0 1",
        "--upward is for recorded depth images.*; leave it out",
        LOOK + " --mesh {chair} --up z",
    ),
    "where the object is": (LOOK + " --depth {scan}", "give --center X Y Z and --radius R", LOOK + " --depth {scan}" + BALL),
    "center and radius": (
        LOOK + " --depth {scan} --center 0.5 0.1 0.8",
        "center and radius of the object belong together",
        LOOK + " --depth {scan}" + BALL,
    ),
    "intrinsics": (
        LOOK + " --depth {bare}" + BALL,
        "give --intrinsics FX FY CX CY",
        LOOK + " --depth {bare} --intrinsics 90 91 40.5 28.5" + BALL,
    ),
    "an archive": (
        LOOK + " --depth {npz} --every 2" + BALL,
        "--every, --depth-unit and --intrinsics are for folders",
        LOOK + " --depth {npz}" + BALL,
    ),
    "too many images": (LOOK + " --depth {scan}" + BALL, r"give (--every \d+)", LOOK + " --depth {scan} {0}" + BALL),
    "the upward direction": (
        "check frames {room} --upward 0 -1 0",
        r"give (--upward [-.\d ]*\d)",
        "check frames {room} {0}",
    ),
    "objects": ("enrol --system {blank} --to {to}", "NAME=FILE", "enrol box={chair} --system {blank} --to {to}"),
    "one at a time": (
        "enrol one={scan} other={scan} --system {blank} --to {to}" + BALL,
        "enrol one at a time, with --system of those before it",
        "enrol one={scan} --system {blank} --to {to}" + BALL,
        "enrol other={scan} --system {to} --to {to}" + BALL,
    ),
    "a name that is taken": (
        "enrol box={chair} --system {known} --to {to}",
        "remove it first, or choose another name",
        "enrol --remove box --system {known} --to {to}",
        "enrol box={chair} --system {to} --to {to}",
        "enrol other={chair} --system {known} --to {to}",
    ),
    "what was enrolled": (
        "enrol box={chair} --system {blank} --to {to}",
        r"recognise with: mevs (look --system \S+)\)",
        "{0} --mesh {chair}",
    ),
    "which system enrols": (
        "enrol box={chair} --system {system} --to {to}",
        "one that mevs_jax.enrol returned",
        "enrol box={chair} --system {known} --rename box=old --to {to}",
    ),
    "what to export": ("export --to {to}", "--out DIR or --system PATH", "export --system {system} --to {to}"),
    "a mesh is no data set": (DATA + "{chair}", "--data takes a folder laid out as", DATA + "{set}"),
    "a share to train on": (DATA + "{unsplit}", r"add (--dataset.split [\d.]+)", DATA + "{unsplit} {0}"),
    "damaged files": (DATA + "{damaged}", r"leave such objects out with (--\S+)\n", DATA + "{damaged} {0}"),
    "too few views": (DATA + "{set} --views 1", "needs at least 2 viewpoints", DATA + "{set} --views 2"),
    "too near": (
        DATA + "{set} --dataset.capture.distance 0.5",
        "--dataset.capture.distance 0.5 is not above 1 .*; choose another",
        DATA + "{set} --dataset.capture.distance 1.5",
    ),
    "other settings": (
        "data --out {run} --views 4",
        "choose another --out, or delete it",
        "data --out {run}",
        DATA + "{set} --views 4",
    ),
}  # fmt: skip
"""What is said, where its advice is found, and the commands that follow it; what is in brackets there is used in these."""


@pytest.mark.parametrize("name", FOLLOWED)
def test_advice_that_is_followed_works(name, paths, at_once, tmp_path, monkeypatch):
    wrong, told, *right = FOLLOWED[name]
    if name == "too many images":
        monkeypatch.setattr(reading, "MOST_FRAMES", 2)
    places = {name: str(path) for name, path in paths.items()} | {"to": str(tmp_path / "to")}
    for of in ("known", "run"):
        if f"{{{of}}}" in " ".join((wrong, *right)) and not paths[of].exists():
            command = {
                "known": "enrol box={chair} --system {blank} --to {known}",
                "run": (DATA + "{set}").replace("to}", "run}"),
            }
            ended(at_once(*command[of].format(**places).split()))
    result = at_once(*wrong.format(**places).split())
    found = re.search(told, result.stdout + result.stderr)
    assert found, result
    for command in right:
        again = at_once(*command.format(*found.groups(), **places).split())
        assert not re.search(told, ended(again) + again.stderr)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lost", "asked"),
    [
        ("metrics.json", "report"),
        ("classifier", "eval"),
        ("entropy", "eval"),
        ("system", "look --mesh {chair} --system"),
    ],
)
def test_a_run_names_the_command_that_makes_what_is_lost(lost, asked, whole, paths, at_once, tmp_path):
    run = shutil.copytree(whole, tmp_path / "run")
    path = run / lost
    path.unlink() if path.is_file() else shutil.rmtree(path)
    again = f"{asked} {run}" if asked.startswith("look") else f"{asked} --out {run}"
    again = again.format(chair=paths["chair"])
    told = re.search(r"with: mevs ((\w+)( --out \S+)?)", at_once(*again.split()).stderr)
    assert told
    ended(at_once(*(told[1] if told[3] else f"{told[2]} --out {run}").split()))
    ended(at_once(*again.split()))
