"""Studies: `mevs study thesis`, `learned`, `rendering`, `published-code`, `future-work`."""

from __future__ import annotations

from mevs_jax.cli.parsing import Invocation
from mevs_jax.cli.stages import evaluate, report, weights_of


def thesis(call: Invocation) -> None:
    """The thesis, whole."""
    from eval.thesis.run import reproduce

    page = reproduce(call.settings, call.preset, call.out, call.options.pretrained)
    print(f"Report: {page.absolute()}")


def learned(call: Invocation) -> None:
    """Learned fusion and learned choice."""
    from eval.learned.stage import learn_to_choose

    print(f"Report: {learn_to_choose(call.settings, call.out).absolute()}")


def rendering(call: Invocation) -> None:
    """Policies by differentiable rendering."""
    from eval import stages

    stages.ascend_on_objects(call.settings, call.out)
    evaluate(call)
    report(call)


def published_code(call: Invocation) -> None:
    """What the published code does otherwise than the thesis's text."""
    from eval import training

    training.train_by_view(call.settings, call.out, weights_of(call))
    evaluate(call)
    report(call)


def future_work(call: Invocation) -> None:
    """What the thesis names as future work."""
    from eval.future.study import line_of, study_future_work

    found = study_future_work(call.settings, call.out)
    random = ", ".join(f"{100 * share:.1f}" for share in found.random)
    views = " and ".join(map(str, found.counted))
    print(f"{found.objects} test objects, after {views} views; 95 % intervals over objects; random views {random} %")
    for row in found.rows:
        print(line_of(row))
    print(f"Best on validation objects: {found.best}. Table: {(call.out / 'future' / 'table.json').absolute()}")
