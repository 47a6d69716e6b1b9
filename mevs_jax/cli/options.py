"""Options of the command line."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from eval.settings import PRESETS, Settings


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
