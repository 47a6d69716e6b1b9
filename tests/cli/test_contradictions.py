"""Later stages of a run refuse options that contradict what the run was made with, and name what differs."""

from __future__ import annotations

import json
import re
import shutil

import pytest

from data_pipeline.errors import DataError
from eval.consistency import check_made_with
from eval.run_file import load_run, save_run
from eval.settings import TINY
from mevs_jax.cli import parsing
from tests.data_pipeline.objects.making import box, members, off, write


def files_of(out):
    """All but the lock, which a command of another test may hold at the same time."""
    return {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != ".lock"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("report --data other", "dataset.source furniture10, not other), which mevs report does not change"),
        ("report --views=7", "dataset.capture.views 6, not 7), which mevs report"),
        ("report --classifier.optimiser.epochs 9", "classifier.optimiser.epochs 2, not 9), which mevs report"),
        ("report --evaluation.draws 3", "evaluation.draws 2, not 3), which mevs report"),
        ("report --encoder mine.py:net", "classifier.encoder"),
        ("report --preset small", "was made with --preset tiny, not small"),
        ("eval --dataset.seed 1 --dataset.capture.views 7", "dataset.seed 0, not 1; dataset.capture.views 6, not 7"),
        ("eval --entropy.network.points 9", "entropy.network.points 64, not 9), which mevs eval does not change"),
        ("eval --archive a.zip", 'dataset.archive "", not a.zip'),
        ("train --data other", "dataset.source furniture10, not other), which mevs train does not change"),
        ("train --classifier.optimiser.epochs 3", "task.optimiser.epochs 2, not 3"),
        ("train --entropy.network.points 32", "task.network_config.points 64, not 32"),
        ("train --encoder nowhere.py:net", "nowhere.py cannot be read"),
        ("train --preset small", "with other settings (task.network_config.depth 10, not 18"),
        ("sweep --views 7", "dataset.capture.views 6, not 7), which mevs sweep does not change"),
        ("check live --classifier.images image", "classifier.images depth, not image), which mevs check live"),
        ("run --data other", "other settings (source furniture10, not other)"),
        ("run --views 7", "other settings (capture.views 6, not 7)"),
        ("run --preset small", "task.network_config.depth 10, not 18"),
        ("study rendering --data other", "dataset.source furniture10, not other); leave these options out"),
        ("study learned --dataset.seed 3", "dataset.seed 0, not 3); leave these options out"),
        (
            "study published-code --classifier.optimiser.learning-rate 0.1",
            "has a classifier trained with other settings (classifier.optimiser.learning_rate 0.001, not 0.1)",
        ),
    ],
)
def test_options_that_contradict_a_run_are_refused(arguments, said, whole, refuses):
    before = files_of(whole)
    assert said in refuses(*arguments.split(), "--out", whole)
    assert files_of(whole) == before


def test_options_that_say_what_the_run_says_are_accepted(whole):
    for command in ("report", "eval", "train"):
        same = ["--out", str(whole), "--dataset.source", "furniture10", "--data", "furniture10", "--views", "6"]
        assert parsing.parse(command, [*same, "--classifier.optimiser.epochs", "2"]).settings == TINY
    seeded = ["--out", str(whole), "--seed", "4", "--classifier.optimiser.epochs", "2"]
    assert parsing.parse("eval", seeded).settings.classifier == TINY.classifier


def test_a_report_says_what_was_done(whole, tmp_path, refuses):
    """A `run.json` that says something else, as an older version left it after a sweep, is noticed."""
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    content = json.loads((out / "run.json").read_text())
    content["settings"]["classifier"]["optimiser"]["epochs"] = 7
    (out / "run.json").write_text(json.dumps(content))
    (out / "checks.json").unlink()
    for command in (("report",), ("eval",), ("check", "live")):
        said = refuses(*command, "--out", out)
        assert "made with other settings than" in said
        assert "run.json says (classifier.optimiser.epochs 2, not 7)" in said
    content["settings"]["classifier"]["optimiser"]["epochs"] = 2
    content["settings"]["evaluation"]["draws"] = 5
    (out / "run.json").write_text(json.dumps(content))
    said = "metrics.json is stale (its settings were others: evaluation.draws 2, not 5); make it again with: mevs eval --out"
    assert said in refuses("report", "--out", out)
    assert said in refuses("export", "--out", out, "--to", tmp_path / "system")


def test_what_a_run_of_version_0_1_was_made_with_is_compared_with_the_options(whole, tmp_path, refuses, at_once):
    """It has no `run.json`, so its settings are given again."""
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    (out / "run.json").unlink()
    assert "(classifier.optimiser.epochs 2, not 9)" in refuses(
        "report", "--out", out, "--preset", "tiny", "--classifier.optimiser.epochs", "9"
    )
    assert "than the options say (dataset.source furniture10, not other)" in refuses(
        "report", "--out", out, "--preset", "tiny", "--data", "other"
    )
    assert "dataset.capture.resolution 32, not 64" in refuses("eval", "--out", out)  # of the preset small
    assert at_once("report", "--out", out, "--preset", "tiny").returncode == 0


def test_settings_of_a_later_version_are_not_compared(whole, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    path = out / "classifier" / "config.json"
    config = json.loads(path.read_text())
    del config["task"]["optimiser"]["parts"]
    path.write_text(json.dumps(config))
    (path.parent / "checks.json").unlink()
    check_made_with(TINY, out)
    config["task"]["optimiser"]["epochs"] = 50
    path.write_text(json.dumps(config))
    with pytest.raises(DataError, match=r"classifier.optimiser.epochs 50, not 2"):
        check_made_with(TINY, out)


def test_what_a_sweep_tries_does_not_become_the_run(whole, tmp_path):
    for name, trained in (("with", True), ("without", False)):
        out = tmp_path / name
        save_run(out, "tiny", TINY, [])
        if trained:
            shutil.copytree(whole / "classifier", out / "classifier")
        options = ["--out", str(out), "--classifier.optimiser.epochs", "9", "--entropy.network.points", "32"]
        call = parsing.parse("sweep", [*options, "--sweep.members", "3"])
        assert call.settings.classifier.optimiser.epochs == 9
        parsing.keep_settings(call)
        kept = load_run(out).settings
        assert kept.classifier.optimiser.epochs == (2 if trained else 9)
        assert (kept.sweep.members, kept.entropy.network.points) == (3, 32)


def test_damaged_files_are_left_out_as_the_run_that_found_them_advises(at_once, refuses, tmp_path):
    files = members() | {"rack/train/rack_9.off": off(*box())[:50]}
    small = ("--views", 3, "--dataset.capture.resolution", 16)
    data = ("data", "--data", write(tmp_path / "set", files), "--out", tmp_path / "run", *small)
    told = re.search(r"or leave such objects out with (--\S+)$", refuses(*data))
    assert "1 left out" in at_once(*data, told[1]).stderr
    assert load_run(tmp_path / "run").settings.dataset.skip_damaged
