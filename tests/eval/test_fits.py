"""What fits are fitted on: which objects, from which starts, along which walks and with which weights.

Tests of leaks ask whether test objects change what is fitted. These ask whether what is fitted is right, each by an answer that
is planted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import eval.learned.measure as measuring
import eval.learned.study as studying
import eval.runs as of_run
import train.choosing.stages as choosing
from data_pipeline.errors import DataError
from eval.learned.study import novel_classes, novel_metrics, order_of_fused, study, walk_metrics
from eval.learned.walks import OnLattice, Walking, by_network
from eval.numbers.comparison import views_to_reach
from eval.numbers.confidence import stops_of
from eval.settings import TINY
from eval.tables import save_view_tables
from eval.walks.grid import Results
from eval.walks.knowledge import order_of_sums
from mevs_jax import fibonacci_sphere
from tests.reference.choosing import CLASSES, some_policy
from tests.reference.evaluation import some_tables
from tests.reference.made_up_study import STUDIED, Study
from train.choosing.features import Features
from train.choosing.stages import Stages
from train.results.identity import VERSIONS
from train.results.records import as_json

VIEWS = 16
"""So many that oracles and costs are tried from some start views only."""


def features_of(labels: np.ndarray, right: np.ndarray) -> Features:
    """Features that fusions add: each view says a class clearly, the true one or the next, by `right` (objects, views)."""
    said = np.where(right, labels[:, None], (labels[:, None] + 1) % CLASSES)
    logits = jnp.asarray(4 * np.eye(CLASSES)[said], jnp.float32)
    directions = np.stack([fibonacci_sphere(VIEWS)] * len(labels))
    return Features(logits, logits, jnp.asarray(labels, jnp.int32), jnp.asarray(directions, jnp.float32))


def test_a_fixed_order_serves_every_class_alike(adding):
    """One view tells the class that most objects are of; another one tells each of the other three."""
    labels = np.repeat(np.arange(CLASSES), (40, 4, 4, 4))
    common, rare = 5, 11
    data = features_of(labels, np.zeros((len(labels), VIEWS), bool))
    tells = np.zeros((len(labels), VIEWS, 1), np.float32)
    tells[labels == 0, common] = tells[labels > 0, rare] = 40
    told = data.logits + tells * np.eye(CLASSES, dtype=np.float32)[labels][:, None]
    assert order_of_fused(adding, replace(data, features=told, logits=told), 2).views[:2] == [rare, common]
    found = order_of_sums(told, labels)
    assert found.views[:2] == [rare, common]
    reachable = np.arange(VIEWS) != rare
    within = order_of_sums(told, labels, reachable)
    assert within.views[0] == common
    assert sorted(within.views) == np.flatnonzero(reachable).tolist()


def test_an_order_of_any_length_is_fitted_by_one_program(adding, monkeypatch):
    shapes, real = set(), studying.over_objects
    monkeypatch.setattr(
        studying, "over_objects", lambda *given, **how: shapes.add(given[3].shape) or real(*given, **how)
    )
    data = features_of(np.arange(8) % CLASSES, np.tile(np.arange(VIEWS) % 3 > 0, (8, 1)))
    assert sorted(order_of_fused(adding, data, 3).views) == list(range(VIEWS))
    assert shapes == {(3,)}


def test_temperatures_serve_every_class_alike():
    """They are the same however many objects a class has; one class is sure and wrong, the others are right."""
    random, labels = np.random.default_rng(0), np.arange(24) % 3
    beliefs = random.normal(0, 1, (24, 2, 2, 3)) + 3 * np.eye(3)[np.where(labels == 0, 1, labels)][:, None, None]
    found = []
    for times in (1, 6):
        chosen = np.repeat(np.arange(24), np.where(labels == 0, times, 1))
        given = jnp.asarray(beliefs[chosen], jnp.float32), jnp.asarray(labels[chosen])
        found.append(np.array(walk_metrics(*([one, one] for one in given))[0]["temperatures"]))
    np.testing.assert_allclose(found[0], found[1], rtol=0.02)
    assert (found[0] > 1.2).all()


@pytest.mark.slow
def test_oracles_and_thresholds_are_of_their_walks(adding):
    """Views of even number are right, and surer than others. Oracles start there. Thresholds are of policies trained apart."""
    random = np.random.default_rng(1)
    even = np.arange(VIEWS) % 2 == 0

    def objects(count: int) -> OnLattice:
        data = features_of(np.arange(count) % CLASSES, np.tile(even, (count, 1)))
        strength = np.where(even, 1.0, 0.3)[:, None] * random.uniform(0.8, 1.2, (count, VIEWS, 1))
        told = data.logits * strength.astype(np.float32)
        return OnLattice(replace(data, features=told, logits=told))

    policies = []
    for sign in (1.0, -1.0):
        policy = some_policy()
        nnx.update(policy, jax.tree.map(lambda leaf, sign=sign: sign * leaf, nnx.state(policy)))
        policies.append(by_network("learned", "", policy, adding))
    validation, test, thresholds = objects(24), objects(20), []
    for one in policies:
        found, each = study(adding, policies[:1], (validation, test), Walking(3, 1), apart=[one] * 2, others=False)
        thresholds.append([row["ours"] and row["ours"]["threshold"] for row in found["costs"]["beside_thesis"]])
        for policy in each.values():
            assert policy.right[0].mean() == pytest.approx(0.5)
            assert policy.from_some[0].mean() == 1
    assert found["trying_starts"] == VIEWS // 2
    assert thresholds[0] != thresholds[1]


@pytest.mark.slow
def test_policies_without_classes_are_tested_on_objects_of_these(adding):
    """Objects of two classes are recognised from everywhere; they are fewer than those of the others."""
    labels = np.repeat(np.arange(CLASSES), (3, 5, 2, 6))
    known = np.isin(labels, (0, 2))
    test = OnLattice(features_of(labels, np.tile(known[:, None], (1, VIEWS))))
    policy = by_network("learned", "", some_policy(), adding)
    for pair, right in (((0, 2), 1.0), ((1, 3), 0.0)):
        each = novel_classes(adding, [(pair, policy)], policy, test, Walking(2, 1))
        assert {one.shape for one in each.values()} == {(2, np.isin(labels, pair).sum())}
        (row,) = as_json(novel_metrics(each, [pair], labels))["pairs"]
        assert row["objects"] == np.isin(labels, pair).sum()
        assert row["random"] == row["trained_without"] == row["trained_with"] == [right] * 2


def test_views_to_reach_are_of_the_same_objects_as_their_target():
    """A policy that is the baseline needs as many views, whichever objects are drawn; another one always needs one less."""
    level, steps = np.random.default_rng(0).uniform(0, 0.5, (12, 1)), np.arange(9) / 20

    def results(ahead: int) -> Results:
        after = jnp.asarray(level + steps + ahead / 20, jnp.float32)[None]
        return Results(after[..., None], after[..., None], after, after, jnp.zeros((1, 12, 1, 1, 9), jnp.int32))

    found = views_to_reach({"random": results(0), "same": results(0), "better": results(1)})
    assert set(found) == {3, 5, 9}
    for views, row in found.items():
        for name, expected in (("same", views), ("better", views - 1)):
            assert row.views[name] == pytest.approx(expected, abs=1e-3)
            assert row.interval[name] == pytest.approx([expected] * 2, abs=1e-3)


def test_the_risk_that_is_allowed_is_that_of_those_who_stop():
    """Of every object half of the walks stop, and of these one in two is wrong."""
    confidence = np.tile([[0.95], [0.95], [0.1], [0.1]], (6, 1, 1))
    right = np.tile([[True], [False], [True], [False]], (6, 1, 1))
    (row,) = stops_of(confidence, right, [0.1])
    assert (row.sure, row.error) == (0.5, 0.5)
    assert row.excess == pytest.approx([0.25 - 0.1 * 0.5] * 2, abs=1e-6)


@pytest.mark.slow
def test_walks_are_computed_anew_when_what_they_are_of_was(tmp_path, monkeypatch):
    """The data set and the recogniser, the view policies, or PointNet++; and when they mean something else.

    The metrics of the study are then stale, and a report says why; view tables of networks that are there no more are refused.
    """
    config = replace(TINY.learned, max_views=3, draws=1, ablations=("look_ahead",), novel=1)
    stages, computed = Study(None, tmp_path, monkeypatch, config).stages, list[str]()
    made = {"networks": 0, "policies": 0, "tables": 0}

    def walk(*given, **rest):
        computed.append("lattice")
        return {"policies": {}}, {}

    def walk_novel(*given, **rest):
        computed.append("novel")
        return {name: np.ones((3, 4)) for name in ("random", "trained_with")}

    def evaluated() -> None:
        for split in measuring.SPLITS:
            tables = replace(some_tables(), made_by=of_run.tables_made_by(STUDIED, tmp_path))
            save_view_tables(tmp_path / "tables" / f"{split}.npz", tables)

    def measured() -> dict[str, Any]:
        computed.clear()
        metrics = {"seeds": [measuring.measure(stages)], "settings": as_json(config)}
        assert measuring.why_stale(metrics, [stages]) is None
        return metrics

    monkeypatch.setattr(measuring, "made_by", lambda *given: str(made["networks"]))
    monkeypatch.setattr(of_run, "made_by", lambda *given: str(made["tables"]))
    monkeypatch.setattr(measuring, "read_json", lambda path: {"identity": {"made_by": made["policies"]}})
    monkeypatch.setattr(measuring, "_decision", lambda stages: {})
    monkeypatch.setattr(measuring, "study", walk)
    monkeypatch.setattr(measuring, "novel_classes", walk_novel)
    every = ["lattice"] * 5 + ["novel"]
    evaluated()
    metrics = measured()
    assert sorted(computed) == every
    measured()
    assert computed == []  # everything is there
    for name in made:
        made[name] += 1
        if name == "tables":
            with pytest.raises(DataError, match=r"val\.npz is stale .*; make it again with: mevs eval --out"):
                measured()
        evaluated()
        reason = "its settings were others: policies" if name == "policies" else "the data, networks or results that"
        assert measuring.why_stale(metrics, [stages]).startswith(reason)
        metrics = measured()
        # PointNet++ is used with known and unknown pose, and in ablations; others are of other views.
        assert sorted(computed) == (["lattice"] * 3 if name == "tables" else every), name
    for kind in ("walks", "features"):
        monkeypatch.setitem(VERSIONS, kind, VERSIONS[kind] + 1)
        assert measuring.why_stale(metrics, [stages]), kind
        metrics = measured()
        assert sorted(computed) == every, kind
    measured()
    assert computed == []
    monkeypatch.setitem(VERSIONS, "network", VERSIONS["network"] + 1)  # of view policies, which are not trained here
    assert "it is of version 1 of such results" in measuring.why_stale(metrics, [stages])
    assert measuring.why_stale(metrics | {"settings": as_json(replace(config, draws=2))}, [stages]).startswith(
        "its settings"
    )
    assert not {"arrays"} & set(metrics["seeds"][0]["lattices"]["6"])


def test_classes_without_test_objects_are_not_left_out(tmp_path, monkeypatch):
    """No policy is trained without them, and nothing is walked."""
    stages = Study(None, tmp_path, monkeypatch, replace(TINY.learned, novel=5)).stages
    assert measuring._pairs(stages) == [(0, 1)]
    counts = {"a": 0, "b": 0, "c": 8}
    monkeypatch.setattr(
        choosing, "load_statistics", lambda _: replace(STUDIED, counts=STUDIED.counts | {"test": counts})
    )
    stages = Stages(stages.config, stages.dataset, tmp_path)
    assert measuring._pairs(stages) == []
    assert measuring.novel_together([stages]) is None
