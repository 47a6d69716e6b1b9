"""What commands are given whose advice is followed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from data_pipeline.objects.furniture import furniture
from mevs_jax import fibonacci_sphere
from mevs_jax.trained import save
from tests.cli.conftest import at_once, ended, refuses  # noqa: F401
from tests.data_pipeline.frames import forms
from tests.data_pipeline.objects.making import box, members, off, write
from tests.eval.checks import test_frames as rooms
from tests.mevs_jax.gallery.conftest import CAMERA, matcher  # noqa: F401
from tests.mevs_jax.trained import making
from tests.train.tasks.test_own_encoder import ENCODER
from train.tasks.matcher import objects_system

DATA = "data --out {to} --views 3 --dataset.capture.resolution 16 --data "
MADE = {
    "known": "enrol box={chair} --system {blank} --to {known}",
    "run": DATA.replace("{to}", "{run}") + "{set}",
}
"""The commands that make what takes seconds; each is run once, where it is first named."""


OTHERS = """
def none(**rest): return 3
def plain(**rest): return nnx.List([])
def odd(classes, channels): ...
def three(**rest): return Net(3, rest["channels"], 0, rest["rngs"])
def scores(key, state, scene): return scene.graph.distances[state.view]
def plain_odd(key): return key
def few(key, state, scene): return scene.graph.distances[state.view][:2]
def fails(key, state, scene): return scene.no_such_field
"""
"""Functions that are no encoders, and a policy."""
SPLITS = {"train": (0, 1, 2), "test": (3, 4)}
"""Numbers of the objects of a class in `unsplit`."""


@pytest.fixture(scope="session")
def given(matcher, tmp_path_factory) -> dict[str, Path]:  # noqa: F811
    """A system, one that objects are enrolled in and one with an object, meshes, recordings and folders of meshes."""
    root = tmp_path_factory.mktemp("advice")
    made = {
        name: root / name
        for name in (
            "system",
            "blank",
            "known",
            "scan",
            "bare",
            "set",
            "unsplit",
            "damaged",
            "run",
            "empty",
            "few",
            "hollow",
            "sized",
        )
    }
    made |= {
        "chair": root / "chair.off",
        "room": root / "room.npz",
        "list": root / "list.csv",
        "no_list": root / "no.csv",
        "splits": root / "splits.json",
        "views": root / "views.json",
    }
    made |= {"weights": root / "18.safetensors", "others": root / "34.safetensors"}
    made |= {"text": root / "text.txt", "own": root / "own.py", "npz": forms.npz(root)}
    save(making.system(), made["system"])
    objects_system(matcher, CAMERA).save(made["blank"])
    piece = furniture("chair", 3)
    made["chair"].write_bytes(off(piece.vertices, piece.faces))
    forms.seven_scenes(made["scan"])
    forms.seven_scenes(made["bare"])
    (made["bare"] / "camera-intrinsics.txt").unlink()
    poses = rooms.path_of_camera()[::4]
    np.savez(made["room"], depth=rooms.room(poses), K=rooms.K, T_world_camera=poses)
    write(made["set"], members())
    boxes = {f"{kind}/{at}.off": off(*box((1, 1, 1 + at))) for kind in ("mug", "rack") for at in range(5)}
    write(made["unsplit"], boxes)
    write(made["damaged"], members() | {"rack/train/rack_9.off": off(*box())[:50]})
    write(made["few"], {f"{kind}/a.off": off(*box()) for kind in ("mug", "rack")})
    made["empty"].mkdir()
    named = {split: [f"{kind}/{at}.off" for kind in ("mug", "rack") for at in own] for split, own in SPLITS.items()}
    made["splits"].write_text(json.dumps(named))
    made["views"].write_text(json.dumps(fibonacci_sphere(4).tolist()))
    made["list"].write_text("learning-rate,dropout\n1e-3,0.1\n")
    made["no_list"].write_text("learning-rate\n")
    made["text"].write_text("hello")
    made["text"].with_name("text.txt.py").write_text("hello")
    made["own"].write_text(ENCODER + OTHERS)
    write(made["hollow"], members() | {"mug/train/flat.off": off(box()[0], [])})
    save(making.system("sized"), made["sized"])
    for name, blocks in (("weights", 2), ("others", 6)):  # of ResNet-18 and -34
        save_file({f"layer3.{blocks - 1}.conv1.weight": np.zeros(1, np.float32)}, made[name])
    return made


@pytest.fixture
def places(given, at_once, tmp_path, request) -> Places:  # noqa: F811
    return Places(given | {"to": tmp_path / "to"}, at_once, tmp_path, request)


class Places(dict[str, str]):
    """Paths by name for `str.format_map`; what takes seconds to make is made when it is first named."""

    def __init__(self, paths: dict[str, Path], at_once, folder: Path, request: pytest.FixtureRequest):  # noqa: F811
        super().__init__({name: str(path) for name, path in paths.items()})
        self._at_once, self._folder, self._request = at_once, folder, request

    def __getitem__(self, name: str) -> str:
        if name == "whole" and name not in self:
            self[name] = str(shutil.copytree(self._request.getfixturevalue("whole"), self._folder / "whole"))
        if name == "half" and name not in self:
            (self._folder / "half").mkdir()
            (self._folder / "half" / "data").symlink_to(self._request.getfixturevalue("data"))
            self[name] = str(self._folder / "half")
        path = super().__getitem__(name)
        if name in MADE and not Path(path).exists():
            ended(self._at_once(*MADE[name].format_map(dict(self)).split()))
        return path
