"""The whole job, stage by stage: data → networks → tables and metrics → report. Each stage skips what is done.

A run directory holds `data/`, `classifier/`, `entropy/`, `tables/`, `metrics.json` and `report/index.html`; and
`classifier_by_view/` where the compatibility table is to be whole.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from data_pipeline.augment import CloudAugmentation, ViewAugmentation
from data_pipeline.builder import DataConfig, DatasetStatistics, load_statistics, prepare, report_left_out
from data_pipeline.capture import CaptureConfig
from data_pipeline.files import as_read, read_json, write_json
from data_pipeline.meshes import DataError
from data_pipeline.progress import console
from eval.active import ABLATIONS, ActiveConfig, Stages, check_active
from eval.active_measure import measure, together, train_all
from eval.active_page import write_active_page
from eval.ascent import AscentConfig
from eval.climbing import ClimbConfig, climb_objects, climbing_study, load_climbed
from eval.grid import FIRST_MV, GridConfig
from eval.knowledge import learn
from eval.ladder import CLIMBED
from eval.live import Agreement, LiveConfig, Networks, compare_with_tables
from eval.page import ReportInputs
from eval.report import read_history, write_report
from eval.study import reachable_views, run_study
from eval.sweep_report import write_sweep_report
from eval.thesis_networks import ThesisConfig
from eval.view_tables import ViewTables, compute_view_tables, load_view_tables, made_by, save_view_tables
from mevs_jax.models import Abstraction
from mevs_jax.policies import POLICIES
from mevs_jax.viewpoints import ViewGraph
from train.classifier import ClassifierConfig, ClassifierTask, ResNetConfig
from train.entropy import EntropyConfig, EntropyTask, PointNet2Config
from train.fusion import SetFusionConfig
from train.loop import fit, load_best
from train.optimiser import OptimiserConfig
from train.policy import PolicyConfig
from train.pretrained import StartingWeights
from train.recogniser import RecogniserConfig
from train.step import Task
from train.sweep import Member, SweepConfig, sweep


@dataclass(frozen=True)
class Settings:
    """Everything that can be set; the defaults are the thesis's."""

    dataset: DataConfig = DataConfig()
    classifier: ClassifierConfig = ClassifierConfig()
    entropy: EntropyConfig = EntropyConfig()
    evaluation: GridConfig = GridConfig()
    live: LiveConfig = LiveConfig()
    thesis: ThesisConfig = ThesisConfig()
    sweep: SweepConfig = SweepConfig()
    ascent: AscentConfig = AscentConfig()
    climb: ClimbConfig = ClimbConfig()
    active: ActiveConfig = ActiveConfig()


THESIS = Settings()
"""The thesis's sizes: 224×224, 40 views, ResNet-18 on depth, PointNet++ on 4,096 points. For an accelerator: two CPU cores
train PointNet++ of this size on 7 clouds a second, five hours for one epoch of ModelNet10.
`mevs run --preset thesis --data ModelNet10.zip`"""

_BRIEF = OptimiserConfig(
    epochs=8, batch_size=64, epoch_views=8, validation_views=4, weight_decay=0.02, schedule="cosine"
)

SMALL = Settings(
    dataset=DataConfig(capture=CaptureConfig(resolution=64)),
    classifier=ClassifierConfig(
        network=ResNetConfig(width=32, channels=1, standardise=False),
        optimiser=_BRIEF,
    ),
    entropy=EntropyConfig(
        network=PointNet2Config(
            points=1024,
            abstractions=(
                Abstraction(centres=128, radius=0.25, samples=16, layers=(32, 32, 64)),
                Abstraction(centres=32, radius=0.5, samples=16, layers=(64, 64, 128)),
            ),
            dropout=0.0,
        ),
        augmentation=CloudAugmentation(scale=False, tilt=False, translate=False, jitter=False, drop=False),
        optimiser=OptimiserConfig(
            epochs=8,
            batch_size=32,
            views_per_object=2,
            epoch_views=4,
            validation_views=2,
            learning_rate=2e-3,
            schedule="cosine",
        ),
    ),
    thesis=ThesisConfig(
        resnet18=replace(_BRIEF, epochs=7, views_per_object=1, learning_rate=2e-3),
        resnet34=replace(_BRIEF, epochs=9, views_per_object=2, learning_rate=2e-3),
        fine_tuning=replace(_BRIEF, epochs=4, views_per_object=2),
        resnet34_width=32,
    ),
    active=ActiveConfig(
        recogniser=RecogniserConfig(
            network=ResNetConfig(width=32, channels=4, standardise=False, stem="patches"),
            augmentation=ViewAugmentation(stretch=0.15),
            balanced=True,
            optimiser=OptimiserConfig(
                method="muon",
                epochs=6,
                batch_size=256,
                views_per_object=8,
                epoch_views=40,
                validation_views=8,
                learning_rate=5e-3,
                weight_decay=0.05,
                schedule="cosine",
            ),
        ),
        fold_epochs=4,
        draws=2,
        fitting_starts=4,
        ablations=ABLATIONS,
        novel=5,
        rotation_epochs=3,
    ),
)
"""The same study at 64×64 with narrower networks.
`mevs run --data modelnet10_voxels32.npz`: 12 minutes on two cores of an AMD EPYC (Zen 5), `mevs thesis` 40."""

BEST = replace(
    SMALL,
    dataset=replace(SMALL.dataset, capture=CaptureConfig(resolution=128)),
    active=replace(
        SMALL.active,
        recogniser=replace(
            SMALL.active.recogniser,
            network=ResNetConfig(channels=4, standardise=False),
            optimiser=replace(SMALL.active.recogniser.optimiser, epochs=12, batch_size=512),
        ),
        folds=4,
        fold_epochs=0,
        seeds=3,
        lattices=(10, 60),
    ),
)
"""What `mevs active` is meant to have where there is an accelerator: views of 128×128, a ResNet-18 as wide as the paper's, four
parts, three seeds. It has been run for some steps, never to its end."""

_TRIFLING_SETS = SetFusionConfig(width=16, heads=2, blocks=1)
_TRIFLE = OptimiserConfig(epochs=2, batch_size=16, views_per_object=2, epoch_views=4, schedule="cosine")

TINY = Settings(
    dataset=DataConfig(train_per_class=4, test_per_class=1, capture=CaptureConfig(views=6, resolution=32)),
    classifier=ClassifierConfig(
        network=ResNetConfig(depth=10, width=8, channels=1, standardise=False),
        optimiser=_TRIFLE,
    ),
    entropy=EntropyConfig(
        network=PointNet2Config(
            points=64,
            abstractions=(
                Abstraction(centres=16, radius=0.4, samples=8, layers=(8, 16)),
                Abstraction(centres=8, radius=0.8, samples=8, layers=(16, 32)),
            ),
            global_layers=(32, 64),
            head_layers=(32,),
        ),
        optimiser=_TRIFLE,
    ),
    evaluation=GridConfig(draws=2),
    live=LiveConfig(objects=10, at_once=8, max_views=4),
    thesis=ThesisConfig(
        _TRIFLE,
        _TRIFLE,
        _TRIFLE,
        resnet34_width=8,
        timing_runs=3,
        climbing_runs=1,
        climbing_starts=2,
        climbing_resolution=16,
    ),
    active=ActiveConfig(
        recogniser=RecogniserConfig(
            network=ResNetConfig(depth=10, width=8, channels=4, standardise=False, stem="patches"),
            fusion=_TRIFLING_SETS,
            optimiser=replace(_TRIFLE, validation_views=2),
        ),
        policy=PolicyConfig(width=16, heads=2, blocks=1, most_seen=3, walks=1, rounds=1, epochs=2, batch_size=32),
        changed=1,
        max_views=4,
        draws=2,
        lattices=(),
        ablations=("look_ahead", "crossed", "summed", "cloud"),
        novel=1,
        rotation_epochs=1,
    ),
    climb=ClimbConfig(objects=1, starts=2, resolution=16, faces=64),
)
"""Seconds, and no use but to see that everything runs."""

PRESETS = {"small": SMALL, "best": BEST, "thesis": THESIS, "tiny": TINY}


@dataclass(frozen=True)
class Options(Settings):
    """What the command line takes: all settings, and short names for the common ones."""

    preset: Literal["small", "best", "thesis", "tiny"] = "small"
    """which defaults all other settings have"""
    data: str | None = None
    """furniture10, modelnet10 or modelnet40 (downloaded), a folder of meshes, a zip of the same layout, or an .npz of voxel
    grids; overrides dataset.source"""
    archive: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """ModelNet10.zip or ModelNet40.zip where it is here already; overrides dataset.archive"""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """candidate viewpoints around an object; overrides dataset.capture.views"""
    out: Path | None = None
    """where everything is written; runs/<preset> unless given"""
    pretrained: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE")] = ()
    """ImageNet weights to start classifiers from: torchvision's resnet18 (and resnet34), .pth or .safetensors"""
    beam: Annotated[str | None, tyro.conf.arg(metavar="OPTIONS")] = None
    """for mevs data: capture and write by Apache Beam, with such options, say "--runner=DirectRunner" (docs/scaling.md)"""
    distributed: bool = False
    """for mevs train: this is one of several processes, on one machine or many, that train together (docs/scaling.md)"""
    model_devices: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """for mevs train: devices that share one copy of a network's weights; batches are split over the others"""

    def settings(self) -> Settings:
        """The settings with the short names applied."""
        dataset = self.dataset
        if self.data is not None:
            dataset = replace(dataset, source=self.data)
        if self.archive is not None:
            dataset = replace(dataset, archive=self.archive)
        if self.views is not None:
            dataset = replace(dataset, capture=replace(dataset.capture, views=self.views))
        chosen = {field.name: getattr(self, field.name) for field in fields(Settings)}
        return Settings(**chosen | {"dataset": dataset})


def options_from(preset: Literal["small", "best", "thesis", "tiny"]) -> Options:
    """The defaults of all options under a preset."""
    chosen = PRESETS[preset]
    return Options(**{field.name: getattr(chosen, field.name) for field in fields(Settings)}, preset=preset)


def check_output(out: Path) -> None:
    """Raises `DataError` where nothing can be written to `out`."""
    probe = out / f".probe.{os.getpid()}"
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise DataError(f"cannot write to {out} ({error.strerror}); choose another --out") from error


def make_data(settings: Settings, out: Path, beam: str | None = None) -> DatasetStatistics:
    statistics = prepare(settings.dataset, out / "data", beam)
    report_left_out(statistics)
    return statistics


def tasks(settings: Settings, statistics: DatasetStatistics) -> tuple[ClassifierTask, EntropyTask]:
    """What is trained on a data set."""
    camera = statistics.camera
    return (
        ClassifierTask.of(settings.classifier, len(statistics.classes), camera),
        EntropyTask.of(settings.entropy, statistics.views, statistics.entropy_max, camera),
    )


def train(
    settings: Settings, out: Path, start: StartingWeights | None = None, mesh: jax.sharding.Mesh | None = None
) -> None:
    """Trains both networks, the classifier from `start` or random weights, on `mesh` or all devices."""
    statistics = load_statistics(out / "data")
    classify, predict = tasks(settings, statistics)
    planned: list[tuple[Task, str, StartingWeights | None]] = [
        (classify, "classifier", start),
        (predict, "entropy", None),
    ]
    for task, name, weights in planned:
        summary = fit(task, out / "data", statistics, out / name, weights, mesh)
        console.print(
            f"{task.name}: best epoch {summary['best_epoch']} of {summary['epoch']}, validation "
            + ", ".join(f"{key} {value:.4f}" for key, value in summary["best"].items())
            + f", {summary['seconds'] / 60:.1f} min"
        )


def train_sweep(settings: Settings, out: Path, mesh: jax.sharding.Mesh | None = None) -> tuple[Path, list[Member]]:
    """Trains many configurations of one network together; returns the sweep's folder and its members."""
    statistics = load_statistics(out / "data")
    name = settings.sweep.network
    task = tasks(settings, statistics)[("classifier", "entropy").index(name)]
    folder = out / "sweep" / name
    members = sweep(task, out / "data", statistics, folder, settings.sweep, mesh)
    write_sweep_report(members, folder)
    return folder, members


BY_VIEW = "classifier_by_view"


def train_by_view(settings: Settings, out: Path, start: StartingWeights | None = None) -> None:
    """Trains the classifier once more, validated by view as in the thesis's published code, for the compatibility table."""
    statistics = load_statistics(out / "data")
    classify, _ = tasks(settings, statistics)
    by_view = replace(classify, optimiser=replace(classify.optimiser, validation_by="view"))
    fit(by_view, out / "data", statistics, out / BY_VIEW, start)


def _tables(
    settings: Settings, out: Path, statistics: DatasetStatistics, split: str, classifier: str = "classifier"
) -> ViewTables:
    """The view tables of a split, made anew where the stored ones are of other networks."""
    made = made_by(statistics, out / classifier, out / "entropy")
    path = out / "tables" / (f"{split}.npz" if classifier == "classifier" else f"{split}_by_view.npz")
    if path.exists() and (tables := load_view_tables(path)).made_by == made:
        return tables
    classify, predict = tasks(settings, statistics)
    networks = load_best(classify, out / classifier), load_best(predict, out / "entropy")
    tables = compute_view_tables(out / "data", split, statistics, classify, networks[0], predict, networks[1])
    tables = replace(tables, made_by=made)
    save_view_tables(path, tables)
    return tables


def check_evaluation(config: GridConfig) -> None:
    """Raises `DataError` for a grid without cells."""
    if config.max_views < FIRST_MV or config.draws < 1:
        raise DataError("--evaluation.max-views must be at least 2 and --evaluation.draws at least 1")


def evaluate(settings: Settings, out: Path) -> dict[str, Any]:
    """Metrics of the test split, as written to `metrics.json`."""
    statistics = load_statistics(out / "data")
    by_view_made = None
    if (out / BY_VIEW / "summary.json").exists():
        by_view_made = made_by(statistics, out / BY_VIEW, out / "entropy")
    identity = {
        "evaluation": asdict(settings.evaluation),
        "made_by": made_by(statistics, out / "classifier", out / "entropy"),
        "by_view": by_view_made,
        "climbed": None,
    }
    climbed = load_climbed(out, statistics, settings.climb)
    if climbed is not None:
        identity["climbed"] = asdict(settings.climb)
    identity = as_read(identity)
    check_evaluation(settings.evaluation)
    path = out / "metrics.json"
    if path.exists() and (metrics := read_json(path))["identity"] == identity:
        return metrics
    try:
        reachable_views(np.array(statistics.viewpoints), settings.evaluation.lowest_elevation)
    except ValueError as error:
        raise DataError(str(error)) from error
    tables, by_view, leak = _tables(settings, out, statistics, "test"), None, None
    if by_view_made is not None:
        by_view = _tables(settings, out, statistics, "test", BY_VIEW)
        leak = {
            name: {
                "validation": float(read_json(out / name / "summary.json")["best"]["accuracy"]),
                "test": float((made.logits.argmax(-1) == made.labels[:, None]).mean()),
            }
            for name, made in (("classifier", tables), (BY_VIEW, by_view))
        }
    validation = _tables(settings, out, statistics, "val")
    metrics = run_study(tables, validation, statistics, settings.evaluation, by_view, leak)
    if climbed is not None:
        metrics["climbing"] = climbing_study(tables, statistics, climbed, settings.evaluation)
    metrics["identity"] = identity
    write_json(path, metrics)
    return metrics


def learn_to_choose(settings: Settings, out: Path) -> Path:
    """Trains and measures learnt fusion and learnt choice; returns the page."""
    config, found = settings.active, []
    check_active(config, settings.dataset.capture.views)
    seeds = [Stages(config, settings.dataset, out, seed, settings.entropy) for seed in range(config.seeds)]
    for stages in seeds:
        train_all(stages)
        found.append(measure(stages))
    metrics = {"seeds": found, "together": together(seeds, found), "settings": asdict(config)}
    write_json(out / "active" / "metrics.json", metrics)
    page = out / "active" / "index.html"
    write_active_page(metrics, load_statistics(out / "data"), page)
    return page


def climb_on_objects(settings: Settings, out: Path) -> None:
    """Finds where differentiable rendering would look next on many test objects; `evaluate` then compares it."""
    statistics = load_statistics(out / "data")
    climb_objects(settings.dataset, statistics, out, settings.climb)


def check_live(settings: Settings, out: Path) -> dict[str, Agreement]:
    """Walks test objects with the networks in the loop and compares with the tables; writes `live.json`."""
    for policy in settings.live.policies:
        if policy not in POLICIES:
            raise DataError(f"unknown policy {policy!r}; it is one of {', '.join(POLICIES)}")
        if policy in {rung.policy for rung in CLIMBED}:
            raise DataError(f"{policy} looks into what mevs climb has found; live walks have no such tables")
    statistics = load_statistics(out / "data")
    classify, predict = tasks(settings, statistics)
    networks = Networks(classify, load_best(classify, out / "classifier"), predict, load_best(predict, out / "entropy"))
    validation = _tables(settings, out, statistics, "val")
    found = compare_with_tables(
        out / "data",
        "test",
        networks,
        _tables(settings, out, statistics, "test"),
        learn(jnp.asarray(validation.logits), jnp.asarray(validation.labels)),
        ViewGraph.from_points(np.array(statistics.viewpoints)),
        config=settings.live,
    )
    write_json(out / "live.json", {policy: asdict(agreement) for policy, agreement in found.items()})
    return found


def report(settings: Settings, preset: str, out: Path) -> Path:
    """Writes the page and returns where it is; one that is newer than its metrics is left as it is."""
    page, metrics, active = out / "report" / "index.html", out / "metrics.json", out / "active" / "metrics.json"
    if not metrics.exists():
        raise DataError(f"no metrics in {out}; make them with: mevs eval --out {out}")
    made_of = [path for path in (metrics, active) if path.exists()]
    if not page.exists() or page.stat().st_mtime < max(path.stat().st_mtime for path in made_of):
        statistics = load_statistics(out / "data")
        networks = {"classifier": out / "classifier", "entropy predictor": out / "entropy"}
        write_report(
            ReportInputs(
                statistics=statistics,
                metrics=read_json(metrics),
                tables=load_view_tables(out / "tables" / "test.npz"),
                data=out / "data",
                histories={name: read_history(folder) for name, folder in networks.items()},
                summaries={name: read_json(folder / "summary.json") for name, folder in networks.items()},
                preset=preset,
                settings=asdict(settings),
                active=read_json(active) if active.exists() else None,
            ),
            page,
        )
    return page
