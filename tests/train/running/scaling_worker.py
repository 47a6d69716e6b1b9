"""Trains in a process of its own, on as many simulated devices as asked for: `python scaling_worker.py '{"devices": 8, …}'`."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

import jax
from jax.sharding import Mesh

import train.loop
from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import load_statistics
from eval.runs import tasks
from eval.settings import TINY
from tests.reference.quick import quick_tasks
from train.running.devices import DATA, MODEL, device_mesh, parameter_sharding, place, place_batch
from train.running.preemption import Preempted
from train.step import initial_state, train_step_of

_BRIEF = replace(TINY.classifier.optimiser, epochs=4, learning_rate=1e-4)

SETTINGS = replace(
    TINY,
    classifier=replace(TINY.classifier, optimiser=_BRIEF),
    entropy=replace(TINY.entropy, optimiser=_BRIEF),
)
"""Both networks with augmentation, PointNet++ with dropout. A low learning rate: once in some dozens of steps rounding decides
whether a rectified unit is on, and what follows from that grows with the rate."""


COLLECTIVES = re.compile(r"\b(all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute)(?:-start)?\(")


def losses(data: Path, mesh: Mesh, steps: int) -> tuple[dict[str, list[float]], dict[str, list[str]]]:
    """The training loss of the first steps, and how devices talk in a step, by network.

    Both networks, and PointNet++ alone where weights are split.
    """
    out, talk = {}, {}
    for task in tasks(SETTINGS, load_statistics(data))[0 if mesh.shape["model"] == 1 else -1 :]:
        structure, state = initial_state(task, task.optimiser.seed)
        where = parameter_sharding(mesh, state)
        state = place(state, where)
        step = jax.jit(train_step_of(task, structure, steps), donate_argnums=0, out_shardings=(where, None))
        batches = train_batches(data, task.batches)
        program, found = None, []
        for _ in range(steps):
            batch = place_batch(mesh, next(batches))
            program = program or step.lower(state, batch, task.hyperparameters).compile()
            state, loss = program(state, batch, task.hyperparameters)
            found.append(loss)
        talk[task.name] = sorted(set(COLLECTIVES.findall(program.as_text())))
        out[task.name] = [float(loss) for loss in found]
    return out, talk


def fit_until(data: Path, out: Path, stop_at: int, by: int = signal.SIGTERM, every: int = 1000) -> None:
    """Trains the quick predictor; at the batch of number `stop_at` the process gets the signal `by`.

    Args:
        every: steps between checkpoints within an epoch.
    """
    real = train.loop.train_batches

    def batches(*arguments, first_step: int = 0):
        for number, batch in enumerate(real(*arguments, first_step=first_step), first_step):
            if number == stop_at:
                os.kill(os.getpid(), by)
            yield batch

    train.loop.train_batches = batches
    statistics = load_statistics(data)
    task = quick_tasks(statistics, checkpoint_steps=every)[1]
    try:
        train.loop.fit(task, data, statistics, out)
    except Preempted:
        sys.exit(143)


def meshes() -> dict[str, Mesh]:
    """One device, all of them, and all of them with weights split in two."""
    return {"1": Mesh([[jax.devices()[0]]], (DATA, MODEL)), "all": device_mesh(), "split": device_mesh(2)}


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    jax.config.update("jax_num_cpu_devices", asked["devices"])
    assert len(jax.devices()) == asked["devices"]
    if "steps" in asked:
        print(json.dumps({name: losses(Path(asked["data"]), mesh, asked["steps"]) for name, mesh in meshes().items()}))
    else:
        given = {name: asked[name] for name in ("by", "every") if name in asked}
        fit_until(Path(asked["data"]), Path(asked["out"]), asked["stop_at"], **given)
