"""A job that survives being killed, and what each command adds to it."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.files import keep_json
from eval.learned.stage import learn_to_choose
from eval.settings import TINY
from eval.stages import ascend_on_objects, report
from tests.cli.conftest import MEVS, ended, one_after_another, refused
from tests.conftest import open3d_or_skip
from tests.reference.leaks import LEARNED


def test_the_job_leaves_a_report_and_metrics(whole):
    metrics = json.loads((whole / "metrics.json").read_text())
    assert metrics["objects"] == 10
    assert metrics["views"] == 6
    page = (whole / "report" / "index.html").read_text()
    assert "http" not in page.replace("http://www.w3.org", "").replace("https://www.w3.org", "")  # needs no other file
    assert re.findall(r"<h2[^>]*>(.*?)</h2>", page) == [
        "Objects, and the views chosen around them",
        "Accuracy by policy",
        "Accuracy by distance travelled",
        "Confidence and calibration",
        "The thesis's grid",
        "Differences between the thesis and its published code",
        "Predicting depth entropy",
        "Training",
        "Data",
        "Methods",
        "What to do next",
    ]
    for rung in metrics["ladder"]:
        assert html.escape(rung["title"]) in page
    assert "0 objects were left out" in page
    notice, lead = page.index('<p class="warning"'), page.index('<p class="lead">')
    assert page[notice:lead].count("chance: test accuracy") == 1  # two epochs on 30 objects teach too little
    assert notice < lead


@pytest.mark.slow
def test_a_run_that_diverges_ends_with_one_sentence(data, tmp_path, at_once):
    """A learning rate at which the loss stays finite, and results from the classifier's outputs do not."""
    (tmp_path / "data").symlink_to(data)
    rate = ("--classifier.optimiser.learning-rate", "1e6", "--entropy.optimiser.epochs", "1")
    ended = refused(at_once("run", "--preset", "tiny", "--out", tmp_path, *rate), code=3)
    assert re.search(r"not finite.*; to train it again, lower --classifier.optimiser.learning-rate, and delete", ended)
    assert not (tmp_path / "metrics.json").exists()


def test_a_second_run_redoes_nothing(whole, tmp_path, at_once):
    out = shutil.copytree(whole, tmp_path / "run")
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    ended(at_once("run", "--preset", "tiny", "--out", out))
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}


def test_networks_for_another_number_of_views_are_refused(whole, tmp_path, refuses):
    for name in ("data", "classifier", "entropy"):
        shutil.copytree(whole / name, tmp_path / name)
    config = tmp_path / "entropy" / "config.json"
    config.write_text(config.read_text().replace('"views": 6', '"views": 8'))
    (tmp_path / "entropy" / "checks.json").unlink()  # as version 0.1 left networks; the change would be found by it
    assert "was trained for 8 views, the data set has 6" in refuses("eval", "--preset", "tiny", "--out", tmp_path)


@pytest.mark.slow
def test_learning_writes_a_page_and_is_not_repeated(studied, tmp_path, capsys):
    """What `mevs study learned` adds to a run, with ablations and classes that are left out."""
    out = tmp_path / "run"
    shutil.copytree(studied, out)
    page = (out / "learned" / "index.html").read_text()
    summary = out / "learned" / "seed_0" / "policies" / "learned" / "summary.json"
    made_once = summary.stat().st_mtime_ns
    assert learn_to_choose(LEARNED, out).read_text() == page
    assert summary.stat().st_mtime_ns == made_once
    assert "Learned fusion and view selection" in report(LEARNED, "tiny", out).read_text()
    trained_again = out / "learned" / "seed_0" / "recogniser" / "summary.json"
    keep_json(trained_again, json.loads(trained_again.read_text()) | {"best_epoch": 99})
    capsys.readouterr()
    assert "Learned fusion and view selection" not in report(LEARNED, "tiny", out).read_text()
    left_out = f"so the report leaves it out; make it again with: mevs study learned --out {out}"
    assert left_out in " ".join(capsys.readouterr().err.split())
    said = [
        "6 candidate views",
        "Unknown yaw",
        "Stopping when a further view does not pay",
        "PointNet++ entropy (thesis)",
        "view policy",
    ]
    said += ["label-free oracle", "Classes left out of policy training", "Means of 2 seeds", "Any rotation"]
    for words in (*said, "Information gain by expected views reaches", "Other random seeds"):
        assert html.escape(words) in page


@pytest.mark.slow
def test_published_code_and_ascents_fill_their_tables(whole, tmp_path, at_once):
    """One evaluation of what `mevs study published-code` and `mevs study rendering` add to a run."""
    open3d_or_skip()
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    assert "mevs study published-code" in (out / "report" / "index.html").read_text()
    ascend_on_objects(TINY, out)
    ended(at_once("compat", "--preset", "tiny", "--out", out))
    metrics = json.loads((out / "metrics.json").read_text())
    made = metrics["compatibility"]
    assert all(row["difference"] is not None for row in made["rows"].values())
    assert set(made["single_view_accuracy"]) == {"classifier", "classifier_by_view"}
    assert (metrics["climbing"]["objects"], metrics["climbing"]["views"]) == (1, 6)
    assert {"random", "predicted_entropy", "diff_volume", "diff_mesh"} <= set(metrics["climbing"]["policies"])
    page = (out / "report" / "index.html").read_text()
    assert "Choosing by differentiable rendering" in page
    assert "mevs study published-code" not in page
    before = json.loads((whole / "metrics.json").read_text())
    assert before["compatibility"]["rows"]["text"] == made["rows"]["text"]


LIVE = ("check", "live", "--live.objects", "6")


@pytest.mark.parametrize(
    "policies",
    [
        ("predicted_entropy",),
        pytest.param(("random", "predicted_entropy", "information_gain"), marks=pytest.mark.slow),
    ],
    ids=len,
)
def test_live_walks_what_the_tables_say(policies, whole, tmp_path, at_once, refuses):
    shutil.copytree(whole, tmp_path / "run")
    arguments = (*LIVE, "--preset", "tiny", "--out", tmp_path / "run", "--live.policies")
    ended(at_once(*arguments, *policies))
    found = json.loads((tmp_path / "run" / "live.json").read_text())
    assert set(found) == set(policies)
    for policy, agreement in found.items():
        assert agreement["walks"] == agreement["same"] == 6, policy
    assert "unknown policy 'fly'" in refuses(*arguments, "fly")


@pytest.mark.slow
def test_many_devices_say_what_one_does(whole, tmp_path):
    """View tables and live walks on four simulated devices, whose number divides neither the objects nor the chunks."""
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    shutil.rmtree(out / "tables")
    (out / "metrics.json").unlink()
    evaluate, walk = ("eval", "--out", out), (*LIVE, "--out", out, "--live.policies", "random")
    ended(one_after_another(evaluate, walk, JAX_NUM_CPU_DEVICES="4"))
    with np.load(out / "tables" / "test.npz") as mine, np.load(whole / "tables" / "test.npz") as theirs:
        for name in ("logits", "predicted_entropy"):
            np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-4, atol=1e-5)
    agreement = json.loads((out / "live.json").read_text())["random"]
    assert agreement["walks"] == agreement["same"] == 6


def test_a_sweep_without_members_is_refused(whole, tmp_path, refuses):
    (tmp_path / "data").symlink_to(whole / "data")
    arguments = ("sweep", "--preset", "tiny", "--out", tmp_path, "--sweep.members", "0")
    assert "--sweep.members 0 is too few" in refuses(*arguments)


@pytest.mark.slow
def test_a_sweep_is_made_by_command(whole, tmp_path, at_once):
    (tmp_path / "data").symlink_to(whole / "data")
    said = ended(at_once("sweep", "--preset", "tiny", "--out", tmp_path, "--sweep.members", "3"))
    assert "Best of 3: validation loss" in said
    assert len(json.loads((tmp_path / "sweep" / "entropy" / "members.json").read_text())) == 3
    grid = ("--grid", "learning-rate=1e-4,1e-3", "--seeds", "2", "--adopt", "--sweep.network", "classifier")
    said = ended(at_once("sweep", "--out", tmp_path, *grid))
    assert "Best of 4: validation loss" in said
    assert f"The run has it now: {tmp_path / 'classifier'}" in said
    kept = json.loads((tmp_path / "run.json").read_text())["settings"]
    assert kept["classifier"]["optimiser"]["learning_rate"] in (1e-4, 1e-3)
    assert kept["seeds"] == 1
    ended(at_once("train", "--out", tmp_path))  # trains the other network alone


def test_a_reach_that_leaves_nothing_is_refused(whole, refuses):
    arguments = ("eval", "--preset", "tiny", "--out", whole, "--evaluation.lowest-elevation", "89")
    assert "viewpoints have an elevation of at least 89°" in refuses(*arguments)
    assert "must be at least 2" in refuses(*arguments[:5], "--evaluation.max-views", "1")


def kill_when(out: Path, ready, sign: int) -> int:
    """Starts the job, ends it once `ready(out)`, and returns its exit code."""
    process = subprocess.Popen(
        [*MEVS, "run", "--preset", "tiny", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    deadline = time.monotonic() + 300
    while process.poll() is None and not ready(out) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert process.poll() is None, "the job ended before it could be interrupted"
    os.kill(process.pid, sign)
    process.wait(60)
    return process.returncode


def is_like(out: Path, whole: Path) -> None:
    """The job in `out`, which was begun again, ended with the results of the job that was never interrupted."""
    assert json.loads((out / "metrics.json").read_text()) == json.loads((whole / "metrics.json").read_text())
    with np.load(out / "tables" / "test.npz") as a, np.load(whole / "tables" / "test.npz") as b:
        np.testing.assert_array_equal(a["logits"], b["logits"])
    assert list(out.rglob("*.partial*")) == []


def has_trained_an_epoch(out: Path) -> bool:
    log = out / "classifier" / "metrics.jsonl"
    return log.exists() and log.stat().st_size > 0


@pytest.mark.slow
def test_an_interrupted_training_ends_as_one_that_was_not(whole, tmp_path, at_once):
    """Interrupted after an epoch; the slow test below compares whole jobs."""
    shutil.copytree(whole / "data", tmp_path / "data")
    shutil.copytree(whole / "entropy", tmp_path / "entropy")
    assert kill_when(tmp_path, has_trained_an_epoch, signal.SIGINT) == 130
    assert not (tmp_path / "classifier" / "summary.json").exists()
    ended(at_once("train", "--preset", "tiny", "--out", tmp_path))
    mine, theirs = (json.loads((out / "classifier" / "summary.json").read_text()) for out in (tmp_path, whole))
    assert mine | {"seconds": 0} == theirs | {"seconds": 0}
    assert list(tmp_path.rglob("*.partial*")) == []


@pytest.mark.slow
def test_a_job_that_is_killed_again_and_again_ends_with_the_same_metrics(whole, tmp_path, at_once):
    for ready, sign, code in (
        (lambda out: len(list((out / "data" / "captures").glob("*/*.npz"))) > 5, signal.SIGKILL, -signal.SIGKILL),
        (has_trained_an_epoch, signal.SIGINT, 130),
        (lambda out: (out / "entropy" / "config.json").exists(), signal.SIGKILL, -signal.SIGKILL),
    ):
        assert kill_when(tmp_path, ready, sign) == code
    ended(at_once("run", "--preset", "tiny", "--out", tmp_path))
    is_like(tmp_path, whole)
