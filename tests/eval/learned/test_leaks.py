"""What the learned study fits and chooses, and the system that it exports, do not depend on the test objects."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import eval.learned.measure as measuring
import eval.learned.stopping as stopping
import eval.learned.study as studying
import train.choosing.stages as choosing
from eval.learned.system import figures_of, learned_system
from eval.settings import TINY
from eval.tables import ViewTables, save_view_tables
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.trained import TrainedSystem
from tests.reference.evaluation import CLASSES
from tests.reference.leaks import (
    CHANGES,
    check_fitted,
    check_tested,
    other_tables,
    seed_of,
    walk_all_anyhow,
    without_bootstrap,
)
from tests.reference.made_up_study import OBJECTS_OF, VIEWS, Study

CONFIG = replace(TINY.learned, max_views=3, draws=1, ablations=("look_ahead", "summed"), novel=1)
TRUTH = ("oracle_entropy", "belief_oracle", "label_oracle")
"""Policies that know the truth."""
WITH_COST = "with_cost"
"""Name of the walks with a movement cost, which are on test objects alone."""

pytestmark = pytest.mark.slow


@dataclass
class Measured:
    """What the study with some test objects finds.

    Attributes:
        found: the metrics.
        system: the exported system.
        others: those that would be exported if another policy won on test objects, one for each.
        given: what each measurement is given apart from test objects.
        knowledge: of the walks on the lattice of the run, by policy.
        walks: views of these walks by policy and split.
        refitted: inputs of each fit of temperatures.
    """

    found: dict[str, Any] = field(default_factory=dict)
    system: TrainedSystem | None = None
    others: list[TrainedSystem] = field(default_factory=list)
    given: list[Any] = field(default_factory=list)
    knowledge: list[Any] = field(default_factory=list)
    walks: dict[str, list[np.ndarray]] = field(default_factory=dict)
    refitted: list[Any] = field(default_factory=list)


def tables_of(split: str) -> ViewTables:
    random, objects = np.random.default_rng(len(split)), OBJECTS_OF[split]
    arrays = [random.random(shape).astype(np.float32) for shape in ((objects, VIEWS, VIEWS), (objects, VIEWS))]
    logits = np.zeros((objects, VIEWS, CLASSES), np.float32)
    return ViewTables([""] * objects, np.zeros(objects, np.int32), logits, *arrays, made_by="classifier entropy")


def measured_with(change: str | None, out: Path) -> Measured:
    """The measurements of the first seed, the one on the lattice of the run in full."""
    seen = Measured()

    def study(fusion, learned, lattices, walking, **rest):
        weights = {policy.name: jax.tree.leaves(policy.score) for policy in learned}
        apart = [jax.tree.leaves(policy.score) for policy in rest["apart"]]
        validation, test = lattices
        seen.given.append((fusion, weights, apart, rest["fusions"], vars(validation)))
        if apart:  # on the lattice of the run
            return real_study(fusion, learned, lattices, walking, **rest)
        known, after = (float(data.features.labels.sum() + data.features.logits.sum()) for data in (validation, test))
        found = {"temperatures": [known] * 3, "after_views": [after] * 3}
        return {"policies": dict.fromkeys(("random", "learned", "expected_views"), found)}, {}

    def novel_classes(fusion, pairs, whole, test, walking, expected):
        weights = [(classes, jax.tree.leaves(policy.score)) for classes, policy in pairs]
        seen.given.append((fusion, weights, jax.tree.leaves(whole.score), vars(walking), expected))
        told = float(test.features.labels.sum() + test.features.logits.sum())
        return {name: np.full((3, 4), told) for name in ("random", "trained_with")}

    def walk_all(key, policy, fusion, lattice, knowledge, **steps):
        views = walk_all_anyhow(key, policy, fusion, lattice, knowledge, **steps)
        seen.walks.setdefault(policy.name, []).append(views)
        seen.knowledge.append(knowledge)
        return views

    def calibrated(network, validation, prior, posed=True):
        """In place of `calibrated`, whose inputs tests/train/choosing/test_leaks.py compares."""
        random, (structure, weights) = np.random.default_rng(seed_of((validation, prior, posed))), nnx.split(network)
        temperatures = jnp.asarray(random.uniform(0.5, 2, VIEWS), jnp.float32)
        return CalibratedFusion(structure, weights, prior, temperatures, temperatures[0], posed)

    def refit(beliefs, labels, *promising):
        seen.refitted.append((beliefs, labels))
        return real_refit(beliefs, labels, *promising)

    real_study, real_refit = measuring.study, studying._refit
    for split in ("val", "test"):
        save_view_tables(
            out / "tables" / f"{split}.npz", other_tables(tables_of(split), change if split == "test" else None)
        )
    with pytest.MonkeyPatch.context() as patch:
        stages = Study(change, out, patch, CONFIG).stages
        without_bootstrap(patch)
        patch.setattr(choosing, "calibrated", calibrated)
        patch.setattr(measuring, "study", study)
        patch.setattr(measuring, "novel_classes", novel_classes)
        patch.setattr(measuring, "_decision", lambda stages: {})
        patch.setattr(measuring, "read_json", lambda path: {"identity": {"policy": path.parent.name}})
        patch.setattr(studying, "walk_all", walk_all)
        patch.setattr(stopping, "walk_all", walk_all)
        patch.setattr(studying, "_refit", refit)
        seen.found = measuring.measure(stages)
        figures = figures_of(seen.found, VIEWS)
        seen.system = learned_system(stages, seen.found, figures, "")
        for winner in figures["after_views"]:
            after = {name: [float(name == winner)] * 3 for name in figures["after_views"]}
            seen.others.append(learned_system(stages, seen.found, figures | {"after_views": after}, ""))
    return seen


@pytest.fixture(scope="module")
def every(tmp_path_factory) -> dict[str | None, Measured]:
    return {change: measured_with(change, tmp_path_factory.mktemp("study")) for change in (None, *CHANGES)}


RULES = ("beside_thesis", "not_paying")
"""Comparisons of stopping rules, in which our threshold is the one that is as accurate on validation objects."""


def temperatures_in(found: dict[str, Any]) -> dict[str, Any]:
    """The temperatures of every policy's walks, by kind of candidates."""
    return {
        f"{kind} {views} {name}": policy["temperatures"]
        for kind in ("lattices", "unposed", "scattered", "ablations", "rotated")
        for views, one in found[kind].items()
        for name, policy in one["policies"].items()
    }


def accuracies_in(found: dict[str, Any]) -> dict[str, Any]:
    """Some results on test objects."""
    policies = found["lattices"][str(VIEWS)]["policies"]
    likelihood = {name: policy["negative_log_likelihood"] for name, policy in policies.items()}
    others = {
        kind: found[kind][str(VIEWS)]["policies"]["learned"]["after_views"][0] for kind in ("unposed", "ablations")
    }
    return {"likelihood": likelihood, "novel": found["novel"]["pairs"][0]["random"][0]} | others


@pytest.mark.parametrize("change", CHANGES)
def test_every_measurement_is_given_what_was_learned_from_other_objects(change, every):
    """Validation objects, fusions and view policies, for every kind of candidates."""
    one, other = every[None], every[change]
    assert len(one.given) == len(("lattice", "unposed", "turned", "ablations", "novel", "rotated"))
    check_fitted(one.given, other.given)


@pytest.mark.parametrize("change", CHANGES)
def test_temperatures_are_fitted_on_validation_objects(change, every):
    one, other = every[None], every[change]
    assert len(temperatures_in(one.found)) == 10 + 4 * 3
    check_fitted(temperatures_in(one.found), temperatures_in(other.found))
    assert len(one.refitted) == 10 + VIEWS  # of each policy, and of sets of views of each size
    check_fitted(one.refitted, other.refitted)
    check_tested(accuracies_in(one.found), accuracies_in(other.found))


@pytest.mark.parametrize("change", CHANGES)
def test_knowledge_is_of_validation_objects(change, every):
    one, other = every[None], every[change]
    assert all(known is not None for known in one.knowledge)
    check_fitted(one.knowledge, other.knowledge)


def test_views_are_chosen_without_the_labels_of_test_objects(every):
    one, other = (
        {name: views for name, views in every[change].walks.items() if name not in TRUTH} for change in (None, "labels")
    )
    assert {*one} >= {"random", "fixed_order", "expected_views", "learned", "learned_and_table", WITH_COST}
    check_fitted(one, other)


def test_walks_on_validation_objects_are_the_same_whatever_networks_say_of_test_objects(every):
    for place, check in enumerate((check_fitted, check_tested)):
        one, other = (
            {name: views[place] for name, views in every[change].walks.items() if name != WITH_COST}
            for change in (None, "outputs")
        )
        assert {*one} >= {*TRUTH, "random", "learned"}
        check(one, other)


@pytest.mark.parametrize("change", CHANGES)
def test_stopping_thresholds_are_chosen_on_validation_objects(change, every):
    costs = [every[which].found["lattices"][str(VIEWS)]["costs"] for which in (None, change)]
    chosen = [
        {name: [row["ours"] and row["ours"]["threshold"] for row in found[name]] for name in RULES} for found in costs
    ]
    assert len({threshold for rows in chosen[0].values() for threshold in rows}) > 2
    check_fitted(*chosen)
    check_tested(*({name: [row["accuracy"] for row in found[name][:3]] for name in RULES} for found in costs))


@pytest.mark.parametrize("change", CHANGES)
def test_the_exported_system_is_of_validation_objects(change, every):
    """Fusions, view policies, knowledge, temperatures, strangeness, policies by default: all but figures and the data set."""
    fitted, tested = [], []
    for one in (every[None], every[change]):
        assert one.system is not None
        described = asdict(one.system.description)
        figures = described.pop("evaluation")
        del described["data"]
        fitted.append({"description": described, "parts": one.system.parts})
        tested.append(
            {
                "after_views": figures["after_views"]["learned"][1:],
                "unknown": figures["unknown_yaw"]["after_views"]["learned"][0],
            }
        )
    named = {name + end for name in ("learned", "expected_views") for end in ("", "_unposed")}
    assert {*fitted[0]["parts"].temperatures} >= {"random", *named}
    check_fitted(*fitted)
    check_tested(*tested)


def test_no_figure_of_test_objects_decides_what_the_exported_system_uses(every):
    """Whichever policy wins on test objects, and however far."""
    one = every[None]
    made = [
        {"description": asdict(replace(of.description, evaluation={})), "parts": of.parts}
        for of in (one.system, *one.others)
    ]
    assert len(made) > 4
    for other in made[1:]:
        check_fitted(made[0], other)
