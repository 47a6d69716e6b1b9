"""The report's sections on view selection: accuracy, distance travelled, confidence, the thesis's grid, its published code."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from data_pipeline.dataset.builder import open_split
from eval.numbers.confidence import READINGS
from eval.report import figures
from eval.report.html import ReportInputs, difference, image, percent, rows_by_knowledge, signed, span, table
from mevs_jax.policies.base import Scene
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection import Episode, ViewTable, select_from_table


def _verdict(difference: float, interval: Sequence[float]) -> str:
    if interval[0] > 0:
        return f"better than random by {100 * difference:.1f} points"
    if interval[1] < 0:
        return f"worse than random by {-100 * difference:.1f} points"
    return f"not distinguishable from random ({signed(difference)} points)"


def _titles(metrics: dict[str, Any]) -> dict[str, str]:
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


def _steps(metrics: dict[str, Any], wanted: Sequence[int]) -> list[int]:
    """The wanted numbers of views that the walks reach."""
    return [step for step in wanted if step <= len(metrics["policies"]["random"]["after_views"])]


def lead(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    single, policies = metrics["single_view"], metrics["policies"]
    sentences = [
        f"Accuracy is {percent(single['accuracy'])} % from one view, {percent(policies['random']['after_views'][1])} % from two "
        f"random views, and {percent(single['all_views'])} % from the sum of all {metrics['views']}."
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
        f'<p class="lead">{" ".join(sentences)}</p><p class="note">Over {metrics["objects"]} test objects and '
        f"{metrics['starts']} start views of each. All policies have the same objects, start views and logits. Two "
        f"policies are called distinguishable if the 95 % interval of their difference, paired by object, excludes zero.</p>"
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
    steps = _steps(metrics, range(1, 10))
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


def ladder_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    policies, against = metrics["policies"], metrics["against_random"]
    steps = _steps(metrics, (2, 3, 4, 6, 9))
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
        "random in percentage points with its 95 % interval, in <span class='faint'>grey</span> if the interval contains zero. "
        "Each interval is for its own cell: of twenty differences that do not exist, one would be expected not to be grey. "
        f"Area: mean accuracy over 1 to {len(policies['random']['after_views'])} views.{reach_note}</p>"
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
        + image(
            figures.ladder_gains(against, metrics["ladder"], _steps(metrics, (2, 4)), ("label_oracle", "pair_oracle")),
            "Hollow markers: not distinguishable from random. Colours by what a policy uses: grey nothing, blue outputs "
            "of the networks, red views of other objects, orange the truth. The label oracles are left out; they would lie far "
            "to the right.",
        )
        + image(
            figures.accuracy_after_views(
                policies,
                _titles(metrics),
                metrics["single_view"]["all_views"],
                [rung["policy"] for rung in _own(metrics)],
            ),
            "Bands: 95 % intervals over objects.",
        )
        + _every_step(metrics)
    )


def ascent_section(inputs: ReportInputs) -> str:
    """The policies by differentiable rendering; empty if they were not evaluated."""
    found = inputs.metrics.get("climbing")
    if found is None:
        return ""
    steps = _steps(inputs.metrics, (2, 3, 4, 6))
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
        "thesis's predicted entropy, both with 95 % intervals.</p>"
        + table(["next view chosen by", *(f"{step} views" for step in steps)], rows_by_knowledge(rows))
        + f"<p class='note'>{found['objects']} test objects, every start view. {found['views_without_surface']} of "
        f"{found['views']:,} views show too little for a surface; the choice after such a view is arbitrary.</p>"
    )


def draws(metrics: dict[str, Any]) -> str:
    return f"{metrics['random_draws_per_start']} draws for each object and start view"


def movement_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    titles = _titles(metrics)
    last = _steps(metrics, (4,)) or [len(metrics["policies"]["random"]["after_views"])]
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
        "<h2>Accuracy by distance travelled</h2><p>Policies with a movement cost choose the view with the largest "
        "score − cost × great-circle distance (in radians).</p>"
        + image(
            figures.accuracy_by_distance(
                metrics["policies"], titles, metrics["movement"], [rung["policy"] for rung in _own(metrics)]
            ),
            "Markers: after 1, 2, 3, … views. Thin lines: the same policy with the movement cost printed at its end.",
        )
        + f"<details><summary>After {last[0]} views, by movement cost</summary>"
        + table(["policy", "movement cost", "accuracy (%)", "distance travelled"], rows)
        + "</details>"
    )


def confidence_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    titles = _titles(metrics)
    name = "information_gain"
    readings = metrics["confidence"][name]["readings"]
    steps = _steps(metrics, (1, 2, 4, 9))
    rows = [
        [
            html.escape(READINGS[reading]),
            *(f"{100 * values['ece'][step - 1]:.1f}" for step in steps),
            *(f"{values['nll'][step - 1]:.2f}" for step in steps),
            percent(values["accuracy"][steps[-1] - 1]),
        ]
        for reading, values in readings.items()
    ]
    header = ["confidence from", *(f"ECE, {s}" for s in steps), *(f"NLL, {s}" for s in steps), f"accuracy, {steps[-1]}"]
    stops = []
    for plain, calibrated in zip(
        readings["sum_of_logits"]["stopping"], readings["temperature"]["stopping"], strict=True
    ):
        row = [f"{100 * plain['risk']:g}"]
        for cell in (plain, calibrated):
            exceeded = cell["excess"][0] > 0
            error = "–" if cell["error"] is None else f"{100 * cell['error']:.1f}"
            row += [
                f"<b>{error}</b>" if exceeded else error,
                f"{100 * cell['sure']:.0f}",
                f"{cell['views']:.2f}",
                percent(cell["accuracy"]),
            ]
        stops.append(row)
    parts = ("error when confident", "confident", "views", "accuracy")
    return (
        f"<h2>Confidence and calibration</h2><p>Walks by {html.escape(titles[name])}. Adding logits treats the views of one "
        "object as independent, so confidence exceeds accuracy. A temperature for each number of views, fitted on validation "
        "walks, corrects this and changes no prediction; only the mean of probabilities can change one.</p>"
        + image(
            figures.calibration_by_views(readings, READINGS),
            "Expected calibration error (ECE), 15 bins, test objects. Temperatures and exponent are fitted on validation "
            "objects.",
        )
        + table(header, rows)
        + "<p class='note'>After the given number of views: ECE and accuracy in %, negative log-likelihood (NLL) in nats.</p>"
        + image(
            figures.reliability_curves(readings, READINGS, steps), "On the dotted line, confidence equals accuracy."
        )
        + "<p>Stopping as soon as the risk, 1 − confidence, is at most the requested risk. Columns except views in %; "
        "<b>bold</b>: the error exceeds the requested risk by its 95 % interval.</p>"
        + table(
            ["requested risk", *(f"{part}, summed" for part in parts), *(f"{part}, calibrated" for part in parts)],
            stops,
        )
    )


def compatibility_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    made = metrics["compatibility"]
    column = metrics["thresholds"].index(0.99)
    limits = [mv for mv in (2, 3, 4, 9) if mv in metrics["max_views"]]
    thesis, rows = made["thesis"], []
    if thesis:
        rows.append(
            [
                f"<i>the thesis, Table {thesis['table']}</i>",
                signed(thesis["mean"], 2),
                f"{thesis['above_zero']} of 56",
                *["" for _ in limits],
            ]
        )
    for row in made["rows"].values():
        if row["difference"] is None:
            rows.append(
                [html.escape(row["title"]), "<code>mevs study published-code</code>", "", *["" for _ in limits]]
            )
            continue
        cells = [
            difference(
                row["difference"][metrics["max_views"].index(mv)][column],
                row["interval"][metrics["max_views"].index(mv)][column],
            )
            for mv in limits
        ]
        rows.append(
            [
                html.escape(row["title"]),
                difference(row["mean"], row["mean_interval"], 2),
                f"{row['above_zero']} of {row['cells']}",
                *cells,
            ]
        )
    leak = made["single_view_accuracy"]
    note = ""
    if leak:
        ours, theirs = leak["classifier"], leak["classifier_by_view"]
        note = (
            f"<p class='note'>Single views, validation and test: {percent(ours['validation'])} % and {percent(ours['test'])} % "
            f"validated by object, {percent(theirs['validation'])} % and {percent(theirs['test'])} % by view.</p>"
        )
    return (
        "<h2>Differences between the thesis and its published code</h2><p>Gain of the PointNet++ policy over random in the grid "
        "above, in percentage points: first as the thesis's text describes it, then with one change at a time, and last with all "
        "changes of the published code. The use of all clouds is not part of the published code.</p>"
        + table(["switch", "mean of the grid", "cells above zero", *(f"CT 0.99, MV {mv}" for mv in limits)], rows)
        + note
    )


def grid_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    policies, against, titles = metrics["policies"], metrics["against_random"], _titles(metrics)
    shown = ("predicted_entropy", "oracle_entropy", "information_gain")
    parts = [
        "<h2>The thesis's grid</h2><p>A walk stops at a confidence threshold (CT, columns) or at a limit on views (MV, "
        "rows). Each interval is for its own cell, and neighbouring cells share their walks: if a policy did not differ "
        "from random, about one cell in twenty would be bold all the same.</p>",
        '<div class="figures">',
    ]
    for name in shown:
        low, high = np.moveaxis(np.array(against[name]["interval"]), -1, 0)
        parts.append(
            image(
                figures.difference_grid(
                    against[name]["difference"],
                    against[name]["interval"],
                    metrics["thresholds"],
                    metrics["max_views"],
                    f"{titles[name]} − random",
                ),
                f"Percentage points (thesis Tables 7 and 12). Bold: the 95 % interval excludes zero, in "
                f"{((low > 0) | (high < 0)).sum()} of {low.size} cells.",
            )
        )
    parts.append("</div>")
    for name in ("random", *shown):
        for key, label, show in (
            ("accuracy", "accuracy (%)", percent),
            ("class_accuracy", "class accuracy (%)", percent),
            ("views_used", "views used", lambda value: f"{value:.2f}"),
        ):
            rows = []
            for row, (mv, values) in enumerate(zip(metrics["max_views"], policies[name][key], strict=True)):
                cells = [show(value) for value in values]
                if key == "accuracy":
                    cells = [
                        f"{cell}<br><small class='note'>{span(interval)}</small>"
                        for cell, interval in zip(cells, policies[name]["interval"][row], strict=True)
                    ]
                rows.append([str(mv), *cells])
            shown_cells = table(["MV \\ CT", *(f"{ct:g}" for ct in metrics["thresholds"])], rows)
            parts.append(f"<details><summary>{titles[name]}: {label}</summary>{shown_cells}</details>")
    matrices = {
        titles[name]: np.array(policies[name]["headline_confusion"]) for name in ("random", "predicted_entropy")
    }
    headline = metrics["headline"]
    parts.append(
        image(
            figures.confusions(matrices, inputs.statistics.classes),
            f"Percentages of each true class; CT {headline['threshold']}, MV {headline['max_views']} (thesis Fig. 23).",
        )
    )
    return "".join(parts) + _example_walk(inputs)


def _example_walk(inputs: ReportInputs) -> str:
    """A walk of the predicted-entropy policy that starts with a wrong prediction and ends with the right one, if there is one."""
    tables, statistics = inputs.tables, inputs.statistics
    graph = statistics.graph
    stacked = tables.stacked()

    @jax.jit
    def walk_along(table: ViewTable, start: int | jax.Array) -> Episode:
        steps = min(4, statistics.views)
        return select_from_table(
            jax.random.key(0), table, Scene(graph, table.entropy), POLICIES["predicted_entropy"], start, max_views=steps
        )

    def walk(index: int, start: int) -> Episode:
        return walk_along(jax.tree.map(lambda leaf: leaf[index], stacked), start)

    wrong = np.argwhere(tables.logits.argmax(-1) != tables.labels[:, None])
    episode, index = None, 0
    for candidate, start in wrong[:: max(1, len(wrong) // 50)]:
        episode, index = walk(int(candidate), int(start)), int(candidate)
        if int(episode.predictions[-1]) == tables.labels[index]:
            break
    episode = episode or walk(0, 0)
    images = open_split(inputs.data, "test")[index]["image"]
    views = np.asarray(episode.views)
    captions = [
        f"view {view}: {statistics.classes[int(p)]}\n{100 * float(c):.0f} % confident"
        for view, p, c in zip(views, episode.predictions, episode.confidences, strict=True)
    ]
    title = f"{tables.names[index]}: the views chosen, and the prediction after each"
    return image(
        figures.episode_strip([images[view] for view in views], captions, title),
        "One walk of the PointNet++ policy.",
        "png",
    )
