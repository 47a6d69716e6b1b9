"""The report: one self-contained page with the results, their intervals, and how they were obtained."""

from __future__ import annotations

import html
import json
import platform
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.capture.viewpoints import FILE, is_file
from data_pipeline.dataset.builder import open_split
from data_pipeline.files import write_text
from eval.report import figures
from eval.report.confidence import confidence_section
from eval.report.current import mark
from eval.report.grid import compatibility_section, grid_section
from eval.report.html import (
    MANY_CLASSES,
    ReportInputs,
    data_url,
    document,
    folded,
    image,
    percent,
    picture,
    table,
    warning,
)
from eval.report.next_steps import next_section
from eval.report.policies import ascent_section, draws, ladder_section, lead, movement_section
from eval.report.scenes import scenes_section
from eval.report.seeds import seeds_section
from mevs_jax.geometry.viewpoints import local_maxima
from train.results.chance import Chance

_SPLITS = {"train": "training", "val": "validation", "test": "test", "other": "no split"}
"""Where the source had objects that were left out."""


def _data_section(inputs: ReportInputs) -> str:
    statistics = inputs.statistics
    rows = [
        [html.escape(name), *(str(statistics.counts[split][name]) for split in ("train", "val", "test"))]
        for name in statistics.classes
    ]
    totals = [f"<b>{sum(statistics.counts[split].values())}</b>" for split in ("train", "val", "test")]
    camera = statistics.camera
    lattice = f"lattice <code>{html.escape(camera.lattice)}</code>"
    if is_file(camera.lattice):
        pairs = statistics.neighbours
        near = "" if pairs is None else f", {len(pairs)} pairs of neighbours"
        lattice = f"directions from a file{near}, content {html.escape(camera.lattice.removeprefix(FILE))}"
    left_out = [
        f"<li><code>{html.escape(name)}</code>: {html.escape(why)}</li>"
        for by_name in statistics.left_out.values()
        for name, why in by_name.items()
    ]
    counts = table(
        ["class", "train", "val", "test"], [["<b>all</b>", *totals], *rows], "number of objects in each class"
    )
    if len(rows) > MANY_CLASSES:
        counts = folded(f"Objects in each of the {len(rows)} classes", counts)
    return (
        f"<h2>Data</h2><p>{html.escape(statistics.source)}: {statistics.views} views of each object ({lattice}), "
        f"{camera.resolution}×{camera.resolution} pixels, {camera.field_of_view:g}° field of view from {camera.distance:g} "
        f"radii away. Points seen per view: {statistics.points_mean:,.0f} ± {statistics.points_std:,.0f}. Entropies are "
        f"divided by the largest of the training split, {statistics.entropy_max:.2f} bits.</p>"
        + counts
        + f"<p>{statistics.left_out_count} objects were left out "
        + f"({', '.join(f'{len(names)} of {_SPLITS[split]}' for split, names in statistics.left_out.items())}).</p>"
        + (folded("Objects left out, with reasons", f"<ul>{''.join(left_out)}</ul>") if left_out else "")
        + _contact_sheet(inputs)
        + image(
            figures.entropy_histogram(
                statistics.entropy_histograms["train"], statistics.entropy_mean, statistics.entropy_std
            ),
            "The thesis reports a mean of 0.329 and a standard deviation of 0.156 (Fig. 9).",
            f"Histogram of the depth entropies of all training views, divided by the largest: mean "
            f"{statistics.entropy_mean:.2f}, "
            f"standard deviation {statistics.entropy_std:.2f}.",
        )
    )


def _contact_sheet(inputs: ReportInputs) -> str:
    """A test object of each class from some viewpoints, a row of pictures for each class."""
    statistics, source = inputs.statistics, open_split(inputs.data, "test")
    chosen: dict[int, int] = {}
    for index, label in enumerate(inputs.tables.labels):
        chosen.setdefault(int(label), index)
    views = np.linspace(0, statistics.views - 1, min(10, statistics.views)).round().astype(int)
    rows = []
    for label in sorted(chosen)[:MANY_CLASSES]:
        images, name = source[chosen[label]]["image"][views], html.escape(statistics.classes[label])
        strip = data_url(picture(np.concatenate(list(images), axis=1)))
        rows.append([name, f'<img class="strip" alt="{len(views)} shaded views of a {name}" src="{strip}">'])
    shown = table(
        ["class", f"views {', '.join(map(str, views))}"], rows, "a test object of each class from some viewpoints"
    )
    which = f"each of the first {MANY_CLASSES} classes" if len(chosen) > MANY_CLASSES else "each class"
    return f"<p>One test object of {which} from {len(views)} of the {statistics.views} viewpoints:</p>{shown}"


def _entropy_section(inputs: ReportInputs) -> str:
    entropy, statistics, tables = inputs.metrics.entropy, inputs.statistics, inputs.tables
    graph = statistics.graph
    errors = np.square(tables.predicted_entropy - tables.entropy[:, None, :]).mean(axis=(1, 2))
    example = int(np.argsort(errors)[len(errors) // 2])
    true, predicted = tables.entropy[example], tables.predicted_entropy[example, 0]
    limits = (float(min(true.min(), predicted.min())), float(max(true.max(), predicted.max())))
    maps = [
        image(
            figures.view_map(
                np.asarray(graph.points), np.asarray(graph.neighbours), weights, np.asarray(peaks), title, limits
            ),
            f"{tables.names[example]}, an object of median error, on an equal-area map of the directions around it. Larger and "
            "lighter: higher entropy. Red rings: local maxima, views above all their neighbours.",
            f"Map of the {title} entropies of {len(weights)} views, from {weights.min():.2f} to {weights.max():.2f}; the "
            f"highest "
            f"is view {int(weights.argmax())}. Local maxima: views {', '.join(map(str, np.flatnonzero(peaks)))}.",
        )
        for weights, title in ((true, "true"), (predicted, "predicted after view 0"))
        for peaks in (local_maxima(jnp.asarray(weights), graph.neighbours),)
    ]
    low, high = entropy.better_than_mean_map
    verdict = "is better" if low > 0 else "is not better"
    gain = f"{low:+.4f} to {high:+.4f}".replace("-", "−")
    explained = f"{100 * (entropy.explained_variance or 0):.0f}".replace("-", "−")
    rows = [[html.escape(name), f"{value:.4f}"] for name, value in entropy.by_class.items() if value is not None]
    return (
        "<h2>Predicting depth entropy</h2><p>A <dfn>partial cloud</dfn> is what one view shows of the surface, as points. "
        "From one partial cloud, the network PointNet++ predicts the normalised entropy of every view with a mean squared "
        f"error of {entropy.pointnet2:.4f} ({explained} % of the variance explained). "
        f"It {verdict} than the mean map, which receives no view (difference in error {gain}). The "
        "class-mean map is given the true class.</p>"
        + image(
            figures.entropy_errors(entropy),
            "Test objects, every view as input; 95 % intervals over objects. A shorter bar is better.",
            f"Bars of the mean squared error: PointNet++ {entropy.pointnet2:.4f}, mean map {entropy.mean_map:.4f}, "
            f"class-mean map {entropy.class_mean_map:.4f}.",
        )
        + f'<div class="figures">{"".join(maps)}</div>'
        + folded("Error by class", table(["class", "MSE"], rows))
    )


def _training_section(inputs: ReportInputs) -> str:
    def called(name: str, summary: dict[str, Any]) -> str:
        encoder = summary.get("encoder")
        if encoder is None:
            return html.escape(name)
        return (
            f"{html.escape(name)}: <code>{html.escape(encoder['module'])}:{html.escape(encoder['name'])}</code> "
            f"(source {html.escape(encoder['source'])})"
        )

    rows = [
        [
            called(name, s),
            str(s["best_epoch"]),
            str(s["epoch"]),
            f"{s['best_loss']:.4f}",
            f"{s['seconds'] / 60:.1f} min",
        ]
        for name, s in inputs.summaries.items()
    ]
    by_view = inputs.metrics.single_view.by_view
    return (
        "<h2>Training</h2>"
        + table(["network", "best epoch", "epochs", "best validation loss", "time"], rows)
        + f'<div class="figures">{"".join(_losses(*named) for named in inputs.histories.items())}</div>'
        + f"<p>Accuracy on single views: {percent(min(by_view))} % at the worst viewpoint, {percent(max(by_view))} % at the "
        f"best; class accuracy {percent(inputs.metrics.single_view.class_accuracy)} %.</p>"
    )


def _losses(name: str, history: list[dict[str, float]]) -> str:
    parts = [
        f"{title} loss from {history[0][key]:.3f} to {history[-1][key]:.3f}"
        for key, title in (("train/loss", "training"), ("val/loss", "validation"))
        if history
    ]
    return image(
        figures.losses(name, history),
        "Loss by epoch, one pass over the training objects. Validation objects are never trained on.",
        f"Curves of the {name}'s loss over {len(history)} epochs: {', '.join(parts)}.",
    )


def _methods_section(inputs: ReportInputs) -> str:
    settings = html.escape(json.dumps(inputs.settings, indent=1, default=str))
    device = jax.devices()[0]
    return (
        "<h2>Methods</h2><p>Splits are by object; nothing was chosen on test objects. Walks start from every reachable view of "
        f"every object. Results of random policies are means over {draws(inputs.metrics)}. "
        f"The policies' knowledge of other objects, and all temperatures, are fitted on "
        f"{inputs.metrics.validation_objects} validation objects. Preset "
        f"<code>{html.escape(inputs.preset)}</code>, JAX {jax.__version__} on {html.escape(device.device_kind)} "
        f"({html.escape(platform.machine())}, Python {platform.python_version()}).</p>"
        f"{folded('All settings', f'<pre>{settings}</pre>')}"
    )


def _chance_notice(inputs: ReportInputs) -> str:
    """A notice if the classifier's accuracy on single views of test objects is not above chance."""
    chance = Chance.of(inputs.metrics.single_view.accuracy, inputs.statistics, ["test"])
    return warning(chance.warning("classifier", "test"))


def _learned_section(inputs: ReportInputs) -> str:
    return inputs.learned or ""


_SECTIONS = (
    _chance_notice,
    lead,
    scenes_section,
    ladder_section,
    seeds_section,
    ascent_section,
    _learned_section,
    movement_section,
    confidence_section,
    grid_section,
    compatibility_section,
    _entropy_section,
    _training_section,
    _data_section,
    _methods_section,
    next_section,
)


def write_report(inputs: ReportInputs, path: Path, described: Any = None) -> None:
    """Writes the report as one page that needs no other file.

    Args:
        described: describes all that the page is made from; `is_current` compares it.
    """
    body = "".join(section(inputs) for section in _SECTIONS)
    title = f"Next-best-view selection: {html.escape(inputs.statistics.source)}"
    content = document(title, body)
    write_text(path, content + mark(described, content))
