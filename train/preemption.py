"""A machine that is about to be taken away says so with SIGTERM: save, and leave."""

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
    """Holds an interrupt back to the end of the block: one that falls into Orbax's threads leaves them waiting for each other."""
    if threading.current_thread() is not threading.main_thread():
        yield  # gets no signals
        return
    heard: list[tuple[int, FrameType | None]] = []
    numbers = [
        signal.SIGINT,
        *([signal.SIGALRM] if hasattr(signal, "SIGALRM") else []),
    ]  # the alarm repeats an interrupt
    before: dict[int, Any] = {
        number: signal.signal(number, lambda *arguments: heard.append(arguments)) for number in numbers
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if heard and callable(before[heard[0][0]]):
            before[heard[0][0]](*heard[0])


class Preempted(Exception):
    """The training was asked to end, and saved what it had done."""


class Preemption:
    """Listens for SIGTERM while it is entered. Several processes agree on the step after which they all leave."""

    def __init__(self) -> None:
        self.asked = False
        # A library's loop in another thread gets no signals; several processes listen through JAX.
        self._listens = jax.process_count() == 1 and threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Preemption:
        if self._listens:
            self._before = signal.signal(signal.SIGTERM, self._hear)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._listens:
            signal.signal(signal.SIGTERM, self._before)

    def _hear(self, number: int, frame: FrameType | None) -> None:
        self.asked = True

    def after(self, step: int) -> bool:
        """Whether to leave after this step, of which every process asks in turn."""
        if jax.process_count() > 1:
            self.asked = multihost_utils.reached_preemption_sync_point(step) or self.asked
        return self.asked
