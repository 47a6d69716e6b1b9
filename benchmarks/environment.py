"""Steps a second of `ActiveRecognition`, beside environments of ap_gym and Gymnasium: `python benchmarks/environment.py`.

All environments run many episodes at once. A step of one episode counts as one step. The pure environment draws its actions in
the compiled loop; vector environments are given actions that were drawn beforehand. Calls take turns, and rates are medians.
Peers that are not installed (`pip install -e '.[ap-gym,gymnax]'`) are left out. The table is kept in
`benchmarks/results/environment.md`.

The peers compute other observations: a glimpse of an image (CircleSquare, which needs no download), and a pole's four numbers.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import tyro

from benchmarks.comparing import seconds_of
from benchmarks.evaluation import CLASSES, VIEWS, made_up_tables
from benchmarks.reporting import RESULTS, Row, Table, machine_name
from data_pipeline.files import write_text
from mevs_jax import ActiveRecognition, ViewGraph, fibonacci_sphere

TABLE = Table(
    "environment | episodes at once | steps a second",
    "{name} | {episodes:,} | {rates[1]:,.0f} ({rates[0]:,.0f}–{rates[2]:,.0f})",
)
OBJECTS, MAX_VIEWS = 800, 9


@dataclass(frozen=True)
class Measured:
    """One environment: `call` makes `steps` steps."""

    name: str
    episodes: int
    steps: int
    call: Callable[[], Any]


def environment_of(entropies: bool) -> ActiveRecognition:
    tables = jax.tree.map(lambda leaf: leaf[:OBJECTS], made_up_tables())
    predicted = tables.predicted_entropy if entropies else None
    tables = replace(tables, logits=tables.logits[:, 0], predicted_entropy=predicted, entropy=None)
    return ActiveRecognition(tables, ViewGraph.from_points(fibonacci_sphere(VIEWS)), max_views=MAX_VIEWS)


def pure(episodes: int, steps: int, entropies: bool) -> Measured:
    """The pure environment in a scan of `step_autoreset`, with random views."""
    environment = environment_of(entropies)

    @jax.jit
    def walk(environment: ActiveRecognition, key: jax.Array) -> jax.Array:
        def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[Any, jax.Array]:
            states, observations = carry
            keys = jax.random.split(key, episodes + 1)
            views = jax.random.randint(keys[-1], (episodes,), 0, VIEWS)
            actions = {"action": views, "prediction": observations.belief}
            found = jax.vmap(environment.step_autoreset)(keys[:-1], states, actions)
            return found[:2], found[2].mean()

        keys = jax.random.split(key, steps + 1)
        start = jax.vmap(environment.reset)(jax.random.split(keys[-1], episodes))
        return jax.lax.scan(step, start, keys[:-1])[1]

    name = "`ActiveRecognition`, compiled" + (", with predicted entropies" if entropies else "")
    return Measured(name, episodes, episodes * steps, lambda: walk(environment, jax.random.key(0)))


def in_form_of_gymnax(episodes: int, steps: int) -> Iterator[Measured]:
    """The same in the form of gymnax, if it is installed."""
    try:
        from mevs_jax.environment.gymnax import ViewSelection
    except ImportError as error:
        print(f"left out: {error}", file=sys.stderr)
        return
    env = ViewSelection(environment_of(False))

    @jax.jit
    def walk(key: jax.Array) -> jax.Array:
        def step(states: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            keys = jax.random.split(key, episodes + 1)
            views = jax.random.randint(keys[-1], (episodes,), 0, VIEWS)
            found = jax.vmap(env.step, (0, 0, 0, None))(keys[:-1], states, views, env.default_params)
            return found[1], found[2].mean()

        keys = jax.random.split(key, steps + 1)
        _, start = jax.vmap(env.reset, (0, None))(jax.random.split(keys[-1], episodes), env.default_params)
        return jax.lax.scan(step, start, keys[:-1])[1]

    yield Measured("gymnax's form, compiled", episodes, episodes * steps, lambda: walk(jax.random.key(0)))


def single(steps: int = 200) -> Iterator[Measured]:
    """The environment of Gymnasium whose actions are views, if it is installed."""
    try:
        from mevs_jax.gymnasium import ViewSelectionEnv
    except ImportError as error:
        print(f"left out: {error}", file=sys.stderr)
        return
    env, views = ViewSelectionEnv(environment_of(False)), np.random.default_rng(0).integers(VIEWS, size=steps)

    def call() -> None:
        for number, view in enumerate(views):
            if number % MAX_VIEWS == 0:
                env.reset()
            env.step(view)

    yield Measured("`ViewSelectionEnv`", 1, steps, call)


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

        from mevs_jax.gymnasium import ActiveRecognitionVectorEnv
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


def main(episodes: int = 4096, steps: int = 200, vectors: tuple[int, ...] = (64, 1024), repeats: int = 7) -> None:
    """Measures, shows and keeps.

    Args:
        episodes: at once in the pure environment.
        steps: of the pure environment in one call.
        vectors: episodes at once in vector environments.
        repeats: calls of each, whose median is taken.
    """
    measured = [pure(episodes, steps, entropies) for entropies in (False, True)]
    measured += [*in_form_of_gymnax(episodes, steps), *single(), *(one for count in vectors for one in vector(count))]
    for one in measured:
        seconds_of(one.call)  # compiles
    taken = np.array([[seconds_of(one.call) for one in measured] for _ in range(repeats)])

    def row_of(one: Measured, seconds: np.ndarray) -> Row:
        rates = np.quantile(one.steps / seconds, (0.25, 0.5, 0.75)).tolist()
        return {"name": one.name, "episodes": one.episodes, "rates": rates}

    rows = TABLE.show(map(row_of, measured, taken.T))
    where = f"{machine_name()}, {len(os.sched_getaffinity(0))} cores"
    head = f"{where}. Steps a second: median (quartiles) of {repeats} calls."
    write_text(RESULTS / "environment.md", f"{head}\n\n{TABLE.markdown(rows)}\n")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
