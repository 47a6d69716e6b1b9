"""The thesis's whole evaluation as one program, compared with a loop over objects as in the published code.

The grid has about 900 objects × 40 start views × 3 policies × 3 backbones × limits of 2–9 views × 7 confidence
thresholds, from tables of random logits and entropies (the time does not depend on their values). The published
evaluation walks every object again for each cell, in Python. Here the loop reads the same tables, without networks,
on a subset, and its time is scaled up. Its predictions are compared with those of the program. `make bench` runs
this. The peak memory is that of the process before the loop.
"""

from __future__ import annotations

import platform
import resource
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.files import write_json
from eval.walks.grid import FIRST_MV, LAST_MV, THRESHOLDS, run_grid
from mevs_jax import Knowledge, ViewGraph, ViewTable, fibonacci_sphere
from mevs_jax.markdown import markdown_table
from mevs_jax.policies import policy_record
from tests.reference import numpy_rules

OBJECTS, VIEWS, CLASSES, BACKBONES = 908, 40, 10, 3
COMPARED = tuple(map(policy_record, ("random", "predicted_entropy", "oracle_entropy")))
SUBSET = 4


def made_up_tables() -> ViewTable:
    random = np.random.default_rng(0)
    return ViewTable(
        logits=jnp.asarray(random.normal(0, 2, (OBJECTS, BACKBONES, VIEWS, CLASSES)), jnp.float32),
        predicted_entropy=jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS, VIEWS)), jnp.float32),
        entropy=jnp.asarray(random.uniform(0, 1, (OBJECTS, VIEWS)), jnp.float32),
        label=jnp.asarray(random.integers(0, CLASSES, OBJECTS), jnp.int32),
    )


def loop_over_objects(tables: ViewTable, neighbours: np.ndarray, objects: int) -> tuple[np.ndarray, int]:
    """Whether each prediction is right (objects, backbones, policies, MV, CT), and the number of walks.

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
    return right, right.size


def main() -> None:
    tables, graph = made_up_tables(), ViewGraph.from_points(fibonacci_sphere(VIEWS))
    nothing = Knowledge(jnp.zeros((BACKBONES, VIEWS)), jnp.zeros((BACKBONES, CLASSES, VIEWS, CLASSES)))

    def program(tables: ViewTable = tables):
        return jax.block_until_ready(run_grid(jax.random.key(0), tables, graph, nothing, COMPARED, max_views=LAST_MV))

    start = time.perf_counter()
    results = program()
    compiling = time.perf_counter() - start
    times = []
    for _ in range(15):
        start = time.perf_counter()
        program()
        times.append(time.perf_counter() - start)
    # Measured before the loop and the check below, so that they do not count. The unit on Linux is kilobytes.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    grid_cells = BACKBONES * len(COMPARED) * (LAST_MV - FIRST_MV + 1) * len(THRESHOLDS)
    walks = OBJECTS * VIEWS * grid_cells

    start = time.perf_counter()
    right, looped = loop_over_objects(tables, np.asarray(graph.neighbours), SUBSET)
    per_walk = (time.perf_counter() - start) / looped

    # Compares the predictions of the program with those of the loop, on the subset and its start views.
    views = {name: np.asarray(result.views)[0, :SUBSET, :, 0] for name, result in results.items()}
    logits = np.asarray(tables.logits)
    for number, policy in enumerate(COMPARED):
        if policy.name == "random":
            continue
        for index in range(SUBSET):
            walk = views[policy.name][index, index % VIEWS]
            for backbone in range(BACKBONES):
                beliefs = np.cumsum(logits[index, backbone, walk], axis=0)
                sure = np.array([numpy_rules.softmax_confidence(belief) for belief in beliefs])
                for limit, column in np.ndindex(LAST_MV - FIRST_MV + 1, len(THRESHOLDS)):
                    stops = np.flatnonzero(sure[: FIRST_MV + limit] >= THRESHOLDS[column])
                    end = stops[0] if len(stops) else FIRST_MV + limit - 1
                    answer = beliefs[end].argmax() == np.asarray(tables.label)[index]
                    assert answer == right[index, backbone, number, limit, column]

    machine = f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, JAX {jax.__version__}"
    row = {
        "walks": walks,
        "compile_and_first_run_seconds": compiling,
        "seconds": float(np.median(times)),
        "slowest_seconds": max(times),
        "peak_memory_gib": peak,
        "loop_seconds_per_walk": per_walk,
        "loop_seconds_scaled": per_walk * walks,
        "times_faster": per_walk * walks / float(np.median(times)),
    }
    print(f"Measured on: {machine}\n")
    header = ("walks", "program, s", "slowest of 15", "compiling, s", "peak memory, GiB", "loop, s (scaled)", "ratio")
    cells = [
        f"{walks:,}",
        f"{row['seconds']:.3f}",
        f"{row['slowest_seconds']:.3f}",
        f"{compiling:.1f}",
        f"{peak:.2f}",
        f"{row['loop_seconds_scaled']:,.0f}",
        f"{row['times_faster']:,.0f}×",
    ]
    print(markdown_table(header, [cells]))
    path = Path(__file__).parent / "results" / "evaluation.json"
    write_json(path, {"machine": machine, "rows": [row]})
    print(f"\nWritten to {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}")


if __name__ == "__main__":
    main()
