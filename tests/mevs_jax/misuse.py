"""Arguments of wrong types: as a program, prints what each of them ends with. Tests check types, and this program does not."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

import mevs_jax
from mevs_jax.agent.looking import Frames

WORDS = (None, "a", [], {})
NUMBERS = (*WORDS, float("nan"))
WRONG: dict[str, tuple[Any, ...]] = {
    "stop": NUMBERS,
    "max_views": (*NUMBERS, float("inf"), 2.5),
    "unknown": ("a", [], float("nan")),
    "gain_per_cost": (*NUMBERS, float("inf")),
    "distance": ("a", [], float("nan")),
    "max_candidates": ("a", [], 1.5, float("inf"), 10**9),
    "seed": (*NUMBERS, 0.5),
    "radius": (*NUMBERS, float("inf")),
    "center": (*NUMBERS, "abc"),
    "up": NUMBERS,
    "yaw": ("a", [], float("inf")),
    "points": WORDS,
    "depth": (*WORDS, np.zeros((32, 32), int)),
    "K": WORDS,
    "T_world_camera": WORDS,
    "mask": ("a", np.full((32, 32), "a"), np.full((32, 32), -1), np.full((32, 32), 0.01)),
    "mask of Frames": ("a", np.full((1, 32, 32), "a"), np.full((1, 32, 32), -1), np.full((1, 32, 32), 0.01)),
    "floor": ("a", [], float("nan")),
    "depth of observe_view": (*WORDS, np.full((32, 32), np.nan)),
    "pose": WORDS,
    "reachable": ("a", [None], [1.5], 99),
    "cost": ("a", [None] * 12, lambda pose: "a"),
    "candidates": ("a", 3, [None], {}),
    "mark_failed": NUMBERS,
    "first": ("a", 0.5, 12, -1),
    "metres": ("a", [], 0.0, float("nan")),
    "path": (None, 3, []),
    "radius of observe": ("a", -1.0, 0.0),
}


def calls(system: Any, agent: Any, image: tuple[Any, ...], view: tuple[Any, ...]) -> dict[str, Callable[[Any], Any]]:
    """A call for each name, with a value in its place."""
    sphere = {"center": (0, 0, 0), "radius": 1.0}
    mesh = np.eye(3), np.array([[0, 1, 2]])
    depth, K, pose = image
    recorded = {"depth": depth[None], "K": K, "T_world_camera": pose[None], "center": (0, 0, 0), "radius": 1.0}
    made: dict[str, Callable[[Any], Any]] = {
        "points": agent.reset_from_points,
        "depth": lambda value: agent.observe(value, K, pose),
        "K": lambda value: agent.observe(depth, value, pose),
        "T_world_camera": lambda value: agent.observe(depth, K, value),
        "depth of observe_view": lambda value: agent.observe_view(value, view[1]),
        "mask of Frames": lambda value: Frames.of(recorded | {"mask": value}).image(0),
        "pose": lambda value: agent.observe_view(view[0], value),
        "mark_failed": agent.mark_failed,
        "path": mevs_jax.load,
        "radius of observe": lambda value: system.observe(*view, value),
    }
    for name in ("stop", "max_views", "unknown", "gain_per_cost", "distance", "max_candidates", "seed"):
        made[name] = lambda value, name=name: system.agent(**{name: value})
    for name in ("radius", "center", "up", "yaw"):
        made[name] = lambda value, name=name: agent.reset(**sphere | {name: value})
    for name in ("mask", "floor"):
        made[name] = lambda value, name=name: agent.observe(*image, **{name: value})
    for name in ("reachable", "cost", "candidates"):
        made[name] = lambda value, name=name: agent.decide(**{name: value})
    for name in ("first", "metres"):
        made[name] = lambda value, name=name: mevs_jax.look(system, *mesh, **{name: value})
    return made


def main() -> None:
    from tests.mevs_jax.agent.test_agent import begun, in_metres, views_of
    from tests.mevs_jax.trained import making

    system = making.system()
    agent, view = begun(system, "random"), views_of(system)[0]
    made = calls(system, agent, in_metres(*view), view)
    for name, values in WRONG.items():
        for value in values:
            try:
                made[name](value)
                ended = "nothing", ""
            except Exception as error:
                ended = type(error).__name__, str(error)
            print(json.dumps([ended[0], name.split(" of ")[0], f"{ended[1]} [{value!r:.20}]"]))


if __name__ == "__main__":
    main()
