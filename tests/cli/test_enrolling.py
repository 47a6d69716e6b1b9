"""`mevs enrol`: objects come, go and get other names; what cannot be is said in one sentence."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

import mevs_jax
from data_pipeline.objects.furniture.solids import box, joined
from tests.cli.conftest import ended
from tests.mevs_jax.gallery.conftest import CAMERA, matcher  # noqa: F401
from tests.mevs_jax.gallery.test_enrolment import AROUND, frames_of
from train.tasks.matcher import objects_system


@pytest.fixture(scope="module")
def objects(matcher, tmp_path_factory):  # noqa: F811
    """Files: a system without objects, a mesh in millimetres, and depth images."""
    folder = tmp_path_factory.mktemp("objects")
    objects_system(matcher, CAMERA).save(folder / "blank")
    tall, flat = joined([box(50, 80, 300)]), joined([box(0.3, 0.2, 0.05), box(0.1, 0.05, 0.06, z=0.05)])
    tall.export(folder / "tall.ply")
    images = frames_of((np.asarray(flat.vertices), np.asarray(flat.faces)), AROUND, 0.2)
    names = {"depth": "depth", "K": "K", "T_world_camera": "pose", "mask": "mask"}
    stacked = {name: np.stack([getattr(image, own) for image in images]) for name, own in names.items()}
    np.savez(folder / "flat.npz", **stacked)
    return folder


def test_objects_are_enrolled_from_files(objects, at_once, tmp_path):
    to = tmp_path / "known"
    start = ("enrol", f"tall={objects / 'tall.ply'}", f"flat={objects / 'flat.npz'}", "--metres", 0.001)
    said = ended(at_once(*start, "--system", objects / "blank", "--to", to))
    assert "Enrolled: tall, flat" in said
    assert f"mevs look --system {to}" in said
    system = mevs_jax.load(to)
    np.testing.assert_allclose(system.parts.gallery.radii[0], np.linalg.norm([0.05, 0.08, 0.3]) / 2, rtol=1e-4)
    seen = ended(at_once("look", "--system", to, "--mesh", objects / "tall.ply", "--metres", 0.001))
    assert seen.splitlines()[-1].startswith("tall,")
    ended(at_once("enrol", "--system", to, "--to", to, "--rename", "tall=box", "--remove", "flat"))
    assert mevs_jax.load(to).classes == ("box", "unknown object")


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ([], "mevs enrol needs objects"),
        (["tall"], "'tall' is not NAME=FILE"),
        (["tall={tall}", "tall={tall}"], "two objects have one name"),
        (["cup={tall}", "--system", "furniture10"], "recognises what it was trained on"),
        (["cup=nowhere.npz"], "there is no file nowhere.npz"),
        (["--remove", "cup"], "no object 'cup' is enrolled; those are none"),
        (["cup={tall}", "--metres", "-1"], "--metres is the metres in one unit"),
    ],
)
def test_what_cannot_be_enrolled_is_said(objects, tmp_path, refuses, given, sentence):
    words = [word.format(tall=objects / "tall.ply") for word in given]
    if "--system" not in words:
        words += ["--system", str(objects / "blank")]
    assert sentence in refuses("enrol", *words, "--to", tmp_path / "to")


def test_textures_are_read_and_what_is_missing_is_said(at_once, tmp_path):
    square = "v -1 0 0\nv 1 0 0\nv 1 0 2\nv -1 0 2\nv 0 1 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl print\n"
    faces = "f 1/1 2/2 3/3 4/4\nf 1/1 2/2 5/3\nf 4/4 3/3 5/2\n"
    for name, colour in (("red", (200, 20, 20)), ("blue", (20, 20, 200))):
        (tmp_path / f"{name}.obj").write_text(f"mtllib {name}.mtl\n{square}{faces}")
        (tmp_path / f"{name}.mtl").write_text(f"newmtl print\nmap_Kd {name}.png\n")
        if name == "red":
            Image.new("RGB", (4, 4), colour).save(tmp_path / f"{name}.png")
    given = [f"{name}={tmp_path / name}.obj" for name in ("red", "blue")]
    out = at_once("enrol", *given, "--metres", 0.1, "--to", tmp_path / "known")
    ended(out)
    assert "blue.obj needs 'blue.png', which is not beside it" in out.stderr
    colours = mevs_jax.load(tmp_path / "known").parts.gallery.colours
    assert np.asarray(colours.objects).tolist() == [0]
    seen = ended(at_once("look", "--system", tmp_path / "known", "--mesh", tmp_path / "red.obj", "--metres", 0.1))
    assert "red" in seen.splitlines()[-1]
