"""Checks: `mevs check live`."""

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
