"""The stages of a run: `mevs run`, `data`, `train`, `sweep`, `eval`, `report`."""

from __future__ import annotations

from mevs_jax.cli.parsing import Invocation, keep_settings


def run(call: Invocation) -> None:
    """All stages, one after the other."""
    from eval import stages
    from eval.walks.own_policies import load_policies
    from train.own_code import load_own
    from train.tasks.classifier import starting_weights

    classifier = call.settings.classifier
    start = starting_weights(call.options.pretrained, classifier.network, classifier.encoder)
    load_policies(call.settings.policies)  # so that an error in a policy is found before anything is computed
    if classifier.encoder:
        load_own(classifier.encoder, "--encoder")
    stages.policies_of(call.settings, stages.make_data(call.settings, call.out))
    stages.train(call.settings, call.out, start)
    evaluate(call)
    if not call.settings.classifier.encoder:  # of which no trained system can be made
        print(f"Trained system: {stages.make_system(call.settings, call.out).absolute()}")
    report(call)


def data(call: Invocation) -> None:
    """The data set."""
    from eval import stages

    statistics = stages.make_data(call.settings, call.out, call.options.beam)
    counts = ", ".join(f"{sum(of.values())} {split}" for split, of in statistics.counts.items())
    print(f"Data set: {counts} objects of {len(statistics.classes)} classes, {statistics.views} views each")


def train(call: Invocation) -> None:
    """The networks, with other processes if there are any."""
    from contextlib import ExitStack

    from data_pipeline.lock import locked
    from data_pipeline.progress import console
    from eval import stages
    from train.devices import device_mesh, is_first, join_processes
    from train.tasks.classifier import starting_weights

    classifier = call.settings.classifier
    with ExitStack() as held:
        if call.options.distributed:
            join_processes()  # before anything is computed
            console.quiet = not is_first()
            if is_first():
                stages.check_output(call.out)
                held.enter_context(locked(call.out, " ".join(["mevs", *call.arguments])))
                keep_settings(call)
        start = starting_weights(call.options.pretrained, classifier.network, classifier.encoder)
        stages.train(call.settings, call.out, start, device_mesh(call.options.model_devices))


def sweep(call: Invocation) -> None:
    """A sweep over one network's hyperparameters."""
    from eval import stages

    folder, members = stages.train_sweep(call.settings, call.out)
    best = min(members, key=lambda member: member.loss)
    print(
        f"Best of {len(members)}: validation loss {best.loss:.4f} with learning rate {best.learning_rate:.2e}, weight decay "
        f"{best.weight_decay:.2e}, dropout {best.dropout:.2f}, augmentation {best.augmentation:.2f}"
    )
    print(f"All of them: {folder / 'members.md'}; the best network: {folder / 'network'}")


def evaluate(call: Invocation) -> None:
    """The metrics, and the main ones in a few lines."""
    from eval import stages

    metrics = stages.evaluate(call.settings, call.out)
    accuracy = metrics["single_view"]["accuracy"]
    print(f"Single views: {100 * accuracy:.1f} % of {metrics['objects']} test objects right")
    titles = {rung["policy"]: rung["title"] for rung in metrics["ladder"]}
    own = [rung["policy"] for rung in metrics["ladder"] if "own" in rung]
    after_two = ", ".join(
        f"{titles[name]} {100 * metrics['policies'][name]['after_views'][1]:.1f} %"
        for name in ("random", "predicted_entropy", "oracle_entropy", "information_gain", *own)
    )
    print(f"After two views: {after_two}")
    print(f"Metrics: {call.out / 'metrics.json'}")


def report(call: Invocation) -> None:
    """The report."""
    from eval import stages

    print(f"Report: {stages.report(call.settings, call.preset, call.out).absolute()}")
