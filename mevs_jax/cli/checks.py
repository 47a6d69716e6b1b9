"""Checks: `mevs check live`, `mevs check agent`."""

from __future__ import annotations

from mevs_jax.cli.parsing import Invocation


def live(call: Invocation) -> None:
    """Walks with the networks in the loop, beside walks from the view tables."""
    from eval import stages

    for policy, found in stages.check_live(call.settings, call.out).items():
        print(
            f"{policy}: {found.same} of {found.walks} walks are the same live as by table "
            f"(confidences within {found.largest_difference:.1e})"
        )


def agent(call: Invocation) -> None:
    """Measures what an agent promises."""
    from eval import stages

    found = stages.check_agent(call.settings, call.out)
    for policy, walks in found["walks"].items():
        print(
            f"{policy}: {walks['same']} of {walks['walks']} walks are those on view tables (probabilities within "
            f"{walks['largest_difference']:.1e})"
        )
        for row in found["stopping"].get(policy, []):
            print(
                f"  stops at {row['stop']:g}: wrong {100 * row['error']:.2f} % (promised {100 * row['promised_error']:g} %), "
                f"{100 * row['stopped']:.0f} % of walks stop, {row['views']:.1f} views"
            )
    for row in found["camera"]:
        print(
            f"any camera at {row['distance']:g} radii: overlap {row['overlap_median']:.3f} (5th percentile "
            f"{row['overlap_low']:.3f}), depth within {100 * row['error_median']:.2f} % of the radius, accuracy "
            f"{100 * row['accuracy']:.1f} % (own camera {100 * row['own_accuracy']:.1f} %)"
        )
    time = found["latency_ms"]
    print(
        f"640×480 image to next pose: {time['p50']:.1f} ms (99th percentile {time['p99']:.1f}), "
        f"{time['compilations']:.0f} compilations"
    )
