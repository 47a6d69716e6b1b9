"""Records and systems with arrays are compared by what they hold."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import mevs_jax
from mevs_jax.policies.registry import POLICIES
from mevs_jax.trained import load, save
from tests.mevs_jax.agent.test_agent import LYING, begun, in_metres, views_of


def test_records_are_equal_by_content(classifier):
    agent = begun(classifier, "random")
    belief, step = agent.observe_view(*views_of(classifier)[0]), agent.decide()
    image = mevs_jax.DepthImage(*in_metres(*views_of(classifier)[0]))
    for record in (belief, step, image, LYING):
        again = deepcopy(record)
        assert record == again
        assert len({record, again}) == 1
    assert belief == replace(belief, latency_ms=0.0)
    assert belief != replace(belief, probabilities=belief.probabilities[::-1].copy())
    assert belief != replace(belief, views=2)
    assert step != replace(step, index=step.index + 1)
    assert mevs_jax.Sphere((0, 0, 1), 1.0) == mevs_jax.Sphere(np.array([0.0, 0, 1]), 1)
    assert agent.history == deepcopy(agent.history)


def test_systems_are_equal_by_content(classifier, recogniser, tmp_path):
    save(classifier, tmp_path / "system")
    read = load(tmp_path / "system")
    assert read == classifier
    assert len({read, classifier, recogniser}) == 2
    changed = replace(classifier, parts=replace(classifier.parts, single=jnp.float32(9)))
    assert changed != classifier


def test_a_policy_may_be_registered_twice(monkeypatch):
    monkeypatch.setattr("mevs_jax.policies.registry.POLICIES", dict(POLICIES))

    def mine(key, state, scene):
        return scene.graph.points[:, 2]

    for _ in range(2):
        assert mevs_jax.register_policy("registered_twice", mine) is mine
