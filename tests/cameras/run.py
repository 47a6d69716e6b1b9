"""Gives the shipped system every fault of `tests.cameras.faults`: `python -m tests.cameras.run [--pieces 3] [--to FILE]`.

Furniture is seen from two directions, alone and in a room with a mask. A fault is noticed if the agent refuses the image with a
sentence, or if its belief is in doubt; else the agent may go on to look (silent), or be sure, and then right or wrong. Ends
with 1 if anything else than a `ValueError` is raised, or a sound image is not taken.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np

import mevs_jax
from data_pipeline.capture.casting import default_caster
from data_pipeline.objects.sources import furniture10, load_object
from mevs_jax.agent import Agent
from tests.cameras.faults import ONE, Given, taken

DIRECTIONS = (
    np.array([(0.8, 0.3, 0.5), (-0.4, 0.9, 0.3)]) / np.linalg.norm([(0.8, 0.3, 0.5), (-0.4, 0.9, 0.3)], axis=1)[:, None]
)
OUTCOMES = ("refused", "in doubt", "silent", "sure and right", "sure and WRONG")


def outcome(agent: Agent, given: Given, name: str) -> str:
    """What the agent makes of one image, whose object is of a class."""
    try:
        agent.reset(center=given.center, radius=given.radius, up=given.up)
        belief = agent.observe(given.depth, given.K, given.pose, mask=given.mask, floor=given.floor)
    except ValueError:
        return "refused"
    if belief.doubt:
        return "in doubt"
    if agent.decide(reachable=[0]).reason != "sure":
        return "silent"
    return "sure and right" if belief.name == name else "sure and WRONG"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--pieces", type=int, default=3, help="of furniture, each of another class")
    parser.add_argument("--to", type=Path, help="a file for the table")
    options = parser.parse_args()
    agent, views, wrong = mevs_jax.load("furniture10").agent(max_views=20), [], 0
    pieces = [entry for entry in furniture10(2, 1).entries if entry.split == "test"]
    chosen = [2, 9, 5, 8, 1, 7, 0, 3, 4, 6][: options.pieces]  # the chair first, and what is unlike it
    for entry in (pieces[at] for at in chosen):
        mesh = load_object(entry)
        cast, lowest = default_caster()(mesh), float(mesh.vertices[:, 2].min())
        name = entry.name.rsplit("_test_", 1)[0]
        views += [(name, taken(cast, one, lowest=lowest, room=room)) for one in DIRECTIONS for room in (False, True)]
    rows = {"sound images": Counter(outcome(agent, given, name) for name, given in views)}
    wrong += rows["sound images"]["refused"] + rows["sound images"]["in doubt"]
    for kind, faults in ONE.items():
        for fault, change in faults.items():
            try:
                rows[f"{kind}: {fault}"] = Counter(outcome(agent, change(given), name) for name, given in views)
            except Exception as error:
                wrong += 1
                print(f"{kind}: {fault}: {type(error).__name__}: {error}")
    late = rows["two images: one pose for both"] = Counter()
    for (name, given), (_, other) in zip(views, [*views[2:], *views[:2]], strict=True):
        with suppress(ValueError):
            outcome(agent, given, name)
            agent.observe(other.depth, given.K, given.pose, mask=other.mask)
            late["silent"] += 1
            continue
        late["refused"] += 1
    lines = ["fault | " + " | ".join(OUTCOMES), "---" + "|---" * len(OUTCOMES)]
    lines += [f"{fault} | " + " | ".join(str(counted[one]) for one in OUTCOMES) for fault, counted in rows.items()]
    print("\n".join(lines))
    if options.to is not None:
        options.to.write_text("\n".join(lines) + "\n", encoding="utf-8")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
