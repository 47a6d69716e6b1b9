"""The programs in `examples/` run as their first lines say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from data_pipeline.objects.furniture import furniture

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        pytest.param("own_policy", "opposite: ", marks=pytest.mark.slow),
        ("load_and_ask", "confident after "),
        pytest.param("depth_camera", " views: sure", marks=pytest.mark.slow),
        pytest.param("ppo", "| PPO − random | +0.0 ", marks=pytest.mark.slow),
        pytest.param("own_encoder", "validation accuracy", marks=pytest.mark.slow),
        pytest.param("stable_baselines", "PPO  ", marks=pytest.mark.slow),
    ],
)
def test_an_example_runs(name, said, whole, tmp_path):
    if name == "stable_baselines":
        for package in ("gymnasium", "stable_baselines3"):
            pytest.importorskip(package, reason="it needs gymnasium and stable_baselines3, which brings PyTorch")
    arguments = {
        "own_policy": [str(whole)],
        "stable_baselines": [str(whole), "2000"],
        "own_encoder": [str(whole), str(tmp_path)],
        "ppo": [str(whole), "--updates", "2", "--episodes", "16", "--networks", "2"],
    }
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), *arguments.get(name, [])]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    assert said in ended.stdout
    assert f"examples/{name}.py" in (EXAMPLES / f"{name}.py").read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--system", "."], "trained.json"),
        (["--policy", "nonsense"], "unknown policy 'nonsense'"),
        (["--views", "0"], "max_views"),
        (["--stop", "0"], "stop"),
        (["--seed", "-1"], "--seed"),
        (["--study", "--each", "0"], "--each"),
        (["--film", "x.mp4"], "must be a .gif"),
        (["--find", "mug"], "--find NAME needs --among"),
        (["--find", "mug", "--among", "mug"], "'mug' is not NAME=FILE"),
        (["--film", "none/x.gif"], "folder that exists"),
        (["--table", "none"], "none"),
        (["--table", ".", "--objects", "0"], "--objects"),
    ],
)
def test_what_the_arm_cannot_use_is_a_sentence(arguments, said, tmp_path, monkeypatch, capsys):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    from examples.robot_arm.__main__ import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["robot_arm", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert said in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_an_arm_recognises_an_object_on_its_table(tmp_path):
    """With a film and the errors of a depth camera, without a display."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    command = [sys.executable, "-m", "examples.robot_arm", "--object", "monitor", "--film", str(tmp_path / "film.gif")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=EXAMPLES.parent)
    if "MuJoCo cannot draw here" in ended.stderr:
        pytest.skip("MuJoCo cannot draw here: the system has no libEGL (libegl1)")
    assert ended.returncode == 0, ended.stderr
    assert "monitor after " in ended.stdout
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames >= 10


@pytest.mark.slow
def test_an_arm_finds_the_object_that_is_wanted(tmp_path):
    """Of three enrolled ones; the others are not taken for it."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    given = []
    for name in ("table", "toilet", "chair"):
        furniture(name, 40).export(tmp_path / f"{name}.ply")
        given.append(f"{name}={tmp_path / name}.ply")
    command = [sys.executable, "-m", "examples.robot_arm", "--find", "chair", "--among", *given]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=EXAMPLES.parent)
    if "MuJoCo cannot draw here" in ended.stderr:
        pytest.skip("MuJoCo cannot draw here: the system has no libEGL (libegl1)")
    assert ended.returncode == 0, ended.stderr
    last = ended.stdout.splitlines()[-1]
    assert "(chair): chair " in last
    assert last.endswith("(sure)")


def test_all_examples_are_run():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {
        "own_policy",
        "own_encoder",
        "stable_baselines",
        "load_and_ask",
        "depth_camera",
        "ppo",
    }
