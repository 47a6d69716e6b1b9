"""Devices share batches and weights equally, or a message says what cannot be shared."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from data_pipeline.distributed import is_lost_process
from data_pipeline.errors import DataError
from tests.train.running.scaling_worker import SETTINGS
from train.running.devices import Layout, Lead, check_batch, device_mesh, parameter_sharding


def test_what_cannot_be_shared_is_told():
    with pytest.raises(DataError, match="--model-devices 3 does not divide the 1 devices"):
        device_mesh(3)
    for changed, told in (
        ({"parts": 3}, "batch of 16 views in 3 parts cannot be shared equally by 1 devices"),
        ({"views_per_object": 3}, "16 views, 3 of an object, cannot be read equally by 1 processes"),
    ):
        with pytest.raises(DataError, match=told):
            check_batch("classifier", replace(SETTINGS.classifier.optimiser, **changed), Layout.of_mesh(device_mesh()))
    assert not is_lost_process(RuntimeError("Gloo: connection closed by peer"))  # there are no others here


def test_large_weights_are_split_over_the_model_axis():
    mesh = jax.sharding.AbstractMesh((4, 2), ("data", "model"))
    shapes = {"kernel": (3, 3, 64, 64), "odd": (64, 101), "bias": (8192,), "small": (8, 8)}
    where = parameter_sharding(mesh, {name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in shapes.items()})
    assert {name: tuple(found.spec) for name, found in where.items()} == {
        "kernel": (None, None, None, "model"),
        "odd": (),
        "bias": (),
        "small": (),
    }


def test_the_progress_shown_is_of_steps_that_have_ended(monkeypatch):
    lead, results, ended = Lead(steps=2), [jnp.int32(step) for step in range(5)], []
    monkeypatch.setattr(type(results[0]), "block_until_ready", lambda step: ended.append(int(step)))
    assert [lead.limit(step) for step in results] == [0, 0, 1, 1, 1]
    assert ended == [0, 1, 2]
    assert [lead.end(), lead.end()] == [2, 0]
    assert ended == [0, 1, 2, 3, 4]
