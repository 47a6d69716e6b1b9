"""The options of each command, without the settings of its stages. Light: imports nothing but tyro."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

Preset = Literal["demo", "small", "best", "thesis", "tiny"]


def _arg(metavar: str, default: str = "") -> Any:
    """How an option is shown: its placeholder, and its default where that is not plain from the help text."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "")


Flag = Annotated[tyro.conf.FlagCreatePairsOff[bool], _arg("")]
Up = Annotated[Literal["auto", "z", "y"], _arg("auto|z|y", "auto: y for glTF, as declared for DAE, else z")]
System = Annotated[str, _arg("PATH|NAME", "furniture10, which comes with the package")]


@dataclass(frozen=True)
class Options:
    """What every command takes."""

    out: Annotated[Path | None, _arg("DIR", "runs/PRESET")] = None
    """folder of the run: everything is written there, and a run continues there"""
    preset: Annotated[Preset | None, _arg("demo|small|best|thesis|tiny", "that of the run, or small")] = None
    """defaults of all settings; a run that was begun keeps its own (run.json)"""
    print_config: Flag = False
    """print the resolved configuration as JSON and stop"""


@dataclass(frozen=True)
class WithSeed(Options):
    """Commands that draw random numbers."""

    seed: Annotated[int | None, _arg("N", "0")] = None
    """seed of weights, training order and random policies (the split is --dataset.seed)"""


@dataclass(frozen=True)
class WithOthers(Options):
    """Commands that several processes may run together."""

    distributed: Flag = False
    """this is one of several processes that share the work (docs/scaling.md)"""


@dataclass(frozen=True)
class SweepOptions(WithSeed, WithOthers):
    """Options of `mevs sweep`."""

    grid: Annotated[tuple[str, ...], _arg("NAME=V,V ...")] = ()
    """all combinations of these values instead of drawn ones, as learning-rate=1e-4,3e-4 weight-decay=0.01,0.05"""
    seeds: Annotated[int | None, _arg("K", "1")] = None
    """train each configuration from K seeds"""
    adopt: Flag = False
    """make the best network that of the run, and its hyper-parameters those of the run's settings"""


@dataclass(frozen=True)
class WithSeeds(WithSeed):
    """Commands that train or evaluate the networks of a run from several seeds."""

    seeds: Annotated[int | None, _arg("K", "1, or that of the run")] = None
    """train both networks from K seeds, --seed and those after it, and report means over the trainings"""


@dataclass(frozen=True)
class WithPolicies(Options):
    """Commands that run policies."""

    policy: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], _arg("MODULE:FUNCTION", "those of the run")] = ()
    """a policy of your own, evaluated like all others: module:function or path/to/file.py:function; once for each policy;
    `none` leaves those of the run out (docs/own.md)"""


@dataclass(frozen=True)
class EvalOptions(WithSeeds, WithPolicies, WithOthers):
    """Options of `mevs eval`."""


@dataclass(frozen=True)
class WithWeights(WithSeed):
    """Commands that train classifiers."""

    pretrained: Annotated[tuple[Path, ...], _arg("FILE ...")] = ()
    """ImageNet weights to start classifiers from: torchvision's resnet18 and resnet34, .pth or .safetensors; or
    efficientnet_lite0, those of the installed extra `pretrained`, for --encoder efficientnet_lite0"""


@dataclass(frozen=True)
class WithNetworks(WithSeeds, WithWeights):
    """Commands that train the networks of a run."""

    encoder: Annotated[str | None, _arg("NAME", "a ResNet")] = None
    """train another network as the classifier: efficientnet_lite0, vit_tiny_patch8, vit_tiny_patch16, or your own,
    module:function or path/to/file.py:function (docs/own.md)"""
    seeds_at_once: Annotated[int, _arg("N", "0, all")] = 0
    """train at most N seeds together, which bounds memory"""


@dataclass(frozen=True)
class WithData(Options):
    """Commands that make a data set."""

    data: Annotated[str | None, _arg("SOURCE", "furniture10, built in")] = None
    """furniture10-families, modelnet10 or modelnet40 (downloaded), a folder or zip of meshes (CLASS/train/, CLASS/test/), or an
    .npz of voxels"""
    archive: Annotated[str | None, _arg("FILE")] = None
    """ModelNet10.zip or ModelNet40.zip, where it has been downloaded already"""


@dataclass(frozen=True)
class WithViews(WithData):
    """Commands that make one data set with a number of views of its own."""

    views: Annotated[int | None, _arg("N", "40")] = None
    """number of candidate viewpoints around an object"""


@dataclass(frozen=True)
class StudyOptions(WithViews, WithSeed):
    """Options of studies of one data set."""


@dataclass(frozen=True)
class LearnedOptions(StudyOptions, WithOthers):
    """Options of `mevs study learned`."""

    seeds: Annotated[int | None, _arg("K", "1, or 3 with --preset best")] = None
    """train everything from K seeds, --learned.seed and those after it, and report means over the trainings"""


@dataclass(frozen=True)
class DataOptions(WithViews, WithOthers):
    """Options of `mevs data`."""

    beam: Annotated[str | None, _arg("OPTIONS")] = None
    """use Apache Beam with these pipeline options, as --beam=--runner=DirectRunner (docs/scaling.md)"""
    frames: Annotated[Path | None, _arg("FOLDER")] = None
    """make the data set of recorded objects: posed depth images FOLDER/CLASS/OBJECT, fused into meshes (docs/frames.md)"""


@dataclass(frozen=True)
class RunOptions(WithViews, WithNetworks, WithPolicies):
    """Options of `mevs run`."""


@dataclass(frozen=True)
class ThesisOptions(WithData, WithWeights):
    """Options of `mevs study thesis`."""

    seeds: Annotated[int | None, _arg("K", "1, or that of the run")] = None
    """train all networks from K seeds, and report the main numbers over the trainings"""


@dataclass(frozen=True)
class TrainOptions(WithNetworks, WithOthers):
    """Options of `mevs train`."""

    model_devices: Annotated[int, _arg("N", "1")] = 1
    """devices that share one copy of a network's weights; batches are split over the others"""
    plan: Flag = False
    """print what this command would do, or why it cannot, and train nothing (docs/scaling.md)"""
    plan_devices: Annotated[int | None, _arg("N", "those that are here")] = None
    """with --plan: devices to plan for, of all processes together"""
    plan_target: Annotated[str | None, _arg("DEVICES")] = None
    """with --plan: plan for these, and ask XLA's compiler for them: gpu:h100, or a slice of TPUs, as tpu:v5e:8x8"""
    plan_processes: Annotated[int | None, _arg("N", "1")] = None
    """with --plan --distributed: processes to plan for"""
    plan_objects: Annotated[int | None, _arg("N", "the run's data set")] = None
    """with --plan: plan for a data set of so many training objects that is not made yet"""
    json: Flag = False
    """with --plan: print the plan as JSON, in bytes and operations"""


_XYZ = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """What files of recorded depth images do not say."""

    every: Annotated[int, _arg("N", "1")] = 1
    """of a folder or bag of depth images: read each n-th image only"""
    depth_unit: Annotated[float | None, _arg("M", "0.001; 0.0002 for TUM; as BOP or a bag says")] = None
    """of a folder or bag of depth images: metres in one unit of their pixels"""
    intrinsics: Annotated[tuple[float, float, float, float] | None, _arg("FX FY CX CY", "as the files say")] = None
    """of a folder or bag of depth images: the camera's intrinsics in pixels"""


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(ReadingOptions):
    """Where the object is in recorded depth images."""

    center: Annotated[_XYZ | None, _arg("X Y Z", "as the file says, or from its mask")] = None
    """of recorded depth images: the object's center in the world, in metres, with --radius"""
    radius: Annotated[float | None, _arg("R", "as the file says, or from its mask")] = None
    """of recorded depth images: metres from the object's center to its furthest point"""
    upward: Annotated[_XYZ | None, _arg("X Y Z", "as the file says, or 0 0 1")] = None
    """of recorded depth images: the upward direction in the world"""
    floor: Annotated[float | None, _arg("H", "as the file says, or none")] = None
    """of recorded depth images: height of the supporting surface along the upward direction; below it is not the object"""


@dataclass(frozen=True, kw_only=True)
class LookOptions(RecordingOptions):
    """Options of `mevs look`."""

    system: System = "furniture10"
    """the trained system: a folder, a run, a name that comes with the package, or hf://owner/name on the Hugging Face hub"""
    mesh: Annotated[Path | None, _arg("FILE|CLASS")] = None
    """a mesh to recognise: .off, .obj, .stl, .ply, .glb, .gltf, .dae or .3mf, or a built-in piece by its class, as chair; it is
    rendered from the views that are chosen"""
    depth: Annotated[Path | None, _arg("PATH")] = None
    """recorded depth images to choose from: an .npz, a folder, a bag of ROS, or PATH#OBJECT of BOP (docs/frames.md)"""
    scene: Flag = False
    """find and recognise every object that stands on the floor or table of --depth (docs/scene.md)"""
    first: Annotated[int | None, _arg("VIEW", "chosen; for recorded images, the first that shows the object")] = None
    """the first view"""
    policy: Annotated[str, _arg("NAME", "best, which the system names")] = "best"
    """the policy that chooses views"""
    stop: Annotated[float, _arg("P", "0.95")] = 0.95
    """calibrated probability of the class at which to stop; above 1 never"""
    max_views: Annotated[int, _arg("N", "8")] = 8
    """largest number of views"""
    unknown: Annotated[float | None, _arg("Q", "0.95, unless the system has a class of unknown objects")] = None
    """answer "unknown object" for an object that is stranger than this share of the known ones; 1: never"""
    up: Up = "auto"
    """the upward axis of the mesh"""
    metres: Annotated[float, _arg("M", "0, its size is unknown")] = 0.0
    """metres in one unit of the mesh, for a system that was trained to use sizes"""
    json: Flag = False
    """print the walk as JSON"""
    draw: Annotated[Path | None, _arg("FILE")] = None
    """draw the walk, or the scene from above, into this image, .png or .svg"""
    save: Annotated[Path | None, _arg("FILE")] = None
    """save the walk's history, which can be repeated, into this .npz"""
    view: Flag = False
    """show the walk in a browser, in 3-D, until Ctrl-C (needs the extra `view`)"""


@dataclass(frozen=True, kw_only=True)
class EnrolOptions(RecordingOptions):
    """Options of `mevs enrol`."""

    objects: Annotated[tyro.conf.Positional[tuple[str, ...]], _arg("NAME=FILE ...")] = ()
    """objects by name: a mesh in metres, or depth images as of `mevs look --depth`"""
    to: Annotated[Path, _arg("DIR")]
    """folder of the system of enrolled objects that is written, for --system of other commands; one that is there is replaced"""
    system: Annotated[str, _arg("PATH|NAME", "objects, which comes with the package")] = "objects"
    """what the objects are added to: the system that comes with the package, or a folder of enrolled objects"""
    remove: Annotated[tuple[str, ...], _arg("NAME ...")] = ()
    """objects of --system to leave out"""
    rename: Annotated[tuple[str, ...], _arg("OLD=NEW ...")] = ()
    """objects of --system that get another name"""
    up: Up = "auto"
    """the upward axis of the meshes"""
    metres: Annotated[float, _arg("M", "1")] = 1.0
    """metres in one unit of the meshes, 0.001 for millimetres; 0: sizes say nothing"""


@dataclass(frozen=True, kw_only=True)
class WithObjects:
    """Checks of trained systems on other objects."""

    data: Annotated[str, _arg("SOURCE")]
    """objects: a folder or zip of meshes in class folders, or an .npz of voxel grids; those for testing where the folders name a
    split, else all"""
    up: Up = "auto"
    """the upward axis of the meshes"""
    names: Annotated[tuple[str, ...], _arg("FOLDER=CLASS ...")] = ()
    """what the system calls classes that have another name in the data; classes that it does not know are strangers"""
    draws: Annotated[int, _arg("N", "4")] = 4
    """random walks from each first view"""
    json: Flag = False
    """print all figures as JSON"""


@dataclass(frozen=True, kw_only=True)
class TransferOptions(WithObjects):
    """Options of `mevs check transfer`."""

    system: System = "furniture10"
    """the trained system, as for mevs look"""
    unknown_yaw: Flag = False
    """do not tell the system which way the objects face; else they face as in their files"""
    metres: Annotated[float, _arg("M", "0, sizes are unknown")] = 0.0
    """metres in one unit of the files, for a system that was trained to use sizes"""
    max_views: Annotated[int, _arg("N", "8")] = 8
    """number of views of each walk"""
    to: Annotated[Path | None, _arg("FILE")] = None
    """write all figures into this .json file"""


@dataclass(frozen=True, kw_only=True)
class InstancesOptions:
    """Options of `mevs study instances`."""

    data: Annotated[str, _arg("SOURCE", "strangers, built in")] = "strangers"
    """objects, each of which is enrolled: a folder or zip of meshes in class folders, or built-in ones"""
    up: Up = "auto"
    """the upward axis of the meshes"""
    system: Annotated[str, _arg("PATH|NAME", "objects, which comes with the package")] = "objects"
    """the system that objects are enrolled with"""
    metres: Annotated[float, _arg("M")] = 1.0
    """metres in one unit of the files: the errors of cameras depend on the size of objects"""
    sizes: Annotated[tuple[int, ...], _arg("N ...", "all")] = ()
    """numbers of objects to enrol, besides all"""
    conditions: Annotated[tuple[str, ...], _arg("NAME ...", "all")] = ()
    """what to measure, such as mesh, "mesh, true size", or "3 images"; each is kept in TO/conditions"""
    fit: Flag = False
    """first learn the system that objects are enrolled with, from procedural shapes, and write it into TO/objects"""
    shapes: Annotated[int, _arg("N", "1000")] = 1000
    """procedural shapes to learn from with --fit; a quarter as many others calibrate it, a twelfth its colours"""
    to: Annotated[Path, _arg("DIR", "runs/instances")] = Path("runs/instances")
    """folder for the figures (instances.json) and what is learned"""


@dataclass(frozen=True, kw_only=True)
class RealityOptions(WithObjects):
    """Options of `mevs check reality`."""

    to: Annotated[Path, _arg("FOLDER")]
    """where images and figures (reality.json) are written; an interrupted check goes on there"""
    system: Annotated[tuple[str, ...], _arg("PATH|NAME ...", "furniture10")] = ("furniture10",)
    """trained systems, which see the same images; the first is the one that others are compared with"""
    conditions: Annotated[tuple[str, ...], _arg("NAME ...", "all")] = ()
    """conditions: clean, roll, structured_light, stereo, stereo_strong, sphere_5, sphere_10, beside, turned, part_30, part_50,
    part_70, upper, table, together"""
    objects: Annotated[int, _arg("N", "0, all")] = 0
    """number of objects, spread over all: about 20 s for every ten, on two cores"""
    seed: Annotated[int, _arg("N", "0")] = 0
    """seed of noise, wrong centres, and random walks"""


@dataclass(frozen=True, kw_only=True)
class FramesOptions(ReadingOptions):
    """Options of `mevs check frames`."""

    path: Annotated[tyro.conf.Positional[Path], _arg("PATH")]
    """recorded depth images, as for mevs look --depth"""
    upward: Annotated[_XYZ | None, _arg("X Y Z", "as the file says, or 0 0 1")] = None
    """the upward direction in the recording's world, which is compared with the largest surface that is seen from above"""
    draw: Annotated[Path | None, _arg("FILE")] = None
    """draw two pairs of images and how their surfaces agree into this image, .png or .svg"""


@dataclass(frozen=True, kw_only=True)
class CompileOptions:
    """Options of `mevs check compile`."""

    target: Annotated[str, _arg("DEVICES")]
    """what to compile for: gpu:h100, or a slice of TPUs, as tpu:v5e:8x8 (v5e, v5p, v6e)"""
    only: Annotated[tuple[str, ...], _arg("NAME ...", "all")] = ()
    """programs, by their names or what these begin with, as train or ball-query"""
    to: Annotated[Path | None, _arg("FILE")] = None
    """write all figures into this .json file"""
    against: Annotated[Path | None, _arg("FILE")] = None
    """fail if a program moves or holds a quarter more bytes than in this file, which --to has written"""
    json: Flag = False
    """print all figures as JSON"""


@dataclass(frozen=True)
class StatusOptions:
    """Options of `mevs status`."""

    out: Annotated[tyro.conf.Positional[Path], _arg("RUN")]
    """the run directory"""


@dataclass(frozen=True)
class ExportOptions:
    """Options of `mevs export`."""

    to: Annotated[Path, _arg("FOLDER")]
    """where to write"""
    out: Annotated[Path | None, _arg("DIR")] = None
    """folder of a run, whose trained system is made first if it is not there"""
    system: Annotated[str | None, _arg("PATH|NAME")] = None
    """or a trained system, as for mevs look"""
    half: Flag = False
    """store the networks in float16, which halves the folder"""
    measured: Annotated[tuple[Path, ...], _arg("FILE ...")] = ()
    """results of `mevs check transfer --to FILE` with this system, for its card"""
    stablehlo: Flag = False
    """also write the compiled programs for CPU, CUDA and TPU, which need JAX and NumPy alone"""
