"""What the commands do: recognise one object, or compare policies on many."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product

import numpy as np

import mevs_jax
from data_pipeline.capture.sensor import Kind
from data_pipeline.objects.furniture import CLASSES
from data_pipeline.objects.mesh import Mesh, normalise
from data_pipeline.objects.recipes import FurniturePiece
from eval.numbers.comparison import intervals
from examples.robot_arm.arm import Arm, Reach
from examples.robot_arm.camera import DepthCamera
from examples.robot_arm.film import Shot, write_film
from examples.robot_arm.looking import Recognition, recognise
from examples.robot_arm.scene import RADIUS, Scene, make_scene
from mevs_jax.agent import Agent
from mevs_jax.geometry.sphere import turned
from mevs_jax.markdown import markdown_table

POLICIES = ("random", "nearest", "best", "information_gain", "information_gain, near")
"""Those of the study."""
FIRSTS = 3
"""First views of each object in the study."""
HELD_OUT = 1_000_000
"""Seeds from here on are those of test objects; networks are trained on others."""


def unknown_piece(kind: str, seed: int) -> Mesh:
    """A piece of furniture that no network was trained on."""
    return normalise(*FurniturePiece(kind, HELD_OUT + seed).load(), kind)


def meshes_of(objects: Sequence[str]) -> dict[str, Mesh]:
    """Meshes by name from NAME=FILE; raises `ValueError` for anything else."""
    found = {}
    for one in objects:
        name, equals, path = one.partition("=")
        if not (name and equals and path):
            raise ValueError(f"{one!r} is not NAME=FILE, as in --among mug=mug.obj")
        found[name] = normalise(*mevs_jax.read_mesh(path), name)
    return found


@contextmanager
def on_the_table(mesh: Mesh, agent: Agent, sensor: Kind) -> Iterator[tuple[Scene, DepthCamera, Reach, np.ndarray]]:
    """An object on the table: scene, camera, what the arm reaches, views it can begin with."""
    scene = make_scene(mesh)
    camera, arm = DepthCamera(scene, sensor), Arm(scene)
    agent.reset(center=scene.center, radius=RADIUS, yaw=0.0, true_size=False)
    reach = arm.reach(agent.poses)
    yield scene, camera, reach, np.flatnonzero(np.isfinite(arm.costs(reach)[0]))
    camera.close()


def show(agent: Agent, options: argparse.Namespace) -> None:
    """Recognises one object, and films it."""
    piece = unknown_piece(options.object, options.seed)
    with on_the_table(piece, agent, options.sensor) as (scene, camera, reach, firsts):
        print(f"{len(firsts)} of {len(reach.angles)} viewpoints can be reached")
        if not len(firsts):
            return
        camera.begin(options.seed)
        walk = recognise(agent, scene, camera, reach, int(firsts[0]), frames=14 if options.film else 1)
        for number, look in enumerate(walk.looks, 1):
            sure = 100 * look.belief.confidence
            print(f"view {number}: {look.belief.name}, {sure:.1f} % ({1e3 * look.seconds:.0f} ms to decide)")
        views = f"{len(walk.looks)} view{'s' * (len(walk.looks) != 1)}"
        print(f"{walk.name} after {views} ({walk.reason}), {walk.radians:.1f} rad of joint motion after the first")
        if options.film and walk.looks:
            shots = [shot_of(number, walk, agent.system.classes) for number in range(len(walk.looks))]
            write_film(shots, scene, camera, options.film)
            print(f"Film: {options.film}")


def shot_of(number: int, walk: Recognition, classes: Sequence[str]) -> Shot:
    """A look as the film shows it, with the likeliest classes."""
    look, count = walk.looks[number], len(walk.looks)
    end = f"{walk.name}: {walk.reason} after {count} view{'s' * (count > 1)}"
    labels = np.argsort(-look.belief.probabilities)[:7]
    bars = [(classes[label], float(look.belief.probabilities[label]), label == look.belief.label) for label in labels]
    return Shot(end if number == count - 1 else f"view {number + 1}", look.passed, look.depth, bars)


def find(agent: Agent, objects: dict[str, Mesh], options: argparse.Namespace) -> None:
    """Looks for the agent's target among objects that stand on the table one after another, at random yaws."""
    random = np.random.default_rng(options.seed)
    for number, name in enumerate(random.permutation([*objects]), 1):
        turned_mesh = replace(
            objects[name], vertices=objects[name].vertices @ turned(random.uniform(0, 2 * np.pi)).T.astype(np.float32)
        )
        with on_the_table(turned_mesh, agent, options.sensor) as (scene, camera, reach, firsts):
            if not len(firsts):
                print(f"object {number} ({name}): no viewpoint can be reached")
                continue
            camera.begin(options.seed + number)
            walk = recognise(agent, scene, camera, reach, int(firsts[0]))
        wanted = agent.system.classes.index(agent.target or "")
        said = f"{100 * walk.looks[-1].belief.probabilities[wanted]:.1f} %" if walk.looks else "not seen"
        print(f"object {number} ({name}): {agent.target} {said} after {len(walk.looks)} views ({walk.reason})")
        if walk.name == agent.target and walk.reason == "sure":
            return
    print(f"{agent.target} was not found")


def study(agents: dict[str, Agent], options: argparse.Namespace) -> None:
    """Compares policies by objects recognised, views, and joint motion."""
    rows: dict[str, list[list[float]]] = {name: [] for name in agents}
    reached = []
    for label, seed in product(range(len(CLASSES)), range(options.each)):
        kind = CLASSES[label]
        with on_the_table(unknown_piece(kind, seed), agents["best"], options.sensor) as (scene, camera, reach, firsts):
            reached.append(len(firsts))
            if not len(firsts):
                sys.exit(f"no viewpoint of {kind} {seed} can be reached")
            for first in firsts[np.linspace(0, len(firsts) - 1, FIRSTS).astype(int)]:
                for name, agent in agents.items():
                    camera.begin(label * 10_000 + seed, int(first))
                    walk = recognise(agent, scene, camera, reach, int(first))
                    seconds = float(np.mean([look.seconds for look in walk.looks] or [0.0]))
                    rows[name].append([walk.name == kind, len(walk.looks), walk.radians, seconds])
        right = (f"{name} {np.mean([row[0] for row in walks[-FIRSTS:]]):.2f}" for name, walks in rows.items())
        print(f"{kind} {seed}: {', '.join(right)}", file=sys.stderr)
    by_object = {name: np.array(walks, float).reshape(-1, FIRSTS, 4).mean(axis=1).T for name, walks in rows.items()}
    figures = {name: _figures(values, by_object["random"]) for name, values in by_object.items()}
    views = len(agents["random"].system.viewpoints)
    print(
        f"{len(reached)} objects, {FIRSTS} first views each; {np.mean(reached):.1f} of {views} viewpoints can be reached"
    )
    header = ["views chosen by", "right, %", "less random", "views", "joint motion, rad", "ms to decide"]
    print(markdown_table(header, [_row(name, of_policy) for name, of_policy in figures.items()]))
    if options.to:
        options.to.write_text(json.dumps({"reached": reached, "policies": figures}, indent=1))


def _figures(by_object: np.ndarray, random: np.ndarray) -> dict[str, list[float]]:
    """Means with 95 % intervals over objects; the rows are right, views, radians and seconds, (4, objects)."""
    values = dict(zip(("right", "views", "radians", "seconds"), by_object, strict=True))
    values["gain"] = by_object[0] - random[0]
    return {name: [float(each.mean()), *intervals(each)] for name, each in values.items()}


def _row(name: str, figures: dict[str, list[float]]) -> list[str]:
    def cell(key: str, scale: float, sign: str = "") -> str:
        middle, low, high = (scale * value for value in figures[key])
        return f"{middle:{sign}.1f} [{low:{sign}.1f}, {high:{sign}.1f}]"

    cells = [cell("right", 100), cell("gain", 100, "+"), cell("views", 1), cell("radians", 1)]
    return [name, *cells, f"{1e3 * figures['seconds'][0]:.0f}"]
