"""Steps a second of `ActiveRecognition`, beside environments of ap_gym and Gymnasium: `python benchmarks/environment.py`.

All environments run many episodes at once. A step of one episode counts as one step. The pure environment draws its actions in
the compiled loop; vector environments are given actions that were drawn beforehand. Calls take turns, and rates are medians.
Peers that are not installed (`pip install -e '.[gym]'`) are left out. The table is kept in `benchmarks/results/environment.md`.

The peers compute other observations: a glimpse of an image (CircleSquare, which needs no download), and a pole's four numbers.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from data_pipeline.files import write_text
from mevs_jax import ActiveRecognition, ViewGraph, ViewTable, fibonacci_sphere
from mevs_jax.markdown import markdown_table

RESULT = Path(__file__).parent / "results" / "environment.md"
OBJECTS, VIEWS, CLASSES, MAX_VIEWS = 800, 40, 10, 9


@dataclass(frozen=True)
class Options:
    """What is measured, and how often."""

    episodes: int = 4096
    """episodes at once in the pure environment"""
    steps: int = 200
    """steps of the pure environment in one call"""
    vector: tuple[int, ...] = (64, 1024)
    """episodes at once in vector environments"""
    repeats: int = 7
    """calls of each, whose median is taken"""


@dataclass(frozen=True)
class Measured:
    """One environment: `call` makes `steps` steps."""

    name: str
    episodes: int
    steps: int
    call: Callable[[], Any]


def environment_of(entropies: bool) -> ActiveRecognition:
    random = np.random.default_rng(0)
    tables = ViewTable(
        logits=jnp.asarray(random.normal(0, 2, (OBJECTS, VIEWS, CLASSES)), jnp.float32),
        predicted_entropy=jnp.asarray(random.uniform(size=(OBJECTS, VIEWS, VIEWS)), jnp.float32) if entropies else None,
        entropy=None,
        label=jnp.asarray(random.integers(0, CLASSES, OBJECTS), jnp.int32),
    )
    return ActiveRecognition(tables, ViewGraph.from_points(fibonacci_sphere(VIEWS)), max_views=MAX_VIEWS)


def pure(options: Options, entropies: bool) -> Measured:
    """The pure environment in a scan of `step_autoreset`, with random views."""
    environment, count = environment_of(entropies), options.episodes

    @jax.jit
    def walk(environment: ActiveRecognition, key: jax.Array) -> jax.Array:
        def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[Any, jax.Array]:
            states, observations = carry
            keys = jax.random.split(key, count + 1)
            views = jax.random.randint(keys[-1], (count,), 0, VIEWS)
            actions = {"action": views, "prediction": observations.belief}
            found = jax.vmap(environment.step_autoreset)(keys[:-1], states, actions)
            return found[:2], found[2].mean()

        keys = jax.random.split(key, options.steps + 1)
        start = jax.vmap(environment.reset)(jax.random.split(keys[-1], count))
        return jax.lax.scan(step, start, keys[:-1])[1]

    name = "`ActiveRecognition`, compiled" + (", with predicted entropies" if entropies else "")
    return Measured(
        name, count, count * options.steps, lambda: jax.block_until_ready(walk(environment, jax.random.key(0)))
    )


def stepping(name: str, envs: Any, actions: list[Any]) -> Measured:
    """A vector environment of Gymnasium, which takes `actions` one after another."""
    envs.reset(seed=0)

    def call() -> None:
        for action in actions:
            envs.step(action)

    return Measured(name, envs.num_envs, envs.num_envs * len(actions), call)


def vector(count: int) -> Iterator[Measured]:
    """Our vector environment and its peers, as far as they are installed."""
    random, steps = np.random.default_rng(0), 32
    try:
        import ap_gym
        import gymnasium

        from mevs_jax.environment.gymnasium import ActiveRecognitionVectorEnv
    except ImportError as error:
        print(f"left out: {error}", file=sys.stderr)
        return
    ours = [
        {"action": random.integers(VIEWS, size=count), "prediction": random.normal(size=(count, CLASSES))}
        for _ in range(steps)
    ]
    yield stepping("`ActiveRecognitionVectorEnv`", ActiveRecognitionVectorEnv(environment_of(False), count), ours)
    circles = ap_gym.make_vec("CircleSquare-v0", num_envs=count, vectorization_mode="vector_entry_point")
    glimpses = [
        {"action": random.uniform(-1, 1, (count, 2)).astype(np.float32), "prediction": random.normal(size=(count, 2))}
        for _ in range(steps)
    ]
    yield stepping("ap_gym, CircleSquare-v0", circles, glimpses)
    poles = gymnasium.make_vec("CartPole-v1", num_envs=count, vectorization_mode="vector_entry_point")
    yield stepping("Gymnasium, CartPole-v1 in NumPy", poles, [random.integers(2, size=count) for _ in range(steps)])


def main(options: Options) -> None:
    measured = [pure(options, entropies) for entropies in (False, True)]
    measured += [one for count in options.vector for one in vector(count)]
    times: list[list[float]] = [[] for _ in measured]
    for one in measured:
        one.call()  # compiles
    for _ in range(options.repeats):
        for one, taken in zip(measured, times, strict=True):
            start = time.perf_counter()
            one.call()
            taken.append(time.perf_counter() - start)
    rows = []
    for one, taken in zip(measured, times, strict=True):
        fastest, median, slowest = (one.steps / np.quantile(taken, (0.25, 0.5, 0.75))).tolist()
        rows.append([one.name, f"{one.episodes:,}", f"{median:,.0f} ({slowest:,.0f}–{fastest:,.0f})"])
    table = markdown_table(["environment", "episodes at once", "steps a second"], rows)
    print(table)
    where = (
        f"{platform.machine()}, {len(os.sched_getaffinity(0))} cores, {jax.default_backend()}, JAX {jax.__version__}"
    )
    write_text(RESULT, f"{where}. Steps a second: median (quartiles) of {options.repeats} calls.\n\n{table}\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
