"""A trained run, asked about one object of its data set: `python examples/load_and_ask.py [RUN]`.

It looks at the object from one view, and prints what the classifier says and which view the policy by expected information gain
would take next, until it is confident. RUN is a directory in which `mevs run` has been run (default: runs/demo).
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from data_pipeline.dataset.statistics import load_statistics
from eval.tables import load_view_tables
from eval.walks.knowledge import learn
from mevs_jax import POLICIES, select_from_table


def main(run: Path, position: int = 0, start: int = 0) -> None:
    statistics = load_statistics(run / "data")
    graph = statistics.graph
    test, validation = (load_view_tables(run / "tables" / f"{split}.npz") for split in ("test", "val"))
    knowledge = learn(jnp.asarray(validation.logits), jnp.asarray(validation.labels))
    table = jax.tree.map(lambda leaf: leaf[position], test.stacked())
    walk = select_from_table(
        jax.random.key(0),
        table,
        table.scene(graph, knowledge),
        POLICIES["information_gain"],
        start,
        threshold=0.95,
        max_views=min(5, statistics.views),
    )
    print(f"{test.names[position]}, seen from view {start} first:")
    for view, label, confidence in zip(walk.views, walk.predictions, walk.confidences, strict=True):
        if view >= 0:
            print(f"  view {view}: {statistics.classes[label]}, {100 * confidence:.0f} % confident")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo"))
