"""Calibrated fusions and view policies are learned without test objects."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import eval.learned.stopping as stopping
import train.choosing.stages as choosing
from eval.learned.measure import APART
from eval.learned.stopping import walks_apart
from eval.learned.walks import OnLattice, Walking, by_network
from eval.settings import TINY
from tests.reference.leaks import CHANGES, check_fitted, check_tested
from tests.reference.made_up_study import STUDIED, VIEWS, Study
from train.choosing.variants import VARIANTS

FUSIONS = {
    "posed": {},
    "unposed": {"posed": False},
    "summed": {"summed": True},
    "of a part": {"fold": 1},
}
LEARNED = tuple(name for name, variant in VARIANTS.items() if not variant.network)
"""Variants that have networks of their own."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def studies(tmp_path_factory) -> dict:
    """By what is changed about test objects: the study, its fusions and its policies."""
    found = {}
    for change in (None, *CHANGES):
        with pytest.MonkeyPatch.context() as patch:
            study = Study(change, tmp_path_factory.mktemp("stages"), patch, TINY.learned)
            stages = study.stages
            stages.prepare()
            stages.train_recogniser()
            policies = {name: stages.policy(name) for name in LEARNED}
            policies["without classes"] = stages.policy(without=(0, 2))
            fusions = {name: stages.fusion(**which) for name, which in FUSIONS.items()}
            asked = list(study.asked)
            test = stages.features("turned_test", stages.turned, "test")
            found[change] = study, asked, fusions, policies, stages.prior, test
    return found


def test_test_objects_are_not_asked_for(studies):
    _, asked, *_ = studies[None]
    assert {split for _, split, _ in asked} == {"train", "val"}
    assert {network for _, _, network in asked} > {"recogniser", "recogniser without part 1 of 2"}


@pytest.mark.parametrize("change", CHANGES)
def test_fusions_are_calibrated_on_validation_objects(change, studies):
    """Temperatures of sets of views and of single views, for objects of known and unknown pose; and what they subtract."""
    one, other = (studies[which][2] for which in (None, change))
    check_fitted(one, other)
    for fusion in one.values():
        assert np.unique(fusion.temperatures).size > 3
        assert fusion.single != 1


@pytest.mark.parametrize("change", CHANGES)
def test_the_prior_is_of_training_objects(change, studies):
    assert studies[None][0].stages.prior.shape == (3,)
    check_fitted(*(studies[which][4] for which in (None, change)))


def test_the_prior_counts_training_objects(tmp_path, monkeypatch):
    uneven = {"train": {"a": 1, "b": 2, "c": 5}, "val": {"a": 3, "b": 1, "c": 1}, "test": {"a": 9, "b": 1, "c": 1}}
    stages = Study(None, tmp_path, monkeypatch, TINY.learned).stages
    stages.statistics = replace(STUDIED, counts=uneven)
    np.testing.assert_allclose(jnp.exp(stages.prior), np.array([1, 2, 5]) / 8, rtol=1e-6)


def test_expected_views_are_of_training_objects_without_the_prior(tmp_path, monkeypatch):
    """A recogniser says the prior, and more of the class of training objects. Validation objects are of one class."""
    uneven = STUDIED.counts | {"train": {"a": 1, "b": 2, "c": 5}}
    stages = Study(None, tmp_path, monkeypatch, TINY.learned).stages
    stages.statistics = replace(STUDIED, counts=uneven)
    directions, width = np.asarray(STUDIED.viewpoints), 8 * TINY.learned.recogniser.network.width

    def outputs(data, split, task, network, ask=None, chosen=None):
        labels = np.arange(30) % 3 if split == "train" else np.zeros(30)
        named = labels.astype(int) if split == "train" else np.arange(30) % 3 // 2  # right in two of three cases
        said = 3 * np.eye(3)[named][:, None] + np.asarray(stages.prior)
        seen = [np.broadcast_to(said, (30, VIEWS, 3)), np.broadcast_to(directions, (30, VIEWS, 3))]
        seen.append(np.broadcast_to(labels[:, None, None], (30, VIEWS, 1)))
        features = [] if "answers" in getattr(ask, "__qualname__", "") else [np.zeros((30, VIEWS, width))]
        return np.concatenate([*features, *seen], axis=-1).astype(np.float32)

    monkeypatch.setattr(choosing, "network_outputs", outputs)
    found = np.asarray(stages.expected_views().at(directions))
    for label in range(3):
        own, others = found[label, :, label], np.delete(found[label], label, axis=-1)
        assert (own > others.max(axis=-1) + 0.5).all()
        np.testing.assert_allclose(others[:, 0], others[:, 1], atol=1e-3)


@pytest.mark.parametrize("change", CHANGES)
def test_view_policies_learn_from_other_objects(change, studies):
    """Everything that their training is given: features, logits, labels, directions, clouds, and fusions."""
    one, other = (studies[which][0].fitted_on for which in (None, change))
    assert len(one) == len(LEARNED) + 1
    check_fitted(one, other)
    check_fitted(*(studies[which][3] for which in (None, change)))


def test_policies_that_are_trained_without_classes_see_no_object_of_these(studies):
    """Those classes are new to them when they are tested on them."""
    name, (parts, check) = studies[None][0].fitted_on[-1]
    assert name == "view policy (learned) of seed 0"
    assert check is None
    for _, data in parts:
        assert set(np.asarray(data.labels).tolist()) == {1}


def test_held_out_policies_walk_objects_that_they_did_not_learn_from(tmp_path, monkeypatch):
    """Stopping rules are fitted on these walks; neither an object nor an augmented copy of it may be on both sides."""
    study = Study(None, tmp_path, monkeypatch, replace(TINY.learned, changed=2))
    stages, walked = study.stages, []
    stages.prepare()
    stages.train_recogniser()
    seen = stages.features("turned_val", stages.turned, "val")
    copies = stages.changed(2)

    def walk(key, policy, fusion, lattice, knowledge, *, max_views, every):
        walked.append(numbers_of(seen.logits, lattice.features.logits))
        return np.zeros((len(lattice.features.logits), 1, max_views), np.int32)

    monkeypatch.setattr(stopping, "walk_all", walk)
    monkeypatch.setattr(stopping, "best_gains", lambda policy, data, views, beliefs: np.zeros(views.shape))
    fusion = stages.fusion()
    apart = [by_network("learned", "", stages.policy(aside=(part, APART)), fusion) for part in range(APART)]
    lessons = [parts for name, (parts, _) in study.fitted_on][-APART:]
    walks_apart(jax.random.key(0), apart, fusion, OnLattice(seen), None, Walking(3, 1), np.ones(3))
    assert sorted(set().union(*walked)) == list(range(len(seen.labels)))
    for parts, own in zip(lessons, walked, strict=True):
        assert len(parts) == 3
        for whole, (_, data) in zip((seen, *copies), parts, strict=True):
            learned = numbers_of(whole.logits, data.logits)
            assert not learned & own
            assert learned | own == set(range(len(seen.labels)))


def numbers_of(whole: jnp.ndarray, some: jnp.ndarray) -> set[int]:
    """Which objects these are, by their logits."""
    places = {np.asarray(row).tobytes(): number for number, row in enumerate(whole)}
    return {places[np.asarray(row).tobytes()] for row in some}


@pytest.mark.parametrize("change", CHANGES)
def test_test_objects_are_others(change, studies):
    one, other = (studies[which][5] for which in (None, change))
    names = {"labels": ("labels",), "outputs": ("features", "logits")}[change]
    check_tested(*({name: getattr(test, name) for name in names} for test in (one, other)))
