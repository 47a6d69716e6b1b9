"""The thesis's eight networks: four classifiers, two fine-tuned from another, and PointNet++ for two lattices and two frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from data_pipeline.dataset.statistics import DatasetStatistics, load_statistics
from data_pipeline.files import read_json
from train.loop import check_training, load_best
from train.many.members import SweepTask
from train.many.seeds import train_seeds
from train.optimiser import OptimiserConfig
from train.results.chance import warn_of_chance
from train.running.devices import Layout, device_mesh
from train.tasks.classifier import ClassifierConfig, ClassifierTask, ResNetConfig, starting_weights
from train.tasks.entropy import EntropyConfig, EntropyTask
from train.weights.starting import StartingWeights, weights_from_network

VIEWS = (10, 40)
"""The thesis's two data sets, by number of views per object."""
Frame = Literal["world", "camera"]
FRAMES: tuple[Frame, ...] = ("world", "camera")


@dataclass(frozen=True)
class Backbone:
    """One of the thesis's classifiers (§5.3.3, Table 5).

    Attributes:
        name: name of its folder.
        title: name in the thesis.
        depth: depth of the ResNet.
        images: its input.
        views: views per object of the data set it is trained on.
        start: name of the backbone whose weights it starts from; None: ImageNet's weights if they are given, else random ones.
    """

    name: str
    title: str
    depth: Literal[18, 34]
    images: Literal["depth", "image"]
    views: int
    start: str | None = None


BACKBONES = (
    Backbone("resnet18_image_10", "ResNet-18 (10 views/object, image)", 18, "image", 10),
    Backbone("resnet18_image_40", "ResNet-18 (40 views/object, image)", 18, "image", 40, "resnet18_image_10"),
    Backbone("resnet18_depth_40", "ResNet-18 (40 views/object, depth)", 18, "depth", 40, "resnet18_image_40"),
    Backbone("resnet34_depth_40", "ResNet-34 (40 views/object, depth)", 34, "depth", 40),
)
PIPELINE = tuple(backbone for backbone in BACKBONES if backbone.views == 40)
"""The backbones that view selection is evaluated with (§5.3.3: "the last 3 models in Table 6")."""


@dataclass(frozen=True)
class ThesisConfig:
    """Settings of `mevs study thesis` beyond those of a single run."""

    resnet18: OptimiserConfig = OptimiserConfig(weight_decay=1e-4)
    """training of the first ResNet-18"""
    resnet34: OptimiserConfig = OptimiserConfig(weight_decay=1e-4)
    """training of ResNet-34"""
    fine_tuning: OptimiserConfig = OptimiserConfig(weight_decay=1e-4)
    """training of the classifiers that start from another one's weights"""
    resnet34_width: int = 64
    """channels of ResNet-34's first stage"""
    timing_runs: int = 50
    """timed runs of PointNet++ on each class, for the thesis's Table 3"""
    ascent_runs: int = 3
    """objects of each class on which the viewpoint is optimised, for the thesis's Table 2"""
    ascent_starts: int = 8
    """initial viewpoints of each optimisation; the thesis's times are of one"""
    ascent_resolution: int = 64
    """resolution of the rendered images in pixels per side"""


@dataclass(frozen=True)
class ThesisFolder:
    """Paths within the folder of a thesis run."""

    out: Path

    def data(self, views: int) -> Path:
        return self.out / f"views{views}" / "data"

    def backbone(self, name: str) -> Path:
        return self.out / "backbones" / name

    def entropy(self, views: int, frame: Frame) -> Path:
        return self.out / "entropy" / f"{views}_{frame}"

    def networks(self) -> dict[str, Path]:
        """Returns the folders of all eight networks, by name."""
        out = {backbone.name: self.backbone(backbone.name) for backbone in BACKBONES}
        return out | {f"entropy_{views}_{frame}": self.entropy(views, frame) for views in VIEWS for frame in FRAMES}

    def statistics(self, views: int) -> DatasetStatistics:
        return load_statistics(self.data(views))


def backbone_network(backbone: Backbone, classifier: ClassifierConfig, thesis: ThesisConfig) -> ResNetConfig:
    """Returns the network configuration of a backbone under the settings of a run."""
    width = classifier.network.width if backbone.depth == 18 else thesis.resnet34_width
    return replace(classifier.network, depth=backbone.depth, width=width)


def first_weights(
    classifier: ClassifierConfig, thesis: ThesisConfig, pretrained: tuple[Path, ...]
) -> dict[str, StartingWeights | None]:
    """Returns the initial weights of the backbones that start from no other backbone, by name.

    Raises:
        DataError: if a file cannot be read, or no file fits a backbone.
    """
    return {
        backbone.name: starting_weights(pretrained, backbone_network(backbone, classifier, thesis))
        for backbone in BACKBONES
        if backbone.start is None
    }


def backbone_task(
    backbone: Backbone, classifier: ClassifierConfig, thesis: ThesisConfig, statistics: DatasetStatistics
) -> ClassifierTask:
    """Returns the training task of a backbone under the settings of a run."""
    alone = thesis.resnet18 if backbone.depth == 18 else thesis.resnet34
    config = replace(
        classifier,
        network=backbone_network(backbone, classifier, thesis),
        images=backbone.images,
        optimiser=thesis.fine_tuning if backbone.start else alone,
    )
    task = ClassifierTask.of(config, len(statistics.classes), statistics.camera)
    return replace(task, name=backbone.title)


def entropy_task(frame: Frame, entropy: EntropyConfig, statistics: DatasetStatistics) -> EntropyTask:
    """Returns the training task of PointNet++ for a lattice and a frame; only the frame differs from the run's settings."""
    config = replace(entropy, network=replace(entropy.network, frame=frame))
    task = EntropyTask.of(config, statistics.views, statistics.entropy_max, statistics.camera)
    return replace(task, name=f"PointNet++ ({statistics.views} views, {frame} frame)")


@dataclass(frozen=True)
class ThesisSettings:
    """The settings of the networks of one seed."""

    classifier: ClassifierConfig
    entropy: EntropyConfig
    thesis: ThesisConfig

    def shifted(self, number: int) -> ThesisSettings:
        """Returns the settings of seed number `number`, counted from these."""
        configs = {name: getattr(self.thesis, name).shifted(number) for name in ("resnet18", "resnet34", "fine_tuning")}
        return ThesisSettings(
            replace(self.classifier, optimiser=self.classifier.optimiser.shifted(number)),
            replace(self.entropy, optimiser=self.entropy.optimiser.shifted(number)),
            replace(self.thesis, **configs),
        )

    def networks(self, folder: ThesisFolder) -> list[tuple[str, DatasetStatistics, SweepTask]]:
        """Returns the name, the statistics of the data and the task of each network, backbones first."""
        of_views = {views: folder.statistics(views) for views in VIEWS}
        backbones: list[tuple[str, DatasetStatistics, SweepTask]] = [
            (one.name, of_views[one.views], backbone_task(one, self.classifier, self.thesis, of_views[one.views]))
            for one in BACKBONES
        ]
        return backbones + [
            (f"entropy_{views}_{frame}", of_views[views], entropy_task(frame, self.entropy, of_views[views]))
            for views in VIEWS
            for frame in FRAMES
        ]


def train_thesis(
    folders: Sequence[ThesisFolder], settings: Sequence[ThesisSettings], first: dict[str, StartingWeights | None]
) -> None:
    """Trains all eight networks of every seed, skipping those that are finished; those of all seeds are one job.

    Args:
        folders: of each seed; all have the data sets of the first.
        settings: of each seed.
        first: the result of `first_weights`.

    Raises:
        DataError: if a network that is missing cannot be trained by these devices, before the first is trained.
    """
    layout, backbones = Layout.of_mesh(device_mesh()), {backbone.name: backbone for backbone in BACKBONES}
    for name, statistics, task in settings[0].networks(folders[0]):
        if not (folders[0].networks()[name] / "summary.json").exists():
            check_training(task, statistics, layout)
    for same in zip(*(own.networks(folders[0]) for own in settings), strict=True):
        (name, statistics, _), tasks = same[0], [task for _, _, task in same]
        backbone, starts, option = backbones.get(name), list[StartingWeights | None](), "entropy.optimiser"
        if backbone is not None:
            starts = [
                _weights_before(backbone, folder, own) if backbone.start else first[name]
                for folder, own in zip(folders, settings, strict=True)
            ]
            option = f"thesis.{'fine-tuning' if backbone.start else f'resnet{backbone.depth}'}"
        summaries = train_seeds(
            tasks,
            folders[0].data(statistics.views),
            statistics,
            [folder.networks()[name] for folder in folders],
            folders[0].out / "seeds" / f"{name}_together",
            starts,
            rate_option=f"--{option}.learning-rate",
        )
        for task, summary in zip(tasks, summaries, strict=True):
            warn_of_chance(task, summary, statistics)


def _weights_before(backbone: Backbone, folder: ThesisFolder, settings: ThesisSettings) -> StartingWeights:
    """Returns the weights of the backbone that this one starts from."""
    before = next(other for other in BACKBONES if other.name == backbone.start)
    task = backbone_task(before, settings.classifier, settings.thesis, folder.statistics(before.views))
    trained = folder.backbone(before.name)
    loss = read_json(trained / "summary.json")["best_loss"]
    return weights_from_network(load_best(task, trained), f"{before.title}, validation loss {loss:.6f}")
