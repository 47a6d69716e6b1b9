"""The objects of a table recognised together or one after the other: `python -m examples.robot_arm --table FOLDER`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_pipeline.objects.mesh import Mesh
from eval.numbers.comparison import intervals
from examples.robot_arm.arm import Arm
from examples.robot_arm.film import Shot, write_film
from examples.robot_arm.looking import NATS_PER_RADIAN
from examples.robot_arm.scene import HEIGHT, HOME, WIDTH
from examples.robot_arm.table import DISTANCE, Table, laid
from mevs_jax import SceneAgent, TrainedSystem
from mevs_jax.markdown import markdown_table

MOST_VIEWS, MOST_EACH = 12, 3
"""Images of a table, and of one object where one comes after the other."""
COUNTED = (1, 2, 4, 6, 8)
"""Numbers of images after which right answers are counted."""


@dataclass(frozen=True)
class Way:
    """How the next pose is chosen: by expected gain, or blindly.

    Attributes:
        name: in the table of results.
        blind: `random` or `farthest`, among the poses that show something new.
        focus: for one object after the other: the nearest one that is not decided.
        alone: what images show of other objects is not used.
        near: motion costs `NATS_PER_RADIAN`.
    """

    name: str
    blind: str = ""
    focus: bool = False
    alone: bool = False
    near: bool = False


TOGETHER = Way("all together, near", near=True)
WAYS = (
    Way("random", blind="random"),
    Way("farthest", blind="farthest"),
    Way("one after the other, each alone, near", focus=True, alone=True, near=True),
    Way("one after the other, near", focus=True, near=True),
    Way("all together"),
    TOGETHER,
)


@dataclass(frozen=True)
class Looked:
    """How the objects of a table were recognised.

    Attributes:
        names: the answers at the end.
        sure: whether the agent is, also of an unknown object.
        right: number of right answers after each image.
        radians: length of the arm's path at the end, from its home.
        shots: for a film.
    """

    names: list[str]
    sure: list[bool]
    right: list[int]
    radians: float
    shots: list[Shot]


def look_around(table: Table, system: TrainedSystem, way: Way, stop: float, seed: int, frames: int = 1) -> Looked:
    """Looks until the agent is sure of each object, or no image is left.

    Args:
        stop: as of `SceneAgent`.
        seed: of random poses.
        frames: moments of each motion that are kept.
    """

    def begun() -> SceneAgent:
        worth = NATS_PER_RADIAN * way.near
        return SceneAgent(
            system, table.spheres, stop=stop, max_views=MOST_VIEWS, distance=DISTANCE, gain_per_cost=worth
        )

    arm, agent, random = Arm(table.scene), begun(), np.random.default_rng(seed)
    arm.place(HOME)
    names, sure, closed = ["unknown object"] * len(table.names), [False] * len(table.names), set[int]()
    right, shots, eyes, focus, looks = list[int](), list[Shot](), [table.scene.camera_pose[:3, 3]], -1, 0
    while len(right) < MOST_VIEWS:
        left = [one for one, decided in enumerate(sure) if not decided and one not in closed]
        if not left:
            break
        if way.focus and focus not in left:
            focus, looks = min(left, key=lambda one: float(np.linalg.norm(table.spheres[one].position - eyes[-1]))), 0
            agent = begun() if way.alone else agent
        costs, paths = arm.costs(table.reach)
        chosen = _next(agent, way, table.poses, [focus] if way.focus else left, costs, random, np.array(eyes))
        if chosen is None:
            closed |= {focus} if way.focus else set(left)
            continue
        passed = arm.move(paths[chosen] or [], frames)
        depth = see(agent, table)
        eyes.append(table.scene.camera_pose[:3, 3])
        looks += 1
        for one in [focus] if way.alone else range(len(names)):
            names[one], sure[one] = agent.names[one], agent.reasons[one] in ("sure", "unknown object")
        if way.focus and looks >= MOST_EACH:
            closed.add(focus)
        right.append(sum(map(str.__eq__, names, table.names)))
        believed = [0.0 if belief is None else belief.confidence for belief in agent.beliefs]
        title = f"view {len(right)}: sure of {sum(sure)} of {len(sure)} objects"
        shots.append(Shot(title, passed, depth, list(zip(names, believed, sure, strict=True))))
    return Looked(names, sure, right, arm.travelled, shots)


def see(agent: SceneAgent, table: Table) -> Float[np.ndarray, "side side"]:
    """Shows the agent what the camera sees: the middle square, outside of which it sees nothing. Labels are the simulator's."""
    side = (WIDTH - HEIGHT) // 2
    depth, labels, K = table.camera.take()[:, side:-side], table.labels()[:, side:-side], table.scene.K.copy()
    K[0, 2] -= side
    agent.observe(depth, K, table.scene.camera_pose, labels=labels)
    return depth


def _next(
    agent: SceneAgent,
    way: Way,
    poses: Float[np.ndarray, "poses 4 4"],
    objects: Sequence[int],
    costs: Float[np.ndarray, " poses"],
    random: np.random.Generator,
    eyes: Float[np.ndarray, "looks 3"],
) -> int | None:
    """The next pose, None if none that can be reached shows something new of the objects."""
    reachable = np.isfinite(costs)
    if not way.blind:
        cost = np.where(reachable, costs, 0.0) if way.near else None
        step = agent.decide(reachable, cost=cost, candidates=poses, objects=objects)
        return None if step.done else step.index
    order = random.permutation(np.flatnonzero(reachable))
    if way.blind == "farthest":
        apart = np.linalg.norm(poses[order, None, :3, 3] - eyes, axis=-1).min(axis=1)
        order = order[np.argsort(-apart, kind="stable")]
    shows = (int(one) for one in order if not agent.decide(candidates=poses[[one]], objects=objects).done)
    return next(shows, None)


def show_table(meshes: Mapping[str, Mesh], system: TrainedSystem, options: argparse.Namespace) -> None:
    """Recognises what is on one table, and films it."""
    with laid(meshes, system, options.objects, options.seed, options.sensor) as table:
        table.camera.begin(options.seed)
        found = look_around(table, system, TOGETHER, options.stop, options.seed, 10 if options.film else 1)
        for name, true, sure in zip(found.names, table.names, found.sure, strict=True):
            print(f"{true}: {name}{'' if sure else '?'}")
        print(f"{len(found.right)} images, {found.radians:.1f} rad of joint motion")
        if options.film and found.shots:
            write_film(found.shots, table.scene, table.camera, options.film)
            print(f"Film: {options.film}")


def study_tables(meshes: Mapping[str, Mesh], system: TrainedSystem, options: argparse.Namespace) -> None:
    """Compares ways to choose, on tables of their own objects, places and errors."""
    rows: dict[str, list[list[float]]] = {way.name: [] for way in WAYS}
    for seed in range(options.seed, options.seed + options.tables):
        with laid(meshes, system, options.objects, seed, options.sensor) as table:
            for way in WAYS:
                table.camera.begin(seed)
                rows[way.name].append(_counted(look_around(table, system, way, options.stop, seed), table))
        print(f"table {seed}: {', '.join(f'{name} {row[-1][0]:.2f}' for name, row in rows.items())}", file=sys.stderr)
        if options.to:
            options.to.write_text(
                json.dumps({"objects": options.objects, "enrolled": len(meshes), "ways": rows}, indent=1)
            )
    print(f"{options.tables} tables of {options.objects} of {len(meshes)} enrolled objects")
    print(tabulated(rows))


def _counted(found: Looked, table: Table) -> list[float]:
    """Of one table: shares right, sure, and sure and wrong; images, radians; and the shares right after `COUNTED` images."""
    is_right = np.array([name == true for name, true in zip(found.names, table.names, strict=True)])
    sure, after = np.array(found.sure), [0, *found.right]
    early = [after[min(count, len(after) - 1)] / len(sure) for count in COUNTED]
    ends = [is_right.mean(), sure.mean(), (sure & ~is_right).mean(), len(found.right), found.radians]
    return [float(value) for value in (*ends, *early)]


def tabulated(rows: Mapping[str, Sequence[Sequence[float]]]) -> str:
    """The table of results: means over tables with 95 % intervals."""
    scales = [100, 100, 100, 1, 1] + [100] * len(COUNTED)
    header = ["poses chosen", "right, %", "sure, %", "sure and wrong, %", "images", "joint motion, rad"]
    header += [f"right after {count}" for count in COUNTED]
    lines = []
    for name, tables in rows.items():
        values = np.array(tables).T * np.array(scales)[:, None]
        cells = [f"{value.mean():.1f} [{intervals(value)[0]:.1f}, {intervals(value)[1]:.1f}]" for value in values[:5]]
        lines.append([name, *cells, *(f"{value.mean():.0f}" for value in values[5:])])
    return markdown_table(header, lines)
