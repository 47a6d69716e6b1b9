"""A run from several seeds (`--seeds K`): the run itself, and a run of its own for each further seed in `seeds/`.

All have the same data, settings and objects, and differ in the seeds of weights, augmentation, batches and dropout. The networks
of all seeds are trained as one job, and walked as one program. `seeds.json` and `seeds.csv` hold means over the trainings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.distributed import is_first, wait_for_all
from data_pipeline.errors import DataError
from eval import stages
from eval.evaluation import identity_of_seeds, policies_on
from eval.numbers.metrics import OverTrainings
from eval.numbers.policies import EvaluationInputs
from eval.numbers.trainings import csv_over_trainings, rows_over_trainings, walks_of_all
from eval.run_file import save_run
from eval.runs import Run, seed_folder
from eval.settings import Settings
from eval.training import say_trained, trainings
from train.many.seeds import check_networks, train_seeds
from train.results.kept import keep_beside, kept_record
from train.running.devices import device_mesh
from train.weights.starting import StartingWeights


def seed_settings(settings: Settings, number: int) -> Settings:
    """The settings of the run of a seed."""
    classifier = replace(settings.classifier, optimiser=settings.classifier.optimiser.shifted(number))
    entropy = replace(settings.entropy, optimiser=settings.entropy.optimiser.shifted(number))
    return replace(settings, classifier=classifier, entropy=entropy, seeds=1)


def make_folders(settings: Settings, preset: str, out: Path, arguments: Sequence[str]) -> None:
    """Makes a run of its own for each further seed, which has the data of the run."""
    for number in range(1, settings.seeds):
        folder = seed_folder(out, number)
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "data").is_symlink():
            (folder / "data").symlink_to(Path("..") / ".." / "data", target_is_directory=True)
        save_run(folder, preset, seed_settings(settings, number), list(arguments))


def train(
    settings: Settings,
    out: Path,
    start: StartingWeights | None = None,
    mesh: jax.sharding.Mesh | None = None,
    at_once: int = 0,
    begin: Callable[[], None] = lambda: None,
) -> None:
    """Trains both networks from all seeds, once all are checked.

    Args:
        settings: of the run.
        out: folder of the run.
        start: initial weights of the classifiers; random if None.
        mesh: devices to train on; all if None.
        at_once: largest number of seeds that are trained together, which bounds memory; 0: all.
        begin: called by the first process once nothing was found that forbids the training.
    """
    if at_once < 0:
        raise DataError(f"--seeds-at-once {at_once} is below 0; 0 is for all seeds")
    statistics, numbers = load_statistics(out / "data"), range(settings.seeds)
    size, mesh = at_once or settings.seeds, mesh or device_mesh()
    parts = [slice(first, first + size) for first in range(0, settings.seeds, size)]
    seeds = [trainings(seed_settings(settings, number), statistics, start) for number in numbers]
    networks = []
    for same in zip(*seeds, strict=True):
        name, weights = same[0][1], [weights for _, _, weights in same]
        tasks: list[Any] = [task for task, _, _ in same]
        folders, work = [seed_folder(out, number) / name for number in numbers], out / "seeds" / f"{name}_together"
        networks.append((tasks, name, folders, work, weights))
        for part in parts:
            check_networks(tasks[part], statistics, folders[part], work, weights[part], mesh)
    if is_first():
        begin()
    wait_for_all("seeds")
    for tasks, name, folders, work, weights in networks:
        option, summaries = f"--{name}.optimiser.learning-rate", []
        for part in parts:
            summaries += train_seeds(
                tasks[part], out / "data", statistics, folders[part], work, weights[part], mesh, option
            )
        for number, summary in enumerate(summaries):
            say_trained(tasks[number], summary, statistics, f", seed {number}")


def evaluate(settings: Settings, out: Path) -> OverTrainings:
    """Evaluates the run of every seed, and all together; returns what `seeds.json` holds."""
    runs = [seed_folder(out, number) for number in range(settings.seeds)]
    if missing := [run for run in runs if not (run / "classifier").is_dir()]:
        raise DataError(
            f"no networks in {missing[0]}; train those of all seeds with: mevs train --seeds {settings.seeds} --out {out}"
        )
    for number, run in enumerate(runs):
        stages.evaluate(seed_settings(settings, number), run)
    statistics = load_statistics(out / "data")
    own = policies_on(settings.policies, statistics)

    def compute() -> OverTrainings:
        inputs = [replace(EvaluationInputs.of_run(run), config=settings.evaluation) for run in runs]
        return OverTrainings(
            seeds=settings.seeds,
            objects=len(inputs[0].tables.names),
            single_view=np.array([one.tables.single_view_accuracy for one in inputs]),
            rows=rows_over_trainings(*walks_of_all(inputs, own)),
        )

    identity = identity_of_seeds(Run(out, statistics, settings), own)
    found = kept_record(out / "seeds.json", OverTrainings, identity, compute)
    keep_beside(out / "seeds.csv", csv_over_trainings(found.rows))
    return found
