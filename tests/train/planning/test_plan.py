"""A plan of a training says what the training does, and refuses what the training refuses."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import jax
import pytest

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from data_pipeline.files import write_json
from eval.checks.compiling import read_check
from eval.runs import tasks
from eval.settings import PRESETS, TINY
from train.loop import check_launch, check_training, identity_of
from train.optimiser import OptimiserConfig
from train.planning.compile import compile_for, training_program
from train.planning.costs import bytes_of, flop_of, memory_of, views_like
from train.planning.plan import NetworkPlan, bytes_of_a_record, notes_on, planned_statistics
from train.planning.targets import Chip, Target, mesh_of
from train.running.devices import Layout, check_batch
from train.step import abstract_state, initial_state, train_step_of
from train.tasks.recogniser import RecogniserTask
from train.validation import ValidationSet


def size(tree) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("network", [0, 1], ids=["classifier", "entropy"])
def test_a_plan_says_what_training_does(network, data):
    """Batches, steps, the state, what is read and what is kept for validation, as they are in a training."""
    statistics = load_statistics(data)
    task = tasks(TINY, statistics)[network]
    record = bytes_of_a_record(statistics, data)
    plan = NetworkPlan.of(task, statistics, Layout(), record)
    batch = next(train_batches(data, task.batches))
    expected = {name: jax.ShapeDtypeStruct(array.shape, array.dtype) for name, array in batch.items()}
    assert views_like(task, statistics, 16) == expected
    assert plan.inputs_bytes == size(batch)
    _, state = initial_state(task, 0)
    assert (plan.state_bytes, plan.weights_bytes) == (size(state), size(state.parameters))
    objects = statistics.objects_of(["train"])  # 4 views of each, 2 in a batch of 16
    assert (plan.batch_objects, plan.epoch_steps, plan.steps) == (8, -(-objects * 2 // 8), -(-objects * 2 // 8) * 2)
    kept = ValidationSet(task, data, statistics, 1)
    assert plan.validation_views == sum((weights > 0).sum() for _, weights in kept)
    [(arrays, weights)] = kept
    assert plan.validation_bytes * len(weights) == size(arrays) * plan.validation_views
    shards = sum(path.stat().st_size for path in data.rglob("*-train.array_record*"))
    assert plan.epoch_bytes == pytest.approx(plan.epoch_steps * 8 * shards / objects)


def test_devices_share_a_plan():
    """64 devices of 16 processes, weights split in two, batches in two parts: every share by hand."""
    statistics = planned_statistics(PRESETS["small"].dataset, 1_000_000)
    task = tasks(PRESETS["small"], statistics)[0]
    task = replace(task, optimiser=replace(task.optimiser, batch_size=256, parts=2))
    plan = NetworkPlan.of(task, statistics, Layout.of(64, 16, 2), 1e6)
    assert (plan.device_views, plan.device_objects, plan.process_views, plan.process_objects) == (8, 2, 16, 4)
    assert plan.epoch_steps == 1_000_000 * 8 // 4 // 64  # 8 views of each object, 4 in a batch
    assert (plan.epoch_bytes, plan.process_epoch_bytes) == (1e6 * 2_000_000, 1e6 * 2_000_000 / 16)
    assert plan.validation_views == 15_625 * 4  # of 250,000 objects
    assert plan.activations_bytes == 4 * plan.view_activations_bytes
    whole = bytes_of(abstract_state(task)[1].parameters)
    assert whole / 2 <= plan.weights_bytes < 0.51 * whole
    assert plan.gradients_bytes == 2 * plan.weights_bytes
    assert plan.step_flop == 64 * plan.device_flop


@pytest.mark.parametrize(
    ("preset", "network"), [("tiny", 1), ("small", 1), pytest.param("small", 0, marks=pytest.mark.slow)]
)
def test_operations_are_near_those_of_the_compiled_step(preset, network):
    settings = PRESETS[preset]
    statistics = planned_statistics(settings.dataset, 1000)
    task = tasks(settings, statistics)[network]
    views = task.optimiser.batch_size
    structure, state = abstract_state(task)
    step = jax.jit(train_step_of(task, structure, 10), donate_argnums=0)
    compiled = step.lower(state, views_like(task, statistics, views), task.hyperparameters).compile()
    assert flop_of(task, statistics, views) == pytest.approx(compiled.cost_analysis()["flops"], rel=0.08)


H100 = read_check(Path(__file__).parents[3] / "benchmarks/results/compiled_h100.json").programs
"""What XLA's compiler made of programs for an H100."""


@pytest.mark.parametrize(
    ("name", "preset", "network", "changed"),
    [
        ("train-classifier-small", "small", 0, {}),
        ("train-classifier-small-parts", "small", 0, {"batch_size": 256, "parts": 4}),
        ("train-entropy-small", "small", 1, {}),
        ("train-recogniser-small", "small", 2, {}),
        ("train-classifier", "thesis", 0, {}),
        ("train-classifier-bfloat16", "thesis", 0, {"compute": "bfloat16"}),
        ("train-entropy", "thesis", 1, {}),
        ("train-entropy-bfloat16", "thesis", 1, {"compute": "bfloat16"}),
    ],
)
def test_memory_is_near_that_of_the_step_compiled_for_a_gpu(name, preset, network, changed):
    settings = PRESETS[preset]
    statistics = planned_statistics(settings.dataset, 1000)
    recogniser = RecogniserTask.of(settings.learned.recogniser, len(statistics.classes), statistics.camera)
    task = (*tasks(settings, statistics), recogniser)[network]
    task = replace(task, optimiser=replace(task.optimiser, **changed))
    planned = memory_of(task, statistics, Layout())
    of_device = sum(planned[name] for name in ("state_bytes", "gradients_bytes", "inputs_bytes", "activations_bytes"))
    assert 0.8 < of_device / H100[name].peak_bytes < 1.2


def test_a_plan_for_a_target_has_the_compiler_s_memory(monkeypatch):
    """For the device that is here, as if it were not."""
    here = Target("cpu", "cpu", "", Chip("cpu", 1e9, 1e6), "", "jax")
    monkeypatch.setattr(Target, "devices", lambda _: jax.devices()[:1])
    statistics = planned_statistics(TINY.dataset, 100)
    task = tasks(TINY, statistics)[1]
    plan = NetworkPlan.of(task, statistics, Layout(), 1e6, here)
    assert (
        plan.compiled_bytes == compile_for(here, training_program(task, statistics, mesh_of(here.devices()))).peak_bytes
    )
    assert plan.compiled_bytes > 0
    assert NetworkPlan.of(task, statistics, Layout(), 1e6).compiled_bytes is None


def test_a_refused_batch_comes_with_one_that_is_not():
    counts = itertools.product((1, 16, 100), (1, 3), (1, 4), (1, 8, 24), (1, 4))
    refused = 0
    for batch_size, parts, views_per_object, data, processes in counts:
        layout = Layout(processes, data * processes)
        config = OptimiserConfig(batch_size=batch_size, parts=parts, views_per_object=views_per_object)
        try:
            check_batch("classifier", config, layout)
        except DataError as error:
            refused += 1
            better = int(str(error).split("such as ")[1].split(")")[0])
            check_batch("classifier", replace(config, batch_size=better), layout)
            assert batch_size < better < batch_size + 24 * 4 * 3 * 4
    assert refused > 20
    for name in ("batch_size", "parts", "views_per_object"):
        with pytest.raises(DataError, match=f"optimiser.{name.replace('_', '-')} must be at least 1, and is 0"):
            check_batch("classifier", replace(OptimiserConfig(), **{name: 0}), Layout())


@pytest.mark.parametrize(
    ("shape", "told"),
    [
        ((30, 16), "30 devices cannot be shared equally by 16 processes"),
        ((0, 1), "0 devices cannot be shared"),
        ((64, 16, 8), "--model-devices 8 does not divide the 4 devices of a process"),
        ((64, 16, 0), "--model-devices 0 does not divide"),
    ],
)
def test_devices_that_cannot_be_arranged_are_refused(shape, told):
    with pytest.raises(DataError, match=told):
        Layout.of(*shape)


def test_views_and_objects_that_are_too_few_are_told(data):
    """More views than an object has cannot be drawn; more objects than there are can be, again."""
    statistics = load_statistics(data)  # 30 objects of 6 views to train on
    task = tasks(TINY, statistics)[0]

    def with_optimiser(**changed):
        return replace(task, optimiser=replace(task.optimiser, **changed))

    check_training(with_optimiser(batch_size=18, views_per_object=6), statistics, Layout())
    for changed, there in (({"views_per_object": 8}, 6), ({"views_per_object": 6, "validation_by": "view"}, 5)):
        with pytest.raises(DataError, match=f"views of an object in a batch are more than the {there}"):
            check_training(with_optimiser(batch_size=48, **changed), statistics, Layout())
    many = with_optimiser(batch_size=128)
    assert next(train_batches(data, many.batches))["label"].shape == (128,)
    assert "a batch holds 64 objects and there are 30" in notes_on(many, statistics)[0]
    assert notes_on(task, statistics) == []
    with pytest.raises(DataError, match="--plan-objects must be at least 1"):
        planned_statistics(TINY.dataset, 0)


def test_a_network_that_is_trained_is_not_planned_again(data, tmp_path):
    statistics = load_statistics(data)
    task = tasks(TINY, statistics)[0]
    three = Layout(1, 3)
    with pytest.raises(DataError, match="cannot be shared equally by 3 devices"):
        check_launch(task, statistics, tmp_path, None, three)
    write_json(tmp_path / "config.json", identity_of(task, statistics))
    write_json(tmp_path / "summary.json", {})
    assert check_launch(task, statistics, tmp_path, None, three) is False
    other = replace(task, optimiser=replace(task.optimiser, seed=1))
    with pytest.raises(DataError, match="holds a network trained with other settings"):
        check_launch(other, statistics, tmp_path, None, Layout())
