"""The stages of a run after the trainings: metrics, trained system, report, and checks. Each skips completed work.

A run directory holds `data/`, `classifier/`, `entropy/`, `tables/`, `metrics.json`, `metrics.csv` and `report/index.html`. It
also holds `classifier_by_view/` if the validation of the published code is compared. Each stage resolves the settings at its
door: what it calls is given what it needs of them.
"""

from __future__ import annotations

from pathlib import Path

from data_pipeline.dataset.config import check_same_data
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from eval.checks.agent import AgentPromises
from eval.consistency import check_evaluation
from eval.evaluation import evaluate_run, load_metrics
from eval.numbers.metrics import Metrics
from eval.promises import agent_promises, live_agreement
from eval.rendering.policies import ascend_objects
from eval.reporting import write_run_report
from eval.runs import Run
from eval.settings import Settings
from eval.system import make_run_system
from eval.walks.live import Agreement
from eval.walks.own_policies import load_policies


def evaluate(settings: Settings, out: Path) -> Metrics:
    """Returns the metrics of the test split, as written to `metrics.json`; `metrics.csv` has those by number of views."""
    check_evaluation(settings.evaluation)
    return evaluate_run(Run.of(settings, out))


def make_system(settings: Settings, out: Path) -> Path:
    """Writes the trained system of the run into `system/`, unless it is there already; returns the folder.

    Raises:
        DataError: if the run is not finished, its metrics are stale, or its classifier is an encoder of the user's own.
    """
    if encoder := settings.classifier.own:
        raise DataError(f"a trained system holds networks of this project, and the classifier of {out} is {encoder}")
    run = Run.of(settings, out)
    return make_run_system(run, load_metrics(run, None))


def ascend_on_objects(settings: Settings, out: Path) -> None:
    """Computes the choices of differentiable rendering for many test objects; `evaluate` then compares them."""
    statistics = load_statistics(out / "data")
    check_same_data(settings.dataset, out / "data")
    ascend_objects(settings.dataset, statistics, out, settings.rendering)


def check_live(settings: Settings, out: Path) -> dict[str, Agreement]:
    """Compares walks with the networks in the loop with walks on view tables; writes `live.json`."""
    return live_agreement(Run.of(settings, out))


def check_agent(settings: Settings, out: Path) -> AgentPromises:
    """Measures what an agent with the run's system promises, on test objects; writes `agent.json`."""
    folder = make_system(settings, out)
    return agent_promises(Run.of(settings, out), folder)


def report(settings: Settings, preset: str, out: Path) -> Path:
    """Writes the report and returns its path; a page that is as it was written, from the same content, is kept.

    Raises:
        DataError: if the run is not finished, or its metrics are stale.
    """
    run, own = Run.of(settings, out), load_policies(settings.policies)
    return write_run_report(run, load_metrics(run, own), own, preset)
