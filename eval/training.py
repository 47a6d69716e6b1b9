"""The first stages of a run: the data set, and both networks. Each skips completed work."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from data_pipeline.dataset.builder import prepare
from data_pipeline.dataset.statistics import SUMMARY, DatasetStatistics, load_statistics, report_left_out
from data_pipeline.errors import DataError
from data_pipeline.progress import console
from eval.consistency import check_classifier
from eval.runs import BY_VIEW, tasks
from eval.settings import Settings
from train.loop import check_launch, fit
from train.planning.plan import plan_of, planned_statistics
from train.planning.targets import Target
from train.results.chance import warn_of_chance
from train.running.devices import Layout, check_batch, device_mesh
from train.step import Task
from train.weights.starting import StartingWeights


def make_data(settings: Settings, out: Path, beam: str | None = None) -> DatasetStatistics:
    statistics = prepare(settings.dataset, out / "data", beam)
    report_left_out(statistics)
    return statistics


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
        say_trained(task, summary, statistics)


def say_trained(task: Task, summary: dict[str, Any], statistics: DatasetStatistics, which: str = "") -> None:
    """Prints the outcome of a training, and a warning if the network learned nothing; `which` follows its name."""
    best = ", ".join(f"{key} {value:.4f}" for key, value in summary["best"].items())
    console.print(
        f"{task.name}{which}: best epoch {summary['best_epoch']} of {summary['epoch']}, validation {best}, "
        f"{summary['seconds'] / 60:.1f} min"
    )
    warn_of_chance(task, summary, statistics)


def plan_training(
    settings: Settings,
    out: Path,
    start: StartingWeights | None,
    layout: Layout,
    objects: int | None = None,
    target: Target | None = None,
) -> dict[str, Any]:
    """Returns what `train` would do on these devices, as values that JSON can hold; nothing is trained.

    Args:
        objects: number of training objects of a data set that is not made yet; None for the run's own data set.
        target: devices of the layout, which are not here, to compile the training steps for.

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
    return plan_of(waiting, statistics, layout, made, target)


def train_by_view(settings: Settings, out: Path, start: StartingWeights | None = None) -> None:
    """Trains the classifier again for the compatibility table, validated by view as in the thesis's published code."""
    statistics = load_statistics(out / "data")
    check_classifier(settings, out)
    classify, _ = tasks(settings, statistics)
    by_view = replace(classify, optimiser=replace(classify.optimiser, validation_by="view"))
    option = "--classifier.optimiser.learning-rate"
    summary = fit(by_view, out / "data", statistics, out / BY_VIEW, start, rate_option=option)
    warn_of_chance(by_view, summary, statistics)
