"""The report's sections on view selection: accuracy by policy, choosing by rendering, distance travelled."""

from __future__ import annotations

import html
from collections.abc import Iterable

import numpy as np

from eval.numbers.metrics import Difference, Metrics, Reach, Summary
from eval.report import figures
from eval.report.html import (
    MARKS,
    Interval,
    ReportInputs,
    difference,
    folded,
    image,
    mark,
    percent,
    rows_by_knowledge,
    signed,
    span,
    table,
    with_interval,
)


def steps_of(metrics: Metrics, wanted: Iterable[int]) -> list[int]:
    """The wanted numbers of views that the walks reach."""
    return [step for step in wanted if step <= metrics.most_views]


def draws(metrics: Metrics) -> str:
    return f"{metrics.random_draws_per_start} draws for each object and start view"


def lead(inputs: ReportInputs) -> str:
    """The first sentences of the report, and the terms that it uses."""
    metrics = inputs.metrics
    single = metrics.single_view
    sentences = [
        f"The classifier names the object from one view with an accuracy of {percent(single.accuracy)} %, from two random "
        f"views with {percent(metrics.policies['random'].after_views[1])} %, and from all {metrics.views} with "
        f"{percent(single.all_views)} %."
    ]
    for name, called in (
        ("predicted_entropy", "the thesis's policy (PointNet++ entropy)"),
        ("oracle_entropy", "perfect knowledge of the entropies"),
        ("information_gain", "expected information gain"),
    ):
        gain = metrics.against_random[name]
        verdict = _verdict(gain.after_views_difference[1], gain.after_views_interval[1])
        sentences.append(f"At two views, {called} is {verdict}.")
    return (
        f'<p class="lead">{" ".join(sentences)}</p>'
        f"<p>A <dfn>view</dfn> is one depth image of the object, from one of the {metrics.views} candidate directions "
        "around it. A <dfn>policy</dfn> is a rule that chooses the next view from what was seen so far. The classifier gives "
        "one number for each class and view, the <dfn>logits</dfn>; the logits of all views seen are added, and the class "
        "with the largest sum is the answer. The sums give a probability for each class, the <dfn>belief</dfn>. The "
        "<dfn>depth entropy</dfn> of a view says how varied its depths are; <i>the thesis</i> (Learning Optimal View "
        "Selection for Multi-View Object Representation, which this program reimplements) prefers views where it is high, and "
        "predicts it by the network PointNet++. <dfn>Expected information gain</dfn> is how much surer the belief is expected "
        "to become by a view, in <dfn>nats</dfn>: a choice between two equally likely classes has 0.69 nats. An "
        "<dfn>oracle</dfn> is a policy that knows something about the object that a robot cannot know.</p>"
        f'<p class="note">Over {metrics.objects} test objects and {metrics.starts} start views of each: every walk begins '
        "at another view. All policies have the same objects, start views and logits. <dfn>Validation objects</dfn> are "
        "neither trained on nor tested on; the best epoch of a training and all that is fitted later is chosen on them. A "
        "<dfn>95 % interval</dfn> is computed by drawing the test objects again, with repetition, many times: in 95 % of the "
        "draws the value lies inside. Two policies are called distinguishable if the 95 % interval of their difference, "
        "paired by object, excludes zero.</p>"
    )


def _verdict(difference: float, interval: Interval) -> str:
    if interval[0] > 0:
        return f"better than random by {100 * difference:.1f} points"
    if interval[1] < 0:
        return f"worse than random by {-100 * difference:.1f} points"
    return f"not distinguishable from random ({signed(difference)} points)"


def _cell(policy: Summary, gains: Iterable[Difference | None], step: int) -> str:
    """Accuracy after some views, and below it the differences from other policies; a dash for a policy itself."""
    parts = [f"<b>{percent(policy.after_views[step - 1])}</b>"]
    for gain in gains:
        at = step - 1
        parts.append(
            "–" if gain is None else difference(gain.after_views_difference[at], gain.after_views_interval[at])
        )
    return "<br>".join(parts)


def _views_to_reach(reach: Reach, name: str) -> str:
    views = reach.views[name]
    low, high = ("∞" if end is None else f"{end:.1f}" for end in reach.interval[name])
    return ("never" if views is None else f"<b>{views:.1f}</b>") + f"<br><small>[{low}, {high}]</small>"


def ladder_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    last, exact = metrics.most_views, metrics.random_exact_up_to
    beyond = "" if exact >= last else f", and as a mean over {draws(metrics)} beyond that"
    target = next((views for views in (5, 3) if views in metrics.views_to_reach), None)
    note = f" Last column: number of views needed for the accuracy of {target} random views." if target else ""
    return (
        "<h2>Accuracy by policy</h2><p>Accuracy (%) after exactly the given number of views. Below it: the difference from "
        f"random in percentage points with its 95 % interval. {MARKS} Each interval is for its own cell: of twenty differences "
        "that do not exist, one would be expected to be marked. <dfn>Area</dfn>: mean accuracy over 1 to "
        f"{last} views.{note}</p>"
        + _ladder(metrics, target)
        + f"<p class='note'>Random selection without repetition is computed as an exact expectation up to {exact} views"
        f"{beyond}. The label oracles are optimistic, because they also find views that are right by chance. With the best "
        f"pair of views for the known label, accuracy is {percent(metrics.best_pair.accuracy)} % "
        f"[{span(metrics.best_pair.interval)}].</p>"
        + _sources(metrics)
        + _gain_figures(metrics)
        + image(figures.accuracy_after_views(metrics), "Bands: 95 % intervals over objects.", _alt_of_curves(metrics))
        + _every_step(metrics)
    )


def _ladder(metrics: Metrics, target: int | None) -> str:
    """The table of all policies; `target` is the number of random views whose accuracy the last column is about."""
    steps, rows = steps_of(metrics, (2, 3, 4, 6, 9)), []
    header = ["next view chosen by", *(f"{step} views" for step in steps), "area"]
    if target is not None:
        header.append(f"views to reach {percent(metrics.views_to_reach[target].accuracy)} %")
    for listed in metrics.ladder:
        policy, gain = metrics.policies[listed.policy], metrics.against_random.get(listed.policy)
        row = [html.escape(listed.title), *(_cell(policy, [gain] if gain else [], step) for step in steps)]
        area = [f"<b>{percent(policy.area)}</b>"]
        if gain is not None:
            area.append(difference(gain.area_difference, gain.area_interval))
        row.append("<br>".join(area))
        if target is not None:
            row.append(_views_to_reach(metrics.views_to_reach[target], listed.policy))
        rows.append((listed.knows, row))
    return table(header, rows_by_knowledge(rows))


def _sources(metrics: Metrics) -> str:
    """A note that names where the user's policies come from; empty without any."""
    named = [
        f"“{html.escape(listed.title)}” is <code>{html.escape(listed.own['module'])}:{html.escape(listed.own['name'])}"
        f"</code> (source {listed.own['source']})"
        for listed in metrics.own
        if listed.own
    ]
    return f"<p class='note'>Policies of one's own: {'; '.join(named)}.</p>" if named else ""


def _every_step(metrics: Metrics) -> str:
    """The folded table of accuracies after each number of views."""
    steps, rows = steps_of(metrics, range(1, 10)), []
    for listed in metrics.ladder:
        policy = metrics.policies[listed.policy]
        known = zip(policy.after_views, policy.after_views_interval, strict=True)
        cells = [with_interval(percent(accuracy), interval) for accuracy, interval in known][: len(steps)]
        rows.append([html.escape(listed.title), *cells])
    return folded(
        "Accuracy (%) after each number of views, with 95 % intervals", table(["policy", *map(str, steps)], rows)
    )


def _gain_figures(metrics: Metrics) -> str:
    """Gains over random, a figure for each of some numbers of views."""
    left_out, titles, shown = ("label_oracle", "pair_oracle"), metrics.titles, []
    for count in steps_of(metrics, (2, 4)):
        gains = {
            name: (gain.after_views_difference[count - 1], gain.after_views_interval[count - 1])
            for name, gain in metrics.against_random.items()
            if name in titles and name not in left_out
        }
        best = max(gains, key=lambda name: gains[name][0])
        above, below = (
            [titles[name] for name, (_, interval) in gains.items() if mark(interval) == sign] for sign in "▲▼"
        )
        shown.append(
            image(
                figures.ladder_gains(metrics, count, left_out),
                "Hollow markers: not distinguishable from random. Circles: the policy uses nothing; squares: outputs of the "
                "networks; triangles: views of other objects; crosses: the truth. The label oracles are left out; they would "
                "lie far to the right.",
                f"Gains over random after {count} views, with intervals. The largest is {signed(gains[best][0])} points, by "
                f"{titles[best]}. Above zero: {', '.join(above) or 'none'}. Below zero: {', '.join(below) or 'none'}.",
            )
        )
    return f'<div class="figures">{"".join(shown)}</div>'


def _alt_of_curves(metrics: Metrics) -> str:
    """Says what the curves of accuracy by number of views show."""
    parts = []
    for name in ("random", "predicted_entropy", "information_gain"):
        after = metrics.policies[name].after_views
        parts.append(
            f"{metrics.titles[name]} {percent(after[0])} % after one view and {percent(after[-1])} % after {len(after)}"
        )
    return f"Curves of accuracy by number of views: {'; '.join(parts)}. The table has all numbers."


def ascent_section(inputs: ReportInputs) -> str:
    """The policies by differentiable rendering; empty if they were not evaluated."""
    found = inputs.metrics.ascents
    if found is None:
        return ""
    steps, rows = steps_of(inputs.metrics, (2, 3, 4, 6)), []
    for listed in found.ladder:
        gains = [base.get(listed.policy) for base in found.against.values()]
        cells = [_cell(found.policies[listed.policy], gains, step) for step in steps]
        rows.append((listed.knows, [html.escape(listed.title), *cells]))
    settings = found.settings
    return (
        "<h2>Choosing by differentiable rendering</h2><p>The thesis's other two methods. They reconstruct a volume, or a "
        f"surface of at most {settings.faces} faces, from the latest view. Gradient ascent over the sphere from "
        f"{settings.starts} start views then maximises the objective, rendered at "
        f"{settings.resolution}×{settings.resolution} pixels. The distinct optima are visited in the order of their "
        "values. Accuracy (%) after the given number of views; below it the difference from random, and below that from the "
        f"thesis's predicted entropy, both with 95 % intervals. {MARKS}</p>"
        + table(["next view chosen by", *(f"{step} views" for step in steps)], rows_by_knowledge(rows))
        + f"<p class='note'>{found.objects} test objects, every start view. {found.views_without_surface} of "
        f"{found.views:,} views show too little for a surface; the choice after such a view is arbitrary.</p>"
    )


def movement_section(inputs: ReportInputs) -> str:
    metrics, rows, said = inputs.metrics, [], []
    last = min(4, metrics.most_views)
    for name, runs in metrics.movement.items():
        title = metrics.titles[name]
        shown = [(percent(run.after_views[last - 1]), f"{np.degrees(run.travelled[last - 1]):.0f}") for run in runs]
        for run, (accuracy, degrees) in zip(runs, shown, strict=True):
            rows.append([html.escape(title), f"{run.cost:g}", accuracy, f"{degrees}°"])
        (accuracy, degrees), (with_cost, fewer) = shown[0], shown[-1]
        said.append(
            f"{title} travels {degrees} degrees for {last} views and reaches {accuracy} %; with the largest movement cost "
            f"{fewer} degrees and {with_cost} %."
        )
    return (
        "<h2>Accuracy by distance travelled</h2><p>The camera moves on a sphere around the object. A distance is the angle "
        "along the shortest way (a great circle). Policies with a <dfn>movement cost</dfn> choose the view with the largest "
        "score − cost × distance in radians (57° are one radian), so they prefer near views.</p>"
        + image(
            figures.accuracy_by_distance(metrics),
            "Markers: after 1, 2, 3, … views. Thin lines, of the same style: a policy with movement costs; the smallest and "
            "the largest are printed at the ends.",
            f"Curves of accuracy by degrees travelled. {' '.join(said)}",
        )
        + folded(
            f"After {last} views, by movement cost",
            table(["policy", "movement cost", "accuracy (%)", "distance travelled"], rows),
        )
    )
