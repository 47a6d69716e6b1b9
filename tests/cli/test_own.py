"""What users bring of their own, by command: policies."""

from __future__ import annotations

import json
import shutil

import pytest

from mevs_jax import POLICIES
from tests.cli.conftest import mevs

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


def ended(result) -> str:
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_a_policy_that_cannot_be_used_is_refused_before_anything_is_made(tmp_path, file, refuses):
    out = tmp_path / "new"
    command = ("run", "--preset", "tiny", "--out", out, "--policy")
    assert "has no function 'g'" in refuses(*command, f"{file}:g")
    assert not (out / "run.json").exists()
    file.write_text(POLICY + "\ndef three(key, state, scene):\n    return scene.graph.points[0]\n")
    assert "returns float32[3]" in refuses(*command, f"{file}:three", "--views", "4")
    assert not (out / "classifier").exists()


@pytest.mark.slow
def test_a_policy_is_walked_live(whole, tmp_path, file):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    ended(mevs("check", "live", "--out", out, "--live.policies", "random", "--policy", f"{file}:drawn"))
    found = json.loads((out / "live.json").read_text())
    assert set(found) == {"random", "drawn"}
    assert all(agreement["walks"] == agreement["same"] for agreement in found.values())
