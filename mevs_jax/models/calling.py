"""Networks whose calls take an argument `train`, instead of a mode that is set on the network."""

from __future__ import annotations

from typing import Any

from flax import nnx


class TrainedByCall(nnx.Module):
    """A network whose calls take `train`: `network(inputs, train=True)`. Without, it evaluates."""

    def train(self, **attributes: Any) -> None:
        """Not supported: Flax's modes change layers of Flax alone, and would change nothing here.

        Raises:
            ValueError: always.
        """
        del attributes
        raise ValueError(
            f"{type(self).__name__} has no training mode: call it with train=True, as in network(inputs, train=True)"
        )

    def eval(self, **attributes: Any) -> None:
        """Does nothing: a call without `train=True` evaluates."""
        del attributes
