"""A user's own code and files, by command: policies, encoders, viewpoints."""

from __future__ import annotations

import json
import shutil

import pytest

from mevs_jax import POLICIES, ViewGraph, fibonacci_sphere
from tests.cli.conftest import ended

POLICY = """
import jax
from mevs_jax import register_policy

@register_policy("my_opposite", title="my <opposite> view", knows="nothing")
def opposite(key, state, scene):
    return -scene.graph.points @ scene.graph.points[state.view]

def drawn(key, state, scene):
    return jax.random.uniform(key, state.attempted.shape)
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(POLICY)
    yield path
    POLICIES.pop("my_opposite", None)


def metrics_of(out):
    return json.loads((out / "metrics.json").read_text())


@pytest.mark.slow
def test_a_policy_enters_the_evaluation_and_the_report(whole, tmp_path, file, at_once, monkeypatch):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    before = metrics_of(out)
    monkeypatch.chdir(tmp_path)
    assert "my <opposite> view" in ended(at_once("eval", "--out", out, "--policy", "mine.py:opposite"))
    after = metrics_of(out)
    names = [rung["policy"] for rung in after["ladder"]]
    assert names.index("my_opposite") == names.index("farthest") + 1
    assert [rung for rung in after["ladder"] if rung["policy"] != "my_opposite"] == before["ladder"]
    assert {"my_opposite"} == set(after["policies"]) - set(before["policies"])
    for name in before["policies"]:
        assert after["policies"][name] == before["policies"][name]
        assert after["against_random"].get(name) == before["against_random"].get(name)
    assert len(after["against_random"]["my_opposite"]["after_views_interval"]) == 6
    (identity,) = after["identity"]["policies"]
    assert (identity["module"], identity["name"], identity["knows"]) == ("mine.py", "opposite", "nothing")
    ended(at_once("report", "--out", out))
    html = (out / "report" / "index.html").read_text()
    assert "my &lt;opposite&gt; view" in html
    assert f"<code>mine.py:opposite</code> (source {identity['source']})" in html
    # The run keeps it, in every working directory; an edited file is evaluated again.
    monkeypatch.chdir("/")
    kept, table = (out / "metrics.json").stat().st_mtime_ns, (out / "metrics.csv").read_text()
    assert "\nmy_opposite,my <opposite> view,nothing,2," in table
    (out / "metrics.csv").write_text(table[:-5])
    ended(at_once("eval", "--out", out))
    assert (out / "metrics.csv").read_text() == table
    assert (out / "metrics.json").stat().st_mtime_ns == kept
    file.write_text(POLICY.replace("return -scene", "return scene"))
    ended(at_once("eval", "--out", out))
    edited = metrics_of(out)
    assert edited["identity"]["policies"][0]["source"] != identity["source"]
    assert edited["policies"]["my_opposite"] != after["policies"]["my_opposite"]
    ended(at_once("eval", "--out", out, "--policy", "none"))
    assert metrics_of(out) == before


def test_a_policy_that_cannot_be_used_is_refused_before_anything_is_made(tmp_path, file, refuses):
    out = tmp_path / "new"
    command = ("run", "--preset", "tiny", "--out", out, "--policy")
    assert "has no function 'g'" in refuses(*command, f"{file}:g")
    assert not (out / "run.json").exists()
    file.write_text(POLICY + "\ndef three(key, state, scene):\n    return scene.graph.points[0]\n")
    assert "returns float32[3]" in refuses(*command, f"{file}:three", "--views", "4")
    assert not (out / "classifier").exists()


@pytest.mark.slow
def test_a_policy_is_walked_live(whole, tmp_path, file, at_once):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    ended(at_once("check", "live", "--out", out, "--live.policies", "random", "--policy", f"{file}:drawn"))
    found = json.loads((out / "live.json").read_text())
    assert set(found) == {"random", "drawn"}
    assert all(agreement["walks"] == agreement["same"] for agreement in found.values())


ENCODER = """
import jax.numpy as jnp
from flax import nnx

class Net(nnx.Module):
    def __init__(self, classes, channels, rngs):
        self.head = nnx.Linear(64 * channels, classes, rngs=rngs)

    def __call__(self, images, train=False):
        return self.head(images[:, ::4, ::4].reshape(len(images), -1))

def net(classes, channels, resolution, rngs):
    return Net(classes, channels, rngs)
"""


@pytest.mark.parametrize("evaluated", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["trained", "evaluated"])
def test_an_encoder_is_the_classifier_of_a_run(evaluated, data, whole, tmp_path, at_once, refuses, monkeypatch):
    """Every file of the run names it, and none a ResNet."""
    monkeypatch.chdir(tmp_path)
    path, out = tmp_path / "nets.py", tmp_path / "run"
    path.write_text(ENCODER)
    out.mkdir()
    shutil.copytree(data, out / "data")
    shutil.copytree(whole / "entropy", out / "entropy")
    brief = ("--classifier.optimiser.epochs", "1")
    train = ("train", "--out", out, "--preset", "tiny")
    assert "--classifier.network.depth is a setting of the ResNet" in refuses(
        *train, "--encoder", "nets.py:net", "--classifier.network.depth", "18"
    )
    (tmp_path / "resnet.pth").write_bytes(b"")
    assert "--pretrained weights are those of a ResNet" in refuses(
        *train, "--encoder", "nets.py:net", "--pretrained", "resnet.pth"
    )
    assert "returns float32[2, 3] for 2 images" in refuses(*train, "--encoder", three_classes(tmp_path))
    assert not (out / "classifier").exists()
    ended(at_once(*train, *brief, "--encoder", "nets.py:net"))
    run, config, summary = (
        json.loads((out / name).read_text())
        for name in ("run.json", "classifier/config.json", "classifier/summary.json")
    )
    assert run["encoder"] == config["task"]["network_config"] == summary["encoder"]
    assert (summary["encoder"]["module"], summary["encoder"]["name"]) == ("nets.py", "net")
    assert run["settings"]["classifier"]["network"] == {"channels": 1}
    assert run["settings"]["classifier"]["encoder"] == f"{path}:net"
    if not evaluated:
        return
    monkeypatch.chdir("/")
    ended(at_once("eval", "--out", out))
    ended(at_once("report", "--out", out))
    page = (out / "report" / "index.html").read_text()
    assert f"classifier: <code>nets.py:net</code> (source {summary['encoder']['source']})" in page
    assert "ResNet" not in page
    # Edited, it is another network: the run goes on with the numbers of the one that was trained, and trains no other.
    path.write_text("an edit that is not finished")
    ended(at_once("report", "--out", out))  # which computes nothing with it
    path.write_text(ENCODER.replace("::4, ::4", "1::4, ::4"))
    ended(at_once("eval", "--out", out))
    assert json.loads((out / "run.json").read_text())["encoder"] == run["encoder"]
    assert "nets.py:net as it was before it was edited; restore that file" in refuses("train", "--out", out)
    shutil.rmtree(out / "tables")
    (out / "metrics.json").unlink()
    assert "other layers than the settings describe (source" in refuses("eval", "--out", out)
    path.unlink()
    assert "nets.py cannot be read" in refuses("eval", "--out", out)


def three_classes(folder):
    path = folder / "three.py"
    path.write_text(ENCODER.replace("Net(classes", "Net(3"))
    return f"{path}:net"


@pytest.mark.slow
def test_viewpoints_of_a_file_are_those_of_the_whole_run(whole, tmp_path, at_once, refuses, monkeypatch):
    """Every graph that the evaluation and the report use has the neighbours of the file."""
    monkeypatch.chdir(tmp_path)
    out, points = tmp_path / "run", fibonacci_sphere(6).tolist()
    ring = [[i, (i + 1) % 6] for i in range(6)]
    (tmp_path / "six.json").write_text(json.dumps({"viewpoints": points, "adjacency": ring}))
    few = ("--dataset.train-per-class", "2", "--dataset.test-per-class", "1", "--dataset.capture.backend", "rasterise")
    make = ("data", "--out", out, "--preset", "tiny", *few, "--dataset.capture.lattice", "file:six.json")
    for option in ("--views", "--dataset.capture.views"):
        assert "six.json has 6 viewpoints, and --" in refuses(*make, option, "7")
    assert "four.json cannot be read" in refuses(*make[:-1], "file:four.json")
    ended(at_once(*make))
    run = json.loads((out / "run.json").read_text())["settings"]["dataset"]["capture"]
    assert (run["views"], run["lattice"]) == (6, f"file:{tmp_path / 'six.json'}")
    for name in ("classifier", "entropy"):
        shutil.copytree(whole / name, out / name)
    graphs = []
    from_points = ViewGraph.from_points.__func__

    def recorded(cls, points, neighbours=None):
        graphs.append(neighbours)
        return from_points(cls, points, neighbours)

    monkeypatch.setattr(ViewGraph, "from_points", classmethod(recorded))
    monkeypatch.chdir("/")
    (tmp_path / "six.json").unlink()  # a data set that is made does not need it
    ended(at_once("eval", "--out", out))
    evaluated = len(graphs)
    ended(at_once("report", "--out", out))
    assert 0 < evaluated < len(graphs), "the evaluation and the report each use the graph"
    assert all(neighbours == sorted([min(pair), max(pair)] for pair in ring) for neighbours in graphs)
    page = (out / "report" / "index.html").read_text()
    assert "directions from a file, 6 pairs of neighbours, content " in page
