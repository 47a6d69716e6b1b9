"""The stages of a run: data → networks → tables and metrics → report. Each stage skips completed work.

A run directory holds `data/`, `classifier/`, `entropy/`, `tables/`, `metrics.json`, `metrics.csv` and `report/index.html`. It
also holds `classifier_by_view/` if the validation of the published code is compared.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from data_pipeline.dataset.builder import open_objects, prepare
from data_pipeline.dataset.config import check_same_data
from data_pipeline.dataset.statistics import SUMMARY, DatasetStatistics, load_statistics, report_left_out
from data_pipeline.errors import DataError, Diverged, Unreadable
from data_pipeline.files import check_of_file, read_json, write_json
from data_pipeline.objects.sources import load_object
from data_pipeline.progress import console
from eval.checks.agent import AgentPromises, compare_walks, latency, recognised, stopping
from eval.consistency import check_classifier, check_evaluated_with, check_made_with
from eval.numbers.policies import csv_of
from eval.numbers.study import reachable_views, run_study
from eval.rendering.policies import ascend_objects, ascent_study, load_ascent_scores
from eval.report.current import is_current
from eval.report.html import ReportInputs
from eval.run_file import plain
from eval.settings import Settings
from eval.system import USABLE, classifier_system, figures_of, identity_of, save_system, stored_system
from eval.tables import ViewTables, compute_view_tables, load_view_tables, save_view_tables
from eval.walks.grid import FIRST_MV, GridConfig
from eval.walks.knowledge import learn
from eval.walks.live import GIVEN, Agreement, Networks, compare_with_tables
from eval.walks.own_policies import checked, load_policies, own_identity
from mevs_jax.policies.registry import PolicyRecord, policy_record
from mevs_jax.trained import load as load_system
from train.loop import check_launch, fit, load_best
from train.planning.plan import plan_of, planned_statistics
from train.results.chance import warn_of_chance
from train.results.finite import place_not_finite
from train.results.identity import made_by, summary_of, why_other
from train.results.kept import keep_beside, kept, kept_json
from train.results.records import as_json
from train.running.devices import Layout, check_batch, device_mesh
from train.running.log import read_history
from train.step import Task
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask
from train.weights.starting import StartingWeights


def check_output(out: Path) -> None:
    """Raises `DataError` if the directory `out` is not writable, or an address of object storage."""
    if len(out.parts) > 1 and re.fullmatch(r"[a-z][a-z0-9+.-]+:", out.parts[0]):  # `Path` has made one slash of two
        raise DataError(
            f"--out {out.parts[0]}//{'/'.join(out.parts[1:])} is an address, and a run needs a folder whose files can be renamed "
            f"and locked; mount that storage, and give the folder"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(prefix=".probe.", dir=out):
            pass
    except OSError as error:
        raise DataError(f"cannot write to {out} ({error.strerror}); choose another --out") from error


def make_data(settings: Settings, out: Path, beam: str | None = None) -> DatasetStatistics:
    statistics = prepare(settings.dataset, out / "data", beam)
    report_left_out(statistics)
    return statistics


def tasks(settings: Settings, statistics: DatasetStatistics) -> tuple[ClassifierTask, EntropyTask]:
    """The tasks of both networks on a data set."""
    camera = statistics.camera
    return (
        ClassifierTask.of(settings.classifier, len(statistics.classes), camera),
        EntropyTask.of(settings.entropy, statistics.views, statistics.entropy_max, camera),
    )


def trainings(
    settings: Settings, statistics: DatasetStatistics, start: StartingWeights | None
) -> tuple[tuple[Task, str, StartingWeights | None], ...]:
    """What `train` trains, in this order: each network's task, the folder in the run, and the weights it starts from."""
    classify, predict = tasks(settings, statistics)
    return (classify, "classifier", start), (predict, "entropy", None)


def check_batches(settings: Settings, out: Path) -> None:
    """Raises `DataError` if the devices that are here cannot share the batches of a network that is not trained yet.

    Several seeds may be trained without sharing batches; they are checked when the data are there.
    """
    if settings.seeds > 1:
        return
    layout = Layout.of_mesh(device_mesh())
    networks = ("classifier", "classifier", settings.classifier), ("entropy predictor", "entropy", settings.entropy)
    for name, folder, config in networks:
        if not (out / folder / "summary.json").exists():
            check_batch(name, config.optimiser, layout)


def train(
    settings: Settings, out: Path, start: StartingWeights | None = None, mesh: jax.sharding.Mesh | None = None
) -> None:
    """Trains both networks, the classifier from `start` or from random weights, on `mesh` or on all devices.

    Both are checked before the first is trained.
    """
    statistics = load_statistics(out / "data")
    planned, mesh = trainings(settings, statistics, start), mesh or device_mesh()
    for task, name, weights in planned:
        check_launch(task, statistics, out / name, weights, Layout.of_mesh(mesh))
    for task, name, weights in planned:
        summary = fit(task, out / "data", statistics, out / name, weights, mesh, f"--{name}.optimiser.learning-rate")
        console.print(
            f"{task.name}: best epoch {summary['best_epoch']} of {summary['epoch']}, validation "
            + ", ".join(f"{key} {value:.4f}" for key, value in summary["best"].items())
            + f", {summary['seconds'] / 60:.1f} min"
        )
        warn_of_chance(task, summary, statistics)


def plan_training(
    settings: Settings, out: Path, start: StartingWeights | None, layout: Layout, objects: int | None = None
) -> dict[str, Any]:
    """Returns what `train` would do on these devices, as values that JSON can hold; nothing is trained.

    Args:
        objects: number of training objects of a data set that is not made yet; None for the run's own data set.

    Raises:
        DataError: if there is no data set, or `train` would refuse to begin.
    """
    if objects is not None:
        made, statistics = None, planned_statistics(settings.dataset, objects)
        waiting = [task for task, _, _ in trainings(settings, statistics, start)]
    else:
        made = out / "data"
        if not (made / SUMMARY).exists():
            raise DataError(
                f"no data set in {made}; create one with: mevs data --out {out}, or plan for one of N objects by --plan-objects N"
            )
        statistics = load_statistics(made)
        waiting = [
            task
            for task, name, weights in trainings(settings, statistics, start)
            if check_launch(task, statistics, out / name, weights, layout)
        ]
    return plan_of(waiting, statistics, layout, made)


BY_VIEW = "classifier_by_view"


def train_by_view(settings: Settings, out: Path, start: StartingWeights | None = None) -> None:
    """Trains the classifier again for the compatibility table, validated by view as in the thesis's published code."""
    statistics = load_statistics(out / "data")
    check_classifier(settings, out)
    classify, _ = tasks(settings, statistics)
    by_view = replace(classify, optimiser=replace(classify.optimiser, validation_by="view"))
    option = "--classifier.optimiser.learning-rate"
    summary = fit(by_view, out / "data", statistics, out / BY_VIEW, start, rate_option=option)
    warn_of_chance(by_view, summary, statistics)


def _tables(
    settings: Settings, out: Path, statistics: DatasetStatistics, split: str, classifier: str = "classifier"
) -> ViewTables:
    """The view tables of a split, computed again if the stored ones are from other networks."""
    made = made_by(statistics, out / classifier, out / "entropy")
    path = out / "tables" / (f"{split}.npz" if classifier == "classifier" else f"{split}_by_view.npz")

    def compute() -> ViewTables:
        classify, predict = tasks(settings, statistics)
        networks = load_best(classify, out / classifier), load_best(predict, out / "entropy")
        tables = compute_view_tables(out / "data", split, statistics, classify, networks[0], predict, networks[1])
        return replace(tables, made_by=made)

    def why_stale(tables: ViewTables) -> str | None:
        if not tables.is_finite:
            return "it has numbers that are not finite"
        return why_other({"made_by": tables.made_by}, {"made_by": made})

    return kept(path, load_view_tables, save_view_tables, why_stale, compute)


def check_evaluation(config: GridConfig) -> None:
    """Raises `DataError` if the grid has no cells."""
    if config.max_views < FIRST_MV or config.draws < 1:
        raise DataError("--evaluation.max-views must be at least 2 and --evaluation.draws at least 1")


def policies_of(settings: Settings, statistics: DatasetStatistics) -> tuple[PolicyRecord, ...]:
    """Returns the policies of `--policy`, checked on this data set before anything is trained or evaluated.

    Raises:
        DataError: if one cannot be used.
    """
    if own := load_policies(settings.policies):
        checked(own, statistics.graph, len(statistics.classes))
    return own


def evaluate(settings: Settings, out: Path) -> dict[str, Any]:
    """Returns the metrics of the test split, as written to `metrics.json`; `metrics.csv` has those by number of views."""
    statistics = load_statistics(out / "data")
    check_made_with(settings, out)
    own = policies_of(settings, statistics)
    climbed = load_ascent_scores(out, statistics, settings.rendering)
    by_view_made = None
    if (out / BY_VIEW / "summary.json").exists():
        by_view_made = made_by(statistics, out / BY_VIEW, out / "entropy")
    identity: dict[str, Any] = {
        "evaluation": asdict(settings.evaluation),
        "made_by": made_by(statistics, out / "classifier", out / "entropy"),
        "by_view": by_view_made,
        "climbed": None if climbed is None else asdict(settings.rendering),
        **({"policies": [own_identity(policy) for policy in own]} if own else {}),
    }
    check_evaluation(settings.evaluation)

    def compute() -> dict[str, Any]:
        try:
            reachable_views(np.array(statistics.viewpoints), settings.evaluation.lowest_elevation)
        except ValueError as error:
            raise DataError(str(error)) from error
        tables, by_view, leak = _tables(settings, out, statistics, "test"), None, None
        if by_view_made is not None:
            by_view = _tables(settings, out, statistics, "test", BY_VIEW)
            leak = {
                name: {
                    "validation": float(summary_of(out / name)["best"]["accuracy"]),
                    "test": float((made.logits.argmax(-1) == made.labels[:, None]).mean()),
                }
                for name, made in (("classifier", tables), (BY_VIEW, by_view))
            }
        validation = _tables(settings, out, statistics, "val")
        metrics = run_study(tables, validation, statistics, settings.evaluation, by_view, leak, own)
        if climbed is not None:
            metrics["climbing"] = ascent_study(tables, statistics, climbed, settings.evaluation)
        _check_metrics(metrics, tables, out)
        return metrics

    metrics = kept_json(out / "metrics.json", identity, compute)
    keep_beside(out / "metrics.csv", csv_of(metrics))
    return metrics


def _check_metrics(metrics: dict[str, Any], tables: ViewTables, out: Path) -> None:
    """Raises `Diverged` if a metric is infinite or NaN, which outputs of networks that are finite, but huge, lead to."""
    if (place := place_not_finite(metrics)) is None:
        return
    largest = {
        "classifier": float(np.abs(tables.logits).max()),
        "entropy": float(np.abs(tables.predicted_entropy).max()),
    }
    name = max(largest, key=lambda name: largest[name])
    raise Diverged(
        f"the metric {place} is not finite, and the outputs of the network in {out / name} reach {largest[name]:.2g}; to train "
        f"it again, lower --{name}.optimiser.learning-rate, and delete {out / name} or choose another --out"
    )


def make_system(settings: Settings, out: Path) -> Path:
    """Writes the trained system of the run into `system/`, unless it is there already; returns the folder.

    Raises:
        DataError: if the run is not finished, or its classifier is an encoder of the user's own.
    """
    if encoder := settings.classifier.encoder:
        raise DataError(f"a trained system holds networks of this project, and the classifier of {out} is {encoder}")
    folder, statistics = out / "system", load_statistics(out / "data")
    if not (out / "metrics.json").exists():
        raise DataError(f"no metrics in {out}; make them with: mevs eval --out {out}")
    metrics = _metrics(out / "metrics.json", f"mevs eval --out {out}")
    made = made_by(statistics, out / "classifier", out / "entropy")
    evaluation = figures_of(metrics)
    identity = identity_of(made, evaluation, settings.evaluation.max_views)
    if stored_system(folder, identity):
        return folder
    classify, predict = tasks(settings, statistics)
    networks = load_best(classify, out / "classifier"), load_best(predict, out / "entropy")
    validation = _tables(settings, out, statistics, "val")
    system = classifier_system(
        statistics,
        classify,
        networks[0],
        predict,
        networks[1],
        validation,
        evaluation,
        settings.evaluation.max_views,
        identity,
    )
    save_system(system, folder)
    return folder


def ascend_on_objects(settings: Settings, out: Path) -> None:
    """Computes the choices of differentiable rendering for many test objects; `evaluate` then compares them."""
    statistics = load_statistics(out / "data")
    check_same_data(settings.dataset, out / "data")
    ascend_objects(settings.dataset, statistics, out, settings.rendering)


def check_live(settings: Settings, out: Path) -> dict[str, Agreement]:
    """Compares walks with the networks in the loop with walks on view tables; writes `live.json`."""
    for policy in settings.live.policies:
        try:
            record = policy_record(policy)
        except ValueError as error:
            raise DataError(str(error)) from error
        if not record.can_use(GIVEN):
            raise DataError(
                f"{policy} needs the tables of mevs study rendering, which live walks do not have; leave it out"
            )
    statistics = load_statistics(out / "data")
    check_made_with(settings, out)
    own = checked(load_policies(settings.policies), statistics.graph, len(statistics.classes))
    classify, predict = tasks(settings, statistics)
    networks = Networks(classify, load_best(classify, out / "classifier"), predict, load_best(predict, out / "entropy"))
    validation = _tables(settings, out, statistics, "val")
    found = compare_with_tables(
        out / "data",
        "test",
        networks,
        _tables(settings, out, statistics, "test"),
        learn(validation.logits, validation.labels),
        statistics.graph,
        config=settings.live,
        own=own,
    )
    write_json(out / "live.json", {policy: asdict(agreement) for policy, agreement in found.items()})
    return found


def check_agent(settings: Settings, out: Path) -> AgentPromises:
    """Measures what an agent with the run's system promises, on test objects; writes `agent.json`."""
    folder, config = make_system(settings, out), settings.agent
    if min(config.objects, config.shots, config.calls, config.max_views) < 1:
        raise DataError("--agent.objects, --agent.max-views, --agent.shots and --agent.calls must be at least 1")
    system, statistics = load_system(folder), load_statistics(out / "data")
    tables = _tables(settings, out, statistics, "test")
    entries = {entry.name: entry for entry in open_objects(settings.dataset).entries}
    chosen = np.unique(np.linspace(0, len(tables.names) - 1, config.objects).astype(int))
    if missing := [tables.names[index] for index in chosen if tables.names[index] not in entries]:
        raise DataError(
            f"{settings.dataset.source} has no object {missing[0]!r}; pass the --data from which {out} was made"
        )
    meshes = [(load_object(entries[tables.names[index]]), int(tables.labels[index])) for index in chosen]
    policies = [name for name in USABLE if name in system.policies]
    walks = compare_walks(system, out / "data", config, policies)
    stops = {
        name: stopping(system, tables, name, config.max_views)
        for name in dict.fromkeys((system.description.best, "random"))
    }
    camera, times = recognised(system, meshes, config), latency(system, out / "data", config.calls)
    found = AgentPromises(walks, stops, camera, times, config)
    write_json(out / "agent.json", as_json(found))
    return found


def report(settings: Settings, preset: str, out: Path) -> Path:
    """Writes the report and returns its path; a page that is as it was written, from the same content, is kept."""
    page, metrics, active = out / "report" / "index.html", out / "metrics.json", out / "learned" / "metrics.json"
    if not metrics.exists():
        raise DataError(f"no metrics in {out}; make them with: mevs eval --out {out}")
    check_made_with(settings, out)
    found = _metrics(metrics, f"mevs eval --out {out}")
    check_evaluated_with(settings, found, out)
    networks = {"classifier": out / "classifier", "entropy predictor": out / "entropy"}
    of_networks = [folder / name for folder in networks.values() for name in ("summary.json", "metrics.jsonl")]
    data, tables = out / "data", [out / "tables" / f"{split}.npz" for split in ("test", "val")]
    over_seeds = out / "seeds.json"
    made_of = (metrics, active, over_seeds, data / SUMMARY, *tables, *of_networks)

    def described() -> list[Any]:
        return [preset, plain(settings), *(path.is_file() and check_of_file(path) for path in made_of)]

    if is_current(page, described()):
        return page
    from eval.learned.page import active_section  # imported late, as they need plots
    from eval.report.page import write_report

    statistics = load_statistics(data)
    learned = _metrics(active, f"mevs study learned --out {out}") if active.exists() else None
    inputs = ReportInputs(
        statistics=statistics,
        metrics=found,
        tables=_tables(settings, out, statistics, "test"),
        validation=_tables(settings, out, statistics, "val"),
        data=data,
        histories={name: read_history(folder) for name, folder in networks.items()},
        summaries={name: summary_of(folder) for name, folder in networks.items()},
        preset=preset,
        settings=plain(settings),
        learned=learned,
        learned_section="" if learned is None else active_section(learned),
        seeds=_metrics(over_seeds, f"mevs eval --out {out}") if settings.seeds > 1 and over_seeds.exists() else None,
    )
    write_report(inputs, page, described())  # the tables may have been made again
    return page


def _metrics(path: Path, command: str) -> dict[str, Any]:
    """Returns what a file of metrics holds; raises `DataError`, which names the command that makes it, if it is damaged."""
    try:
        return read_json(path)
    except Unreadable as error:
        raise Unreadable(path, error.reason, f"make it again with: {command}") from error
