"""Operations timed together with their peers, in one process."""

from __future__ import annotations

import importlib.util
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from data_pipeline.files import read_json
from mevs_jax.markdown import markdown_row

GUARD = 3.0
HEADER = ("what", "ours", "peer", "theirs", "ratio", "")


@dataclass
class Row:
    """An operation timed together with one peer.

    Attributes:
        what, peer: names of the operation and of the peer.
        ours, theirs: lower quartile, median and upper quartile, in milliseconds.
        ratio: their time divided by ours.
        note: differences between the two results.
    """

    what: str
    peer: str
    ours: list[float]
    theirs: list[float]
    ratio: float
    note: str = ""


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
            start = time.perf_counter()
            jax.block_until_ready(calls[number]())
            taken[number, turn] = 1000 * (time.perf_counter() - start)
    return taken


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
) -> list[Row]:
    calls = [ours, *peers.values()]
    taken = take_turns(calls, rounds) if turns else np.concatenate([take_turns([call], rounds) for call in calls])
    quartiles = np.quantile(taken, [0.25, 0.5, 0.75], axis=1).T
    rows = [
        Row(what, peer, list(quartiles[0]), list(theirs), theirs[1] / quartiles[0, 1], (notes or {}).get(peer, ""))
        for peer, theirs in zip(peers, quartiles[1:], strict=True)
    ]
    for row in rows:
        print(markdown_row(row_cells(row)), flush=True)
    return rows


def installed(name: str) -> bool:
    found = importlib.util.find_spec(name) is not None
    if not found:
        print(f"(without {name}, which is not installed)")
    return found


def peer_device() -> str:
    """Device of PyTorch: the GPU if JAX uses one and PyTorch can, otherwise the CPU."""
    import torch

    return "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"


def finished(call: Callable[[], Any]) -> Callable[[], Any]:
    """Wraps a PyTorch call so that it returns after its device has finished."""
    import torch

    def until_done() -> Any:
        out = call()
        if peer_device() == "cuda":
            torch.cuda.synchronize()
        return out

    return until_done


def row_cells(row: Row) -> list[str]:
    ours, theirs = (f"{m:.3g} ({low:.3g}–{high:.3g})" for low, m, high in (row.ours, row.theirs))
    return [row.what, ours, row.peer, theirs, f"{row.ratio:.3g}", row.note]


def slower_than_before(rows: list[Row], before: dict[str, Any]) -> list[str]:
    """Messages about ratios below a third of the stored ones; only rows that exist in both are compared."""
    stored = {(row["what"], row["peer"]): row["ratio"] for row in before["rows"]}
    known = [(row, stored[row.what, row.peer]) for row in rows if (row.what, row.peer) in stored]
    return [
        f"{row.what}: {row.ratio:.2g} times as fast as {row.peer}, stored {ratio:.2g}"
        for row, ratio in known
        if row.ratio < ratio / GUARD
    ]


def end_by_guard(rows: list[Row], stored: Path) -> None:
    """Ends the program, with exit code 1 and messages if a ratio is below a third of the stored one."""
    slower = slower_than_before(rows, read_json(stored))
    for sentence in slower:
        print(f"slower than before: {sentence}", file=sys.stderr)
    sys.exit(bool(slower))


def training_step(network: nnx.Module, loss_of: Callable[..., jax.Array]) -> Callable[..., Any]:
    """A compiled step of Adam on the inputs that it is called with. Every call goes on from the last, in the same memory."""
    structure, parameters, *rest = nnx.split(network, nnx.Param, ...)
    others = rest[0]
    adam = optax.adam(1e-5)
    moments = adam.init(parameters)

    @partial(jax.jit, donate_argnums=0)
    def step(state, *inputs):
        parameters, others, moments = state

        def loss(parameters):
            network = nnx.merge(structure, parameters, others, copy=True)
            return loss_of(network, *inputs), nnx.state(network, nnx.Not(nnx.Param))

        (value, others), gradients = jax.value_and_grad(loss, has_aux=True)(parameters)
        updates, moments = adam.update(gradients, moments)
        return (optax.apply_updates(parameters, updates), others, moments), value

    state = jax.tree.map(jnp.copy, (parameters, others, moments))

    def call(*inputs):
        nonlocal state
        state, value = step(state, *inputs)
        return value

    return call


def forward_of(network: nnx.Module) -> Callable[[jax.Array], jax.Array]:
    structure, state = nnx.split(network)
    return lambda inputs: nnx.merge(structure, state, copy=True)(inputs)


def classification_loss(network: Callable[..., jax.Array], images: jax.Array, labels: jax.Array) -> jax.Array:
    return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(network(images, train=True), labels))


def machine_name() -> str:
    return f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, JAX {jax.__version__}"
