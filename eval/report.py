"""The report: one self-contained page that says what was done, what came out, and how sure one may be of it."""

from __future__ import annotations

import base64
import html
import io
import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from data_pipeline.builder import DatasetStatistics, open_split
from data_pipeline.files import write_text
from eval import figures
from eval.view_tables import ViewTables
from mevs_jax.policies import POLICIES, Scene
from mevs_jax.selection import select_from_table
from mevs_jax.viewpoints import ViewGraph, local_maxima

_STYLE = """
body{font:15px/1.55 system-ui,sans-serif;color:#111827;max-width:60rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.7rem;margin-bottom:.2rem}h2{margin-top:2.4rem;
border-bottom:1px solid #e5e7eb;padding-bottom:.2rem}
table{border-collapse:collapse;margin:1rem 0;font-variant-numeric:tabular-nums}th,td{padding:.25rem .6rem;text-align:right}
th{border-bottom:2px solid #d1d5db;font-weight:600}td{border-bottom:1px solid #f3f4f6}
th:first-child,td:first-child{text-align:left}
.lead{font-size:1.1rem}.note{color:#6b7280;font-size:.9rem}.faint{color:#9ca3af}
.figures{display:flex;flex-wrap:wrap;gap:1rem}.figures figure{flex:1 1 45%;margin:0}small{white-space:nowrap}
figure{margin:1rem 0}figcaption{color:#6b7280;font-size:.85rem}img{max-width:100%;height:auto}
code{background:#f3f4f6;padding:.1rem .3rem}
details{margin:1rem 0}summary{cursor:pointer}
"""


@dataclass(frozen=True)
class ReportInputs:
    """Everything the page is made of, as the stages before left it."""

    statistics: DatasetStatistics
    metrics: dict[str, Any]
    tables: ViewTables
    data: Path
    histories: dict[str, list[dict[str, float]]]
    summaries: dict[str, dict[str, Any]]
    preset: str
    settings: dict[str, Any]


def _image(figure: Figure, caption: str, kind: str = "svg") -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **({"metadata": {"Date": None}} if kind == "svg" else {"dpi": 130}))
    plt.close(figure)
    mime = "svg+xml" if kind == "svg" else kind
    encoded = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/{mime};base64,{encoded}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _percent(value: float) -> str:
    return f"{100 * value:.1f}"


def _signed(value: float) -> str:
    """In points, with a sign, a real minus, and no sign where it rounds to zero."""
    text = f"{100 * value:+.1f}".replace("-", "−")
    return "0.0" if text[1:] == "0.0" else text


def _range(interval: Sequence[float]) -> str:
    return f"{100 * interval[0]:.1f}–{100 * interval[1]:.1f}"


def _difference(value: float, interval: Sequence[float]) -> str:
    """In points; faint where the interval holds zero."""
    text = f"{_signed(value)}<br><small>{_signed(interval[0])} to {_signed(interval[1])}</small>"
    return f'<span class="faint">{text}</span>' if interval[0] <= 0 <= interval[1] else text


def _verdict(difference: float, interval: Sequence[float]) -> str:
    if interval[0] > 0:
        return f"better than random by {100 * difference:.1f} points"
    if interval[1] < 0:
        return f"worse than random by {-100 * difference:.1f} points"
    return f"not distinguishable from random ({_signed(difference)} points)"


def _lead(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    single, headline = metrics["single_view"], metrics["headline"]
    row = metrics["max_views"].index(headline["max_views"])
    column = metrics["thresholds"].index(headline["threshold"])
    sentences = [
        f"One view is recognised with {_percent(single['accuracy'])} % accuracy, all {metrics['views']} summed with "
        f"{_percent(single['all_views'])} %."
    ]
    for name, result in metrics["against_random"].items():
        cell = result["difference"][row][column], result["interval"][row][column]
        sentences.append(f"Choosing by {figures.NAMES[name]} is {_verdict(*cell)}.")
    return (
        f'<p class="lead">{" ".join(sentences)}</p><p class="note">With up to {headline["max_views"]} views and a '
        f"confidence threshold of {headline['threshold']}, over {metrics['objects']} test objects and all "
        f"{metrics['starts']} start views of each; random draws without repetition; a difference is called so when its "
        f"95 % interval, paired by object, leaves out zero.</p>"
    )


def _data_section(inputs: ReportInputs) -> str:
    statistics = inputs.statistics
    rows = [
        [html.escape(name), *(str(statistics.counts[split][name]) for split in ("train", "val", "test"))]
        for name in statistics.classes
    ]
    totals = [f"<b>{sum(statistics.counts[split].values())}</b>" for split in ("train", "val", "test")]
    camera = statistics.camera
    source = open_split(inputs.data, "test")
    chosen: dict[int, int] = {}
    for index, label in enumerate(inputs.tables.labels):
        chosen.setdefault(int(label), index)
    views = np.linspace(0, statistics.views - 1, min(10, statistics.views)).round().astype(int)
    sheet = np.stack([source[chosen[label]]["image"][views] for label in sorted(chosen)])
    left_out = [
        f"<li><code>{html.escape(name)}</code>: {html.escape(why)}</li>"
        for by_name in statistics.left_out.values()
        for name, why in by_name.items()
    ]
    return (
        f"<h2>Data</h2><p>{html.escape(statistics.source)}: {statistics.views} views of each object on a Fibonacci "
        f"sphere ({camera.lattice}), {camera.resolution}×{camera.resolution} pixels, {camera.field_of_view:g}° field of view "
        f"from {camera.distance:g} radii away. Points seen per view: {statistics.points_mean:,.0f} ± "
        f"{statistics.points_std:,.0f}. "
        f"Entropies are normalised by the training split's largest, {statistics.entropy_max:.2f} bits.</p>"
        + _table(["class", "train", "val", "test"], [*rows, ["<b>all</b>", *totals]])
        + f"<p>{statistics.left_out_count} objects were left out "
        + f"({len(statistics.left_out['train'])} of training, {len(statistics.left_out['test'])} of test).</p>"
        + (f"<details><summary>Which, and why</summary><ul>{''.join(left_out)}</ul></details>" if left_out else "")
        + _image(
            figures.contact_sheet(sheet, [statistics.classes[label] for label in sorted(chosen)]),
            f"One test object of each class from {len(views)} of the {statistics.views} viewpoints.",
            "png",
        )
        + _image(
            figures.entropy_histogram(statistics.entropy_histogram, statistics.entropy_mean, statistics.entropy_std),
            "The thesis reports a mean of 0.329 and a standard deviation of 0.156 (Fig. 9).",
        )
    )


def _entropy_section(inputs: ReportInputs) -> str:
    entropy, statistics, tables = inputs.metrics["entropy"], inputs.statistics, inputs.tables
    graph = ViewGraph.from_points(np.array(statistics.viewpoints))
    errors = np.square(tables.utility - tables.entropy[:, None, :]).mean(axis=(1, 2))
    example = int(np.argsort(errors)[len(errors) // 2])
    true, predicted = tables.entropy[example], tables.utility[example, 0]
    limits = (float(min(true.min(), predicted.min())), float(max(true.max(), predicted.max())))
    maps = [
        figures.view_map(
            np.asarray(graph.points),
            np.asarray(graph.neighbours),
            weights,
            np.asarray(local_maxima(jnp.asarray(weights), graph.neighbours)),
            title,
            limits,
        )
        for weights, title in ((true, "true"), (predicted, "predicted after view 0"))
    ]
    low, high = entropy["better_than_mean_map"]
    gain = "beats" if low > 0 else "does not beat"
    rows = [[html.escape(name), f"{value:.4f}"] for name, value in entropy["by_class"].items() if value is not None]
    return (
        f"<h2>Predicting depth entropy</h2><p>From one partial cloud, PointNet++ predicts the normalised entropy of every view "
        f"with a mean squared error of {entropy['pointnet2']:.4f} "
        f"({100 * (entropy['explained_variance'] or 0):.0f} % of the variance explained). It {gain} the mean map, which looks at "
        f"nothing (difference in error {low:+.4f} to {high:+.4f}). The class-mean map is told the true class.</p>"
        + _image(figures.entropy_errors(entropy), "Test objects, all views as input; 95 % intervals over objects.")
        + '<div class="figures">'
        + "".join(
            _image(m, f"{tables.names[example]}, an object of median error. Red rings: local maxima.") for m in maps
        )
        + f"</div><details><summary>Error by class</summary>{_table(['class', 'MSE'], rows)}</details>"
    )


def _selection_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    policies, against = metrics["policies"], metrics["against_random"]
    steps = [step for step in (1, 2, 3, 4, 6, 9) if step <= len(policies["random"]["after_views"])]
    ladder = []
    for name, result in policies.items():
        row = [figures.NAMES[name]]
        for step in steps:
            low_high = _range(result["after_views_interval"][step - 1])
            row.append(f"{_percent(result['after_views'][step - 1])}<br><small class='note'>{low_high}</small>")
        ladder.append(row)
    for name, result in against.items():
        row = [f"{figures.NAMES[name]} − random"]
        for step in steps:
            gain, interval = result["after_views_difference"][step - 1], result["after_views_interval"][step - 1]
            row.append("–" if step == 1 else _difference(gain, interval))  # the first view is not chosen
        ladder.append(row)
    parts = [
        "<h2>Choosing the next view</h2><p>Accuracy (%) after exactly so many views, without early stopping, with 95 % "
        "intervals over objects. Grey: not distinguishable from zero.</p>",
        _table(["policy", *(f"{step} view{'s' if step > 1 else ''}" for step in steps)], ladder),
        _image(
            figures.accuracy_after_views(policies, metrics["single_view"]["all_views"]),
            "Bands: 95 % intervals over objects.",
        ),
        _image(
            figures.difference_after_views(against), "All policies share their start views; intervals over objects."
        ),
        "<h2>The thesis's grid</h2><p>Stop at a confidence threshold (CT, columns) or after the most views (MV, rows).</p>",
        '<div class="figures">',
    ]
    for name, result in against.items():
        title = f"{figures.NAMES[name]} − random"
        parts.append(
            _image(
                figures.difference_grid(result["difference"], metrics["thresholds"], metrics["max_views"], title),
                "Percentage points (thesis Tables 7 and 12).",
            )
        )
    parts.append("</div>")
    for name, result in policies.items():
        for key, label, show in (
            ("accuracy", "accuracy (%)", _percent),
            ("class_accuracy", "class accuracy (%)", _percent),
            ("views_used", "views used", lambda value: f"{value:.2f}"),
        ):
            rows = [
                [str(mv), *(show(v) for v in values)]
                for mv, values in zip(metrics["max_views"], result[key], strict=True)
            ]
            table = _table(["MV \\ CT", *(f"{ct:g}" for ct in metrics["thresholds"])], rows)
            parts.append(f"<details><summary>{figures.NAMES[name]}: {label}</summary>{table}</details>")
    matrices = {
        figures.NAMES[name]: np.array(policies[name]["headline_confusion"]) for name in ("random", "predicted_entropy")
    }
    headline = metrics["headline"]
    parts.append(
        _image(
            figures.confusions(matrices, inputs.statistics.classes),
            f"Percent of each true class; CT {headline['threshold']}, MV {headline['max_views']} (thesis Fig. 23).",
        )
    )
    return "".join(parts) + _example_walk(inputs)


def _example_walk(inputs: ReportInputs) -> str:
    """The first object that one view gets wrong and the predicted-entropy walk gets right; else the first object."""
    tables, statistics = inputs.tables, inputs.statistics
    graph = ViewGraph.from_points(np.array(statistics.viewpoints))
    stacked = tables.stacked()

    def walk(index: int, start: int):
        table = jax.tree.map(lambda leaf: leaf[index], stacked)
        steps = min(4, statistics.views)
        return select_from_table(
            jax.random.key(0), table, Scene(graph, table.entropy), POLICIES["predicted_entropy"], start, max_views=steps
        )

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
        f"view {view}: {statistics.classes[int(p)]}\n{100 * float(c):.0f} % sure"
        for view, p, c in zip(views, episode.predictions, episode.confidences, strict=True)
    ]
    title = f"{tables.names[index]}: what the policy looked at, and what it believed"
    return _image(
        figures.episode_strip([images[view] for view in views], captions, title),
        "One walk of the PointNet++ policy.",
        "png",
    )


def _training_section(inputs: ReportInputs) -> str:
    rows = [
        [
            html.escape(name),
            str(s["best_epoch"]),
            str(s["epoch"]),
            f"{s['best_loss']:.4f}",
            f"{s['seconds'] / 60:.1f} min",
        ]
        for name, s in inputs.summaries.items()
    ]
    by_view = inputs.metrics["single_view"]["by_view"]
    return (
        "<h2>Training</h2>"
        + _table(["network", "best epoch", "epochs", "best validation loss", "time"], rows)
        + _image(figures.losses(inputs.histories), "Validation is on objects never trained on.")
        + f"<p>Single views: {_percent(min(by_view))} % at the worst viewpoint, {_percent(max(by_view))} % at the best; class "
        f"accuracy {_percent(inputs.metrics['single_view']['class_accuracy'])} %.</p>"
    )


def _methods_section(inputs: ReportInputs) -> str:
    settings = html.escape(json.dumps(inputs.settings, indent=1, default=str))
    device = jax.devices()[0]
    return (
        "<h2>How this was made</h2><p>Splits are by object; nothing was chosen on test objects. Every object is walked from "
        f"every start view; the random policy is averaged over {inputs.metrics['random_draws_per_start']} draws a start. Preset "
        f"<code>{html.escape(inputs.preset)}</code>, JAX {jax.__version__} on {html.escape(device.device_kind)} "
        f"({html.escape(platform.machine())}, Python {platform.python_version()}).</p>"
        f"<details><summary>All settings</summary><pre>{settings}</pre></details>"
    )


def read_history(folder: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def write_report(inputs: ReportInputs, path: Path) -> None:
    """Writes the page; it needs no other file."""
    body = "".join(
        section(inputs)
        for section in (_lead, _selection_section, _entropy_section, _training_section, _data_section, _methods_section)
    )
    title = f"Where to look next: {html.escape(inputs.statistics.source)}"
    write_text(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{title}</title><style>{_STYLE}</style><h1>{title}</h1>{body}</html>\n",
    )
