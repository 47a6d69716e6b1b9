"""Checks of a trained system use the policies and calibration that it comes with, whatever they find on the tested objects."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import eval.checks.reality as reality
import eval.checks.transfer as transfer
from data_pipeline.objects.mesh import ObjectEntry, ObjectSource
from data_pipeline.objects.recipes import FurniturePiece
from eval.checks.promise import strangers
from eval.checks.reality import RealityConfig, check_reality
from eval.checks.transfer import STRANGER, Objects, Transfer, check_transfer
from eval.checks.walks import BASELINE, Walker, Walks
from mevs_jax.selection.loop import ViewTable
from mevs_jax.trained import TrainedSystem
from tests.mevs_jax.trained import making
from tests.reference.leaks import check_fitted, check_tested, other_labels, some_walks, without_bootstrap

OBJECTS = 16
LABELS = np.arange(OBJECTS) % len(making.CLASSES)
FOLDERS = (*making.CLASSES, "lamp")
"""Classes of the tested objects, the last of which no system knows."""

system = cache(making.system)


def source(labels: np.ndarray = LABELS) -> ObjectSource:
    entries = [
        ObjectEntry(f"o{number}", int(label), "test", FurniturePiece("chair", 0)) for number, label in enumerate(labels)
    ]
    return ObjectSource("tested", FOLDERS, tuple(entries))


def tables_of(labels: np.ndarray) -> ViewTable:
    logits = np.random.default_rng(1).normal(0, 2, (len(labels), making.VIEWS, len(making.CLASSES)))
    entropies = np.random.default_rng(2).random((len(labels), making.VIEWS, making.VIEWS))
    predicted = jnp.asarray(entropies, jnp.float32)
    return ViewTable(jnp.asarray(logits, jnp.float32), predicted, None, jnp.asarray(labels, jnp.int32))


class Seen:
    """Random walks in place of those of `Walker`, and what was asked for.

    Args:
        winner: the policy whose walks alone end with the right class.
    """

    def __init__(self, winner: str) -> None:
        self.winner, self.systems, self.asked = winner, list[TrainedSystem](), list[tuple[Any, ...]]()

    def watch(self, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(Walker, "walk", lambda walker, *given, **named: self.walk(walker.system, *given, **named))

    def walk(self, of: TrainedSystem, tables: ViewTable, policy: str, steps: int, **rest: Any) -> Walks:
        self.systems.append(of)
        reachable = rest.pop("reachable", None)
        self.asked.append((policy, steps, sorted(rest.items()), None if reachable is None else reachable.tolist()))
        objects, views = tables.logits.shape[:2]
        starts = np.repeat(np.arange(views), rest.get("draws", 1))
        found = some_walks(len(policy), objects, starts, views, min(steps, views))
        right = np.zeros(found.shape, bool)
        right[..., 1:] = policy == self.winner
        confidence = np.random.default_rng(len(policy)).random(found.shape).astype(np.float32)
        return Walks(right, confidence, found, np.full(found.shape, np.nan), np.zeros(found.shape, bool))


def transfer_with(patch: pytest.MonkeyPatch, seen: Seen, labels: np.ndarray, **options: Any) -> Transfer:
    """The check of other objects, four of which are of no known class."""
    labels = np.where(np.arange(OBJECTS) < OBJECTS - 4, labels, STRANGER)
    folders = [FOLDERS[label] for label in labels]
    names = [f"o{number}" for number in range(OBJECTS)]
    without_bootstrap(patch)
    seen.watch(patch)
    patch.setattr(transfer, "objects_to_test", lambda data, up: source())
    patch.setattr(transfer, "see_objects", lambda *given: Objects(names, folders, labels, tables_of(labels), {}))
    return check_transfer(system(), "tested", max_views=4, draws=2, **options)


@pytest.mark.parametrize("posed", [True, False])
def test_transfer_uses_the_policies_that_the_system_names(posed, monkeypatch):
    """And not the one that wins on the objects, which is another one the second time."""
    described, found, asked = making.description("classifier"), [], []
    best = described.best if posed else described.best_unposed
    for winner, labels in (("random", LABELS), (best, other_labels(LABELS, len(making.CLASSES)))):
        seen = Seen(winner)
        found.append(transfer_with(monkeypatch, seen, labels, posed=posed))
        asked.append(seen.asked)
        won = float(winner == best)
        assert [row.last for row in found[-1].answers] == [won] * (OBJECTS - 4)
        assert {tuple(row.chosen) for row in found[-1].by_class} == {(0.0, won, won, won)}
    for one, policies in zip(found, asked, strict=True):
        assert one.best == best
        assert {row.policy for row in one.calibration} == {BASELINE, best}
        check_fitted(policies, asked[0])
        # How often walks stop follows from the system's calibration, not from labels.
        check_fitted([row.sure for row in one.stopping], [row.sure for row in found[0].stopping])


def test_reality_uses_the_policies_that_the_system_names(monkeypatch, tmp_path):
    asked, one = [], system()
    other = replace(one.description, best="farthest", best_unposed="farthest")
    systems = {"one": one, "other": replace(one, description=other)}
    for winner, labels in (("random", LABELS), ("farthest", other_labels(LABELS, len(making.CLASSES)))):
        seen, given = Seen(winner), source(labels)
        with monkeypatch.context() as patch:
            without_bootstrap(patch)
            seen.watch(patch)
            patch.setattr(reality, "objects_to_test", lambda data, up, given=given: given)
            patch.setattr(reality, "meshes_of", lambda entries, most: ([(entry, None) for entry in entries], {}))
            patch.setattr(reality, "_tables", tables_in_every_condition)
            found = check_reality(systems, "tested", tmp_path, RealityConfig(("roll", "turned", "upper")))
        asked.append(seen.asked)
        named = {
            name: {(row.policy, row.condition == "turned"): row.name for row in rows}
            for name, rows in found.systems.items()
        }
        assert named["one"]["best", False] == "information_gain"
        assert named["one"]["best", True] == named["other"]["best", True] == named["other"]["best", False] == "farthest"
        accuracies = {row.accuracy for row in found.systems["other"] if row.policy == "best"}
        assert accuracies == ({0.0, 1.0} if winner == "farthest" else {0.0})
        assert {id(walked) for walked in seen.systems} == {id(walked) for walked in systems.values()}
    check_fitted(*asked)


def test_conditions_are_compared_with_what_they_differ_from(monkeypatch, tmp_path):
    """All policies reach the same views; what is seen from above is also compared with perfect images from there."""
    accuracy = {"clean": 1.0, "roll": 0.75, "upper": 0.5, "table": 0.25}
    reaching = dict[str, list[Any]]()

    def walks(walker, tables, condition, config):
        before, found = len(seen.asked), real_walks(walker, tables, condition, config)
        reaching[condition.name] = [reachable for *_, reachable in seen.asked[before:]]
        right = np.arange(OBJECTS)[:, None, None] < OBJECTS * accuracy[condition.name]
        return {part: replace(one, right=np.broadcast_to(right, one.right.shape)) for part, one in found.items()}

    seen, real_walks = Seen("random"), reality._walks
    seen.watch(monkeypatch)
    without_bootstrap(monkeypatch)
    monkeypatch.setattr(reality, "_walks", walks)
    monkeypatch.setattr(reality, "objects_to_test", lambda data, up: source())
    monkeypatch.setattr(reality, "meshes_of", lambda entries, most: ([(entry, None) for entry in entries], {}))
    monkeypatch.setattr(reality, "_tables", tables_in_every_condition)
    rows = check_reality({"one": system()}, "tested", tmp_path, RealityConfig(("roll", "table"))).systems["one"]
    assert {row.policy for row in rows} == {"random", "thesis", "best"}
    for name, there in (("clean", "clean"), ("roll", "clean"), ("upper", "upper"), ("table", "upper")):
        for row in (row for row in rows if row.condition == name):
            assert row.accuracy == accuracy[name]
            assert row.loss == 1 - accuracy[name]
            assert row.loss_there == accuracy[there] - accuracy[name]
        above = [row is not None for row in reaching[name]]
        assert len(above) == 3
        assert above == [there == "upper"] * 3
        assert all(row == reaching[name][0] for row in reaching[name])


def tables_in_every_condition(systems, conditions, meshes, truth: np.ndarray, folder: Path, seed: int):
    return {name: {one.name: tables_of(truth) for one in conditions} for name in systems}


def test_views_and_confidence_do_not_depend_on_the_labels():
    """Walks themselves, by the policy that uses the system's knowledge."""
    walker, found = Walker(system()), []
    for labels in (LABELS, other_labels(LABELS, len(making.CLASSES))):
        found.append(walker.walk(tables_of(labels), "information_gain", 3))
    check_fitted(*({"views": walks.views, "confidence": walks.confidence} for walks in found))
    check_tested(*({"right": walks.right} for walks in found))


@pytest.mark.parametrize("shift", [-1e6, 1e6])
def test_strangeness_is_compared_with_the_objects_that_the_system_was_fitted_on(shift):
    """Where those had much less or much more energy than the tested objects, all of these are strange, or none."""
    of = system()
    assert of.parts.strangeness is not None
    moved = replace(
        of.parts, strangeness=replace(of.parts.strangeness, quantiles=of.parts.strangeness.quantiles + shift)
    )
    walks = Walker(replace(of, parts=moved)).walk(tables_of(LABELS), BASELINE, 4)
    found = strangers(walks, np.arange(OBJECTS) < 10)
    assert found is not None
    for row in found.after:
        assert row.unknown_found == row.known_refused == (shift < 0)
