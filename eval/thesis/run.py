"""`mevs study thesis`: every network, table and figure of the thesis in one run directory; each stage skips completed work.

The directory holds both data sets (`views10/`, `views40/`), the networks (`backbones/`, `entropy/`), their outputs for every view
(`outputs/`), `timing.json`, `thesis.json` and the report (`report/`).
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from flax import nnx

from data_pipeline.capture.viewpoints import is_file
from data_pipeline.dataset.builder import prepare
from data_pipeline.dataset.origin import objects_named
from data_pipeline.dataset.statistics import report_left_out
from data_pipeline.errors import DataError
from data_pipeline.files import json_of, read_json
from data_pipeline.objects.reconstruction import why_no_open3d
from data_pipeline.objects.sources import load_object
from data_pipeline.progress import console
from eval.consistency import check_evaluation, check_seeds
from eval.machine import NO_ACCELERATOR, machine
from eval.rendering.ascent import METHODS
from eval.settings import Settings
from eval.tables import objects_of
from eval.thesis.layout import FigureInputs
from eval.thesis.page import write_thesis_report
from eval.thesis.results import BackboneTraining, LatticeTables, ThesisResults, grids_of
from eval.thesis.seeds import csv_over_trainings, folders_of, over_trainings, table_of
from eval.thesis.timing import (
    AscentTimes,
    LatticeTimes,
    Measured,
    Memory,
    Timing,
    decision_memory_alone,
    time_ascent,
    time_local_maxima,
    time_predictor,
)
from train.loop import load_best
from train.many.thesis import (
    BACKBONES,
    FRAMES,
    PIPELINE,
    VIEWS,
    Backbone,
    Frame,
    ThesisFolder,
    ThesisSettings,
    backbone_task,
    entropy_task,
    first_weights,
    train_thesis,
)
from train.results.finite import check_results
from train.results.identity import identity_of, made_by, stamp_of
from train.results.kept import keep_beside, kept_array, kept_record
from train.results.outputs import network_outputs
from train.results.records import as_json
from train.running.log import read_history
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask


def make_thesis_data(settings: Settings, folder: ThesisFolder) -> None:
    """Makes both data sets, which have the same objects and splits."""
    for views in VIEWS:
        dataset = replace(settings.dataset, capture=replace(settings.dataset.capture, views=views))
        report_left_out(prepare(dataset, folder.data(views)))


# --------------------------------------------------------------------------------------------------------------- outputs


def lattice_tables(
    settings: Settings,
    folder: ThesisFolder,
    views: int,
    split: str,
    backbones: tuple[Backbone, ...] = BACKBONES,
    frames: tuple[Frame, ...] = FRAMES,
) -> LatticeTables:
    """The outputs of the networks for one split of one data set."""
    statistics, data = folder.statistics(views), folder.data(views)

    def outputs(name: str, network: Path, task: ClassifierTask | EntropyTask) -> np.ndarray:
        return kept_array(
            folder.out / "outputs" / f"{name}_on_{views}_{split}.npz",
            stamp_of("outputs", made_by(statistics, network)),
            lambda: network_outputs(data, split, task, load_best(task, network)),
        )

    logits: dict[str, np.ndarray] = {}
    for backbone in backbones:
        task = backbone_task(backbone, settings.classifier, settings.thesis, statistics)
        logits[backbone.name] = outputs(backbone.name, folder.backbone(backbone.name), task)
    predicted_entropy: dict[Frame, np.ndarray] = {}
    for frame in frames:
        predict = entropy_task(frame, settings.entropy, statistics)
        predicted_entropy[frame] = outputs(f"entropy_{frame}", folder.entropy(views, frame), predict)
    names, labels, entropy = objects_of(data, split, statistics)
    return LatticeTables(names, labels, entropy, logits, predicted_entropy)


# --------------------------------------------------------------------------------------------------------- time and memory


def _memory(settings: Settings, folder: ThesisFolder) -> dict[str, Memory]:
    statistics = {views: folder.statistics(views) for views in VIEWS}
    out = {}
    for backbone in (PIPELINE[1], PIPELINE[2]):
        classify = backbone_task(backbone, settings.classifier, settings.thesis, statistics[40])
        name = f"ResNet-{backbone.depth}"
        out[f"{name} + Random view selection"] = decision_memory_alone(classify, None)
        for views in VIEWS:
            predict = entropy_task("world", settings.entropy, statistics[views])
            out[f"{name} + PointNet++ ({views} views)"] = decision_memory_alone(classify, predict)
    return out


def _timing(settings: Settings, folder: ThesisFolder, tables: dict[int, LatticeTables]) -> Timing:
    runs = settings.thesis.timing_runs

    def of_lattice(views: int) -> LatticeTimes:
        statistics = folder.statistics(views)
        task = entropy_task("world", settings.entropy, statistics)
        network: nnx.Module = load_best(task, folder.entropy(views, "world"))
        labels, classes = tables[views].labels, statistics.classes
        by_class = time_predictor(folder.data(views), task, network, labels, classes, runs)
        return LatticeTimes(by_class, time_local_maxima(views))

    return Timing(runs, *map(of_lattice, VIEWS))


def _ascents(settings: Settings, tables: LatticeTables, classes: list[str]) -> AscentTimes:
    """Times and memory of the methods by differentiable rendering."""
    thesis = settings.thesis
    runs, starts, resolution = thesis.ascent_runs, thesis.ascent_starts, thesis.ascent_resolution
    if (missing := why_no_open3d()) is not None:
        return AscentTimes(runs, starts, resolution, missing)
    wanted: dict[str, list[str]] = {}
    for label, name in enumerate(classes):
        members = np.flatnonzero(tables.labels == label)
        evenly = np.unique(np.linspace(0, len(members) - 1, min(runs, len(members))).round().astype(int))
        if len(members):
            wanted[name] = [tables.names[members[at]] for at in evenly]
    found = objects_named(settings.dataset, [one for names in wanted.values() for one in names])
    entries = {entry.name: entry for entry in found}
    meshes = {name: [load_object(entries[one]) for one in names] for name, names in wanted.items()}
    volume, mesh = (time_ascent(METHODS[name], meshes, starts, resolution) for name in ("volume", "mesh"))
    return AscentTimes(runs, starts, resolution, volume=volume, mesh=mesh)


def measure(settings: Settings, folder: ThesisFolder, tables: dict[int, LatticeTables]) -> Measured:
    """Machine, times and memory; measured again only on another machine or with other settings."""
    ran_on, thesis = machine(), settings.thesis
    identity = identity_of(
        "timing",
        machine=ran_on,
        timing_runs=thesis.timing_runs,
        ascent=[thesis.ascent_runs, thesis.ascent_starts, thesis.ascent_resolution],
        network=settings.entropy.network,
        open3d=why_no_open3d() is None,
    )

    def compute() -> Measured:
        console.print(
            f"Timing {thesis.timing_runs} decisions and {thesis.ascent_runs} gradient ascents per class, and measuring their "
            f"memory"
        )
        ascent = _ascents(settings, tables[40], folder.statistics(40).classes)
        return Measured(ran_on, _timing(settings, folder, tables), _memory(settings, folder), ascent)

    return kept_record(folder.out / "timing.json", Measured, identity, compute)


# ------------------------------------------------------------------------------------------------------------- everything


def _example(tables: LatticeTables, classes: list[str]) -> int:
    """Index of the first bathtub, the thesis's example class, among the test objects; without bathtubs, 0."""
    label = classes.index("bathtub") if "bathtub" in classes else int(tables.labels[0])
    return int(np.flatnonzero(tables.labels == label)[0])


def _training(
    folder: ThesisFolder, histories: dict[str, list[dict[str, float]]]
) -> tuple[dict[str, BackboneTraining], dict[str, float]]:
    """Losses and initial weights of the classifiers (Table 5), and training times of all networks."""
    summaries = {name: read_json(network / "summary.json") for name, network in folder.networks().items()}
    backbones = {}
    for name in (backbone.name for backbone in BACKBONES):
        summary, train_loss = summaries[name], min(entry["train/loss"] for entry in histories[name])
        backbones[name] = BackboneTraining(
            train_loss, summary["best_loss"], summary["epoch"], summary["best_epoch"], summary["start"]
        )
    return backbones, {name: summary["seconds"] for name, summary in summaries.items()}


def evaluate_thesis(settings: Settings, folder: ThesisFolder, measured: Measured | None = None) -> FigureInputs:
    """Returns all numbers, as written to `thesis.json`, and the other inputs of the report.

    Args:
        measured: times and memory of networks of the same shapes; measured here if None.
    """
    statistics = {views: folder.statistics(views) for views in VIEWS}
    histories = {name: read_history(network) for name, network in folder.networks().items()}
    for name, network in folder.networks().items():
        if not histories[name]:
            raise DataError(
                f"{network / 'metrics.jsonl'} is lost; delete {network}, and the same command trains it again"
            )
    test = {views: lattice_tables(settings, folder, views, "test") for views in VIEWS}
    costs = measured or measure(settings, folder, test)
    identity = identity_of(
        "thesis",
        made_by=[made_by(statistics[views], *folder.networks().values()) for views in VIEWS],
        evaluation=settings.evaluation,
        measured=costs,
    )

    def compute() -> ThesisResults:
        validation = {views: lattice_tables(settings, folder, views, "val", PIPELINE, ("world",)) for views in VIEWS}
        console.print(f"Walking {len(test[40].labels)} test objects with {len(PIPELINE)} classifiers on two lattices")
        grids = grids_of(test, validation, statistics, settings.evaluation)
        left_out = {views: of.left_out for views, of in statistics.items()}
        backbones, seconds = _training(folder, histories)
        results = ThesisResults(
            **vars(grids), **vars(costs), backbones=backbones, training_seconds=seconds, left_out=left_out
        )
        check_results(as_json(results), f"the results in {folder.out}")
        return results

    results = kept_record(folder.out / "thesis.json", ThesisResults, identity, compute)
    return FigureInputs(folder, results, statistics, test, histories, _example(test[40], statistics[40].classes))


def reproduce(settings: Settings, preset: str, out: Path, pretrained: tuple[Path, ...] = ()) -> Path:
    """Makes data, networks, tables and figures in `out`; returns the path of the page.

    Raises:
        DataError: the settings do not allow the thesis's grid, or the directory holds another run.
    """
    if settings.evaluation.lowest_elevation > -90:
        raise DataError("mevs study thesis walks from every view; leave out --evaluation.lowest-elevation")
    if settings.classifier.encoder or settings.classifier.frozen:
        raise DataError(
            "mevs study thesis trains the thesis's own classifiers; leave out --classifier.encoder and --classifier.frozen"
        )
    if is_file(settings.dataset.capture.lattice):
        raise DataError("mevs study thesis has lattices of 10 and 40 views; leave out --dataset.capture.lattice file:…")
    check_evaluation(settings.evaluation)
    check_seeds(settings)
    thesis = settings.thesis
    if thesis.ascent_runs < 1 or thesis.ascent_starts < 2 or thesis.ascent_resolution < 8:
        raise DataError(
            "--thesis.ascent-runs must be at least 1, --thesis.ascent-starts at least 2 and "
            "--thesis.ascent-resolution at least 8"
        )
    if (missing := why_no_open3d()) is not None:
        console.print(f"Tables 2 and 9 will lack differentiable rendering: {missing}. All else is made.")
    first = first_weights(settings.classifier, thesis, pretrained)
    folder = ThesisFolder(out)
    make_thesis_data(settings, folder)
    folders, own = folders_of(out, settings.seeds), ThesisSettings(settings.classifier, settings.entropy, thesis)
    each = [own.shifted(number) for number in range(settings.seeds)]
    train_thesis(folders, each, first)
    inputs = evaluate_thesis(settings, folder)
    results, table = [inputs.results], None
    measured = Measured(*(getattr(inputs.results, field.name) for field in fields(Measured)))
    for of_seed, its in zip(folders[1:], each[1:], strict=True):
        own_settings = replace(settings, classifier=its.classifier, entropy=its.entropy, thesis=its.thesis)
        found = evaluate_thesis(own_settings, of_seed, measured)
        results.append(found.results)
        write_thesis_report(found, _lead(found, preset), of_seed.out / "report")
    if len(results) > 1:
        rows = over_trainings(results)
        keep_beside(out / "seeds.json", json_of({"seeds": settings.seeds, "rows": as_json(rows)}))
        keep_beside(out / "seeds.csv", csv_over_trainings(rows))
        table = table_of(rows)
    return write_thesis_report(inputs, _lead(inputs, preset), out / "report", table)


def _lead(inputs: FigureInputs, preset: str) -> str:
    """A sentence that describes a run."""
    results, statistics = inputs.results, inputs.statistics[40]
    ran_on, camera = results.machine, statistics.camera
    where = f"{ran_on.cores} CPU cores" if ran_on.device == NO_ACCELERATOR else ran_on.device
    minutes = sum(results.training_seconds.values()) / 60
    return (
        f"{statistics.source}, preset {preset}: views of {camera.resolution}×{camera.resolution} pixels, "
        f"{results.objects[40]} test objects, {statistics.left_out_count} objects left out, "
        f"{minutes:.0f} minutes of training on {where}. Numbers of this run, with those of the thesis in parentheses."
    )
