"""The commands of `mevs`: names, what each does, its options and the settings it uses. Light: nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        title: what it does, in a line.
        options: the class of its options in `mevs_jax.cli.options`, which is imported when needed.
        function: `module:function` that runs it, given an `Invocation`.
        settings: groups of settings that it uses, fields of `eval.settings.Settings`.
        out: default of `--out`, where `{preset}` is the preset.
        writes_run: whether its settings become those of the run, in `run.json`.
        tries: groups of settings that it only tries: where a network was trained, they do not become those of the run.
        locks: whether no other job may write into the run directory meanwhile.
        tool: whether it is a tool, which takes its options alone: it has no run directory, preset or settings.
        needs_study: whether it needs the packages of the study, so a checkout of the project.
    """

    title: str
    options: str
    function: str
    settings: tuple[str, ...] = ()
    out: str = "runs/{preset}"
    writes_run: bool = True
    tries: tuple[str, ...] = ()
    locks: bool = True
    tool: bool = False
    needs_study: bool = True

    def load(self) -> Callable:
        module, name = self.function.split(":")
        return getattr(import_module(f"mevs_jax.cli.{module}"), name)


COMMANDS = {
    "run": Command(
        "data, train, eval and report; skips what is done",
        "RunOptions",
        "stages:run",
        ("dataset", "classifier", "entropy", "evaluation"),
    ),
    "data": Command(
        "capture objects from every viewpoint; write a sharded TFDS data set",
        "DataOptions",
        "stages:data",
        ("dataset",),
    ),
    "train": Command(
        "train the classifier and the entropy predictor", "TrainOptions", "stages:train", ("classifier", "entropy")
    ),
    "sweep": Command(
        "train many configurations of one network (entropy unless told) as one program",
        "SweepOptions",
        "stages:sweep",
        ("sweep", "classifier", "entropy", "learned"),
        tries=("classifier", "entropy", "learned"),
    ),
    "eval": Command(
        "run every policy on every test object from every start view", "EvalOptions", "stages:evaluate", ("evaluation",)
    ),
    "look": Command(
        "recognise one object by chosen views, with a trained system",
        "LookOptions",
        "tools:look",
        tool=True,
        needs_study=False,
    ),
    "enrol": Command(
        "teach a system your objects from meshes or depth images, without training",
        "EnrolOptions",
        "tools:enrol",
        tool=True,
        needs_study=False,
    ),
    "export": Command(
        "write the trained system of a run into a folder of its own",
        "ExportOptions",
        "tools:export",
        tool=True,
        needs_study=False,
    ),
    "report": Command("write report/index.html", "Options", "stages:report", writes_run=False),
    "status": Command(
        "what goes on in a run: stage, step, rate, time left, checkpoints",
        "StatusOptions",
        "stages:status",
        tool=True,
    ),
    "study thesis": Command(
        "every network, table and figure of the thesis, beside its own numbers",
        "ThesisOptions",
        "studies:thesis",
        ("dataset", "classifier", "entropy", "evaluation", "thesis"),
        out="runs/thesis-{preset}",
    ),
    "study learned": Command(
        "learn to fuse views and to choose them; compare with all policies",
        "LearnedOptions",
        "studies:learned",
        ("dataset", "learned"),
    ),
    "study rendering": Command(
        "policies by differentiable rendering; evaluate and report again",
        "StudyOptions",
        "studies:rendering",
        ("dataset", "rendering", "evaluation"),
    ),
    "study instances": Command(
        "how well enrolled objects are recognised",
        "InstancesOptions",
        "checks:instances",
        tool=True,
    ),
    "study published-code": Command(
        "what the thesis's published code changes; evaluate and report again",
        "WithWeights",
        "studies:published_code",
        ("classifier", "evaluation"),
    ),
    "study future-work": Command(
        "other values to predict, other outputs and layers, as the thesis names them",
        "StudyOptions",
        "studies:future_work",
        ("dataset", "classifier", "entropy", "evaluation"),
    ),
    "check live": Command(
        "walk with the networks in the loop; compare with the view tables",
        "WithPolicies",
        "checks:live",
        ("live",),
        writes_run=False,
    ),
    "check agent": Command(
        "how often sure answers are right, on test objects; walks, any camera, time",
        "WithViews",
        "checks:agent",
        ("dataset", "agent"),
        writes_run=False,
    ),
    "check transfer": Command(
        "how a trained system does on objects that it has never seen, of any makers",
        "TransferOptions",
        "checks:transfer",
        tool=True,
    ),
    "check reality": Command(
        "what noise, tables, wrong centres and other objects cost trained systems",
        "RealityOptions",
        "checks:reality",
        tool=True,
    ),
    "check frames": Command(
        "whether recorded depth images agree with each other; name the fault if not",
        "FramesOptions",
        "checks:frames",
        tool=True,
    ),
    "check compile": Command(
        "compile programs for TPUs or GPUs that are not here; what they need",
        "CompileOptions",
        "checks:compiling",
        tool=True,
    ),
    "draw ascent": Command(
        "ascend to the best view of one object by a renderer's gradient; draw it",
        "WithViews",
        "drawings:ascent",
        ("dataset", "ascent"),
        writes_run=False,
        locks=False,
    ),
}

ALIASES = {
    "thesis": "study thesis",
    "active": "study learned",
    "climb": "study rendering",
    "compat": "study published-code",
    "live": "check live",
    "ascend": "draw ascent",
}
"""Names of version 0.1, which this version still takes."""

_OLD_OPTIONS = {
    "--active.": "--learned.",
    "--climb.": "--rendering.",
    "--thesis.climbing-": "--thesis.ascent-",
}

HELP = """usage: mevs COMMAND [--out DIR] [--preset demo|small|best|thesis|tiny] [OPTIONS] [SETTINGS]

Where should a camera look next? Trains the networks of maximum entropy viewpoint selection and
measures how much choosing the next view helps.

stages of a run:
{stages}

trained systems:
{tools}

studies, checks, drawings:
{others}

common options:
  --out DIR               where everything is written (default runs/<preset>); a run continues there
  --preset NAME           small (default): 64×64 views and narrow networks, for a CPU; best, thesis:
                          for an accelerator; demo: that of `make demo`; tiny: to see it all work
  --data PATH             furniture10 (default, built in), furniture10-families (more various),
                          modelnet10 or modelnet40 (downloaded), a folder <class>/{{train,test}}/
                          of .off, .obj, .stl, .ply, .gltf, .glb, .dae or .3mf, a zip of that
                          layout, or an .npz of voxel grids
  --archive FILE          ModelNet10.zip or ModelNet40.zip, where it has been downloaded already
  --views N               candidate viewpoints around an object (default 40)
  --pretrained FILE ...   ImageNet weights for the classifiers: torchvision's .pth or .safetensors
  --policy FILE.py:NAME   a policy of your own, evaluated like all others (docs/own.md)
  --encoder NAME          another network as the classifier: efficientnet_lite0, vit_tiny_patch8,
                          vit_tiny_patch16, or your own, FILE.py:NAME (docs/own.md)
  --seed N                seed of weights, training and random policies (default 0)
  --print-config          print the resolved configuration as JSON, and stop

`mevs COMMAND --help` lists the options of a command, --help-all its settings too. Examples:
  mevs run
  mevs run --data modelnet10 --out runs/modelnet10
  mevs study thesis --data modelnet10 --archive ModelNet10.zip
  mevs train --out runs/modelnet10 --classifier.optimiser.epochs 20
  mevs look --mesh chair.obj
"""


def help_text() -> str:
    """What `mevs --help` prints."""

    def lines(grouped: bool, tools: bool = False) -> str:
        shown = {
            name: of
            for name, of in COMMANDS.items()
            if (" " in name) == grouped and (grouped or of.needs_study != tools)
        }
        width = max(map(len, shown)) + 2
        return "\n".join(f"  {name:<{width}}{command.title}" for name, command in shown.items())

    return HELP.format(stages=lines(False), tools=lines(False, True), others=lines(True))


def find(arguments: Sequence[str]) -> tuple[str, list[str], str | None]:
    """The command that arguments begin with, the arguments after it, and a note where an old name was used.

    Raises:
        ValueError: for a command that does not exist.
    """
    first, rest = arguments[0], list(arguments[1:])
    rest = [_renamed(argument) for argument in rest]
    if first in COMMANDS:
        return first, rest, None
    if first in ALIASES:
        name = ALIASES[first]
        return name, rest, f"`mevs {first}` is now `mevs {name}`; the old name goes with the next version"
    members = [name.split()[1] for name in COMMANDS if name.split()[0] == first and " " in name]
    if members and rest and rest[0] in members:
        return f"{first} {rest[0]}", rest[1:], None
    if members:
        found = f"{rest[0]!r} is none of them" if rest and not rest[0].startswith("-") else "none was given"
        raise ValueError(f"`mevs {first}` is followed by one of {', '.join(members)}; {found}")
    names = dict.fromkeys(name.split()[0] for name in COMMANDS)
    raise ValueError(f"unknown command {first!r}; it is one of {', '.join(names)} (see mevs --help)")


def _renamed(argument: str) -> str:
    for old, new in _OLD_OPTIONS.items():
        if argument.startswith(old):
            return new + argument.removeprefix(old)
    return argument
