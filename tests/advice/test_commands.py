"""What messages advise works: a command says something, and then its advice is followed, word for word, to the end."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from data_pipeline.frames import reading
from tests.advice.conftest import DATA
from tests.advice.listing import found
from tests.cli.conftest import ended

BALL = " --center 0.5 0.1 0.8 --radius 0.2"
"""Where the recorded ball is."""
LOOK = "look --system {system} --max-views 2"
SET = DATA + "{set}"
FOLLOWED = [
    ("mevs look needs an object: --mesh FILE or --depth FILE, one of them", LOOK, LOOK + " --mesh {chair}"),
    ("--mesh FILE or --depth FILE, one of them", LOOK + " --mesh {chair} --depth {npz}", LOOK + " --depth {npz}" + BALL),
    ("… does not use sizes; leave out --metres", LOOK + " --mesh {chair} --metres 0.001", LOOK + " --mesh {chair}"),
    ("--metres is the metres in one unit of a --mesh, 0.001 for millimetres; images are in metres",
     LOOK + " --depth {npz} --metres 0.001" + BALL, LOOK + " --depth {npz}" + BALL),
    ("--… is for recorded depth images, not for …; leave it out", LOOK + " --mesh {chair} --floor 1", LOOK + " --mesh {chair}"),
    ("--… is for recorded depth images, not for …; leave it out",
     LOOK + " --mesh {chair} --upward 0 0 1", LOOK + " --mesh {chair} --up z"),
    ("give --center X Y Z and --radius R in metres", LOOK + " --depth {scan}", LOOK + " --depth {scan}" + BALL),
    ("center and radius of the object belong together; give both",
     LOOK + " --depth {scan} --center 0.5 0.1 0.8", LOOK + " --depth {scan}" + BALL),
    ("write fx fy cx cy of the camera into one, or give --intrinsics FX FY CX CY",
     LOOK + " --depth {bare}" + BALL, LOOK + " --depth {bare} --intrinsics 90 91 40.5 28.5" + BALL),
    ("an .npz is in metres, with K; --every, --depth-unit and --intrinsics are for folders",
     LOOK + " --depth {npz} --every 2" + BALL, LOOK + " --depth {npz}" + BALL),
    ("… has … images, and at most … are read; give --every …",
     LOOK + " --depth {scan}" + BALL, LOOK + " --depth {scan} --every {4}" + BALL),
    ("is a file, in metres, with K; an object's number, --depth-unit and --intrinsics are of folders",
     "check frames {room} --depth-unit 0.001", "check frames {room}"),
    ("if it is the floor or a table, give --upward … … …",
     "check frames {room} --upward 0 -1 0", "check frames {room} --upward {1} {2} {3}"),
    ("mevs enrol needs objects: NAME=FILE ..., or --remove NAME, or --rename OLD=NEW",
     "enrol --system {blank} --to {to}", "enrol box={chair} --system {blank} --to {to}",
     "enrol --remove box --system {to} --to {to}", "enrol --rename box=old --system {known} --to {to}"),
    ("--metres is the metres in one unit of the meshes, 0.001 for millimetres, got …",
     "enrol box={chair} --metres -1 --system {blank} --to {to}", "enrol box={chair} --metres 0.001 --system {blank} --to {to}"),
    ("enrol one at a time, with --system of those before it",
     "enrol one={scan} other={scan} --system {blank} --to {to}" + BALL,
     "enrol one={scan} --system {blank} --to {to}" + BALL, "enrol other={scan} --system {to} --to {to}" + BALL),
    ("there is an object … already; remove it first, or choose another name",
     "enrol box={chair} --system {known} --to {to}", "enrol --remove box --system {known} --to {to}",
     "enrol box={chair} --system {to} --to {to}", "enrol other={chair} --system {known} --to {to}"),
    ("(recognise with: mevs look --system …)", "enrol box={chair} --system {blank} --to {to}",
     "look --system {1} --mesh {chair}"),
    ("one that mevs_jax.enrol returned",
     "enrol box={chair} --system {system} --to {to}", "enrol box={chair} --system {known} --rename box=old --to {to}"),
    ("mevs export needs a run or a system: --out DIR or --system PATH, one of them",
     "export --to {to}", "export --system {system} --to {to}"),
    ("… has no …: it is no trained system; write one with mevs export",
     "look --system {set} --mesh {chair}", "export --system {system} --to {to}", "look --system {to} --mesh {chair}"),
    ("… is a single mesh; --data takes a folder laid out as …", DATA + "{chair}", SET),
    ("… is not a data set; --data takes a folder of class folders, a .zip or a .npz", DATA + "{text}", SET),
    ("no such file or folder: …; --data takes …", DATA + "{set}/nowhere", SET),
    ("… has no meshes laid out as … …; pass --data a folder that has", DATA + "{empty}", SET),
    ("add --dataset.split 0.8 to train on 80 % of each class, 1 to train and test on the same objects",
     DATA + "{unsplit}", DATA + "{unsplit} --dataset.split 0.8"),
    ("--dataset.split … is no share of training objects; …", DATA + "{unsplit} --dataset.split 2",
     DATA + "{unsplit} --dataset.split 0.8"),
    ("--dataset.split … is neither …; give one of them", DATA + "{unsplit} --dataset.split half",
     DATA + "{unsplit} --dataset.split 0.5"),
    ("--dataset.split … cannot be read (…); give …",
     DATA + "{unsplit} --dataset.split {no_list}", DATA + "{unsplit} --dataset.split {splits}"),
    ("or give --dataset.split 1 to train and test on the same objects",
     DATA + "{few} --dataset.split 0.5", DATA + "{few} --dataset.split 1"),
    ("--dataset.split and --dataset.up go with a folder or zip of meshes, not with …",
     DATA + "furniture10 --dataset.split 0.5", DATA + "{unsplit} --dataset.split 0.5"),
    ("--archive goes with --data …, not with …", SET + " --archive {text}", SET),
    ("is given twice, as --data or in --dataset.more, or lies in another of them", SET + " --dataset.more {set}", SET),
    ("or leave such objects out with --dataset.skip-damaged", DATA + "{damaged}", DATA + "{damaged} --dataset.skip-damaged"),
    ("--views … is too few: choosing a next view needs at least 2 viewpoints", SET + " --views 1", SET + " --views 2"),
    ("radii; choose another", SET + " --dataset.capture.distance 0.5", SET + " --dataset.capture.distance 1.5"),
    ("--dataset.capture.field-of-view …", SET + " --dataset.capture.field-of-view 180",
     SET + " --dataset.capture.field-of-view 60"),
    ("--dataset.capture.resolution …", SET + " --dataset.capture.resolution 0", SET),
    ("--dataset.validation-share …", SET + " --dataset.validation-share 1", SET + " --dataset.validation-share 0.3"),
    ("…; choose another --views or --dataset.capture.lattice",
     SET + " --dataset.capture.lattice icosahedron", SET + " --dataset.capture.lattice icosahedron --views 12"),
    ("… has … viewpoints, and --views or --dataset.capture.views is …; leave it out",
     SET + " --dataset.capture.lattice file:{views}", "data --out {to} --dataset.capture.lattice file:{views} --data {set}"),
    ("… has … viewpoints, and --dataset.capture.views is …; leave one of them out",
     "data --out {to} --dataset.capture.lattice file:{views} --dataset.capture.views 40 --data {set}",
     "data --out {to} --dataset.capture.lattice file:{views} --data {set}"),
    ("… has a data set made with other settings…; choose another --out, or delete it", "data --out {run} --views 4",
     "data --out {run}", SET),
    ("there is no run in …; give the folder that --out names", "status {to}", "status {run}"),
    ("…: not all are results of mevs check transfer --to FILE (…)",
     "export --system {system} --measured {text} --to {to}",
     "check transfer --system {system} --data {set} --names mug=chair --draws 1 --max-views 2 --to {to}.json",
     "export --system {system} --measured {to}.json --to {to}"),
    ("… is no .png, .svg or .pdf; name the image by one of these",
     LOOK + " --mesh {chair} --draw {to}.gif", LOOK + " --mesh {chair} --draw {to}.png"),
    ("cannot write … (…); choose another file", LOOK + " --mesh {chair} --save {chair}/a.npz",
     LOOK + " --mesh {chair} --save {to}.npz"),
    ("… is a file; choose another folder", "export --system {system} --to {chair}", "export --system {system} --to {to}"),
    ("… holds other files; choose another folder, or empty it first", "export --system {system} --to {set}",
     "export --system {system} --to {to}"),
    ("two objects have one name; choose another for one of them",
     "enrol box={chair} box={chair} --system {blank} --to {to}", "enrol box={chair} other={chair} --system {blank} --to {to}"),
    ("… has one class only (…); add the folder of at least one other class", DATA + "{set}/mug", SET),
    ("unknown command …; it is one of … (see mevs --help)", "fly", "--help"),
    ("which … does not change; leave these options out", "report --views 7 --out {whole}", "report --out {whole}"),
    ("was made with --preset …, not …, which mevs … does not change; leave it out",
     "report --preset small --out {whole}", "report --out {whole}"),
]  # fmt: skip
"""What is said, as it stands in the source; the command that says it; those that follow it, which use what is filled in."""


@pytest.mark.parametrize(("told", "wrong", "right"), [(told, wrong, right) for told, wrong, *right in FOLLOWED])
def test_advice_that_is_followed_works(told, wrong, right, places, at_once, monkeypatch):
    if "--every" in told:
        monkeypatch.setattr(reading, "MOST_FRAMES", 2)
    result = at_once(*wrong.format_map(places).split())
    said = found(told, result)
    assert said, result
    for command in right:
        again = at_once(*re.sub(r"\{(\d)\}", lambda at: said[int(at[1])], command).format_map(places).split())
        ended(again)
        assert not found(told, again)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lost", "asked"),
    [
        ("metrics.json", "report"),
        ("classifier", "eval"),
        ("entropy", "eval"),
        ("system", "look --mesh {chair} --system"),
    ],
)
def test_a_run_names_the_command_that_makes_what_is_lost(lost, asked, places, at_once):
    run = places["whole"]
    path = Path(run, lost)
    path.unlink() if path.is_file() else shutil.rmtree(path)
    again = f"{asked} {run}" if asked.startswith("look") else f"{asked} --out {run}"
    again = again.format_map(places)
    told = re.search(r"with: mevs ((\w+)( --out \S+)?)", at_once(*again.split()).stderr)
    assert told
    ended(at_once(*(told[1] if told[3] else f"{told[2]} --out {run}").split()))
    ended(at_once(*again.split()))
