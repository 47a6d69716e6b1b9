"""What threads compute is what one thread computes, in order."""

from __future__ import annotations

import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval import threads
from eval.walks import over_objects


@pytest.mark.parametrize("items", [[], [3], [5, 1, 4, 1, 2, 0]])
def test_results_have_the_order_of_the_items(items, monkeypatch):
    """The first is done before any other begins; then three at a time, of which the later ones end first."""
    monkeypatch.setattr(threads, "programs_at_once", lambda: 3)
    done, most, running = [], 0, 0
    lock = threading.Lock()

    def work(item: int) -> int:
        nonlocal most, running
        assert done or item == items[0]
        with lock:
            running += 1
            most = max(most, running)
        time.sleep(0.02 * item)
        with lock:
            running -= 1
        done.append(item)
        return item + 10

    assert threads.by_threads(work, items) == [item + 10 for item in items]
    assert most == min(3, max(1, len(items) - 1)) * bool(items)


def test_objects_are_traced_as_they_are(monkeypatch):
    """Under `jit` there is nothing to share out."""
    monkeypatch.setattr(over_objects, "programs_at_once", lambda: 2)
    program = jax.jit(lambda numbers, scale: (scale * numbers)[None])

    def whole(numbers):
        return over_objects.on_all_cores(program, numbers, 2.0)

    numbers = jnp.arange(5.0)
    np.testing.assert_array_equal(jax.jit(whole)(numbers), whole(numbers))
    np.testing.assert_array_equal(whole(numbers), [2 * np.arange(5.0)])
