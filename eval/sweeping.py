"""`mevs sweep`: many configurations of one network of a run; the best one may become the run's."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from data_pipeline.dataset.config import check_same_data
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.distributed import agreed, is_first
from data_pipeline.errors import DataError
from eval.report.sweep import write_sweep_report
from eval.runs import tasks
from eval.settings import Settings
from train.choosing.stages import Stages
from train.many.members import Member, SweepTask
from train.many.sweep import sweep
from train.results.identity import config_of


def train_sweep(settings: Settings, out: Path, mesh: jax.sharding.Mesh | None = None) -> tuple[Path, list[Member]]:
    """Trains many configurations of one network together; returns the folder of the sweep and its members."""
    name, data = settings.sweep.network, out / "data"
    statistics = load_statistics(data)
    task: SweepTask
    if name == "recogniser":
        check_same_data(settings.dataset, data)
        study = Stages(settings.learned, settings.dataset, out, settings.learned.seed)
        study.prepare()
        task, data, statistics = study.task(), study.turned, study.statistics
    else:
        task = tasks(settings, statistics)[("classifier", "entropy").index(name)]
    folder = out / "sweep" / name
    members = sweep(task, data, statistics, folder, settings.sweep, mesh)
    if is_first():
        write_sweep_report(members, folder)
    return folder, members


def adopt(settings: Settings, out: Path) -> tuple[Path, Settings]:
    """Makes the best network of a finished sweep that of the run.

    Returns:
        Its folder, and the settings with the hyper-parameters that it was trained with.

    Raises:
        DataError: if the run has another such network already.
    """
    name = settings.sweep.network
    made, there = out / "sweep" / name / "network", out / name
    if name == "recogniser":
        there = Stages(settings.learned, settings.dataset, out, settings.learned.seed).recogniser_folder()
    if not made.exists():
        raise DataError(f"{made} is gone; delete {made.parent}, and the same command sweeps again")
    exists = agreed(there.exists())
    if not exists:
        if is_first():
            _copy(made, there)
    elif config_of(there) != config_of(made):
        raise DataError(f"{there} holds another network; delete it, and the same command takes the best of the sweep")
    return there, _with_hyperparameters(settings, config_of(made)["task"])


def _copy(made: Path, there: Path) -> None:
    there.parent.mkdir(parents=True, exist_ok=True)
    copy = Path(tempfile.mkdtemp(prefix=f".{there.name}.", dir=there.parent))
    shutil.copytree(made, copy, dirs_exist_ok=True)
    copy.chmod(0o755)
    copy.rename(there)


def _with_hyperparameters(settings: Settings, task: dict[str, Any]) -> Settings:
    """The settings with the hyper-parameters in a network's `config.json`."""
    name, chosen = settings.sweep.network, {key: task["optimiser"][key] for key in ("learning_rate", "weight_decay")}
    seeds = {key: task["optimiser"][key] for key in ("seed", "data_seed")}
    if name == "recogniser":  # its seed is that of the study
        recogniser = settings.learned.recogniser
        recogniser = replace(recogniser, optimiser=replace(recogniser.optimiser, **chosen))
        return replace(settings, learned=replace(settings.learned, recogniser=recogniser))
    strength = task["augmentation"]["strength"]
    if name == "classifier":
        classifier = settings.classifier
        augmentation = replace(classifier.augmentation, strength=strength)
        optimiser = replace(classifier.optimiser, **chosen, **seeds)
        return replace(settings, classifier=replace(classifier, optimiser=optimiser, augmentation=augmentation))
    entropy = settings.entropy
    network = replace(entropy.network, dropout=task["network_config"]["dropout"])
    cloud = replace(entropy.augmentation, strength=strength)
    optimiser = replace(entropy.optimiser, **chosen, **seeds)
    return replace(settings, entropy=replace(entropy, optimiser=optimiser, augmentation=cloud, network=network))
