"""The stages of a run: `mevs run`, `data`, `train`, `sweep`, `eval`, `report`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mevs_jax.cli.failure import Unusable
from mevs_jax.cli.parsing import Invocation, keep_adopted

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from mevs_jax.cli.options import StatusOptions
    from train.weights.starting import StartingWeights


def run(call: Invocation) -> None:
    """All stages, one after the other."""
    from eval import stages, training
    from eval.consistency import check_seeds
    from eval.evaluation import policies_on
    from eval.walks.own_policies import load_policies
    from train.own_code import load_own

    start, own = weights_of(call), call.settings.classifier.own
    load_policies(call.settings.policies)  # so that an error in a policy is found before anything is computed
    if own:
        load_own(own, "--encoder")
    check_seeds(call.settings)
    training.check_batches(call.settings, call.out)
    policies_on(call.settings.policies, training.make_data(call.settings, call.out))
    _train(call, start)
    evaluate(call)
    if not own:  # of which no trained system can be made
        print(f"Trained system: {stages.make_system(call.settings, call.out).absolute()}")
    report(call)


def weights_of(call: Invocation) -> StartingWeights | None:
    """The weights of `--pretrained`, from which classifiers start."""
    from data_pipeline.errors import DataError
    from train.tasks.classifier import starting_weights

    classifier = call.settings.classifier
    if classifier.frozen and not call.options.pretrained:
        raise DataError("--classifier.frozen trains the last layer on features of given weights; give --pretrained too")
    return starting_weights(call.options.pretrained, classifier.network, classifier.encoder)


def _train(call: Invocation, start: StartingWeights | None, mesh: Mesh | None = None) -> None:
    """Both networks, from one seed or several."""
    from eval import seeds, training
    from eval.consistency import check_seeds

    check_seeds(call.settings)
    if call.settings.seeds == 1:
        training.train(call.settings, call.out, start, mesh)
        return
    begin = partial(seeds.make_folders, call.settings, call.preset, call.out, call.arguments)
    seeds.train(call.settings, call.out, start, mesh, call.options.seeds_at_once, begin)


def data(call: Invocation) -> None:
    """The data set."""
    from data_pipeline.dataset.sheet import draw_objects
    from data_pipeline.distributed import is_first
    from data_pipeline.errors import DataError
    from eval.training import make_data

    if call.options.beam is not None and call.options.distributed:
        raise DataError("--beam has workers of its own; leave out --distributed")
    settings = call.settings
    if call.options.frames is not None:
        settings = replace(settings, dataset=replace(settings.dataset, source=str(_recorded(call))))
    statistics = make_data(settings, call.out, call.options.beam)
    counts = ", ".join(f"{sum(of.values())} {split}" for split, of in statistics.counts.items())
    print(f"Data set: {counts} objects of {len(statistics.classes)} classes, {statistics.views} views each")
    if is_first():
        draw_objects(call.out / "data", statistics, call.out / "objects.png")
        print(f"A picture of them: {call.out / 'objects.png'}")
        print(
            "On it, each object should be whole and stand upright along its arrow; sizes should be of one unit (--dataset.up)"
        )


def _recorded(call: Invocation) -> Path:
    """The folder of meshes that recordings are fused into."""
    from data_pipeline.errors import DataError
    from data_pipeline.objects.recorded import meshes_of_recordings

    if call.options.data is not None or call.options.distributed:
        raise DataError("--frames makes the data set alone, by one process; leave out --data and --distributed")
    made = meshes_of_recordings(call.options.frames, call.out / "meshes")
    for one in made:
        for note in one.left_out:
            print(f"Note: {one.mesh}: {note}")
    print(f"Fused {sum(one.images for one in made)} images into {len(made)} meshes: {call.out / 'meshes'}")
    return call.out / "meshes"


def train(call: Invocation) -> None:
    """The networks."""
    from train.running.devices import device_mesh

    _train(call, weights_of(call), device_mesh(call.options.model_devices))


def sweep(call: Invocation) -> None:
    """A sweep over one network's hyperparameters."""
    from data_pipeline.distributed import is_first
    from data_pipeline.lock import locked
    from eval import sweeping
    from train.many.sweep import best_of

    folder, network, members = sweeping.train_sweep(call.settings, call.out)
    best = best_of(members)
    print(
        f"Best of {len(members)}: validation loss {best.loss:.4f} with learning rate {best.learning_rate:.2e}, weight decay "
        f"{best.weight_decay:.2e}, dropout {best.dropout:.2f}, augmentation {best.augmentation:.2f}"
    )
    print(f"All of them: {folder / 'members.md'}; the best network: {network}")
    if call.options.adopt:
        # Processes that share a study hold the locks of their jobs alone.
        with locked(call.out, "mevs sweep --adopt") if call.settings.sweep.trials else nullcontext():
            there, settings = sweeping.adopt(call.settings, call.out, network)
            if is_first():
                keep_adopted(call, settings)
        print(f"The run has it now: {there}")


def evaluate(call: Invocation) -> None:
    """The metrics, and the main ones in a few lines."""
    from eval import stages

    metrics = stages.evaluate(call.settings, call.out)
    print(f"Single views: {100 * metrics.single_view.accuracy:.1f} % of {metrics.objects} test objects right")
    named = ("random", "predicted_entropy", "oracle_entropy", "information_gain", *(own.policy for own in metrics.own))
    after_two = ", ".join(
        f"{metrics.titles[name]} {100 * metrics.policies[name].after_views[1]:.1f} %" for name in named
    )
    print(f"After two views: {after_two}")
    print(f"Metrics: {call.out / 'metrics.json'}")
    if call.settings.seeds > 1:
        _print_seeds(call)


def _print_seeds(call: Invocation) -> None:
    from eval import seeds

    found = seeds.evaluate(call.settings, call.out)
    print(f"Over {found.seeds} trainings, after two views, less random (95 % for other objects and trainings):")
    for row in found.rows:
        if row.views == 2 and row.policy in ("predicted_entropy", "information_gain"):
            low, high = 100 * row.difference_over_both
            print(f"  {row.title}: {100 * row.difference:+.1f} points [{low:+.1f}, {high:+.1f}]")
    print(f"Means over trainings: {call.out / 'seeds.csv'}")


def report(call: Invocation) -> None:
    """The report."""
    from eval import stages

    print(f"Report: {stages.report(call.settings, call.preset, call.out).absolute()}")


def status(options: StatusOptions) -> None:
    """What goes on in a run."""
    from train.running.status import status_of

    if not options.out.is_dir():
        raise Unusable(f"there is no run in {options.out}; give the folder that --out names")
    for line in status_of(options.out):
        print(line)
