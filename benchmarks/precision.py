"""Effect of folded batch norm and of bfloat16 on accuracy: `python benchmarks/precision.py RUN`.

RUN is a directory made by `mevs run`. Every view of every test object is evaluated with the same weights in three
ways: float32 with separate batch norm layers, float32 with batch norm folded into the weights (as in inference), and
bfloat16 with folded batch norm. The table has the differences from the first with 95 % intervals paired by object,
and how often the first decision is the same, which is the view that the thesis's rule chooses after one cloud.

The table is written to `benchmarks/results/precision.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx
from jaxtyping import Float, Int

from benchmarks.reporting import RESULTS, Row, Table, machine_name, refuse
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.files import write_text
from eval.run_file import load_run
from eval.runs import tasks
from eval.settings import SMALL
from eval.tables import objects_of
from mevs_jax import ViewGraph, bootstrap_interval, maxima_first
from mevs_jax.models.batch_norm import BatchNorm
from train.loop import load_best
from train.results.outputs import network_outputs

TABLE = Table(
    "calculated in | accuracy of single views, % | difference, points | R² of entropies | "
    "difference of squared errors, % of variance | logits differ by at most | entropies | first choice the same",
    "{name} | {accuracy:.2f} | {difference} | {R²:.4f} | "
    "{difference of errors} | {logits:.1e} | {entropies:.1e} | {same:.2f} %",
)


class Unfolded(nnx.Module):
    """A network with separate batch norm layers, as in training, but with the running statistics."""

    def __init__(self, network: nnx.Module):
        self.network = network

    def __call__(self, inputs: jax.Array) -> jax.Array:
        def by_running_statistics(norm: BatchNorm, x: jax.Array, **_: object) -> jax.Array:
            return by_batch(norm, x)

        by_batch = BatchNorm.__call__
        options = {"key": jax.random.key(0), "dropout": 0.0} if hasattr(self.network, "views") else {}
        with mock.patch.object(BatchNorm, "__call__", by_running_statistics):
            return self.network(inputs, train=True, **options)


def interval(by_object: np.ndarray) -> str:
    low, high = np.asarray(bootstrap_interval(jax.random.key(0), jnp.asarray(by_object)))
    return f"{by_object.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


@dataclass(frozen=True)
class Outputs:
    """What both networks say of every view of every object, calculated in one way; `chosen` are the first decisions."""

    right: Float[np.ndarray, " objects"]
    error: Float[np.ndarray, " objects"]
    logits: Float[np.ndarray, "objects views classes"]
    entropy: Float[np.ndarray, "objects seen views"]
    chosen: Int[np.ndarray, "objects views"]


def first_choices(predicted_entropy: jax.Array, graph: ViewGraph) -> jax.Array:
    """The view that the thesis's rule chooses after each first view, (objects, views)."""
    others = ~jnp.eye(len(graph.points), dtype=bool)
    scores = jax.vmap(jax.vmap(partial(maxima_first, neighbours=graph.neighbours)), (0, None))(
        predicted_entropy, others
    )
    return jnp.argmax(jnp.where(others, scores, -jnp.inf), axis=-1)


def row_of(name: str, by: Outputs, first: Outputs, variance: float) -> Row:
    return {
        "name": name,
        "accuracy": 100 * by.right.mean(),
        "difference": interval(100 * (by.right - first.right)),
        "R²": 1 - by.error.mean() / variance,
        "difference of errors": interval(100 * (by.error - first.error) / variance),
        "logits": np.abs(by.logits - first.logits).max(),
        "entropies": np.abs(by.entropy - first.entropy).max(),
        "same": 100 * (by.chosen == first.chosen).mean(),
    }


def main(run: Annotated[Path, tyro.conf.Positional]) -> None:
    if not (run / "metrics.json").exists():
        refuse(f"{run} was not made by `mevs run`")
    statistics, made = load_statistics(run / "data"), load_run(run)
    both: Sequence[Any] = tasks(SMALL if made is None else made.settings, statistics)
    _, labels, entropy = objects_of(run / "data", "test", statistics)

    def calculate(dtype: Literal["float32", "bfloat16"], wrap: Callable[[Any], Any]) -> Outputs:
        outputs = []
        for task, folder in zip(both, ("classifier", "entropy"), strict=True):
            saved = replace(task, optimiser=replace(task.optimiser, compute=dtype))
            outputs.append(network_outputs(run / "data", "test", saved, wrap(load_best(saved, run / folder))))
        logits, predicted_entropy = outputs
        right = (logits.argmax(-1) == labels[:, None]).mean(axis=1)
        error = np.square(predicted_entropy - entropy[:, None]).mean(axis=(1, 2))
        chosen = first_choices(jnp.asarray(predicted_entropy), statistics.graph)
        return Outputs(right, error, logits, predicted_entropy, np.asarray(chosen))

    ways = {
        "float32, batch norm by itself": calculate("float32", Unfolded),
        "float32, folded": calculate("float32", lambda network: network),
        "bfloat16, folded": calculate("bfloat16", lambda network: network),
    }
    variance, first = float(np.square(entropy - entropy.mean()).mean()), next(iter(ways.values()))
    rows = TABLE.show(row_of(name, by, first, variance) for name, by in ways.items())
    measured = f"{len(labels)} test objects × {statistics.views} views; {machine_name()}."
    write_text(RESULTS / "precision.md", f"{measured}\n\n{TABLE.markdown(rows)}\n")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
