"""Drawings: `mevs draw ascent`."""

from __future__ import annotations

from mevs_jax.cli.parsing import Invocation


def ascent(call: Invocation) -> None:
    """The ascent to the best view of one object, as an animation."""
    from eval.rendering.ascent import ascend_on

    sentence, path = ascend_on(call.settings.dataset, call.settings.ascent, call.out)
    print(sentence)
    print(f"Animation: {path.absolute()}")
