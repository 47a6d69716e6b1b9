"""The options of each command, without the settings of its stages. Light: imports nothing but tyro."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

Preset = Literal["small", "best", "thesis", "tiny"]


def _arg(metavar: str, default: str = "") -> Any:
    """How an option is shown: its placeholder, and its default where that is not plain from the help text."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "")


@dataclass(frozen=True)
class Options:
    """What every command takes."""

    out: Annotated[Path | None, _arg("DIR", "runs/PRESET")] = None
    """folder of the run: everything is written there, and a run continues there"""
    preset: Annotated[Preset | None, _arg("small|best|thesis|tiny", "that of the run, or small")] = None
    """defaults of all settings; a run that was begun keeps its own (run.json)"""
    print_config: Annotated[tyro.conf.FlagCreatePairsOff[bool], _arg("")] = False
    """print the resolved configuration as JSON and stop"""


@dataclass(frozen=True)
class WithSeed(Options):
    """Commands that draw random numbers."""

    seed: Annotated[int | None, _arg("N", "0")] = None
    """seed of weights, training order and random policies (the split is --dataset.seed)"""


@dataclass(frozen=True)
class WithPolicies(Options):
    """Commands that run policies."""

    policy: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], _arg("MODULE:FUNCTION", "those of the run")] = ()
    """a policy of your own, evaluated like all others: module:function or path/to/file.py:function; once for each policy;
    `none` leaves those of the run out (docs/own.md)"""


@dataclass(frozen=True)
class EvalOptions(WithSeed, WithPolicies):
    """Options of `mevs eval`."""


@dataclass(frozen=True)
class WithWeights(WithSeed):
    """Commands that train classifiers."""

    pretrained: Annotated[tuple[Path, ...], _arg("FILE ...")] = ()
    """ImageNet weights to start classifiers from: torchvision's resnet18 and resnet34, .pth or .safetensors"""


@dataclass(frozen=True)
class WithEncoder(Options):
    """Commands that train the classifier of a run."""

    encoder: Annotated[str | None, _arg("MODULE:FUNCTION", "a ResNet")] = None
    """train a network of your own as the classifier: module:function or path/to/file.py:function (docs/own.md)"""


@dataclass(frozen=True)
class WithData(WithSeed):
    """Commands that make a data set."""

    data: Annotated[str | None, _arg("SOURCE", "furniture10, built in")] = None
    """modelnet10 or modelnet40 (downloaded), a folder or zip of meshes (CLASS/train/, CLASS/test/), or an .npz of voxels"""
    archive: Annotated[str | None, _arg("FILE")] = None
    """ModelNet10.zip or ModelNet40.zip, where it has been downloaded already"""


@dataclass(frozen=True)
class WithViews(WithData):
    """Commands that make one data set with a number of views of its own."""

    views: Annotated[int | None, _arg("N", "40")] = None
    """number of candidate viewpoints around an object"""


@dataclass(frozen=True)
class DataOptions(WithViews):
    """Options of `mevs data`."""

    beam: Annotated[str | None, _arg("OPTIONS")] = None
    """use Apache Beam with these pipeline options, as "--runner=DirectRunner" (docs/scaling.md)"""


@dataclass(frozen=True)
class RunOptions(WithViews, WithWeights, WithEncoder, WithPolicies):
    """Options of `mevs run`."""


@dataclass(frozen=True)
class ThesisOptions(WithData, WithWeights):
    """Options of `mevs study thesis`."""


@dataclass(frozen=True)
class TrainOptions(WithWeights, WithEncoder):
    """Options of `mevs train`."""

    distributed: Annotated[tyro.conf.FlagCreatePairsOff[bool], _arg("")] = False
    """this is one of several processes that train together (docs/scaling.md)"""
    model_devices: Annotated[int, _arg("N", "1")] = 1
    """devices that share one copy of a network's weights; batches are split over the others"""
