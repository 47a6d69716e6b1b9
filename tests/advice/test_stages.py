"""What messages of long stages advise works: what follows the advice comes to where the work begins.

That work takes minutes, and is done by other tests: here it is a sentence.
"""

from __future__ import annotations

import html
import json
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from data_pipeline.errors import DataError
from data_pipeline.files import write_json
from eval.learned.page import _next as learned_page
from eval.thesis.page import _next as thesis_page
from tests.advice.listing import found

BEGINS = "the work begins"
WORK = (
    "data_pipeline.dataset.builder.capture_all",
    "data_pipeline.objects.recorded.meshes_of_recordings",
    "eval.training.prepare",
    "eval.training.fit",
    "eval.training.plan_of",
    "eval.seeds.train_seeds",
    "train.many.sweep.train_members",
    "eval.sweeping.study_of",
    "eval.evaluation.run_study",
    "eval.learned.stage.seeds_of",
    "eval.thesis.run.first_weights",
    "eval.rendering.policies.progress_bar",
    "eval.rendering.ascent.ascend_on_sphere",
    "eval.promises.compare_walks",
    "eval.promises.compare_with_tables",
    "eval.checks.transfer.see_objects",
    "eval.checks.reality._tables",
    "eval.checks.instances._kept",
    "eval.checks.compiling.check_compile",
    "data_pipeline.scene.looking.scene_in",
    "train.tasks.matcher.fit_matcher",
)
"""The functions that work long, where they are called."""

RUN = "run --preset tiny --out {to} "
PLAN = "train --preset tiny --plan --plan-objects 100 --out {to} "
TRAIN = "train --out {whole} "
EVAL = "eval --out {whole} "
SWEEP = "sweep --sweep.network entropy --out {whole} "
LEARNED = "study learned --out {whole} "
THESIS = "study thesis --preset tiny --out {to} "
RENDERING = "study rendering --out {whole} "
ASCENT = "draw ascent --preset tiny --out {to} "
AGENT = "check agent --out {whole} "
TRANSFER = "check transfer --data {set} "
REALITY = "check reality --to {to} --data {set} --names mug=chair rack=table "
INSTANCES = "study instances --to {to} --system {blank} --data {unsplit} --conditions mesh "
COMPILE = "check compile --target gpu:h100 "
RESNET = (
    "--classifier.network.width 64 --classifier.network.depth 18 --classifier.network.channels 3 "
    "--classifier.network.stem convolution"
)

FOLLOWED = [
    # plans and trainings
    ("--… is for a plan; add --plan, or leave it out", TRAIN + "--plan-devices 1", TRAIN, PLAN + "--plan-devices 1"),
    ("a plan is of one training, and --seeds is …; add --seeds 1", PLAN + "--seeds 3", PLAN + "--seeds 1"),
    ("say how many devices and processes there will be: --plan-devices N --plan-processes N",
     PLAN + "--distributed", PLAN + "--distributed --plan-devices 8 --plan-processes 4"),
    ("… processes train together with --distributed alone; add it, here and to the launch",
     PLAN + "--plan-devices 8 --plan-processes 4", PLAN + "--plan-devices 8 --plan-processes 4 --distributed"),
    ("--plan-objects must be at least 1, and is …", PLAN + "--plan-objects 0", PLAN + "--plan-objects 1"),
    ("--model-devices … does not divide the … devices of a process; use 1, or a divisor",
     PLAN + "--plan-devices 8 --model-devices 3", PLAN + "--plan-devices 8 --model-devices 1",
     PLAN + "--plan-devices 8 --model-devices 4"),
    ("… has … devices, and --plan-devices is …; leave that out",
     PLAN + "--plan-target tpu:v5e:2x2 --plan-devices 3", PLAN + "--plan-target tpu:v5e:2x2"),
    ("no data set in …; create one with: mevs data --out …, or plan for one of N objects by --plan-objects N",
     "train --preset tiny --plan --out {to}", "data --preset tiny --out {1}", PLAN),
    ("no data set in …; create one with: mevs data --out …", "train --preset tiny --out {to}", "data --preset tiny --out {1}"),
    ("--seeds … is not from 1 to …; choose another", TRAIN + "--seeds 0", TRAIN + "--seeds 1"),
    ("--seeds-at-once … is below 0; 0 is for all seeds",
     TRAIN + "--seeds 2 --seeds-at-once -1", TRAIN + "--seeds 2 --seeds-at-once 0"),
    ("no networks in …; train those of all seeds with: mevs train --seeds … --out …",
     EVAL + "--seeds 2", "train --seeds {2} --out {3}"),
    ("which … does not change; leave these options out, or make another run with another --out",
     EVAL + "--views 7", RUN + "--views 7"),
    ("… has a classifier trained with other settings (…); leave these options out, or choose another --out",
     "study published-code --classifier.optimiser.learning-rate 0.1 --out {whole}", "study published-code --out {whole}"),
    ("… holds … with other settings (…); choose another --out, or delete that folder",
     TRAIN + "--classifier.optimiser.epochs 3", RUN + "--classifier.optimiser.epochs 3"),
    ("a folder whose files can be renamed and locked; mount that storage, and give the folder",
     "run --out gs://bucket/run", RUN),
    ("cannot write to … (…); choose another --out", "run --out {chair}/run", RUN),
    ("--beam has workers of its own; leave out --distributed", "data --beam= --distributed --out {to}", "data --out {to}"),
    ("--frames makes the data set alone, by one process; leave out --data and --distributed",
     "data --frames {scan} --data {set} --out {to}", "data --frames {scan} --out {to}"),
    # networks
    ("--pretrained weights are those of a ResNet, not of --encoder …; leave one of them out",
     RUN + "--pretrained {weights} --encoder {own}:net", RUN + "--encoder {own}:net"),
    ("this one has width …, depth …, … channels and the stem …; use --preset thesis, or " + RESNET,
     RUN + "--pretrained {weights}", "run --preset thesis --pretrained {weights} --out {to}",
     RUN + "--pretrained {weights} " + RESNET),
    ("none of … holds a ResNet-…; give --pretrained torchvision's resnet… too",
     RUN + "--pretrained {others} " + RESNET,
     RUN + "--pretrained {others} {weights} " + RESNET),
    ("… is a setting of the ResNet, and the classifier is …; leave one of them out",
     RUN + "--encoder {own}:net --classifier.network.width 8", RUN + "--encoder {own}:net", RUN + "--classifier.network.width 8"),
    ("… is a folder; name a file to write the figures into", TRANSFER + "--to {set}", TRANSFER + "--to {to}.json"),
    ("an --encoder decides itself in which precision it computes: leave the option out",
     "train --preset tiny --out {half} --encoder {own}:net --classifier.optimiser.compute bfloat16",
     "train --preset tiny --out {half} --encoder {own}:net"),
    ("--classifier.frozen trains the last layer on features of given weights; give --pretrained too",
     RUN + "--classifier.frozen", RUN + "--classifier.frozen --pretrained {weights} " + RESNET),
    ("--classifier.reality is for images of depth; leave out --classifier.images …",
     "train --preset tiny --out {half} --classifier.reality.strength 1 --classifier.images image",
     "train --preset tiny --out {half} --classifier.reality.strength 1"),
    ("--encoder … returns …, not a Flax nnx.Module; repair it",
     "train --preset tiny --out {half} --encoder {own}:none", "train --preset tiny --out {half} --encoder {own}:net"),
    ("--encoder … has no weights (nnx.Param) to train; repair it",
     "train --preset tiny --out {half} --encoder {own}:plain", "train --preset tiny --out {half} --encoder {own}:net"),
    ("it is called as function(classes=, channels=, resolution=, rngs=), and its network as network(images, train=)",
     "train --preset tiny --out {half} --encoder {own}:odd", "train --preset tiny --out {half} --encoder {own}:net"),
    ("for 2 images, not floating-point logits [2, …]; repair it",
     "train --preset tiny --out {half} --encoder {own}:three", "train --preset tiny --out {half} --encoder {own}:net"),
    # own code
    ("… takes …, and a policy takes (key, state, scene); change its arguments",
     EVAL + "--policy {own}:plain_odd", EVAL + "--policy {own}:scores"),
    ("… returns …, and a policy returns a floating-point score for every view, […]; repair it",
     EVAL + "--policy {own}:few", EVAL + "--policy {own}:scores"),
    ("… cannot be used: ……; repair it", EVAL + "--policy {own}:fails", EVAL + "--policy {own}:scores"),
    ("the name … is taken by another policy of the evaluation; register it under another name",
     EVAL + "--policy {own}:scores --policy {own}:scores", EVAL + "--policy {own}:scores"),
    ("… cannot be read (…); correct the path, or restore the file", EVAL + "--policy {own}.py:scores",
     EVAL + "--policy {own}:scores"),
    ("… cannot be imported (…); repair it", EVAL + "--policy {text}.py:scores", EVAL + "--policy {own}:scores"),
    ("there is no module …; name one that Python can import, or a file ending in .py",
     EVAL + "--policy no_such_module:scores", EVAL + "--policy {own}:scores"),
    ("… has no source file; name a function written in Python", EVAL + "--policy math:sqrt", EVAL + "--policy {own}:scores"),
    ("… cannot be read (it is not a file); name a .pth or .safetensors file",
     RUN + "--pretrained {set} " + RESNET, RUN + "--pretrained {weights} " + RESNET),
    ("… cannot be read (…); name a .pth or .safetensors file",
     RUN + "--pretrained {to}.pth " + RESNET, RUN + "--pretrained {weights} " + RESNET),
    # sweeps
    ("--sweep.seeds … is not from 1 to 1000; choose another", SWEEP + "--sweep.seeds 0", SWEEP + "--sweep.seeds 1"),
    ("--sweep.grid and --sweep.list exclude each other; leave one out",
     SWEEP + "--sweep.grid dropout=0.1 --sweep.list {list}", SWEEP + "--sweep.list {list}"),
    ("--sweep.members … is too few; it must be at least 1", SWEEP + "--sweep.members 0", SWEEP + "--sweep.members 1"),
    ("--sweep.list … has no configurations: a .csv has a header and rows",
     SWEEP + "--sweep.list {no_list}", SWEEP + "--sweep.list {list}"),
    ("--sweep.list … cannot be read (…); give a .csv or .json file", SWEEP + "--sweep.list {to}", SWEEP + "--sweep.list {list}"),
    ("--sweep.… … … must be a range above 0, smaller end first",
     SWEEP + "--sweep.learning-rate 1e-2 1e-3", SWEEP + "--sweep.learning-rate 1e-3 1e-2"),
    ("--sweep.… … … must be a range within …, smaller end first",
     SWEEP + "--sweep.dropout 0.5 0.1", SWEEP + "--sweep.dropout 0.1 0.5"),
    ("--sweep.grid … is not NAME=VALUE,VALUE, as in learning-rate=1e-4,3e-4",
     SWEEP + "--sweep.grid dropout", SWEEP + "--sweep.grid learning-rate=1e-4,3e-4"),
    ("--sweep.grid names … twice; give all its values once",
     SWEEP + "--sweep.grid dropout=0.1 dropout=0.2", SWEEP + "--sweep.grid dropout=0.1,0.2"),
    ("--sweep.trials is for the classifier and the entropy predictor, and without --distributed",
     "sweep --sweep.network recogniser --sweep.trials 2 --out {whole}",
     "sweep --sweep.network classifier --sweep.trials 2 --out {whole}"),
    # evaluation
    ("--evaluation.max-views must be at least 2 and --evaluation.draws at least 1",
     EVAL + "--evaluation.draws 0", EVAL + "--evaluation.draws 1", EVAL + "--evaluation.max-views 2"),
    ("viewpoints have an elevation of at least …°; choose a lower --evaluation.lowest-elevation",
     EVAL + "--evaluation.lowest-elevation 89", EVAL + "--evaluation.lowest-elevation 0"),
    ("--agent.objects, --agent.max-views, --agent.shots and --agent.calls must be at least 1",
     AGENT + "--agent.objects 0", AGENT + "--agent.objects 1"),
    ("… needs the tables of mevs study rendering, which live walks do not have; leave it out",
     "check live --live.policies diff_mesh_whole --out {whole}", "check live --live.policies random --out {whole}"),
    # studies
    ("--learned.folds must be at least 2 and --learned.seeds at least 1",
     LEARNED + "--learned.folds 1", LEARNED + "--learned.folds 2", LEARNED + "--learned.seeds 1"),
    ("--learned.changed must be at least 0, got …", LEARNED + "--learned.changed -1", LEARNED + "--learned.changed 0"),
    ("leave out --learned.recogniser.network.channels, .standardise and --learned.recogniser.optimiser.validation-by",
     LEARNED + "--learned.recogniser.network.channels 1", LEARNED),
    ("leave it out and set --learned.rotation-epochs", LEARNED + "--learned.recogniser.augmentation.turn",
     LEARNED + "--learned.rotation-epochs 1"),
    ("--learned.recogniser.azimuths must be 0, for none, or 4 to 360, got …",
     LEARNED + "--learned.recogniser.azimuths 3", LEARNED + "--learned.recogniser.azimuths 4",
     LEARNED + "--learned.recogniser.azimuths 0"),
    ("the seeds of a study are counted up from --learned.seed; leave out those of its networks",
     LEARNED + "--learned.policy.seed 3", LEARNED + "--learned.seed 3"),
    ("unknown ablation … in --learned.ablations; choose from …",
     LEARNED + "--learned.ablations magic", LEARNED + "--learned.ablations {2}"),
    ("set --learned.max-views, --learned.policy.most-seen and --learned.q-learning.most-seen to at least 2 and less than …",
     LEARNED + "--learned.max-views 6",
     LEARNED + "--learned.max-views 5 --learned.policy.most-seen 5 --learned.q-learning.most-seen 5"),
    ("--learned.recogniser.optimiser.validation-views must divide 256 and be at most …,",
     LEARNED + "--learned.recogniser.optimiser.validation-views 3",
     LEARNED + "--learned.recogniser.optimiser.validation-views 4"),
    ("… has a data set made with other settings (…); leave these options out, or choose another --out",
     RENDERING + "--dataset.seed 3", RENDERING, RUN + "--dataset.seed 3"),
    ("mevs study thesis walks from every view; leave out --evaluation.lowest-elevation",
     THESIS + "--evaluation.lowest-elevation 0", THESIS),
    ("mevs study thesis trains the thesis's own classifiers; leave out --classifier.encoder",
     THESIS + "--classifier.encoder {own}:net", THESIS),
    ("has lattices of 10 and 40 views; leave out --dataset.capture.lattice file:",
     THESIS + "--dataset.capture.lattice file:{views}", THESIS),
    ("--thesis.ascent-runs must be at least 1, --thesis.ascent-starts at least 2 and --thesis.ascent-resolution at least 8",
     THESIS + "--thesis.ascent-runs 0", THESIS + "--thesis.ascent-runs 1 --thesis.ascent-starts 2 --thesis.ascent-resolution 8"),
    ("--rendering.faces must be at least 1, --rendering.starts at least 2 and --rendering.resolution at least 8",
     RENDERING + "--rendering.objects 0",
     RENDERING + "--rendering.objects 1 --rendering.faces 1 --rendering.starts 2 --rendering.resolution 8"),
    ("--ascent.starts must be at least 2 and --ascent.resolution at least 8",
     ASCENT + "--ascent.starts 1", ASCENT + "--ascent.starts 2 --ascent.resolution 8"),
    ("… cannot be rendered (…); choose another --ascent.object",
     ASCENT + "--data {hollow} --ascent.object mug/train/flat.off",
     ASCENT + "--data {hollow} --ascent.object mug/train/mug_0.off"),
    # checks
    ("--max-views and --draws must be at least 1", TRANSFER + "--max-views 0", TRANSFER + "--max-views 1 --draws 1"),
    ("--metres must be the metres in one unit of the files, 0.001 for millimetres, got …",
     TRANSFER + "--metres -1 --system {sized}", TRANSFER + "--metres 0.001 --system {sized}"),
    ("… does not use sizes; leave out --metres", TRANSFER + "--metres 1", TRANSFER),
    ("--names … is not FOLDER=CLASS, as in --names armchair=chair", TRANSFER + "--names mug", TRANSFER + "--names mug=chair"),
    ("--names …=…: the objects have no class …, but …", TRANSFER + "--names cup=chair", TRANSFER + "--names {4}=chair"),
    ("--names …=…: the system knows no class …, but …", TRANSFER + "--names mug=cup", TRANSFER + "--names mug={4}"),
    ("--up goes with meshes, not with …; leave it out", "check transfer --data strangers --up z",
     "check transfer --data strangers"),
    ("--objects must be at least 2, or 0 for all, and --draws at least 1", REALITY + "--objects 1", REALITY + "--objects 2",
     REALITY + "--objects 0"),
    ("--system names one system twice; name each once", REALITY + "--system furniture10 furniture10",
     REALITY + "--system furniture10"),
    ("cannot write to … (…); choose another --to", REALITY.replace("{to}", "{chair}/to"), REALITY),
    ("--shapes must be at least 40, got …", INSTANCES + "--fit --shapes 39", INSTANCES + "--fit --shapes 40"),
    ("--conditions knows …, not …", INSTANCES.replace("mesh", "fog"), INSTANCES + "--metres 0.1"),
    ("say how many metres one unit of the files is, such as --metres 0.01 for centimetres",
     INSTANCES + "--metres 100", INSTANCES + "--metres 0.01"),
    ("--measured is of systems of classes; enrolled objects are measured by mevs study instances",
     "export --system {known} --measured {text} --to {to}", INSTANCES + "--metres 0.1"),
    ("--scene finds all objects of --depth PATH by itself; leave out --…",
     "look --scene --depth {room} --first 0 --system {system}", "look --scene --depth {room} --system {system}"),
    ("--only …: there is no such program; they are …", COMPILE + "--only magic", COMPILE + "--only {2}"),
    ("--against …: there is no such file; write one with --to …", COMPILE + "--against {to}", COMPILE + "--to {2}"),
    ("--target … names no device; it is gpu:h100, or a TPU with the shape of its slice: ",
     "check compile --target tpu:v9", "check compile --target gpu:h100", "check compile --target tpu:v5e:2x2"),
]  # fmt: skip
"""As of `test_commands`."""


@pytest.fixture
def to_the_work(places, monkeypatch):
    def begins(*_, **__):
        raise DataError(BEGINS)

    assert places["run"]  # which is made by work
    assert places["known"]
    for place in WORK:
        monkeypatch.setattr(place, begins)
    monkeypatch.setattr("data_pipeline.distributed.join_processes", lambda: None)  # without other processes
    monkeypatch.setattr("train.planning.targets.find_spec", lambda _: True)  # for compilers that are not here
    monkeypatch.setattr("train.planning.targets.Target.devices", lambda _: [None] * 4)


def edit(name: str, change: Callable[[Any], object] | None) -> Callable[[Mapping[str, str]], None]:
    """What edits a JSON file of the run as a person would; None damages it."""

    def spoil(places: Mapping[str, str]) -> None:
        path = Path(places["whole"], name)
        text = "{"
        if change is not None:
            change(content := json.loads(path.read_text()))
            text = json.dumps(content)
        path.write_text(text)
        (path.parent / "checks.json").unlink(missing_ok=True)

    return spoil


def gone(name: str) -> Callable[[Mapping[str, str]], None]:
    def spoil(places: Mapping[str, str]) -> None:
        path = Path(places["whole"], name)
        path.unlink() if path.is_file() else shutil.rmtree(path)

    return spoil


def nothing(_: Mapping[str, str]) -> None:
    """Where a command does all that is said."""


SPOILED = [
    ("… cannot be read (…); delete it, and give the options of the run again, or choose another --out",
     edit("run.json", None), TRAIN, gone("run.json"), TRAIN + "--preset tiny", RUN),
    ("repeat mevs run or mevs train with the settings that it was made with, or choose another --out",
     edit("run.json", lambda run: run["settings"]["classifier"]["optimiser"].update(epochs=7)), "report --out {whole}",
     nothing, TRAIN + "--classifier.optimiser.epochs 2", RUN),
    ("… was made by another version of mevs_jax; choose another --out, or delete it",
     edit("data/summary.json", lambda made: made.update(colours=3)), TRAIN, gone("data"), RUN, "run --out {whole}"),
    ("the network in … is not fully trained; finish it with: mevs train --out …",
     gone("classifier/summary.json"), EVAL, nothing, "train --out {2}"),
    ("repeat the command that trained this network, such as mevs train",
     edit("classifier/summary.json", None), EVAL, nothing, TRAIN),
    ("… holds … with other settings; choose another --out, or delete that folder",
     gone("classifier/config.json"), TRAIN + "--classifier.optimiser.epochs 3", gone("classifier"),
     TRAIN + "--classifier.optimiser.epochs 3", RUN),
    ("no trained … in …; train one with: mevs train", gone("classifier/best"), "check live --out {whole}", nothing, TRAIN),
    ("… has the object … no more; put it back, or make a run in another --out",
     lambda places: Path(places["set"], "mug/test/mug_2.off").rename(Path(places["set"], "mug/test/other.off")),
     "study rendering --out {run}",
     lambda places: Path(places["set"], "mug/test/other.off").rename(Path(places["set"], "mug/test/mug_2.off")),
     "study rendering --out {run}", RUN),
    ("mevs study learned --out …",
     lambda places: write_json(Path(places["whole"], "learned", "metrics.json"), {"seeds": [], "settings": {}}),
     "report --out {whole}",
     nothing, "study learned --out {1}"),
]  # fmt: skip
"""As `FOLLOWED`, with what is done before the message, and what it says to do before a command."""


def follow(at_once, places, told: str, wrong: str, right: list[str], mend: Callable[[Mapping[str, str]], None]) -> None:
    result = at_once(*wrong.format_map(places).split())
    said = found(told, result)
    assert said, result
    mend(places)
    for command in right:
        filled = re.sub(r"\{(\d)\}", lambda at: said[int(at[1])].strip('"'), command)
        assert at_once(*filled.format_map(places).split()).stderr.endswith(f": {BEGINS}\n")


@pytest.mark.parametrize(("told", "wrong", "right"), [(told, wrong, right) for told, wrong, *right in FOLLOWED])
def test_advice_that_is_followed_leads_to_the_work(told, wrong, right, places, at_once, to_the_work):
    follow(at_once, places, told, wrong, right, nothing)


@pytest.mark.parametrize(("told", "spoil", "wrong", "mend", "right"), [(*row[:4], row[4:]) for row in SPOILED])
def test_advice_on_what_is_damaged_leads_to_the_work(told, spoil, wrong, mend, right, places, at_once, to_the_work):
    spoil(places)
    follow(at_once, places, told, wrong, right, mend)


def test_what_a_page_says_to_do_next_can_be_done(places, at_once, to_the_work):
    """All but to show a walk, which needs a browser."""
    of_thesis = thesis_page(None).replace("code --out OTHER", "code --out RUN")  # that the command before it makes
    pages = Path(places["whole"], "report", "index.html").read_text() + learned_page({"seeds": [1]}) + of_thesis
    commands = {html.unescape(one) for one in re.findall("<code>mevs ([^<]* --[^<]*)</code>", pages)}
    assert len(commands) > 10
    filled = {
        "RUN/learned/system": places["system"],
        "RUN": places["whole"],
        "OTHER": places["to"],
        "FOLDER": places["to"],
        "DATA": places["set"],
        "FILE": places["chair"],
        "my_policy.py:scores": f"{places['own']}:scores",
    }
    for command in sorted(commands):
        done = at_once(*(filled.get(word, word) for word in command.removesuffix(" --view").split()))
        assert done.returncode == 0 or done.stderr.endswith(f": {BEGINS}\n"), (command, done)
        shutil.rmtree(places["to"], ignore_errors=True)
