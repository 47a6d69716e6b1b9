"""Saving and leaving on SIGTERM, which clusters send before they take a machine away."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

import jax
from jax.experimental import multihost_utils


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Delays interrupts until the end of the block; an interrupt during Orbax's work would leave its threads in a deadlock."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives signals
        return
    received: list[tuple[int, FrameType | None]] = []
    # SIGALRM too: the command line repeats an interrupt by an alarm.
    numbers = [signal.SIGINT, *([signal.SIGALRM] if hasattr(signal, "SIGALRM") else [])]
    before: dict[int, Any] = {
        number: signal.signal(number, lambda *arguments: received.append(arguments)) for number in numbers
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if received and callable(before[received[0][0]]):
            before[received[0][0]](*received[0])


class Preempted(Exception):
    """Raised when a training was stopped by SIGTERM, after it saved its state."""


class Preemption:
    """Context manager that notices SIGTERM. Several processes agree on the step after which they all stop."""

    _steps = 0
    """Steps of all trainings of this process. JAX agrees on one that is larger than any so far."""

    def __init__(self, handles: bool = True) -> None:
        self.asked = False
        # Only the main thread receives signals; with several processes, JAX handles SIGTERM.
        self._handles = handles and jax.process_count() == 1 and threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Preemption:
        if self._handles:
            self._before = signal.signal(signal.SIGTERM, self._on_signal)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._handles:
            signal.signal(signal.SIGTERM, self._before)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.asked = True

    def after_step(self) -> bool:
        """Returns whether to stop after this step; every process must call it for every step."""
        Preemption._steps += 1
        if jax.process_count() > 1:
            self.asked = multihost_utils.reached_preemption_sync_point(Preemption._steps) or self.asked
        return self.asked
