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
from train.many.study import study_of
from train.many.sweep import sweep
from train.results.identity import config_of


def train_sweep(
    settings: Settings, out: Path, mesh: jax.sharding.Mesh | None = None
) -> tuple[Path, Path, list[Member]]:
    """Trains many configurations of one network; returns the folders of the sweep and of the best network, and the members.

    They are trained together, or as a study, in jobs that several processes may share.
    """
    name, data = settings.sweep.network, out / "data"
    statistics, trials = load_statistics(data), settings.sweep.trials
    task: SweepTask
    if trials and (name == "recogniser" or jax.process_count() > 1):
        raise DataError("--sweep.trials is for the classifier and the entropy predictor, and without --distributed")
    if name == "recogniser":
        check_same_data(settings.dataset, data)
        study = Stages(settings.learned, settings.dataset, out, settings.learned.seed)
        study.prepare()
        task, data, statistics = study.task(), study.turned, study.statistics
    else:
        task = tasks(settings, statistics)[("classifier", "entropy").index(name)]
    folder = out / "sweep" / (f"{name}_study" if trials else name)
    if trials:
        job, members = study_of(task, data, statistics, folder, settings.sweep, mesh)
    else:
        job, members = folder, sweep(task, data, statistics, folder, settings.sweep, mesh)
    if is_first():
        write_sweep_report(members, folder)
    return folder, job / "network", members


def adopt(settings: Settings, out: Path, made: Path) -> tuple[Path, Settings]:
    """Makes the best network of a finished sweep that of the run.

    Args:
        made: its folder.

    Returns:
        Its folder, and the settings with the hyper-parameters that it was trained with.

    Raises:
        DataError: if the run has another such network already.
    """
    name = settings.sweep.network
    there = out / name
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
