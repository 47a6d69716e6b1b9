"""The page of `mevs study learned`: learned fusion and learned view selection compared with all other policies."""

from __future__ import annotations

import html
import math
from pathlib import Path
from statistics import fmean
from typing import Any

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.files import write_text
from eval.learned.other_cases import novel, rotated, scattered, unposed
from eval.learned.tables import METHOD, accuracy, against, gain_of_two, ladder
from eval.report import figures
from eval.report.html import (
    commands,
    difference,
    document,
    image,
    percent,
    table,
    warning,
)
from mevs_jax.trained.system import EXPECTED_VIEWS
from train.results.chance import Chance


def _ablations(metrics: dict[str, Any]) -> str:
    """The effect of each part of the method."""
    if "ablations" not in metrics["seeds"][0]:
        return ""
    ((_, found),) = metrics["seeds"][0]["ablations"].items()
    return (
        "<h2>Ablations</h2><p>The view policy, and variants that each change one thing, from the same start views.</p>"
        + ladder(found)
        + against(found, ("random", METHOD))
    )


def _sets(found: dict[str, Any]) -> str:
    rows = [
        [
            str(row["views"]),
            *(accuracy(row[name]["accuracy"], row[name]["interval"]) for name in ("sum", "learned")),
            difference(row["difference"], row["difference_interval"]),
            *(percent(row[name]["calibration_error"]) for name in ("sum", "learned")),
        ]
        for row in found["random_sets"]
    ]
    header = ["random views", "sum of logits", "set fusion", "difference", "ECE, sum", "ECE, set fusion"]
    return table(header, rows)


def _confidence(found: dict[str, Any]) -> str:
    policy = found["policies"][METHOD]
    known = zip(policy["calibration_error"], policy["calibration_error_by_chance"], strict=True)
    errors = [[str(step + 1), *map(percent, (error, *chance))] for step, (error, chance) in enumerate(known)]
    rows = [
        [
            f"{100 * row['risk']:g} %",
            percent(row["sure"]),
            "–" if row["error"] is None else percent(row["error"]),
            percent(row["accuracy"]),
            f"{row['views']:.2f}",
        ]
        for row in policy["stopping"]
    ]
    return (
        table(["views", "calibration error (%)", "by chance: mean", "by chance: 95th percentile"], errors)
        + "<p class='note'>By chance: the error measured on as many objects for a perfectly calibrated confidence.</p>"
        + "<p>Stopping as soon as the calibrated risk is at most the given value, or at the last view.</p>"
        + table(["risk", "confident (%)", "of those wrong (%)", "accuracy (%)", "views"], rows)
    )


def _costs(found: dict[str, Any]) -> str:
    """Stopping rules, and the distance travelled with a movement cost."""
    costs = found.get("costs")
    if costs is None:
        return ""
    walks = html.escape(found["policies"][costs["thesis_walks"]]["title"])
    header = ["accuracy (%)", "views", "by calibrated risk: accuracy (%)", "views", "fewer views"]
    thesis = [[f"{row['threshold']:g}", *_both_rules(row)] for row in costs["beside_thesis"]]
    by_gain = [[f"{-row['threshold']:g}", *_both_rules(row)] for row in costs["not_paying"]]
    steps = [step for step in (1, 3, 7) if step < len(costs["moving"][0]["way"])]
    moving = [
        [
            f"{row['cost']:g}",
            *(
                cell
                for step in steps
                for cell in (
                    accuracy(row["after_views"][step], row["interval"][step]),
                    f"{math.degrees(row['way'][step]):.0f}°",
                )
            ),
        ]
        for row in costs["moving"]
    ]
    return (
        "<h3>Comparison with the thesis's stopping rule</h3>"
        f"<p>The thesis's rule: walks by “{walks}”, the sum of logits, and a threshold on its uncalibrated confidence. The view "
        "policy stops at the calibrated risk that gives the same accuracy on validation objects (– if there is none).</p>"
        + table(["threshold", *header], thesis)
        + "<h3>Stopping when a further view does not pay</h3><p>Stopping as soon as the expected gain of the best remaining "
        "view, in the log-probability of the true class (nats), is below the cost of a view; compared with stopping by "
        "calibrated risk at equal accuracy on validation objects.</p>"
        + table(["cost of a view", *header], by_gain)
        + "<h2>Movement cost</h2><p>Accuracy (%) and distance travelled when each radian of movement has the given cost (nats), "
        "which is subtracted from the expected gain. Walks begin at the start views of the oracles.</p>"
        + table(
            ["movement cost", *(title for step in steps for title in (f"{step + 1} views", "distance travelled"))],
            moving,
        )
    )


def _both_rules(row: dict[str, Any]) -> list[str]:
    own = row["ours"]
    cells = [percent(row["accuracy"]), f"{row['views']:.2f}"]
    if own is None:
        return [*cells, "–", "–", "–"]
    gain = own["views_difference"]
    low, high = gain["interval"]
    fewer = difference(-gain["difference"] / 100, [-high / 100, -low / 100], 2)  # a number, not a share
    return [*cells, percent(own["accuracy"]), f"{own['views']:.2f}", fewer]


def _lead(metrics: dict[str, Any], views: str) -> str:
    """The main results, as means over all seeds."""
    each, together = [seed["lattices"][views] for seed in metrics["seeds"]], metrics["together"][views]
    method, random = (together["policies"][name]["after_views"] for name in (METHOD, "random"))
    gains, first, others = together["against"]["random"], each[0], ""
    for name, title in (
        (EXPECTED_VIEWS, "Information gain by expected views"),
        ("learned_and_table", "The mean of both"),
    ):
        if name in gains:
            known = together["policies"][name]["after_views"]
            others += f" {title} reaches {percent(known[1])} %: {gain_of_two(gains, name)}."
    single = fmean(found["single_view"] for found in each)
    every, summed = (fmean(found["random_sets"][-1][name]["accuracy"] for found in each) for name in ("learned", "sum"))
    trainings = f" Means of {len(each)} seeds; the numbers below are of the first seed unless stated otherwise." * (
        len(each) > 1
    )
    return (
        f'<p class="lead">Accuracy after two views is {percent(method[1])} % if the policy chooses the second and '
        f"{percent(random[1])} % if it is random: {gain_of_two(gains)} points.{others} Accuracy from one view is "
        f"{percent(random[0])} %, and {percent(single)} % from its logits without the fusion; from all "
        f"{first['random_sets'][-1]['views']} views it is {percent(every)} % fused and {percent(summed)} % "
        f"summed.{trainings}</p><p>A <dfn>view</dfn> is one depth image of the object from one of the candidate directions. A "
        "<dfn>policy</dfn> chooses the next view from those seen so far. The <dfn>fusion</dfn> is a network that makes one "
        "<dfn>belief</dfn>, a probability for each class, from all views seen. <i>The thesis</i> (Learning Optimal View "
        "Selection for Multi-View Object Representation) adds the <dfn>logits</dfn> instead, a classifier's numbers for each "
        "class. The <dfn>view policy</dfn> is a network that predicts the gain of every candidate. <dfn>Expected views</dfn> are "
        "what the recogniser says on average of its own training objects, by class and as a function of the direction; from "
        "them the expected information gain of every candidate follows without a further network. <dfn>Calibration error"
        "</dfn> (ECE) is the mean distance between confidence and accuracy, over bins of confidence. A <dfn>nat</dfn> is "
        "the unit of natural logarithms of probabilities; <dfn>risk</dfn> is 1 − confidence. An <dfn>oracle</dfn> knows what "
        "a robot cannot know.</p>"
        f'<p class="note">Over {first["objects"]} test objects and every start view. All policies use the same fusion, '
        f"objects and start views. Everything is fitted or chosen on {first['validation_objects']} validation objects. The "
        "views of these lattices are not in the training data, which has other directions around other objects.</p>"
    )


def _decision(metrics: dict[str, Any]) -> str:
    found = metrics["seeds"][0]["decision"]
    ran_on = found["identity"]["machine"]
    features, image = (
        "{:.1f} ms (99th percentile: {:.1f})".format(*(found[name][share] for share in ("p50", "p99")))
        for name in ("from_features", "from_image")
    )
    return (
        f"<p>One decision among {found['identity']['candidates']} candidates takes {features} from stored features, "
        f"and {image} from the latest depth image: {html.escape(ran_on['cpu'])}, {ran_on['cores']} cores; "
        f"{html.escape(ran_on['device'])}.</p>"
    )


def _seeds(metrics: dict[str, Any], views: str) -> str:
    """Means over all seeds, and the main results of each seed."""
    if len(metrics["seeds"]) < 2:
        return ""
    each = [found["lattices"][views] for found in metrics["seeds"]]
    titles = {name: each[0]["policies"][name]["title"] for name in ("random", "farthest", "fixed_order", METHOD)}
    errors, rows = metrics["together"][views]["policies"][METHOD]["calibration_error"], []
    for name, title in titles.items():
        after = [found["policies"][name]["after_views"][:4] for found in each]
        rows += [[html.escape(title), str(seed), *map(percent, shares)] for seed, shares in enumerate(after)]
    gains, both = [], metrics["together"][views].get("against_over_both", {})
    for base in ("random", "farthest", "fixed_order"):
        if METHOD in both.get(base, {}):
            mean = metrics["together"][views]["against"][base][METHOD]["difference"][1:4]
            cells = zip(mean, both[base][METHOD][1:4], strict=True)
            gains.append([html.escape(titles[base]), "mean, over both", *(difference(*cell) for cell in cells)])
        for seed, found in enumerate(each):
            gain = found["against"][base][METHOD]
            cells = zip(gain["difference"][1:4], gain["interval"][1:4], strict=True)
            gains.append([html.escape(titles[base]), str(seed), *(difference(*cell) for cell in cells)])
    return (
        "<h2>Other random seeds</h2><p>Everything is trained again from other initial weights and batches. Means over "
        f"{len(each)} seeds, first for each object:</p>"
        + ladder(metrics["together"][views])
        + against(metrics["together"][views])
        + f"<p>Calibration error (%) of the view policy after 1 to {len(errors)} views, mean over the seeds: "
        + f"{', '.join(map(percent, errors))}.</p><p>Each seed, with intervals over objects; rows of means have t intervals "
        f"over "
        + "objects and trainings:</p>"
        + table(["next view chosen by", "seed", "1 view", "2", "3", "4"], rows)
        + table(["view policy minus", "seed", "2 views", "3", "4"], gains)
    )


def active_section(metrics: dict[str, Any]) -> str:
    """The section of the run's report."""
    views, found = next(iter(metrics["seeds"][0]["lattices"].items()))
    return "<h2>Learned fusion and view selection</h2>" + _lead(metrics, views) + ladder(found)


def _alt_of_curves(curves: dict[str, Any]) -> str:
    """Says what the curves of accuracy show."""
    parts = [
        f"{policy['title']} {percent(policy['after_views'][0])} % after one view, {percent(policy['after_views'][-1])} % after "
        f"{len(policy['after_views'])}"
        for name, policy in curves.items()
        if name in ("random", "fixed_order", METHOD)
    ]
    return f"Curves of accuracy by number of views: {'; '.join(parts)}. The table has all numbers."


def _next(metrics: dict[str, Any]) -> str:
    """The end of the page: commands that continue this run."""
    steps = [
        (
            "Recognise a mesh of your own with these networks, and look at the walk in a browser:",
            "mevs look --system RUN/learned/system --mesh FILE --view",
        )
    ]
    if len(metrics["seeds"]) < 2:
        steps.append(
            (
                "Train from other seeds, to know whether the results hold for other trainings:",
                "mevs study learned --out RUN --seeds 3",
            )
        )
    return (
        "<h2>What to do next</h2><p><code>RUN</code> stands for the folder of this run; this page is "
        f"<code>learned/index.html</code> in it.</p>{commands(steps)}"
    )


def write_learned_page(metrics: dict[str, Any], statistics: DatasetStatistics, path: Path) -> None:
    """Writes the page, which needs no other file. Numbers are of the first seed unless the page states otherwise."""
    single = fmean(next(iter(seed["lattices"].values()))["single_view"] for seed in metrics["seeds"])
    parts = [warning(Chance.of(single, statistics, ["test"]).warning("recogniser", "test"))]
    for number, (views, found) in enumerate(metrics["seeds"][0]["lattices"].items()):
        titles = {name: policy["title"] for name, policy in found["policies"].items()}
        curves = {name: policy for name, policy in found["policies"].items() if name != "label_oracle"}
        parts.append(
            (_lead(metrics, views) if not number else "") + f"<h2>{views} candidate views</h2>" + ladder(found)
        )
        parts.append(
            image(
                figures.accuracy_of_choices(curves, titles, found["random_sets"][-1]["learned"]["accuracy"]),
                "Accuracy by number of views, over all start views; bands: 95 % intervals over objects.",
                _alt_of_curves(curves),
            )
        )
        parts.append(against(found))
        if not number:
            parts.append("<h2>Fusing random views</h2>" + _sets(found))
            parts.append("<h2>Confidence and calibration</h2>" + _confidence(found) + _costs(found))
            parts.append(
                _decision(metrics)
                + _ablations(metrics)
                + unposed(metrics)
                + scattered(metrics)
                + rotated(metrics)
                + novel(metrics, statistics.classes)
                + _seeds(metrics, views)
            )
    parts.append(f"<p>{statistics.left_out_count} objects without a surface were left out.</p>{_next(metrics)}")
    title = f"Learned view selection: {html.escape(statistics.source)}"
    write_text(path, document(title, "".join(parts)))
