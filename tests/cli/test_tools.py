"""Trained systems by the command line: `mevs look`, `mevs export`, `mevs check agent`."""

from __future__ import annotations

import importlib.util
import inspect
import json
import re
import shutil
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest

import mevs_jax
from data_pipeline.objects.furniture import furniture
from eval.checks import transfer
from eval.checks.scenes import CONDITIONS
from mevs_jax.agent import load_history, viewing
from mevs_jax.cli.options import RealityOptions
from mevs_jax.trained import load, save
from tests.cli.conftest import ended
from tests.mevs_jax.trained import making


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tools") / "system"
    save(making.system(), folder)
    return folder


@pytest.fixture(scope="module")
def chair(tmp_path_factory):
    """A mesh file, y up."""
    piece = furniture("chair", 3)
    path = tmp_path_factory.mktemp("meshes") / "chair.obj"
    turned = piece.vertices[:, [0, 2, 1]] * (1, 1, -1)
    lines = [f"v {x} {y} {z}" for x, y, z in turned] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in piece.faces]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Recorded images of a ball with a notch, in metres, of a 32×32 camera."""
    made = making.system()
    poses = np.stack([np.asarray(mevs_jax.look_at_origin(jnp.asarray(point) * 2)) for point in made.viewpoints[:6]])
    depth = np.stack([making.depth_of_ball(point) for point in made.viewpoints[:6]])
    poses[:, :3, 3] = 0.2 * poses[:, :3, 3] + (1, 2, 3)
    focal = 16 / np.tan(np.pi / 6)
    stored = {
        "depth": 0.2 * depth,
        "K": np.array([[focal, 0, 15.5], [0, focal, 15.5], [0, 0, 1]]),
        "T_world_camera": poses,
        "center": np.array([1.0, 2, 3]),
        "radius": np.array(0.2),
    }
    path = tmp_path_factory.mktemp("frames") / "frames.npz"
    np.savez(path, **stored)
    return path, stored


def test_a_mesh_is_looked_at(system, chair, at_once, tmp_path):
    picture, kept = tmp_path / "walk.png", tmp_path / "walk.npz"
    options = [
        "--system",
        system,
        "--mesh",
        chair,
        "--up",
        "y",
        "--max-views",
        3,
        "--stop",
        2,
        "--first",
        4,
        "--unknown",
        1,
    ]
    walk = json.loads(ended(at_once("look", *options, "--json", "--draw", picture, "--save", kept)))
    assert walk["object"] == "chair.obj"
    assert walk["views"][0] == 4
    assert len(set(walk["views"])) == len(walk["beliefs"]) == 3
    assert walk["reason"] == "budget"
    assert walk["answer"] in making.CLASSES
    np.testing.assert_allclose(sum(walk["beliefs"][0]["probabilities"]), 1, rtol=1e-5)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert load_history(kept).views == 3
    piece = furniture("chair", 3)
    again = mevs_jax.look(load(system), piece.vertices, piece.faces, first=4, max_views=3, stop=2, unknown=None)
    assert list(again.views) == walk["views"]
    assert str(again).splitlines()[-1].endswith("after 3 views (budget)")


def test_a_built_in_piece_is_looked_at_by_its_class(system, at_once, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    found = json.loads(ended(at_once("look", "--system", system, "--mesh", "chair", "--max-views", 2, "--json")))
    piece = furniture("chair", 900)
    walk = mevs_jax.look(load(system), piece.vertices, piece.faces, max_views=2)
    assert (found["object"], found["views"]) == ("chair", list(walk.views))


def test_recorded_images_are_looked_at(system, frames, at_once):
    said = at_once(
        "look", "--system", system, "--depth", frames[0], "--stop", 2, "--unknown", 1, "--policy", "farthest"
    )
    lines = ended(said).splitlines()
    assert lines[0] == "frames.npz"
    assert lines[-1].endswith("after 6 views (budget)")
    assert sorted(int(line.split(":")[0].split()[1]) for line in lines[1:-1]) == list(range(6))


def test_a_walk_is_viewed_in_a_browser(system, chair, at_once, monkeypatch):
    served = []

    class Server:
        def get_port(self):
            return 8080

        def sleep_forever(self):
            served.append("waited")

    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if name == "viser" else found(name))
    monkeypatch.setattr(viewing, "view", lambda history, system: served.append(history.views) or Server())
    result = at_once("look", "--system", system, "--mesh", chair, "--view", "--max-views", 2, "--stop", 2)
    assert result.returncode == 0
    assert served == [2, "waited"]
    assert result.stdout.splitlines()[-1] == "Viewer: http://127.0.0.1:8080 (Ctrl-C ends it)"


def test_a_viewer_needs_viser(system, chair, refuses, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "viser" else found(name))
    assert "pip install 'mevs-jax[view]'" in refuses("look", "--system", system, "--mesh", chair, "--view")


def test_what_cannot_be_looked_at_is_one_sentence(system, chair, frames, refuses, tmp_path):
    assert "--mesh FILE or --depth FILE, one of them" in refuses("look", "--system", system)
    assert "one of them" in refuses("look", "--system", system, "--mesh", chair, "--depth", frames[0])
    assert "those that come with the package" in refuses("look", "--system", "nothing", "--mesh", chair)
    assert "unknown policy 'luck'" in refuses("look", "--system", system, "--mesh", chair, "--policy", "luck")
    assert "first must be a view from 0 to 11" in refuses("look", "--system", system, "--mesh", chair, "--first", 12)
    assert "convert it to one of them" in refuses("look", "--system", system, "--mesh", "chair.blend")
    (tmp_path / "empty.off").write_text("OFF\n0 0 0\n")
    assert "empty.off" in refuses("look", "--system", system, "--mesh", tmp_path / "empty.off")
    assert "is no .png, .svg or .pdf" in refuses("look", "--system", system, "--mesh", chair, "--draw", "walk.doc")
    assert "no file" in refuses("look", "--system", system, "--depth", tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    assert "is no .npz of arrays" in refuses("look", "--system", system, "--depth", tmp_path / "text.npz")
    with zipfile.ZipFile(tmp_path / "member.npz", "w") as archive:
        archive.writestr("depth.npy", b"\x92NUMPY")
    assert "its member 'depth' is no array" in refuses("look", "--system", system, "--depth", tmp_path / "member.npz")
    for change, message in (
        ({"depth": None}, "there is no array 'depth'"),
        ({"radius": None}, "center and radius of the object belong together"),
        ({"radius": None, "center": None}, "or a mask of its pixels"),
        ({"depth": np.zeros((6, 8))}, "depth must be (frames, height, width)"),
        ({"T_world_camera": np.zeros((5, 4, 4))}, "T_world_camera must be (6, 4, 4)"),
        ({"K": np.zeros(3)}, "K must be (3, 3)"),
        ({"radius": np.ones(2)}, "radius must be one number"),
        ({"depth": np.ones((6, 32, 32), np.uint16)}, "metres"),
    ):
        stored = {name: value for name, value in (frames[1] | change).items() if value is not None}
        np.savez(tmp_path / "bad.npz", **stored)
        assert message in refuses("look", "--system", system, "--depth", tmp_path / "bad.npz")


def test_a_run_ends_with_a_system_which_can_be_exported(whole, at_once, tmp_path):
    of_run = load(whole)
    assert of_run.description.kind == "classifier"
    assert of_run.name == str(whole)
    assert set(of_run.temperatures) >= {"random", "farthest", "information_gain", "predicted_entropy"}
    metrics = json.loads((whole / "metrics.json").read_text())
    assert of_run.evaluation["after_views"]["random"] == metrics["policies"]["random"]["after_views"]
    run = shutil.copytree(whole, tmp_path / "run")
    (run / "system" / "weights.safetensors").write_bytes(b"damaged")
    result = at_once("export", "--out", run, "--to", tmp_path / "mine", "--half")
    assert result.returncode == 0, result.stderr
    assert "so it is made again" in " ".join(result.stderr.split())
    mine = load(tmp_path / "mine")
    assert mine.description == of_run.description
    assert (run / "system" / "trained.json").read_bytes() == (whole / "system" / "trained.json").read_bytes()
    assert (run / "system" / "weights.safetensors").read_bytes() == (
        whole / "system" / "weights.safetensors"
    ).read_bytes()


def test_what_cannot_be_exported_is_one_sentence(system, refuses, tmp_path):
    assert "one of them" in refuses("export", "--to", tmp_path / "x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert "holds other files" in refuses("export", "--system", system, "--to", tmp_path / "full")
    assert "has no trained.json" in refuses("export", "--out", tmp_path / "full", "--to", tmp_path / "x")


def test_a_card_says_what_was_measured_elsewhere(system, at_once, refuses, tmp_path):
    row = {"stop": 0.95, "views": 8, "wrong": 0.021, "sure": 0.5, "refused": 0.03}
    rows = [row | {"views": 1, "sure": 0.1}, row | {"strangers_sure": 0.004, "strangers_refused": 0.9}]
    rows[0] |= {"strangers_sure": None, "strangers_refused": None}
    found = {"data": "/my/objects.zip", "posed": False, "known": 39, "strangers": 12, "promises": rows}
    (tmp_path / "found.json").write_text(json.dumps(found))
    ended(at_once("export", "--system", system, "--measured", tmp_path / "found.json", "--to", tmp_path / "mine"))
    card = (tmp_path / "mine" / "README.md").read_text()
    assert "| objects, yaw unknown, up to 8 views | 39 | 50.0 % | 2.1 % | 3.0 % |" in card
    assert "| objects, yaw unknown, up to 8 views: of no known class | 12 | 0.4 % | all | 90.0 % |" in card
    again = load(tmp_path / "mine")
    assert again.description.evaluation["elsewhere"][0]["sure"] == 0.5
    (tmp_path / "other.json").write_text("[]")
    said = refuses("export", "--system", system, "--measured", tmp_path / "other.json", "--to", tmp_path / "theirs")
    assert "other.json: not all are results of mevs check transfer --to FILE" in said


@pytest.mark.slow
def test_what_an_agent_promises_is_measured(whole, tmp_path, at_once, refuses):
    run = shutil.copytree(whole, tmp_path / "run")
    said = ended(at_once("check", "agent", "--out", run))
    found = json.loads((run / "agent.json").read_text())
    assert all(walks["same"] == walks["walks"] == 3 for walks in found["walks"].values())
    assert all(walks["largest_difference"] < 1e-4 for walks in found["walks"].values())
    assert found["latency_ms"]["compilations"] == 0
    assert found["camera"][0]["overlap_median"] > 0.9
    assert "information_gain: 3 of 3 walks are those on view tables" in said
    assert "must be at least 1" in refuses("check", "agent", "--out", run, "--agent.objects", 0)


def test_the_conditions_are_those_that_the_help_names():
    text = re.sub(r"\s+", " ", inspect.getsource(RealityOptions))
    assert f"conditions: {', '.join(condition.name for condition in CONDITIONS)}" in text


def test_a_system_meets_other_objects(system, chair, tmp_path, at_once, refuses, monkeypatch):
    monkeypatch.setattr(transfer, "USABLE", ())  # random selection and the system's best are enough here
    for place in ("seat/a.obj", "lamp/b.obj"):
        (tmp_path / "others" / place).parent.mkdir(parents=True)
        shutil.copy(chair, tmp_path / "others" / place)
    (tmp_path / "others" / "lamp" / "c.obj").write_text("v 0 0 0\n")
    brief = ("--draws", "1", "--max-views", "2")
    command = ("check", "transfer", "--system", system, "--data", tmp_path / "others", *brief)
    named = f"seat={load(system).classes[0]}"
    shown = ended(at_once(*command, "--names", named, "--up", "y", "--to", tmp_path / "found.json"))
    assert "1 objects of known classes: seat (1)\n1 objects of unknown classes: lamp (1)" in shown
    assert "left out: lamp/c.obj: mesh has no faces" in shown
    assert json.loads((tmp_path / "found.json").read_text())["known_as"] == {"seat": load(system).classes[0]}
    alone = ended(at_once(*command))
    assert "the system knows none of these classes; if one only has another name, say so: --names FOLDER=CLASS" in alone
    assert "objects of unknown classes that end sure" in alone
    assert "--names seat is not FOLDER=CLASS" in refuses(*command, "--names", "seat")
    assert "No such file or directory); choose another file" in refuses(
        *command, "--to", tmp_path / "none" / "found.json"
    )
    assert "no such file or folder" in refuses("check", "transfer", "--data", tmp_path / "nothing")
