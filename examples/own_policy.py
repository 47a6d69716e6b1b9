"""A policy of one's own, compared with others: `python examples/own_policy.py [RUN]`.

A policy is a pure function `(key, state, scene) -> scores over views`. The loop hides views that have been seen, and takes the
view of highest score. RUN is a directory in which `mevs run` has been run (default: runs/demo). The evaluation is that of the
run; `mevs eval --policy examples/own_policy.py:opposite --out RUN` adds the policy to its metrics and its report.
"""

from __future__ import annotations

import sys

import jax

from eval.numbers.policies import evaluate_policies
from mevs_jax import POLICIES, Scene, SelectionState, register_policy


@register_policy("opposite", title="opposite to the latest view", knows="nothing")
def opposite(key: jax.Array, state: SelectionState, scene: Scene) -> jax.Array:
    """The view opposite to the latest one has the highest score."""
    del key
    return -scene.graph.points @ scene.graph.points[state.view]


def main(run: str) -> None:
    study = evaluate_policies(run, {"opposite": opposite, "farthest": POLICIES["farthest"]})
    for row in study.rows():
        if row["views"] == 3:
            print(
                f"{row['policy']}: {100 * row['accuracy']:.1f} % right after three views, {100 * row['difference']:+.1f} points "
                f"[{100 * row['low']:+.1f}, {100 * row['high']:+.1f}] from random"
            )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/demo")
