"""The report's sections on view selection: accuracy by policy, choosing by rendering, distance travelled."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from eval.report import figures
from eval.report.html import MARKS, ReportInputs, difference, image, percent, rows_by_knowledge, signed, span, table


def _verdict(difference: float, interval: Sequence[float]) -> str:
    if interval[0] > 0:
        return f"better than random by {100 * difference:.1f} points"
    if interval[1] < 0:
        return f"worse than random by {-100 * difference:.1f} points"
    return f"not distinguishable from random ({signed(difference)} points)"


def titles_of(metrics: dict[str, Any]) -> dict[str, str]:
    return {rung["policy"]: rung["title"].lstrip("— ") for rung in metrics["ladder"]}


def _own(metrics: dict[str, Any]) -> list[dict[str, Any]]:
    """The policies of the user."""
    return [rung for rung in metrics["ladder"] if "own" in rung]


def _sources(metrics: dict[str, Any]) -> str:
    """A note that names where the user's policies come from; empty without any."""
    named = [
        f"“{html.escape(rung['title'])}” is <code>{html.escape(rung['own']['module'])}:{html.escape(rung['own']['name'])}"
        f"</code> (source {rung['own']['source']})"
        for rung in _own(metrics)
        if rung["own"]
    ]
    return f"<p class='note'>Policies of one's own: {'; '.join(named)}.</p>" if named else ""


def steps_of(metrics: dict[str, Any], wanted: Sequence[int]) -> list[int]:
    """The wanted numbers of views that the walks reach."""
    return [step for step in wanted if step <= len(metrics["policies"]["random"]["after_views"])]


def lead(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    single, policies = metrics["single_view"], metrics["policies"]
    sentences = [
        f"The classifier names the object from one view with an accuracy of {percent(single['accuracy'])} %, from two random "
        f"views with {percent(policies['random']['after_views'][1])} %, and from all {metrics['views']} with "
        f"{percent(single['all_views'])} %."
    ]
    for name, called in (
        ("predicted_entropy", "the thesis's policy (PointNet++ entropy)"),
        ("oracle_entropy", "perfect knowledge of the entropies"),
        ("information_gain", "expected information gain"),
    ):
        result = metrics["against_random"][name]
        verdict = _verdict(result["after_views_difference"][1], result["after_views_interval"][1])
        sentences.append(f"At two views, {called} is {verdict}.")
    return (
        f'<p class="lead">{" ".join(sentences)}</p>'
        f"<p>A <dfn>view</dfn> is one depth image of the object, from one of the {metrics['views']} candidate directions "
        "around it. A <dfn>policy</dfn> is a rule that chooses the next view from what was seen so far. The classifier gives "
        "one number for each class and view, the <dfn>logits</dfn>; the logits of all views seen are added, and the class "
        "with the largest sum is the answer. The sums give a probability for each class, the <dfn>belief</dfn>. The "
        "<dfn>depth entropy</dfn> of a view says how varied its depths are; <i>the thesis</i> (Learning Optimal View "
        "Selection for Multi-View Object Representation, which this program reimplements) prefers views where it is high, and "
        "predicts it by the network PointNet++. <dfn>Expected information gain</dfn> is how much surer the belief is expected "
        "to become by a view, in <dfn>nats</dfn>: a choice between two equally likely classes has 0.69 nats. An "
        "<dfn>oracle</dfn> is a policy that knows something about the object that a robot cannot know.</p>"
        f'<p class="note">Over {metrics["objects"]} test objects and {metrics["starts"]} start views of each: every walk begins '
        "at another view. All policies have the same objects, start views and logits. <dfn>Validation objects</dfn> are "
        "neither trained on nor tested on; the best epoch of a training and all that is fitted later is chosen on them. A "
        "<dfn>95 % interval</dfn> is computed by drawing the test objects again, with repetition, many times: in 95 % of the "
        "draws the value lies inside. Two policies are called distinguishable if the 95 % interval of their difference, "
        "paired by object, excludes zero.</p>"
    )


def _ladder_row(rung: dict[str, Any], metrics: dict[str, Any], steps: Sequence[int]) -> list[str]:
    name, result, against = rung["policy"], metrics["policies"][rung["policy"]], metrics["against_random"]
    row = [html.escape(rung["title"])]
    for step in steps:
        cell = f"<b>{percent(result['after_views'][step - 1])}</b>"
        if name in against:
            gain, interval = (against[name][f"after_views_{key}"][step - 1] for key in ("difference", "interval"))
            cell += "<br>" + difference(gain, interval)
        row.append(cell)
    area = f"<b>{percent(result['area'])}</b>"
    if name in against:
        area += "<br>" + difference(against[name]["area_difference"], against[name]["area_interval"])
    return [*row, area]


def _views_to_reach(reach: dict[str, Any], name: str) -> str:
    views = reach["views"][name]
    low, high = ("∞" if end is None else f"{end:.1f}" for end in reach["interval"][name])
    return ("never" if views is None else f"<b>{views:.1f}</b>") + f"<br><small>[{low}, {high}]</small>"


def _every_step(metrics: dict[str, Any]) -> str:
    """The folded table of accuracies after each number of views."""
    steps = steps_of(metrics, range(1, 10))
    rows = []
    for rung in metrics["ladder"]:
        result = metrics["policies"][rung["policy"]]
        cells = [
            f"{percent(result['after_views'][step - 1])}<br><small class='note'>"
            f"{span(result['after_views_interval'][step - 1])}</small>"
            for step in steps
        ]
        rows.append([html.escape(rung["title"]), *cells])
    return (
        "<details><summary>Accuracy (%) after each number of views, with 95 % intervals</summary>"
        + table(["policy", *map(str, steps)], rows)
        + "</details>"
    )


def _gain_figures(metrics: dict[str, Any]) -> str:
    """Gains over random, a figure for each of some numbers of views."""
    left_out, against, titles = ("label_oracle", "pair_oracle"), metrics["against_random"], titles_of(metrics)
    shown = []
    for count in steps_of(metrics, (2, 4)):
        gains = {
            name: (found["after_views_difference"][count - 1], found["after_views_interval"][count - 1])
            for name, found in against.items()
            if name in titles and name not in left_out
        }
        best = max(gains, key=lambda name: gains[name][0])
        above, below = (
            [titles[name] for name, (_, (low, high)) in gains.items() if (low > 0 if way else high < 0)]
            for way in (True, False)
        )
        alt = (
            f"Gains over random after {count} views, with intervals. The largest is {signed(gains[best][0])} points, by "
            f"{titles[best]}. Above zero: {', '.join(above) or 'none'}. Below zero: {', '.join(below) or 'none'}."
        )
        shown.append(
            image(
                figures.ladder_gains(against, metrics["ladder"], count, left_out),
                "Hollow markers: not distinguishable from random. Circles: the policy uses nothing; squares: outputs of the "
                "networks; triangles: views of other objects; crosses: the truth. The label oracles are left out; they would "
                "lie "
                "far to the right.",
                alt,
            )
        )
    return f'<div class="figures">{"".join(shown)}</div>'


def _alt_of_curves(metrics: dict[str, Any]) -> str:
    """Says what the curves of accuracy by number of views show."""
    policies, titles = metrics["policies"], titles_of(metrics)
    last = len(policies["random"]["after_views"])
    parts = [
        f"{titles[name]} {percent(policies[name]['after_views'][0])} % after one view and "
        f"{percent(policies[name]['after_views'][-1])} % after {last}"
        for name in ("random", "predicted_entropy", "information_gain")
    ]
    return f"Curves of accuracy by number of views: {'; '.join(parts)}. The table has all numbers."


def ladder_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    policies = metrics["policies"]
    steps = steps_of(metrics, (2, 3, 4, 6, 9))
    reach = metrics["views_to_reach"].get("5") or metrics["views_to_reach"].get("3")
    rows = []
    for rung in metrics["ladder"]:
        row = _ladder_row(rung, metrics, steps)
        rows.append((rung["knows"], [*row, _views_to_reach(reach, rung["policy"])] if reach else row))
    header = ["next view chosen by", *(f"{step} views" for step in steps), "area"]
    if reach:
        target = next(key for key, value in metrics["views_to_reach"].items() if value is reach)
        header.append(f"views to reach {percent(reach['accuracy'])} %")
        reach_note = f" Last column: number of views needed for the accuracy of {target} random views."
    else:
        reach_note = ""
    exact = metrics["random_exact_up_to"]
    return (
        "<h2>Accuracy by policy</h2><p>Accuracy (%) after exactly the given number of views. Below it: the difference from "
        f"random in percentage points with its 95 % interval. {MARKS} Each interval is for its own cell: of twenty differences "
        "that do not exist, one would be expected to be marked. <dfn>Area</dfn>: mean accuracy over 1 to "
        f"{len(policies['random']['after_views'])} views.{reach_note}</p>"
        + table(header, rows_by_knowledge(rows))
        + f"<p class='note'>Random selection without repetition is computed as an exact expectation up to {exact} views"
        + (
            ""
            if exact >= len(policies["random"]["after_views"])
            else f", and as a mean over {draws(metrics)} beyond that"
        )
        + ". The label oracles are optimistic, because they also find views that are right by chance. With the best pair of "
        f"views for the known label, accuracy is {percent(metrics['best_pair']['accuracy'])} % "
        f"[{span(metrics['best_pair']['interval'])}].</p>"
        + _sources(metrics)
        + _gain_figures(metrics)
        + image(
            figures.accuracy_after_views(
                policies,
                titles_of(metrics),
                metrics["single_view"]["all_views"],
                [rung["policy"] for rung in _own(metrics)],
            ),
            "Bands: 95 % intervals over objects.",
            _alt_of_curves(metrics),
        )
        + _every_step(metrics)
    )


def ascent_section(inputs: ReportInputs) -> str:
    """The policies by differentiable rendering; empty if they were not evaluated."""
    found = inputs.metrics.get("climbing")
    if found is None:
        return ""
    steps = steps_of(inputs.metrics, (2, 3, 4, 6))
    against, rows = found["against"], []
    for rung in found["ladder"]:
        name = rung["policy"]
        row = [html.escape(rung["title"])]
        for step in steps:
            cell = f"<b>{percent(found['policies'][name]['after_views'][step - 1])}</b>"
            for base in against.values():
                if name in base:
                    gain, interval = (base[name][f"after_views_{key}"][step - 1] for key in ("difference", "interval"))
                    cell += "<br>" + difference(gain, interval)
                else:
                    cell += "<br>–"
            row.append(cell)
        rows.append((rung["knows"], row))
    settings = found["settings"]
    return (
        "<h2>Choosing by differentiable rendering</h2><p>The thesis's other two methods. They reconstruct a volume, or a "
        f"surface of at most {settings['faces']} faces, from the latest view. Gradient ascent over the sphere from "
        f"{settings['starts']} start views then maximises the objective, rendered at "
        f"{settings['resolution']}×{settings['resolution']} pixels. The distinct optima are visited in the order of their "
        "values. Accuracy (%) after the given number of views; below it the difference from random, and below that from the "
        f"thesis's predicted entropy, both with 95 % intervals. {MARKS}</p>"
        + table(["next view chosen by", *(f"{step} views" for step in steps)], rows_by_knowledge(rows))
        + f"<p class='note'>{found['objects']} test objects, every start view. {found['views_without_surface']} of "
        f"{found['views']:,} views show too little for a surface; the choice after such a view is arbitrary.</p>"
    )


def draws(metrics: dict[str, Any]) -> str:
    return f"{metrics['random_draws_per_start']} draws for each object and start view"


def _distances(metrics: dict[str, Any], titles: dict[str, str], last: int) -> list[str]:
    """A sentence for each policy with a movement cost, on accuracy and distance after some views."""
    return [
        f"{titles[name]} travels {np.degrees(runs[0]['travelled'][last - 1]):.0f} degrees for {last} views and reaches "
        f"{percent(runs[0]['after_views'][last - 1])} %; with the largest movement cost "
        f"{np.degrees(runs[-1]['travelled'][last - 1]):.0f} degrees and {percent(runs[-1]['after_views'][last - 1])} %."
        for name, runs in metrics["movement"].items()
    ]


def movement_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    titles = titles_of(metrics)
    last = steps_of(metrics, (4,)) or [len(metrics["policies"]["random"]["after_views"])]
    rows = [
        [
            html.escape(titles[name]),
            f"{run['cost']:g}",
            percent(run["after_views"][last[0] - 1]),
            f"{np.degrees(run['travelled'][last[0] - 1]):.0f}°",
        ]
        for name, runs in metrics["movement"].items()
        for run in runs
    ]
    return (
        "<h2>Accuracy by distance travelled</h2><p>The camera moves on a sphere around the object. A distance is the angle "
        "along the shortest way (a great circle). Policies with a <dfn>movement cost</dfn> choose the view with the largest "
        "score − cost × distance in radians (57° are one radian), so they prefer near views.</p>"
        + image(
            figures.accuracy_by_distance(
                metrics["policies"], titles, metrics["movement"], [rung["policy"] for rung in _own(metrics)]
            ),
            "Markers: after 1, 2, 3, … views. Thin lines, of the same style: a policy with movement costs; the smallest and "
            "the largest are printed at the ends.",
            f"Curves of accuracy by degrees travelled. {' '.join(_distances(metrics, titles, last[0]))}",
        )
        + f"<details><summary>After {last[0]} views, by movement cost</summary>"
        + table(["policy", "movement cost", "accuracy (%)", "distance travelled"], rows)
        + "</details>"
    )
