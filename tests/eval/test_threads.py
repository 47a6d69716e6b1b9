"""What threads compute is what one thread computes, in order."""

from __future__ import annotations

import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest

from eval import threads
from train.running import over_objects


@pytest.mark.parametrize("items", [[], [3], [5, 1, 4, 1, 2, 0]])
def test_results_have_the_order_of_the_items(items, monkeypatch):
    """The first is done before any other begins; then three at a time, of which the later ones end first."""
    monkeypatch.setattr(threads, "programs_at_once", lambda: 3)
    done, most, running = [], 0, 0
    changed, expected = threading.Condition(), min(3, max(1, len(items) - 1)) * bool(items)

    def work(item: int) -> int:
        nonlocal most, running
        assert done or item == items[0]
        with changed:
            running += 1
            most = max(most, running)
            changed.notify_all()
            assert not done or changed.wait_for(lambda: most >= expected, timeout=60)
        time.sleep(0.02 * item)
        with changed:
            running -= 1
        done.append(item)
        return item + 10

    assert threads.by_threads(work, items) == [item + 10 for item in items]
    assert most == expected


def plus(one, added, *, times: int):
    return {"sum": times * (one["number"] + added), "vector": jnp.full(3, one["number"])}


@pytest.mark.parametrize("count", [1, 5, 40])
@pytest.mark.parametrize("threads_at_once", [1, 3])
def test_a_function_of_one_object_is_applied_to_all(count, threads_at_once, monkeypatch):
    """Whatever is left over in the last part."""
    monkeypatch.setattr(over_objects, "programs_at_once", lambda: threads_at_once)
    numbers = np.arange(count, dtype=np.float32)
    found = over_objects.over_objects(plus, {"number": numbers}, jnp.float32(0.5), at_once=2, times=3)
    np.testing.assert_array_equal(found["sum"], 3 * (numbers + 0.5))
    np.testing.assert_array_equal(found["vector"], np.stack([numbers] * 3, axis=1))
