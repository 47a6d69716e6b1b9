"""The thesis's whole evaluation as one program, compared with a loop over objects as in the published code.

The grid has about 900 objects × 40 start views × 3 policies × 3 backbones × limits of 2–9 views × 7 confidence
thresholds, from tables of random logits and entropies (the time does not depend on their values). The published
evaluation walks every object again for each cell, in Python. Here the loop reads the same tables, without networks,
on a subset, and its time is scaled up. Its predictions are compared with those of the program. `make bench` runs
this. The peak memory is that of the process before the loop.
"""

from __future__ import annotations

import resource
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.comparing import seconds_of
from benchmarks.reporting import RESULTS, Table, keep, machine_name
from eval.walks.grid import FIRST_MV, LAST_MV, THRESHOLDS, run_grid
from mevs_jax import Knowledge, ViewGraph, ViewTable, fibonacci_sphere
from mevs_jax.policies import policy_record
from tests.reference import numpy_rules

OBJECTS, VIEWS, CLASSES, BACKBONES = 908, 40, 10, 3
COMPARED = tuple(map(policy_record, ("random", "predicted_entropy", "oracle_entropy")))
SUBSET = 4
TABLE = Table(
    "walks | program, s | slowest of 15 | compiling, s | peak memory, GiB | loop, s (scaled) | ratio",
    "{walks:,} | {seconds:.3f} | {slowest_seconds:.3f} | {compile_and_first_run_seconds:.1f} | "
    "{peak_memory_gib:.2f} | {loop_seconds_scaled:,.0f} | {times_faster:,.0f}×",
)


def made_up_tables() -> ViewTable:
    random = np.random.default_rng(0)
    return ViewTable(
        logits=jnp.asarray(random.normal(0, 2, (OBJECTS, BACKBONES, VIEWS, CLASSES)), jnp.float32),
        predicted_entropy=jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS, VIEWS)), jnp.float32),
        entropy=jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS)), jnp.float32),
        label=jnp.asarray(random.integers(0, CLASSES, OBJECTS), jnp.int32),
    )


@cache
def graph_and_knowledge() -> tuple[ViewGraph, Knowledge]:
    nothing = Knowledge(jnp.zeros((BACKBONES, VIEWS)), jnp.zeros((BACKBONES, CLASSES, VIEWS, CLASSES)))
    return ViewGraph.from_points(fibonacci_sphere(VIEWS)), nothing


def whole_grid(tables: ViewTable, seed: int = 0) -> dict[str, Any]:
    """The thesis's evaluation of all objects of the tables, by one seed."""
    return run_grid(jax.random.key(seed), tables, *graph_and_knowledge(), COMPARED, max_views=LAST_MV)


def loop_over_objects(tables: ViewTable, neighbours: np.ndarray, objects: int) -> np.ndarray:
    """Whether each prediction is right (objects, backbones, policies, MV, CT).

    As in the published code, every cell has its own walks, in plain Python on NumPy arrays. To save time, each object starts from
    only one view, as in one run of the published code.
    """
    logits, predicted_entropy, entropy, labels = (
        np.asarray(leaf) for leaf in (tables.logits, tables.predicted_entropy, tables.entropy, tables.label)
    )
    random = np.random.default_rng(0)
    shape = (objects, BACKBONES, len(COMPARED), LAST_MV - FIRST_MV + 1, len(THRESHOLDS))
    right = np.zeros(shape, bool)
    for index, backbone, policy, limit, threshold in np.ndindex(*shape):
        weights, graph = {
            "random": (random.uniform(0, 1, (LAST_MV + 1, VIEWS)), None),
            "predicted_entropy": (predicted_entropy[index], neighbours),
            "oracle_entropy": (np.broadcast_to(entropy[index], (VIEWS, VIEWS)), neighbours),
        }[COMPARED[policy].name]
        _, predictions, _ = numpy_rules.walk(
            logits[index, backbone], weights, graph, index % VIEWS, THRESHOLDS[threshold], FIRST_MV + limit
        )
        right[index, backbone, policy, limit, threshold] = predictions[-1] == labels[index]
    return right


def check(results: dict[str, Any], right: np.ndarray, tables: ViewTable) -> None:
    """Compares the predictions of the program with those of the loop, on the loop's objects and start views."""
    logits, labels = np.asarray(tables.logits), np.asarray(tables.label)
    for number, policy in enumerate(COMPARED):
        if policy.name == "random":
            continue
        views = np.asarray(results[policy.name].views)[0, : len(right), :, 0]
        for index, backbone in np.ndindex(len(right), BACKBONES):
            beliefs = np.cumsum(logits[index, backbone, views[index, index % VIEWS]], axis=0)
            sure = np.array([numpy_rules.softmax_confidence(belief) for belief in beliefs])
            for limit, column in np.ndindex(LAST_MV - FIRST_MV + 1, len(THRESHOLDS)):
                stops = np.flatnonzero(sure[: FIRST_MV + limit] >= THRESHOLDS[column])
                end = stops[0] if len(stops) else FIRST_MV + limit - 1
                answer = beliefs[end].argmax() == labels[index]
                assert answer == right[index, backbone, number, limit, column]


def main() -> None:
    tables, (graph, _) = made_up_tables(), graph_and_knowledge()
    compiling, *times = [seconds_of(lambda: whole_grid(tables)) for _ in range(16)]
    # Measured before the loop and the check below, so that they do not count. The unit on Linux is kilobytes.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    right: list[np.ndarray] = []
    loop = seconds_of(lambda: right.append(loop_over_objects(tables, np.asarray(graph.neighbours), SUBSET)))
    check(whole_grid(tables), right[0], tables)
    walks, per_walk, seconds = OBJECTS * VIEWS * right[0][0].size, loop / right[0].size, float(np.median(times))
    row = {
        "walks": walks,
        "compile_and_first_run_seconds": compiling,
        "seconds": seconds,
        "slowest_seconds": max(times),
        "peak_memory_gib": peak,
        "loop_seconds_per_walk": per_walk,
        "loop_seconds_scaled": per_walk * walks,
        "times_faster": per_walk * walks / seconds,
    }
    print(f"Measured on: {machine_name()}")
    keep(RESULTS / "evaluation.json", {"rows": TABLE.show([row])})


if __name__ == "__main__":
    tyro.cli(main)
