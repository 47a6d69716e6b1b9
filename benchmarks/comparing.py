"""Operations timed together with their peers, in one process."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from benchmarks.reporting import Row, Table
from data_pipeline.files import read_json

GUARD = 3.0
COMPARED = Table(
    "what | ours | peer | theirs | ratio | ",
    "{what} | {ours[1]:.3g} ({ours[0]:.3g}–{ours[2]:.3g}) | {peer} | "
    "{theirs[1]:.3g} ({theirs[0]:.3g}–{theirs[2]:.3g}) | {ratio:.3g} | {note}",
)
"""Times in milliseconds: lower quartile, median and upper quartile. The ratio is their median divided by ours."""
UNITS = "Milliseconds: median (quartiles)."
FLOOR = "its matrix products alone"
"""What nothing that computes the same can be faster than: a floor, not a peer."""


def take_turns(calls: list[Callable[[], Any]], rounds: int) -> np.ndarray:
    """Times in milliseconds (calls, rounds); each round runs every call once, after a warm-up, in another order.

    The threads of some libraries go on spinning for a while after a call, which would slow down the next one. So a call begins
    once they rest.
    """
    random = np.random.default_rng(0)
    for call in calls:
        jax.block_until_ready(call())
    taken = np.empty((len(calls), rounds))
    for turn in range(rounds):
        for number in random.permutation(len(calls)):
            _wait_for_rest()
            taken[number, turn] = 1000 * seconds_of(calls[number])
    return taken


def seconds_of(call: Callable[[], Any]) -> float:
    """Time of one call, until its result is ready."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def _wait_for_rest() -> None:
    """Returns once no thread of this process has worked for ten milliseconds; after a second with a message."""
    for _ in range(100):
        before = time.process_time()
        time.sleep(0.01)
        if time.process_time() - before < 0.001:
            return
    print("(threads of this process do not rest; they slow down the next call)", file=sys.stderr)


def compare(
    what: str,
    ours: Callable,
    peers: dict[str, Callable],
    rounds: int,
    notes: dict[str, str] | None = None,
    turns: bool = True,
) -> Iterator[Row]:
    """A row for each peer. Calls take turns, so that other load on the machine affects all of them, or come one after another."""
    calls = [ours, *peers.values()]
    taken = take_turns(calls, rounds) if turns else np.concatenate([take_turns([call], rounds) for call in calls])
    mine, *others = np.quantile(taken, [0.25, 0.5, 0.75], axis=1).T.tolist()
    notes = {FLOOR: "a floor, not a peer"} | (notes or {})
    for peer, theirs in zip(peers, others, strict=True):
        row = {"what": what, "peer": peer, "ours": mine, "theirs": theirs, "ratio": theirs[1] / mine[1]}
        yield row | {"note": notes.get(peer, "")}


def installed(name: str) -> bool:
    there = importlib.util.find_spec(name) is not None
    if not there:
        print(f"(without {name}, which is not installed)")
    return there


def torch_peers() -> Any:
    """The module `benchmarks.torch_peer`, or None without PyTorch."""
    return import_module("benchmarks.torch_peer") if installed("torch") else None


def end_by_guard(rows: list[Row], stored: Path) -> None:
    """Ends the program, with exit code 1 and messages if a ratio is below a third of the one stored, if there is one."""
    before = {(row["what"], row["peer"]): row["ratio"] for row in read_json(stored)["rows"]}
    slower = [row for row in rows if row["ratio"] < before.get((row["what"], row["peer"]), 0) / GUARD]
    for row in slower:
        ratio, expected = row["ratio"], before[row["what"], row["peer"]]
        text = f"{row['what']}: {ratio:.2g} times as fast as {row['peer']}, stored {expected:.2g}"
        print(f"slower than before: {text}", file=sys.stderr)
    sys.exit(bool(slower))


class TrainingStep:
    """A compiled step of training on the inputs that it is called with. Every call goes on from the last, in the same memory."""

    def __init__(
        self,
        network: nnx.Module,
        loss_of: Callable[..., jax.Array],
        optimiser: optax.GradientTransformation = optax.adam(1e-5),  # noqa: B008
    ) -> None:
        split: Any = nnx.split(network, nnx.Param, ...)
        structure, parameters, others = split

        def step(state, *inputs):
            parameters, others, moments = state

            def loss(parameters):
                network = nnx.merge(structure, parameters, others, copy=True)
                return loss_of(network, *inputs), nnx.state(network, nnx.Not(nnx.Param))

            (value, others), gradients = jax.value_and_grad(loss, has_aux=True)(parameters)
            updates, moments = optimiser.update(gradients, moments, parameters)
            return (optax.apply_updates(parameters, updates), others, moments), value

        self._structure, self._step = structure, jax.jit(step, donate_argnums=0)
        self._state = jax.tree.map(jnp.copy, (parameters, others, optimiser.init(parameters)))

    def __call__(self, *inputs: Any) -> jax.Array:
        self._state, loss = self._step(self._state, *inputs)
        return loss

    def network(self) -> Any:
        """As trained so far."""
        return nnx.merge(self._structure, *self._state[:2], copy=True)


def forward_of(network: nnx.Module) -> Callable[[jax.Array], jax.Array]:
    structure, state = nnx.split(network)
    return lambda inputs: nnx.merge(structure, state, copy=True)(inputs)


def classification_loss(network: Callable[..., jax.Array], images: jax.Array, labels: jax.Array) -> jax.Array:
    return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(network(images, train=True), labels))


def entropy_loss(network: Callable[..., jax.Array], clouds: jax.Array, entropies: jax.Array) -> jax.Array:
    return jnp.mean(jnp.square(network(clouds, train=True, key=jax.random.key(0)) - entropies))
