"""Effect of folded batch norm and of bfloat16 on accuracy: `python benchmarks/precision.py RUN`.

RUN is a directory made by `mevs run`. Every view of every test object is evaluated with the same weights in three
ways: float32 with separate batch norm layers, float32 with batch norm folded into the weights (as in inference), and
bfloat16 with folded batch norm. The table has the differences from the first with 95 % intervals paired by object,
and how often the first decision is the same, which is the view that the thesis's rule chooses after one cloud.

The table is written to `benchmarks/results/precision.md`.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.files import write_text
from eval.settings import PRESETS
from eval.stages import tasks
from eval.tables import objects_of
from mevs_jax import bootstrap_interval, maxima_first
from mevs_jax.markdown import markdown_table
from mevs_jax.models.batch_norm import BatchNorm
from train.loop import load_best
from train.results.outputs import network_outputs

RESULTS = Path(__file__).parent / "results" / "precision.md"


class Unfolded(nnx.Module):
    """A network with separate batch norm layers, as in training, but with the running statistics."""

    def __init__(self, network: nnx.Module):
        self.network = network

    def __call__(self, inputs: jax.Array) -> jax.Array:
        by_batch = BatchNorm.__call__

        def by_running_statistics(
            norm: BatchNorm, x: jax.Array, *, train: bool = False, momentum: object = None
        ) -> jax.Array:
            del train, momentum
            return by_batch(norm, x)

        BatchNorm.__call__ = by_running_statistics  # type: ignore[assignment, method-assign]
        try:
            if hasattr(self.network, "views"):
                return self.network(inputs, train=True, key=jax.random.key(0), dropout=0.0)
            return self.network(inputs, train=True)
        finally:
            BatchNorm.__call__ = by_batch  # type: ignore[method-assign]


def interval(by_object: np.ndarray) -> str:
    low, high = np.asarray(bootstrap_interval(jax.random.key(0), jnp.asarray(by_object)))
    return f"{by_object.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


def main() -> None:
    if len(sys.argv) != 2 or not (Path(sys.argv[1]) / "metrics.json").exists():
        print("usage: python benchmarks/precision.py RUN, where RUN was made by `mevs run`", file=sys.stderr)
        sys.exit(2)
    run = Path(sys.argv[1])
    statistics = load_statistics(run / "data")
    classify, predict = tasks(PRESETS["small"], statistics)
    graph = statistics.graph
    _, labels, entropy = objects_of(run / "data", "test", statistics)
    variance = np.square(entropy - entropy.mean()).mean()

    @jax.jit
    def first_choices(predicted_entropy: jax.Array) -> jax.Array:
        def choice(start: jax.Array, weights: jax.Array) -> jax.Array:
            allowed = jnp.arange(statistics.views) != start
            return jnp.argmax(jnp.where(allowed, maxima_first(weights, allowed, graph.neighbours), -jnp.inf))

        return jax.vmap(jax.vmap(choice), in_axes=(None, 0))(jnp.arange(statistics.views), predicted_entropy)

    found = {}
    dtypes: list[tuple[str, Literal["float32", "bfloat16"], Callable[[Any], Any]]] = [
        ("float32, batch norm by itself", "float32", Unfolded),
        ("float32, folded", "float32", lambda network: network),
        ("bfloat16, folded", "bfloat16", lambda network: network),
    ]
    for name, dtype, wrap in dtypes:
        outputs = []
        for task, folder in ((classify, "classifier"), (predict, "entropy")):
            saved = replace(task, optimiser=replace(task.optimiser, compute=dtype))
            network = load_best(saved, run / folder)
            outputs.append(network_outputs(run / "data", "test", saved, wrap(network)))
        logits, predicted_entropy = outputs
        error = np.square(predicted_entropy - entropy[:, None]).mean(axis=(1, 2))
        found[name] = {
            "right": (logits.argmax(-1) == labels[:, None]).mean(axis=1),
            "error": error,
            "logits": logits,
            "entropy": predicted_entropy,
            "chosen": np.asarray(first_choices(jnp.asarray(predicted_entropy))),
        }
        print(name, f"{100 * found[name]['right'].mean():.2f} %, R² {1 - error.mean() / variance:.4f}", flush=True)
    first = next(iter(found.values()))
    columns = (
        "calculated in",
        "accuracy of single views, %",
        "difference, points",
        "R² of entropies",
        "difference of squared errors, % of variance",
        "logits differ by at most",
        "entropies",
        "first choice the same",
    )
    rows = [
        [
            name,
            f"{100 * by['right'].mean():.2f}",
            interval(100 * (by["right"] - first["right"])),
            f"{1 - by['error'].mean() / variance:.4f}",
            interval(100 * (by["error"] - first["error"]) / variance),
            f"{np.abs(by['logits'] - first['logits']).max():.1e}",
            f"{np.abs(by['entropy'] - first['entropy']).max():.1e}",
            f"{100 * (by['chosen'] == first['chosen']).mean():.2f} %",
        ]
        for name, by in found.items()
    ]
    measured = f"{len(labels)} test objects × {statistics.views} views; {platform.machine()}, {jax.default_backend()}."
    text = f"{measured}\n\n{markdown_table(columns, rows)}\n"
    write_text(RESULTS, text)
    print(text, end="")


if __name__ == "__main__":
    main()
