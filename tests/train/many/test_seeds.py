"""Networks from several seeds are those that are trained from each seed alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

import train.many.training
from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError, Diverged
from eval.settings import TINY
from tests.reference.quick import lines, quick_tasks
from train.loop import fit, load_best, steps_of_an_epoch
from train.many.members import Group, Member, member_of, task_of
from train.many.seeds import shared_equally, train_seeds
from train.many.trainers import TRAINERS
from train.many.training import _Batches
from train.results.identity import config_of, summary_of
from train.running.devices import device_mesh
from train.tasks.recogniser import RecogniserTask

ROOT = Path(__file__).resolve().parents[3]


def of_seeds(data, name: str, seeds=(3, 4)):
    """The same task from several seeds."""
    statistics = load_statistics(data)
    if name == "recogniser":
        optimiser = replace(TINY.learned.recogniser.optimiser, learning_rate=1e-4, epochs=2)
        task = RecogniserTask.of(replace(TINY.learned.recogniser, optimiser=optimiser), 10, statistics.camera)
    else:
        task = quick_tasks(statistics, epochs=2)[("classifier", "entropy").index(name)]
    return [replace(task, optimiser=replace(task.optimiser, seed=seed, data_seed=seed)) for seed in seeds]


def group_of(each, data):
    return Group(each[0], [member_of(task) for task in each], data, load_statistics(data))


@pytest.mark.parametrize("name", ["entropy", "classifier", pytest.param("recogniser", marks=pytest.mark.slow)])
def test_every_seed_ends_as_it_does_alone(name, request, tmp_path):
    data = request.getfixturevalue("turned" if name == "recogniser" else "data")
    statistics, each = load_statistics(data), of_seeds(data, name)
    folders = [tmp_path / str(number) for number in range(2)]
    summaries = train_seeds(each, data, statistics, folders, tmp_path / "work")
    assert not (tmp_path / "work").exists()
    alone = fit(each[1], data, statistics, tmp_path / "alone")
    assert config_of(folders[1]) == config_of(tmp_path / "alone")
    assert summaries[1] == summary_of(folders[1])
    for key in set(alone) - {"seconds", "best", "best_loss"}:
        assert summaries[1][key] == alone[key], key
    assert summaries[1]["best"] == pytest.approx(alone["best"], rel=1e-5)
    assert summaries[0]["best_loss"] != summaries[1]["best_loss"]
    for mine, theirs in zip(lines(folders[1]), lines(tmp_path / "alone"), strict=True):
        assert {name: mine[name] for name in mine} == pytest.approx({name: theirs[name] for name in mine}, rel=1e-4)
    networks = [nnx.state(load_best(each[1], folder), nnx.Param) for folder in (folders[1], tmp_path / "alone")]
    mine, theirs = (jax.tree_util.tree_leaves_with_path(network) for network in networks)
    in_turn = jax.default_backend() == "cpu" and jax.device_count() == 1
    for (place, weights), (_, expected) in zip(mine, theirs, strict=True):
        if in_turn:
            np.testing.assert_array_equal(weights, expected, err_msg=jax.tree_util.keystr(place))
        elif "['key']['bias']" not in jax.tree_util.keystr(place):  # of attention: no gradient but rounding
            np.testing.assert_allclose(weights, expected, rtol=1e-5, atol=1e-6, err_msg=jax.tree_util.keystr(place))


def test_a_member_draws_the_batches_of_its_epoch_wherever_it_trains(data):
    """Members move to other processes once others have stopped."""
    each = of_seeds(data, "entropy")
    batches = _Batches(group_of(each, data))
    batches.begin(np.array([0]), 0)
    for _ in range(2):
        batches.next(np.array([0]))
    batches.begin(np.array([0, 1]), 2)
    drawn = batches.next(np.array([0, 1]))
    for place, task in enumerate(each):
        expected = next(train_batches(data, task.batches, first_step=2))
        for name, values in expected.items():
            np.testing.assert_array_equal(drawn[name][place], values, err_msg=name)


def test_both_ways_of_training_members_take_the_same_steps(data):
    """Twenty steps of two members, each on its own batches; the second stops half way, and its place is given up."""
    each = of_seeds(data, "entropy")
    group, mesh = group_of(each, data), device_mesh()
    assert group.own_batches
    found = []
    for way in ("at once", "in turn"):
        trainer = TRAINERS[way](group, mesh)
        streams = [train_batches(data, task.batches) for task in each]
        for step in range(20):
            training = np.array([True, step < 10])
            if step % 10 == 0:
                trainer.begin(training)
                assert trainer.places.tolist() == np.flatnonzero(training).tolist()
            drawn = [next(streams[place]) for place in trainer.places]
            batch = {name: np.stack([one[name] for one in drawn]) for name in drawn[0]}
            trainer.train(training, batch)
        trainer.keep(np.array([True, False]))
        whole = trainer.saved()
        trainer.resume(whole)  # with all places, as a training that goes on begins
        found.append((jax.tree.map(np.asarray, trainer.saved()), trainer.sums(), trainer.finite()))
    (at_once, sums, finite), (in_turn, turned_sums, turned_finite) = found
    assert finite.tolist() == turned_finite.tolist() == [True, True]
    assert np.asarray(at_once[0].step).tolist() == np.asarray(in_turn[0].step).tolist() == [20, 10]
    for name, values in sums.items():
        np.testing.assert_allclose(values, turned_sums[name], rtol=1e-5)
    for mine, theirs in zip(jax.tree.leaves(at_once[1]), jax.tree.leaves(in_turn[1]), strict=True):
        np.testing.assert_allclose(mine[0], theirs[0], rtol=1e-4, atol=1e-5)


def test_an_interrupted_training_of_seeds_goes_on(data, tmp_path, monkeypatch, capsys):
    """Interrupted after the first epoch, and once more while the networks are written."""
    statistics, each = load_statistics(data), of_seeds(data, "entropy", seeds=(0, 1))
    folders, real = [tmp_path / "0", tmp_path / "1"], train.many.training.train_batches
    epoch = steps_of_an_epoch(each[0], statistics)
    monkeypatch.setattr(
        train.many.training,
        "train_batches",
        lambda *given, **how: _until(real(*given, **how), epoch + 1),
    )
    with pytest.raises(KeyboardInterrupt):
        train_seeds(each, data, statistics, folders, tmp_path / "work")
    monkeypatch.undo()
    written = []

    def export(group, of, best, index, *rest):
        if written:
            raise KeyboardInterrupt
        written.append(of.members[index])
        return train.many.members.export_member(group, of, best, index, *rest)

    monkeypatch.setattr(train.many.seeds, "export_member", export)
    capsys.readouterr()
    with pytest.raises(KeyboardInterrupt):
        train_seeds(each, data, statistics, folders, tmp_path / "work")
    monkeypatch.undo()
    assert "resuming after epoch 1" in " ".join(capsys.readouterr().err.split())
    assert (folders[0] / "summary.json").exists()
    assert not (folders[1] / "summary.json").exists()
    summaries = train_seeds(each, data, statistics, folders, tmp_path / "work")
    whole = train_seeds(each, data, statistics, [tmp_path / "2", tmp_path / "3"], tmp_path / "work")
    assert [one["best"] for one in summaries] == [one["best"] for one in whole]
    assert train_seeds(each, data, statistics, folders, tmp_path / "work") == summaries  # not trained again


def _until(batches, steps: int):
    for number, batch in enumerate(batches):
        if number == steps:
            raise KeyboardInterrupt
        yield batch


def test_a_seed_that_diverges_is_named_and_the_others_are_kept(data, tmp_path, monkeypatch):
    statistics, each = load_statistics(data), of_seeds(data, "entropy", seeds=(0, 1))
    folders = [tmp_path / "0", tmp_path / "1"]
    real = train.many.trainers.InTurn.finite
    monkeypatch.setattr(train.many.trainers.InTurn, "finite", lambda self: real(self) & np.array([True, False]))
    with pytest.raises(Diverged, match=r"diverged from seed 1; to train again, choose another --out and lower --rate"):
        train_seeds(each, data, statistics, folders, tmp_path / "work", rate_option="--rate")
    assert (folders[0] / "summary.json").exists()
    assert not folders[1].exists()


def test_what_others_left_is_given_up_and_a_member_is_not_lengthened(data, tmp_path, monkeypatch, capsys):
    """An interrupted training of more seeds; then fewer. A member's optimiser is not kept, so that it cannot go on."""
    statistics, each = load_statistics(data), of_seeds(data, "entropy", seeds=(0, 1, 2))
    folders, real = [tmp_path / str(number) for number in range(3)], train.many.training.train_batches
    monkeypatch.setattr(
        train.many.training,
        "train_batches",
        lambda *given, **how: _until(real(*given, **how), 12),
    )
    with pytest.raises(KeyboardInterrupt):
        train_seeds(each, data, statistics, folders, tmp_path / "work")
    monkeypatch.undo()
    capsys.readouterr()
    train_seeds(each[:2], data, statistics, folders[:2], tmp_path / "work")
    assert "of other networks, which is given up" in " ".join(capsys.readouterr().err.split())
    longer = replace(each[0], optimiser=replace(each[0].optimiser, epochs=3))
    with pytest.raises(DataError, match="other settings"):
        fit(longer, data, statistics, folders[0])
    assert (folders[0] / "summary.json").exists()


def test_as_many_devices_as_share_the_networks_train_them():
    for networks, devices, expected in ((4, 8, 4), (6, 4, 3), (8, 8, 8), (5, 4, 1), (3, 1, 1)):
        mesh = jax.sharding.Mesh(np.array([jax.devices()[0]] * devices, object).reshape(-1, 1), ("data", "model"))
        assert shared_equally(mesh, networks).size == expected


def test_a_run_with_other_settings_is_refused(data, tmp_path):
    statistics, each = load_statistics(data), of_seeds(data, "entropy", seeds=(0, 1))
    folders = [tmp_path / "0", tmp_path / "1"]
    folders[1].mkdir()
    (folders[1] / "latest").mkdir()
    (folders[1] / "config.json").write_text(json.dumps({"task": {}, "data": "", "start": None}))
    with pytest.raises(DataError, match="holds a network trained with other settings"):
        train_seeds(each, data, statistics, folders, tmp_path / "work")


def test_a_member_trains_as_its_task_says(data, turned):
    for name in ("classifier", "entropy", "recogniser"):
        (task,) = of_seeds(turned if name == "recogniser" else data, name, seeds=(7,))
        assert task_of(task, member_of(task)) == task
    changed = task_of(task, Member(1e-2, 0.5, 0.0, 1.0, 9, data_seed=2))
    optimiser = changed.optimiser
    assert (optimiser.learning_rate, optimiser.weight_decay, optimiser.seed, optimiser.data_seed) == (1e-2, 0.5, 9, 2)


ON_DEVICES = """
import json, sys
import jax
jax.config.update("jax_num_cpu_devices", 4)
import numpy as np
from tests.train.many.test_seeds import group_of, of_seeds
from tests.train.running.scaling_worker import COLLECTIVES
from data_pipeline.dataset.batches import train_batches
from train.running.devices import device_mesh
from train.many.trainers import AtOnce, way_for
from pathlib import Path

data = Path(sys.argv[1])
each = of_seeds(data, "entropy", seeds=range(4))
mesh = device_mesh()
assert way_for(mesh) == "at once"
trainer = AtOnce(group_of(each, data), mesh)
streams = [train_batches(data, task.batches) for task in each]
losses = []
for step in range(4):
    drawn = [next(stream) for stream in streams]
    batch = {name: np.stack([one[name] for one in drawn]) for name in drawn[0]}
    losses.append(np.asarray(trainer.train(np.ones(4, bool), batch)).tolist())
said = COLLECTIVES.findall(trainer.program(np.ones(4, bool), batch))
print(json.dumps({"losses": losses, "said": said}))
"""


@pytest.mark.slow
def test_devices_train_a_seed_each_and_say_nothing_to_each_other(data):
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", ON_DEVICES, str(data)], capture_output=True, text=True, env=environment, timeout=600
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["said"] == []
    each = of_seeds(data, "entropy", seeds=range(4))
    trainer = TRAINERS["in turn"](group_of(each[2:3], data), device_mesh())
    stream = train_batches(data, each[2].batches)
    alone = [float(trainer.train(np.ones(1, bool), next(stream))) for _ in range(4)]
    np.testing.assert_allclose([losses[2] for losses in found["losses"]], alone, rtol=1e-4)
