"""Training goes on from what is sound of a damaged run, and ends as if nothing had been damaged."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from data_pipeline.files import CHECKS
from tests.reference.quick import quick_tasks
from train.loop import fit, load_best
from train.results.networks import trained_once
from train.running.checkpoints import Checkpoints, damage_of


def task_of(statistics):
    return quick_tasks(statistics, epochs=2)[1]


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    statistics = load_statistics(data)
    fit(task_of(statistics), data, statistics, folder)
    return folder


def largest(slot: Path) -> Path:
    return max(slot.glob("*/state/**/d/*"), key=lambda path: path.stat().st_size)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


def remove_checks_and_halve(slot: Path) -> None:
    """As a save of an older version that is half written."""
    next(slot.glob(f"*/{CHECKS}")).unlink()
    path = largest(slot)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


CASES = {
    "summary": [lambda run: (run / "summary.json").write_text("")],
    "latest flipped": [lambda run: (run / "summary.json").unlink(), lambda run: flip(largest(run / "latest"))],
    "best flipped": [lambda run: flip(largest(run / "best"))],
    "best removed": [lambda run: shutil.rmtree(run / "best")],
    "both": [lambda run: shutil.rmtree(run / "best"), lambda run: flip(largest(run / "latest"))],
    "a file for a folder": [lambda run: shutil.rmtree(run / "best"), lambda run: (run / "best").write_text("")],
    "half and unchecked": [
        lambda run: (run / "summary.json").unlink(),
        lambda run: remove_checks_and_halve(run / "latest"),
    ],
    "log": [
        lambda run: (run / "summary.json").write_text("[]"),
        lambda run: (run / "metrics.jsonl").write_bytes(b"\xff1\n"),
    ],
}


@pytest.mark.parametrize("case", CASES)
def test_a_damaged_training_ends_with_the_same_weights(case, trained, data, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    for damage in CASES[case]:
        damage(run)
    statistics = load_statistics(data)
    task = task_of(statistics)
    found, expected = fit(task, data, statistics, run), json.loads((trained / "summary.json").read_text())
    for key in expected.keys() - {"seconds"}:
        assert found[key] == expected[key], key
    mine, theirs = (jax.tree.leaves(nnx.state(load_best(task, folder))) for folder in (run, trained))
    for a, b in zip(mine, theirs, strict=True):
        np.testing.assert_array_equal(a, b)
    assert str(run) in capsys.readouterr().err
    assert fit(task, data, statistics, run) == found


def test_damaged_weights_are_named_where_they_are_only_read(trained, data, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    assert damage_of(run / "best") is None
    flip(largest(run / "best"))
    with pytest.raises(DataError, match=r"best cannot be read \(.* is not as it was written\); repeat the command"):
        load_best(task_of(load_statistics(data)), run)


def test_a_stored_network_is_trained_again_where_it_is_damaged(tmp_path, capsys):
    def network(seed: int) -> nnx.Linear:
        return nnx.Linear(64, 64, rngs=nnx.Rngs(seed))

    def stored(seed: int) -> nnx.Linear:
        return trained_once(tmp_path, {"of": 1}, nnx.eval_shape(lambda: network(0)), lambda: (network(seed), {}))

    first = stored(1)
    np.testing.assert_array_equal(stored(2).kernel[...], first.kernel[...])
    flip(largest(tmp_path / "best"))
    np.testing.assert_array_equal(stored(3).kernel[...], network(3).kernel[...])
    np.testing.assert_array_equal(stored(4).kernel[...], network(3).kernel[...])
    remove_checks_and_halve(tmp_path / "best")
    np.testing.assert_array_equal(stored(5).kernel[...], network(5).kernel[...])
    (tmp_path / "summary.json").write_text('{"identity"')
    np.testing.assert_array_equal(stored(6).kernel[...], network(6).kernel[...])
    assert "trained again" in capsys.readouterr().err


def test_a_slot_that_never_held_a_save_is_not_damaged(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.resume({"a": np.zeros(3)}, 1) is None


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Jobs in the background may have been started with interrupts ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_waits_for_the_checkpoint(tmp_path, monkeypatch):
    """One that falls into Orbax would leave its threads waiting for each other, and the program with them."""
    state = {"weights": jnp.arange(4.0)}
    with Checkpoints(tmp_path) as checkpoints:
        manager = checkpoints._slots["latest"]
        save = manager.save

        def interrupted(*arguments, **named):
            signal.raise_signal(signal.SIGINT)
            return save(*arguments, **named)

        monkeypatch.setattr(manager, "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            checkpoints.save("latest", 1, state, {"epoch": 1})
        restored = checkpoints.restore("latest", state)
        assert restored is not None
        assert restored[1] == {"epoch": 1}
        np.testing.assert_array_equal(restored[0]["weights"], state["weights"])
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


FILL = """
import sys
from pathlib import Path
import jax.numpy as jnp
from data_pipeline.files import why_not_written
from train.running.checkpoints import Checkpoints
try:
    with Checkpoints(Path(sys.argv[1])) as checkpoints:
        checkpoints.save("latest", 1, {str(at): jnp.arange(300_000.0) * at for at in range(20)}, {"epoch": 1})
except Exception as error:
    print(why_not_written(error), file=sys.stderr)
"""


def test_a_full_disk_is_one_sentence(tmp_path):
    """On a disk of 3 MB. The threads that write answer later, when nothing listens any more."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("only root may mount a small disk")
    try:
        ended = subprocess.run([sys.executable, "-c", FILL, str(disk)], capture_output=True, text=True, timeout=300)
    finally:
        subprocess.run(["umount", "-l", disk], check=True)
    assert ended.stderr.splitlines() == [
        "cannot write: the disk is full; free some space, and the same command goes on"
    ]
