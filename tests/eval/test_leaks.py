"""What a run fits and chooses, in its evaluation and for its trained system, does not depend on the test objects."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import eval.evaluation as evaluation
import eval.numbers.confidence as confidence
import eval.numbers.study as study
import eval.promises as promises
import eval.runs as of_run
import eval.stages as stages
import eval.system as system
import eval.training as training
from eval.learned.stage import learn_to_choose
from eval.numbers.policies import EvaluationInputs, evaluate_policies
from eval.numbers.study import entropy_errors
from eval.settings import TINY
from eval.tables import ViewTables
from eval.walks.grid import GridConfig
from eval.walks.knowledge import learn
from eval.walks.ladder import ladder
from mevs_jax.policies.registry import POLICIES
from mevs_jax.trained import TrainedSystem
from tests.reference.evaluation import CLASSES, OBJECTS, VIEWS, some_statistics, some_tables
from tests.reference.leaks import (
    CHANGES,
    LEARNED,
    check_fitted,
    check_tested,
    differing,
    filled,
    other_statistics,
    other_tables,
    other_test_objects,
    seed_of,
    walk_grid_anyhow,
    without_bootstrap,
)
from tests.reference.weights import untrained
from train.loop import RANDOM
from train.results.records import as_json

SETTINGS = replace(TINY, evaluation=GridConfig(max_views=4, draws=1))
WALKED = ("random", "random_with_repetition", "predicted_entropy", "remembered_entropy", "fixed_order")
WALKED += ("information_gain", "label_oracle")
"""Policies of the evaluation: those that it needs, all that have knowledge, and one that knows the truth."""


def tables_of(seed: int, telling: int) -> ViewTables:
    """View tables of random objects, of which one view tells the class."""
    random, tables = np.random.default_rng(seed), some_tables()
    labels = random.permutation(tables.labels)
    logits = random.normal(0, 1.5, tables.logits.shape).astype(np.float32)
    logits[np.arange(OBJECTS), telling, labels] += 5
    predicted, entropy = (random.random(shape.shape) for shape in (tables.predicted_entropy, tables.entropy))
    return ViewTables(tables.names, labels, logits, predicted.astype(np.float32), entropy.astype(np.float32))


TELLING_VALIDATION, TELLING_TEST = 3, 7
VALIDATION, TEST = tables_of(0, telling=TELLING_VALIDATION), tables_of(1, telling=TELLING_TEST)
BEST, BEST_ON_TEST = "information_gain", "predicted_entropy"
"""The policies that see the view that tells the class as their second one: of validation objects and of test objects."""
BY_VIEW = tables_of(2, telling=5)
"""View tables of the test objects by the classifier that is validated by view."""
STATISTICS = replace(some_statistics(some_tables()), capture={"resolution": 32, "views": VIEWS})

pytestmark = pytest.mark.slow


@dataclass
class Run:
    """What a run with some test objects makes.

    Attributes:
        metrics: of its evaluation.
        system: its trained system.
        knowledge: given to each call of `run_grid`, for the evaluation and for the system, and to live walks.
        walks: views of the walks by policies that do not know the truth, of each of these calls.
        fitted_on: inputs of the fits of confidences, in an order that is not that of the policies: they are fitted side by side.
    """

    metrics: dict[str, Any] = field(default_factory=dict)
    system: TrainedSystem | None = None
    knowledge: list[Any] = field(default_factory=list)
    walks: list[dict[str, np.ndarray]] = field(default_factory=list)
    fitted_on: list[Any] = field(default_factory=list)


@cache
def networks() -> dict[str, nnx.Module]:
    classify, predict = of_run.tasks(SETTINGS, STATISTICS)
    return {
        name: filled(untrained(lambda task=task: task.network(nnx.Rngs(0))), seed)
        for seed, (name, task) in enumerate(
            {"classifier": classify, of_run.BY_VIEW: classify, "entropy": predict}.items()
        )
    }


def run_with(change: str | None, out: Path) -> Run:
    """The stages of a run after training, with networks whose outputs are made up."""
    run, trained = Run(), networks()

    def compute_view_tables(data, split, statistics, classify, classifier, predict, predictor):
        if split != "test":
            assert classifier is trained["classifier"]
            return {"val": VALIDATION}[split]
        return other_tables(TEST if classifier is trained["classifier"] else BY_VIEW, change)

    def run_grid(key, tables, graph, knowledge, policies, second, **rest):
        found = walk_grid_anyhow(key, tables, graph, knowledge, policies, second, **rest)
        run.knowledge.append(knowledge)
        run.walks.append({one.name: np.asarray(found[one.name].views) for one in policies if one.knows != "truth"})
        return found

    def fit_confidences(logits, labels):
        run.fitted_on.append((logits, labels))
        return fitted(logits, labels)

    def compare_with_tables(data, split, networks, tables, knowledge, graph, **rest):
        run.knowledge.append(knowledge)
        return {}

    fitted = confidence._fit
    statistics = other_statistics(STATISTICS) if change else STATISTICS
    (out / of_run.BY_VIEW).mkdir()
    (out / of_run.BY_VIEW / "summary.json").touch()
    with pytest.MonkeyPatch.context() as patch:
        without_bootstrap(patch)
        patch.setattr(of_run, "load_statistics", lambda folder: statistics)
        patch.setattr(of_run, "check_made_with", lambda settings, out: None)
        patch.setattr(of_run, "made_by", lambda statistics, *networks: " ".join(folder.name for folder in networks))
        patch.setattr(evaluation, "load_ascent_scores", lambda *_: None)
        patch.setattr(of_run, "load_best", lambda task, folder: trained[folder.name])
        patch.setattr(evaluation, "summary_of", lambda folder: {"best": {"accuracy": 0.5}})
        patch.setattr(system, "summary_of", lambda folder: {"start": RANDOM})
        patch.setattr(of_run, "compute_view_tables", compute_view_tables)
        patch.setattr(promises, "compare_with_tables", compare_with_tables)
        patch.setattr(system, "save_system", lambda system, folder: setattr(run, "system", system))
        patch.setattr(study, "ladder", lambda *given: tuple(one for one in ladder(*given) if one.name in WALKED))
        patch.setattr(study, "run_grid", partial(run_grid, second={BEST_ON_TEST: TELLING_TEST}))
        patch.setattr(system, "run_grid", partial(run_grid, second={BEST: TELLING_VALIDATION}))
        patch.setattr(confidence, "_fit", fit_confidences)
        run.metrics = as_json(stages.evaluate(SETTINGS, out))
        stages.make_system(SETTINGS, out)
        stages.check_live(SETTINGS, out)
    return run


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str | None, Run]:
    return {change: run_with(change, tmp_path_factory.mktemp("run")) for change in (None, *CHANGES)}


# ---------------------------------------------------------------------------------------------------------- the evaluation


def fitted_in(metrics: dict[str, Any]) -> dict[str, Any]:
    """Entries of `metrics.json` that are fitted or chosen."""
    temperatures = {
        f"{policy}, {reading}": {name: values[name] for name in ("temperatures", "validation_ece") if name in values}
        for policy, found in metrics["confidence"].items()
        for reading, values in found["readings"].items()
    }
    chosen = ("thresholds", "max_views", "headline", "ladder", "reachable", "random_exact_up_to", "validation_objects")
    return {"confidence": temperatures} | {name: metrics[name] for name in chosen}


def results_in(metrics: dict[str, Any]) -> dict[str, Any]:
    """Some results on test objects."""
    readings = {
        f"{policy}, {reading}": values["nll"][1]
        for policy, found in metrics["confidence"].items()
        for reading, values in found["readings"].items()
    }
    areas = {name: found["area"] for name, found in metrics["policies"].items() if name != "label_oracle"}
    return {"single_view": metrics["single_view"]["accuracy"], "areas": areas, "confidence": readings}


@pytest.mark.parametrize("change", CHANGES)
def test_temperatures_are_fitted_on_validation_objects(change, runs):
    one, other = runs[None], runs[change]
    check_fitted(fitted_in(one.metrics), fitted_in(other.metrics))
    assert len(one.fitted_on) == len(study.CONFIDENCE_OF)
    check_fitted(sorted(one.fitted_on, key=seed_of), sorted(other.fitted_on, key=seed_of))
    check_tested(results_in(one.metrics), results_in(other.metrics))


@pytest.mark.parametrize("change", CHANGES)
def test_knowledge_is_of_validation_objects(change, runs):
    """In the walks on test and on validation objects, with a movement cost, with either classifier, and live ones."""
    one, other = runs[None], runs[change]
    walks, halves, live = 2 + 1 + len(study.MOVEMENT_COSTS), 2, 1
    assert len(one.knowledge) == walks + halves + live
    assert all(known.expected_logits is not None for known in one.knowledge)
    check_fitted(one.knowledge, other.knowledge)
    for known in (*one.knowledge[:walks], one.knowledge[-1]):  # of all validation objects
        check_fitted(np.ravel(known.order), np.ravel(one.knowledge[0].order))


def test_views_are_chosen_without_the_labels_of_test_objects(runs):
    """Every walk by policies that do not know the truth; and how far these walks went, and how many views they used."""
    one, other = runs[None], runs["labels"]
    assert {name for walks in one.walks for name in walks} >= {*WALKED} - {"label_oracle"}
    check_fitted(one.walks, other.walks)
    seen = [
        {
            "movement": {name: [row["travelled"] for row in rows] for name, rows in run.metrics["movement"].items()},
            "policies": {
                name: [found["travelled"], found["views_used"]]
                for name, found in run.metrics["policies"].items()
                if name != "label_oracle"
            },
        }
        for run in (one, other)
    ]
    check_fitted(*seen)


def test_temperatures_are_fitted_on_walks_of_the_policy_that_uses_them(runs):
    """Beliefs along well-chosen views are other ones than along random views."""
    run = runs[None]
    (walks,) = [walks for walks in run.walks if set(walks) == set(study.CONFIDENCE_OF)]
    objects = np.arange(OBJECTS)[:, None, None]
    expected = [VALIDATION.logits[objects, views[0, :, :, 0]] for views in walks.values()]
    assert len({seed_of(logits) for logits in expected}) == len(study.CONFIDENCE_OF)
    assert {seed_of(np.asarray(logits)) for logits, _ in run.fitted_on} == set(map(seed_of, expected))


def test_walks_on_validation_objects_are_the_same_whatever_networks_say_of_test_objects(runs):
    fitting = [
        [walks for walks in runs[change].walks if set(walks) == set(study.CONFIDENCE_OF)]
        for change in (None, "outputs")
    ]
    assert len(fitting[0]) == 1
    check_fitted(*fitting)
    check_tested(*({"walks": runs[change].walks[0]["information_gain"]} for change in (None, "outputs")))


@pytest.mark.parametrize("change", CHANGES)
def test_policies_of_users_know_validation_objects(change, monkeypatch):
    class Enough(Exception):
        pass

    known = []

    def run_grid(key, tables, graph, knowledge, policies, **rest):
        known.append(knowledge)
        raise Enough

    monkeypatch.setattr(study, "run_grid", run_grid)
    for tables in (TEST, other_tables(TEST, change)):
        with pytest.raises(Enough):
            evaluate_policies(
                EvaluationInputs(tables, VALIDATION, STATISTICS.graph, SETTINGS.evaluation),
                {"fixed_order": POLICIES["fixed_order"]},
            )
    assert known[0].order.shape == (VIEWS,)
    check_fitted(*known)


def test_maps_that_receive_no_view_are_of_training_objects():
    """Mean entropies of the training objects, which are not those of the test objects."""
    random = np.random.default_rng(5)
    maps = {"mean_map": random.random(VIEWS).tolist(), "class_mean_maps": random.random((CLASSES, VIEWS)).tolist()}
    found = entropy_errors(TEST, replace(STATISTICS, **maps))
    assert found.mean_map == pytest.approx(np.square(maps["mean_map"] - TEST.entropy).mean())
    of_classes = np.array(maps["class_mean_maps"])[TEST.labels]
    assert found.class_mean_map == pytest.approx(np.square(of_classes - TEST.entropy).mean())


# ---------------------------------------------------------------------------------------------------------- the trained system


@pytest.mark.parametrize("change", CHANGES)
def test_a_trained_system_is_of_validation_objects(change, runs):
    """Temperatures, knowledge, strangeness, policies by default: all but the figures, and what the data set is called."""
    fitted, tested = [], []
    for run in (runs[None], runs[change]):
        assert run.system is not None
        described = asdict(run.system.description)
        del described["made_by"], described["data"]
        figures = described["evaluation"]
        tested.append({name: figures.pop(name) for name in ("single_view", "after_views")})
        fitted.append({"description": described, "parts": run.system.parts})
    assert set(fitted[0]["description"]["evaluation"]) == {"objects", "validation_after_views"}
    check_fitted(*fitted)
    check_tested(*tested)


def test_no_half_of_the_validation_objects_is_walked_with_knowledge_of_itself(monkeypatch):
    """Its accuracy, by which the best policy is chosen, would be too high otherwise."""
    walked = []

    def run_grid(key, tables, graph, knowledge, policies, **rest):
        walked.append((np.asarray(tables.logits), knowledge))
        return walk_grid_anyhow(key, tables, graph, knowledge, policies, **rest)

    monkeypatch.setattr(system, "run_grid", run_grid)
    system.walk_validation(VALIDATION, STATISTICS.graph, 2)
    assert sum(len(logits) for logits, _ in walked) == OBJECTS
    for logits, knowledge in walked:
        others = ~np.isin(VALIDATION.logits[:, 0, 0], logits[:, 0, 0])
        assert others.sum() == OBJECTS - len(logits)
        expected = learn(jnp.asarray(VALIDATION.logits[others]), jnp.asarray(VALIDATION.labels[others]))
        check_fitted(knowledge, expected)


def best_after_views(after_views: dict[str, list[float]]) -> str:
    return max(after_views, key=lambda name: np.mean(after_views[name][1:4]))


def test_the_best_policy_is_not_the_one_that_is_best_on_test_objects(runs):
    assert runs[None].system is not None
    described = runs[None].system.description
    assert described.best == best_after_views(described.evaluation["validation_after_views"]) == BEST
    assert best_after_views(described.evaluation["after_views"]) == BEST_ON_TEST


def test_no_figure_of_test_objects_decides_what_a_system_uses(monkeypatch):
    """Whichever policy wins on test objects, and however far."""
    trained, made = networks(), []
    monkeypatch.setattr(system, "run_grid", walk_grid_anyhow)
    on_validation = system.walk_validation(VALIDATION, STATISTICS.graph, 4)
    monkeypatch.setattr(system, "walk_validation", lambda *given: on_validation)
    monkeypatch.setattr(system, "summary_of", lambda folder: {"start": RANDOM})
    monkeypatch.setattr(of_run.Run, "tables", lambda *_: VALIDATION)
    monkeypatch.setattr(of_run.Run, "classifier", lambda _: trained["classifier"])
    monkeypatch.setattr(of_run.Run, "predictor", lambda _: trained["entropy"])
    run = of_run.Run(Path("run"), STATISTICS, SETTINGS)
    for winner in system.USABLE:
        after = {name: [float(name == winner)] * 4 for name in system.USABLE}
        figures = {"objects": OBJECTS, "single_view": float(winner == "random"), "after_views": after}
        found = system.system_of_run(run, figures, 4, "")
        assert found.description.evaluation["after_views"] == after
        made.append({"description": asdict(replace(found.description, evaluation={})), "parts": found.parts})
    for one in made:
        check_fitted(one, made[0])


# ----------------------------------------------------------------------------------------------------------- from data to systems


def found_by(out: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a run and its learned study fitted and chose, and what they found on test objects."""
    fitted: dict[str, Any] = {}
    tested: dict[str, Any] = {}
    for name in ("system", "learned/system"):
        described = json.loads((out / name / "trained.json").read_text())
        del described["made_by"], described["data"], described["sha256"]
        tested[name] = described.pop("evaluation")
        fitted[name] = described, (out / name / "weights.safetensors").read_bytes()
    fitted["validation"] = tested["system"].pop("validation_after_views")
    for path in sorted(out.rglob("summary.json")):  # of networks
        summary = json.loads(path.read_text())
        if "best_loss" in summary:
            fitted[str(path.relative_to(out))] = [summary[key] for key in ("best_epoch", "best", "best_loss")]
        elif "rounds" in summary:
            fitted[str(path.relative_to(out))] = summary["rounds"]
    return fitted, tested


@pytest.mark.slow
def test_everything_is_the_same_for_other_test_objects(otherwise_tested, tmp_path, request):
    """Both systems to the last bit, and the losses of their networks, from data sets whose test objects are others.

    What ablations, classes that are left out and further training are fitted on, tests of smaller parts compare.
    """
    shutil.copytree(otherwise_tested, tmp_path / "data")
    less = replace(LEARNED, learned=replace(LEARNED.learned, ablations=(), novel=0, rotation_epochs=0))
    with other_test_objects():
        for stage in (training.train, stages.evaluate, stages.make_system, learn_to_choose):
            stage(less, tmp_path)
    other = found_by(tmp_path)
    one = found_by(request.getfixturevalue("studied"))  # late, since another worker may be making it
    trained = {place for place in other[0] if place.endswith("summary.json")}
    assert {"classifier/summary.json", "entropy/summary.json", "learned/seed_1/recogniser/summary.json"} <= trained
    assert "learned/seed_0/policies/learned_aside_1_of_2/summary.json" in trained
    check_fitted({place: one[0][place] for place in other[0]}, other[0])
    assert "['learned/system']['after_views']['learned'][0]" in differing(one[1], other[1])
    assert "['system']['single_view']" in differing(one[1], other[1])
