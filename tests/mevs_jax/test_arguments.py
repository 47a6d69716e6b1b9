"""Arguments that cannot be are one sentence with their name; what could be mistaken for a number is computed as it should."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import mevs_jax
from mevs_jax.agent import load_history, replay
from mevs_jax.agent.agent import MOST_CANDIDATES
from mevs_jax.deploy import exported
from mevs_jax.deploy.export import export
from mevs_jax.geometry.inputs import check_depth
from mevs_jax.geometry.sphere import upright
from mevs_jax.models.pointnet2 import Abstraction, PointNet2
from mevs_jax.policies.learned import learned
from mevs_jax.trained import fit_strangeness
from tests.mevs_jax import misuse
from tests.mevs_jax.trained import making

KEY = jax.random.key(0)
BELIEFS = np.log(np.random.default_rng(0).dirichlet(np.ones(3), 40)).astype(np.float32)
LABELS = np.random.default_rng(1).integers(0, 3, 40)
GRAPH = mevs_jax.ViewGraph.from_points(mevs_jax.fibonacci_sphere(6))
TABLE = mevs_jax.ViewTable(jnp.zeros((6, 3)), None, None, jnp.int32(0))
NAN = float("nan")


def select(start=0, policy=lambda key, state, scene: jnp.zeros(6), **options):
    return mevs_jax.select_from_table(KEY, TABLE, TABLE.scene(GRAPH), policy, start, **{"max_views": 2} | options)


REFUSED = {
    "start must be from 0 to 5, got 99": lambda: select(99),
    "start must be from 0 to 5, got -1": lambda: select(jnp.int32(-1)),
    r"a score for each of 6 views, got shape \(1,\)": lambda: select(policy=lambda *_: jnp.zeros(1)),
    "threshold must be a probability, got nan": lambda: select(threshold=NAN),
    "max_views must be between 1 and the 6 candidate views, got 7": lambda: select(max_views=7),
    "viewpoints must be unit vectors": lambda: mevs_jax.ViewGraph.from_points(np.full((4, 3), np.nan)),
    r"views 0 and 9 cannot be neighbours": lambda: mevs_jax.ViewGraph.from_points(np.eye(3), [(0, 9)]),
    "position must be finite and not zero": lambda: mevs_jax.look_at_origin(np.zeros(3)),
    "points must be finite and not zero": lambda: mevs_jax.cameras_at(np.array([[0, 0, NAN]])),
    "distance must be positive, got -1": lambda: mevs_jax.cameras_at(np.eye(3), distance=-1.0),
    "step must be finite, got nan": lambda: mevs_jax.orbit(np.eye(4, dtype=np.float32), np.full(2, np.nan)),
    "of a Camera is in radians, between 0 and π, got 60": lambda: mevs_jax.Camera(jnp.eye(4), 60.0),
    "resolution must be at least 1 pixel, got 0": lambda: mevs_jax.Camera(jnp.eye(4), resolution=0),
    "labels must be from 0 to 2, got 3": lambda: mevs_jax.fit_temperature(BELIEFS, LABELS + 1),
    "labels must be from 0 to 2, got -1": lambda: mevs_jax.negative_log_likelihood(BELIEFS, LABELS - 1),
    "no NaN and no infinity, got nan": lambda: mevs_jax.fit_temperature(BELIEFS * NAN, LABELS),
    "finite for the true classes, got -inf": lambda: mevs_jax.fit_temperature(np.full_like(BELIEFS, -np.inf), LABELS),
    "weights must be at least 0, got -1": lambda: mevs_jax.fit_temperature(BELIEFS, LABELS, -1.0),
    "finite for the true classes": lambda: mevs_jax.fit_exponent(np.full((40, 2, 3), -np.inf), LABELS),
    "temperatures must be positive, got 0": lambda: mevs_jax.discounted(jnp.zeros((2, 3)), jnp.array([1.0, 0.0])),
    "confidences must be probabilities.* got 1.5": lambda: mevs_jax.reliability(np.array([1.5]), np.array([True])),
    "bins must be at least 1, got 0": lambda: mevs_jax.expected_calibration_error(np.ones(2), np.ones(2, bool), 0),
    "level must be a probability between 0 and 1, got 95": lambda: mevs_jax.bootstrap_interval(
        KEY, np.ones(3), level=95.0
    ),
    "a bootstrap needs at least 1 value, got 0": lambda: mevs_jax.bootstrap_means(KEY, np.zeros(0)),
    "resamples must be at least 1, got 0": lambda: mevs_jax.bootstrap_means(KEY, np.ones(3), resamples=0),
    "classes must be at least 1, got 0": lambda: mevs_jax.confusion_matrix(LABELS, LABELS, 0),
    "counts must be at least 0, got -1": lambda: mevs_jax.shannon_entropy(np.array([1.0, -1.0])),
    "most must be from 1 to 4 views, got 5": lambda: fit_strangeness(np.zeros((2, 4, 3)), 5),
    "radius must be at least 0, got nan": lambda: mevs_jax.ball_query(np.eye(3), np.eye(3), NAN, 2),
    "temperature must be positive, got 0": lambda: learned(
        mevs_jax.ViewPolicy(3, width=8, heads=1, blocks=1, rngs=nnx.Rngs(0)), 0.0
    ),
    "a view lattice needs at least 2 viewpoints, got 1": lambda: mevs_jax.viewpoint_lattice(1),
    "depth is a masked array": lambda: mevs_jax.DepthImage(
        np.ma.masked_greater(np.ones((8, 8)), 0.5), np.eye(3), np.eye(4)
    ),
    "cost must be at least 0, got nan": lambda: mevs_jax.with_movement(lambda *_: jnp.zeros(6), NAN),
    "dropout must be a probability below 1, got 1": lambda: PointNet2(views=6, dropout=1.0, rngs=nnx.Rngs(0)),
    "an abstraction needs at least 1 sample, got 0": lambda: PointNet2(
        views=6, abstractions=[Abstraction(8, 0.4, 0, (8,))], rngs=nnx.Rngs(0)
    ),
    "points have shape": lambda: making_agent().reset_from_points(np.zeros((9, 2))),
    f"max_candidates must be from 1 to {MOST_CANDIDATES}, got 200000": lambda: making_agent(max_candidates=200_000),
    "seed must be a whole number of 32 bits": lambda: making_agent(seed=2**40),
    "count must be at least 1, got 0": lambda: making.system().log_probabilities(jnp.zeros(4), 0),
    "max_views must be from 1 to 512, got 0": lambda: export(making.system(), "x", max_views=0),
    "platforms must be one or more of cpu, cuda, tpu": lambda: export(making.system(), "x", platforms=["abacus"]),
    "depth has negative numbers": lambda: check_depth(np.full((8, 8), -1.0), making.description("classifier").camera),
    "depth is 9 to 9; an object seen from 2 radii": lambda: check_depth(
        jnp.full((8, 8), 9.0), making.description("classifier").camera
    ),
}


def making_agent(**options):
    return making.system().agent("random", **options)


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_is_refused_by_its_name(message):
    with pytest.raises(ValueError, match=message) as caught:
        REFUSED[message]()
    assert "\n" not in str(caught.value)


def test_what_is_traced_is_not_looked_at():
    assert jax.jit(lambda start: select(start))(jnp.int32(3)).views[0] == 3
    assert jax.jit(mevs_jax.fit_temperature)(BELIEFS, LABELS) == mevs_jax.fit_temperature(BELIEFS, LABELS)


def test_wrong_types_are_one_sentence_each():
    """In a process of its own, where nothing else checks the types."""
    given = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    ended = subprocess.run([sys.executable, misuse.__file__], capture_output=True, text=True, env=given, timeout=300)
    assert ended.returncode == 0, ended.stderr
    for line in ended.stdout.splitlines():
        kind, name, said = json.loads(line)
        assert (kind, "\n" in said) == ("ValueError", False), line
        assert name in said, line
    assert len(ended.stdout.splitlines()) == sum(map(len, misuse.WRONG.values()))


def test_a_class_of_no_probability_does_not_decide_the_temperature():
    beliefs = np.concatenate([BELIEFS, np.full((40, 1), -1e6, np.float32)], axis=1)
    impossible = np.concatenate([BELIEFS, np.full((40, 1), -np.inf, np.float32)], axis=1)
    assert mevs_jax.fit_temperature(impossible, LABELS) == mevs_jax.fit_temperature(beliefs, LABELS)
    walks = np.stack([beliefs, 2 * beliefs], axis=1), np.stack([impossible, 2 * impossible], axis=1)
    np.testing.assert_allclose(*(mevs_jax.fit_exponent(one, LABELS) for one in walks), rtol=1e-5)


def test_a_histogram_need_not_have_a_sum():
    counts = np.array([3.0, 1.0, 4.0])
    for scale in (1.0, 1 / 8, 1e-3):
        np.testing.assert_allclose(mevs_jax.shannon_entropy(scale * counts), 1.405639, rtol=1e-5)


def test_up_near_the_opposite_of_z_is_a_rotation_too():
    for tilt in (1e-5, 1e-6, 1e-8, 1e-11, 1e-13):
        up = np.array([0.6 * tilt, 0.8 * tilt, -1.0])
        rotation = upright(up)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-9)
        np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-9)


def test_copies_of_points_are_no_neighbours():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    others = np.random.default_rng(0).uniform(0.2, 0.8, (60, 3))
    center, radius = mevs_jax.estimate_sphere(np.concatenate([corners, np.repeat(others, 20, axis=0)]))
    np.testing.assert_allclose(center, 0.5)
    np.testing.assert_allclose(radius, np.sqrt(0.75))


def test_an_abstraction_may_have_more_neighbours_than_a_piece():
    network = PointNet2(
        views=6, abstractions=[Abstraction(8, 0.4, 8192, (8,))], global_layers=(8,), head_layers=(8,), rngs=nnx.Rngs(0)
    )
    assert np.isfinite(network(np.random.default_rng(0).uniform(-0.5, 0.5, (64, 3)).astype(np.float32))).all()


def test_programs_beside_their_folder_are_not_read(tmp_path):
    (tmp_path / "out.stablehlo").write_bytes(b"")
    (tmp_path / "there").mkdir()
    manifest = {"form": exported.FORM, "programs": {"../out": {}}}
    (tmp_path / "there" / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match=r"names a program '\.\./out', which is no name"):
        exported.load(tmp_path / "there")


def test_a_history_that_would_fill_the_memory_is_not_read(tmp_path):
    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as packed,
        packed.open("depths.npy", "w") as file,
    ):
        for _ in range(300):
            file.write(bytes(2**20))
    with pytest.raises(ValueError, match=r"is no history of an agent \(it would take 300 MB of memory"):
        load_history(tmp_path / "bomb.npz")


def test_a_history_of_other_options_is_not_repeated():
    agent = making_agent()
    agent.reset(center=(0, 0, 0), radius=1.0)
    agent.history.options["reset"]["colour"] = "red"
    with pytest.raises(ValueError, match=r"has other options of its object than Agent\.reset"):
        replay(agent.history, agent)
    agent.history.options["reset"] = {"radius": 1.0}
    with pytest.raises(ValueError, match=r"has other options of its object than Agent\.reset"):
        replay(agent.history, agent)
