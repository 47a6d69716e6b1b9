"""Exported programs give what the system gives, in a process that has JAX and NumPy alone."""

from __future__ import annotations

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mevs_jax
from mevs_jax.deploy import exported
from mevs_jax.deploy.export import export
from tests.mevs_jax.trained import making

pytest.importorskip("flatbuffers", reason="exporting needs flatbuffers")

ALONE = """
import importlib.abc, json, sys

class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in ("mevs_jax", "flax", "safetensors", "jaxtyping"):
            raise ImportError(name)

sys.meta_path.insert(0, Blocked())
sys.path.insert(0, sys.argv[1])
import numpy as np
import exported

given = np.load(sys.argv[2])
programs = exported.load(sys.argv[1])
radii = [given["radius"]] * any(one["name"] == "radius" for one in programs["recognise"].about["inputs"])
found = programs["recognise"](given["depth"], *(np.repeat(radius, len(given["depth"])) for radius in radii))
if "entropies" in programs:
    found |= programs["entropies"](given["clouds"])
memory, views = exported.blank(programs["decide"]), []
for view in (0, 4, 7):
    step = programs["decide"](memory, given["depth"][view], given["poses"][view], np.ones(12, bool), np.zeros(12), 0, *radii)
    memory = step["memory"]
    views.append(int(step["next"]))
np.savez(sys.argv[3], **found, walk=step["probabilities"], views=views, strangeness=step["strangeness"])
"""


@pytest.mark.parametrize(
    "kind", ["classifier", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("recogniser", "sized"))]
)
def test_exported_programs_run_alone(kind, tmp_path):
    system, folder = making.system(kind), tmp_path / "programs"
    export(system, folder, max_views=5)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["classes"] == list(making.CLASSES)
    assert manifest["programs"]["recognise"]["platforms"] == ["cpu", "cuda", "tpu"]
    poses = np.stack([np.asarray(mevs_jax.look_at_origin(jnp.asarray(point) * 2)) for point in system.viewpoints])
    depth = np.stack([making.depth_of_ball(point) for point in system.viewpoints])
    clouds = np.random.default_rng(0).normal(0, 0.3, (3, 64, 6)).astype(np.float32)
    radius = 0.4
    np.savez(tmp_path / "given.npz", depth=depth, poses=poses, clouds=clouds, radius=radius)
    command = [sys.executable, "-c", ALONE, str(folder), str(tmp_path / "given.npz"), str(tmp_path / "found.npz")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    found = np.load(tmp_path / "found.npz")
    seen = [system.observe(depth[view], poses[view], radius) for view in range(len(depth))]
    np.testing.assert_allclose(found["features"], np.stack([one.features for one in seen]), atol=1e-5)
    alone = [np.asarray(jax.nn.softmax(one.logits / system.parts.single)) for one in seen]
    np.testing.assert_allclose(found["probabilities"], np.stack(alone), atol=1e-5)
    if kind == "classifier":
        np.testing.assert_allclose(found["entropies"], system.parts.entropy.module(clouds), atol=1e-5)
    agent, views = system.agent(stop=2, max_views=5), []
    agent.reset(center=(0, 0, 0), radius=radius, yaw=0.0)
    for view in (0, 4, 7):
        belief = agent.observe_view(depth[view], poses[view])
        views.append(agent.decide().index)
    assert found["views"].tolist() == views
    np.testing.assert_allclose(found["walk"], belief.probabilities, atol=1e-5)
    np.testing.assert_allclose(found["strangeness"], belief.strangeness)
    recognise = exported.load(folder)["recognise"]
    for count in (1, 5):
        given = (depth[:count], *[np.full(count, radius)] * (kind == "sized"))
        np.testing.assert_allclose(recognise(*given)["probabilities"], found["probabilities"][:count], atol=1e-5)
    with pytest.raises(ValueError, match=r"depth must have shape \['b', 32, 32\], got \[2, 8, 8\]"):
        recognise(np.zeros((2, 8, 8)), *[np.ones(2)] * (kind == "sized"))
    (folder / "recognise.stablehlo").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="is damaged, since its hash differs"):
        exported.load(folder)
    (folder / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match="is no manifest of exported programs"):
        exported.load(folder)
