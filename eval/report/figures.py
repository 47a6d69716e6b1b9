"""The report's figures: functions that take numbers and return a matplotlib figure."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from eval.numbers.metrics import EntropyErrors, Metrics, Reading
from eval.projections import equal_area

COLOURS = {
    "random": "#6b7280",
    "farthest": "#0d9488",
    "predicted_entropy": "#2563eb",
    "oracle_entropy": "#d97706",
    "fixed_order": "#9333ea",
    "information_gain": "#dc2626",
    "belief_oracle": "#111827",
}
"""Of the policies drawn as lines. The others appear in tables and in the figure of gains."""
KNOWS_COLOURS = {
    "nothing": "#6b7280",
    "networks": "#2563eb",
    "others": "#dc2626",
    "learned": "#059669",
    "rendering": "#7c3aed",
    "truth": "#d97706",
}
KNOWS_MARKS = {"nothing": "o", "networks": "s", "others": "^", "learned": "D", "rendering": "v", "truth": "P"}
"""Markers by what a policy uses, so that figures can be read without colours."""
INK = "#111827"
_LINES = ("o-", "s--", "^-.", "v:", "D-", "P--", "X-.", "h:", "<-", ">--", "*-.")
"""Markers and lines of policies, in order: they differ without colours."""
_WIDTH = 4.2
"""Inches of a figure that is read on a small screen without scrolling."""

plt.rcParams.update(
    {
        "figure.dpi": 110,
        "font.size": 10,
        "text.color": INK,
        "axes.labelcolor": INK,
        "axes.edgecolor": INK,
        "xtick.color": INK,
        "ytick.color": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 11,
        "axes.titleweight": "bold",
        "svg.fonttype": "none",
        "svg.hashsalt": "mevs",
    }
)


_OWN_COLOURS = ("#db2777", "#65a30d", "#0891b2", "#92400e")


def _colours(metrics: Metrics) -> dict[str, str]:
    """Colours of the policies drawn as lines: those of `COLOURS`, and the users' own."""
    own = (listed.policy for listed in metrics.own)
    return COLOURS | dict(zip(own, itertools.cycle(_OWN_COLOURS), strict=False))


def _curves(
    lines: Iterable[tuple[str, str, np.ndarray, np.ndarray]], all_views: tuple[float, str], height: float, band: float
) -> Figure:
    """Accuracy after each number of views with 95 % bands over objects.

    Args:
        lines: title, colour, accuracies (steps,) and intervals (steps, 2) of each policy.
        all_views: accuracy with all views, and how it is called.
        height: of the axes in inches.
        band: opacity of the bands.
    """
    figure, axis = plt.subplots(figsize=(_WIDTH, height), layout="constrained")
    for line, (title, colour, accuracy, interval) in zip(itertools.cycle(_LINES), lines, strict=False):
        values, (low, high) = 100 * np.asarray(accuracy), 100 * np.asarray(interval).T
        steps = np.arange(1, len(values) + 1)
        axis.plot(steps, values, line, color=colour, label=title, markersize=4)
        axis.fill_between(steps, low, high, color=colour, alpha=band, linewidth=0)
    axis.axhline(100 * all_views[0], color=INK, linestyle=(0, (1, 2)), linewidth=1, label=all_views[1])
    axis.set(xlabel="number of views", ylabel="test accuracy (%)", title="Accuracy by number of views")
    axis.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    _legend_below(figure)
    return figure


def accuracy_after_views(metrics: Metrics) -> Figure:
    """Accuracy after each number of views, over all start views, of the main policies and the user's own."""
    shown = (
        (metrics.titles[name], colour, metrics.policies[name].after_views, metrics.policies[name].after_views_interval)
        for name, colour in _colours(metrics).items()
    )
    return _curves(shown, (metrics.single_view.all_views, "all views summed"), 3.2, 0.06)


def accuracy_of_choices(policies: dict[str, dict[str, Any]], titles: dict[str, str], all_views: float) -> Figure:
    """Accuracy after each number of views, coloured by what each policy knows."""
    shown = (
        (titles[name], KNOWS_COLOURS[policy["knows"]], policy["after_views"], policy["interval"])
        for name, policy in policies.items()
    )
    return _curves(shown, (all_views, "all views fused"), 3.4, 0.05)


def ink_on(colour: Sequence[float] | np.ndarray) -> str:
    """Black or white, whichever has the higher contrast to a colour (r, g, b, …) in [0, 1]; it is 4.5 at least."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour[:3]]
    return "white" if np.dot(linear, (0.2126, 0.7152, 0.0722)) < 0.179 else "black"


def logarithmic(axis: Axes) -> None:
    """Makes the ordinate logarithmic, with plain numbers at its ticks."""
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())


def _legend_below(figure: Figure) -> None:
    """Puts the legend under the axes of a figure, which becomes higher by it; in two columns where the labels are short."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    columns = 2 if max(map(len, labels)) < 21 else 1
    figure.set_figheight(figure.get_figheight() + 0.19 * -(-len(labels) // columns))
    figure.legend(handles, labels, frameon=False, fontsize=9, ncols=columns, loc="outside lower left", handlelength=3)


def ladder_gains(metrics: Metrics, count: int, exclude: Sequence[str]) -> Figure:
    """Gain over random after `count` views in percentage points, with paired 95 % intervals.

    Markers are hollow where the interval contains zero; their form and colour tell what a policy uses.
    """
    against = metrics.against_random
    rows = [listed for listed in metrics.ladder if listed.policy in against and listed.policy not in exclude]
    figure, axis = plt.subplots(figsize=(_WIDTH, 0.3 * len(rows) + 1.0), layout="constrained")
    for row, listed in enumerate(rows):
        result = against[listed.policy]
        gain = 100 * result.after_views_difference[count - 1]
        low, high = 100 * result.after_views_interval[count - 1]
        colour = KNOWS_COLOURS[listed.knows]
        face = "white" if low <= 0 <= high else colour
        axis.plot([low, high], [row, row], color=colour, linewidth=1.5)
        axis.plot(gain, row, KNOWS_MARKS[listed.knows], color=colour, markersize=6, markerfacecolor=face)
    axis.axvline(0, color=INK, linewidth=1)
    axis.set(xlabel="gain over random (points)", title=f"After {count} views")
    axis.grid(axis="x", color="#e5e7eb", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.set_yticks(range(len(rows)), [listed.plain_title for listed in rows])
    axis.invert_yaxis()
    return figure


def accuracy_by_distance(metrics: Metrics) -> Figure:
    """Accuracy against the distance that the camera travelled; the thin lines have a movement cost."""
    styles: dict[str, str] = {}
    figure, axis = plt.subplots(figsize=(_WIDTH, 3.2), layout="constrained")
    for line, (name, colour) in zip(itertools.cycle(_LINES), _colours(metrics).items(), strict=False):
        if name == "belief_oracle":
            continue
        policy = metrics.policies[name]
        distance, values = np.degrees(policy.travelled), 100 * policy.after_views
        axis.plot(distance, values, line, color=colour, label=metrics.titles[name], markersize=4)
        styles[name] = line[1:]
    for name, runs in metrics.movement.items():
        with_cost = [run for run in runs if run.cost > 0]
        for number, run in enumerate(with_cost):
            distance, values = np.degrees(run.travelled), 100 * run.after_views
            axis.plot(distance, values, styles[name], color=COLOURS[name], linewidth=0.9)
            if number in (0, len(with_cost) - 1):
                axis.annotate(f"{run.cost:g}", (distance[-1], values[-1]), fontsize=8, color=COLOURS[name])
    axis.set(xlabel="distance travelled (°)", ylabel="test accuracy (%)", title="Accuracy by distance travelled")
    _legend_below(figure)
    return figure


def calibration_by_views(readings: dict[str, Reading], titles: dict[str, str]) -> Figure:
    """Expected calibration error after each number of views, a line for each way to compute the confidence."""
    figure, axis = plt.subplots(figsize=(_WIDTH, 2.6), layout="constrained")
    colours = ("#d97706", "#0d9488", "#9333ea", "#dc2626", "#6b7280")
    for name, colour, line in zip(readings, colours, _LINES[: len(colours)], strict=True):
        values = 100 * readings[name].ece
        axis.plot(np.arange(1, len(values) + 1), values, line, color=colour, label=titles[name], markersize=4)
    axis.set(xlabel="number of views", ylabel="expected calibration error (%)", title="Calibration error", ylim=0)
    axis.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    _legend_below(figure)
    return figure


def reliability_curves(readings: dict[str, Reading], titles: dict[str, str], views: Sequence[int]) -> Figure:
    """Accuracy against confidence in bins, a panel for each number of views; larger dots hold more of the predictions."""
    binned = {name: reading.reliability for name, reading in readings.items() if reading.reliability is not None}
    rows = -(-len(views) // 2)
    figure, axes = plt.subplots(
        rows, min(2, len(views)), figsize=(_WIDTH, 2.5 * rows + 0.5), sharey=True, layout="constrained", squeeze=False
    )
    for axis in axes.flat[len(views) :]:
        axis.axis("off")
    for axis, count in zip(axes.flat, views, strict=False):
        axis.plot([0, 100], [0, 100], color="#9ca3af", linewidth=1, linestyle=":")
        for name, colour, line, marker in zip(binned, ("#d97706", "#dc2626"), "-:", "os", strict=True):
            confidence, accuracy, share = binned[name][:, count - 1]
            there = share > 0
            x, y, size = 100 * confidence[there], 100 * accuracy[there], 4 + 120 * share[there]
            axis.plot(x, y, line, color=colour, linewidth=1)
            face = colour if marker == "o" else "none"
            axis.scatter(x, y, size, marker=marker, facecolors=face, edgecolors=colour, label=titles[name])
        axis.set(xlabel="confidence (%)", title=f"{count} view{'s' if count > 1 else ''}", xlim=(0, 108), ylim=(0, 108))
    for row in axes:
        row[0].set_ylabel("accuracy (%)")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=9, loc="outside lower left", markerscale=0.5)
    return figure


def heat_map(
    axis: Axes,
    values: Float[np.ndarray, "rows columns"],
    text_of: Callable[[int, int], str],
    names: tuple[Sequence[str], Sequence[str]],
    fontsize: float = 8,
    rotation: float = 0,
    **image: Any,
) -> None:
    """A matrix as coloured cells with text, which is bold where it is marked ▲ or ▼.

    Args:
        text_of: text of the cell in a row and a column; none if empty.
        names: of the columns and of the rows.
        rotation: of the names of columns, in degrees.
        image: colours, as `Axes.imshow` takes them.
    """
    cells = axis.imshow(values, **image)
    for (row, column), value in np.ndenumerate(values):
        if text := text_of(row, column):
            weight = "bold" if text[0] in "▲▼" else "normal"
            colour = ink_on(cells.to_rgba(value))
            axis.text(column, row, text, ha="center", va="center", fontsize=fontsize, fontweight=weight, color=colour)
    axis.set_xticks(range(len(names[0])), names[0], rotation=rotation, ha="right" if rotation else "center")
    axis.set_yticks(range(len(names[1])), names[1])


def difference_grid(
    difference: Float[np.ndarray, "limits thresholds"],
    interval: Float[np.ndarray, "limits thresholds 2"],
    metrics: Metrics,
    title: str,
) -> Figure:
    """The thesis's Table 7 as a figure: gain over random in points by MV and CT, marked ▲ or ▼ where the interval excludes 0."""
    values = 100 * difference
    largest = max(0.5, np.abs(values).max())

    def text_of(row: int, column: int) -> str:
        (low, high), value = interval[row, column], values[row, column]
        mark = "▲" if low > 0 else "▼" if high < 0 else ""
        return mark + (f"{value:+.1f}".replace("-", "−") if abs(value) >= 0.05 else "0.0")

    figure, axis = plt.subplots(figsize=(_WIDTH, 3.4), layout="constrained")
    names = [f"{ct:g}" for ct in metrics.thresholds], [str(mv) for mv in metrics.max_views]
    heat_map(axis, values, text_of, names, 9, cmap="RdBu", vmin=-largest, vmax=largest, aspect="auto")
    axis.set(xlabel="confidence threshold", ylabel="limit on views", title=title)
    axis.spines[:].set_visible(False)
    return figure


def shares_of(confusion: Float[np.ndarray, "classes classes"]) -> Float[np.ndarray, "classes classes"]:
    """A confusion matrix in percent of the true class."""
    return 100 * confusion / np.maximum(confusion.sum(axis=1, keepdims=True), 1e-9)


def confusions(matrices: dict[str, np.ndarray], classes: Sequence[str]) -> Figure:
    """Confusion matrices in percent of the true class, a panel for each policy."""
    width = max(_WIDTH, 0.28 * len(classes) + 1.4)
    figure, axes = plt.subplots(
        1, len(matrices), figsize=(width * len(matrices), width), layout="constrained", sharey=True, squeeze=False
    )
    for axis, (title, matrix) in zip(axes[0], matrices.items(), strict=True):
        share = shares_of(matrix)

        def text_of(row: int, column: int, share: np.ndarray = share) -> str:
            return f"{share[row, column]:.0f}" if share[row, column] >= 0.5 else ""

        heat_map(axis, share, text_of, (classes, classes), rotation=60, cmap="Blues", vmin=0, vmax=100)
        axis.set(xlabel="predicted", title=title)
    axes[0][0].set_ylabel("true")
    return figure


def entropy_histogram(counts: Sequence[int], mean: float, std: float) -> Figure:
    """Normalised depth entropies of the training views."""
    figure, axis = plt.subplots(figsize=(_WIDTH, 2.8), layout="constrained")
    edges = np.linspace(0, 1, len(counts) + 1)
    axis.bar(edges[:-1], counts, width=np.diff(edges), align="edge", color="#93c5fd")
    axis.axvline(mean, color="#1d4ed8", label=f"mean {mean:.3f}, sd {std:.3f}")
    axis.set(xlabel="normalised depth entropy", ylabel="views", title="Depth entropies (training)")
    _legend_below(figure)
    return figure


def entropy_errors(entropy: EntropyErrors) -> Figure:
    """Error of the network and of two predictors that receive no view."""
    rows = [
        ("mean map", entropy.mean_map, entropy.mean_map_interval, "#9ca3af"),
        ("class-mean map\n(given the class)", entropy.class_mean_map, entropy.class_mean_map_interval, "#d1d5db"),
        ("PointNet++", entropy.pointnet2, entropy.pointnet2_interval, "#2563eb"),
    ]
    figure, axis = plt.subplots(figsize=(_WIDTH, 2.6), layout="constrained")
    for position, (_, error, (low, high), colour) in enumerate(rows):
        axis.barh(
            position,
            error,
            color=colour,
            xerr=[[max(0, error - low)], [max(0, high - error)]],
            edgecolor=INK,
            linewidth=0.8,
            ecolor=INK,
            capsize=3,
        )
        at, beside = (high, position), (5, 0)
        axis.annotate(f"{error:.4f}", at, beside, textcoords="offset points", va="center")
    axis.set_yticks(range(len(rows)), [label for label, *_ in rows])
    axis.set(xlabel="mean squared error on test objects", title="Predicting depth entropy")
    axis.margins(x=0.2)
    axis.locator_params(axis="x", nbins=5)
    return figure


def view_map(
    points: np.ndarray,
    neighbours: np.ndarray,
    weights: np.ndarray,
    maxima: np.ndarray,
    title: str,
    limits: tuple[float, float],
) -> Figure:
    """Viewpoints on an equal-area map: the lighter and larger, the higher the entropy; rings around local maxima.

    As in Figs. 7 and 11 of the thesis, whose Mercator maps enlarge what is near the poles.
    """
    x, y = equal_area(points)
    figure, axis = plt.subplots(figsize=(_WIDTH, 2.7), layout="constrained")
    axis.add_patch(Ellipse((0, 0), 4 * np.sqrt(2), 2 * np.sqrt(2), facecolor="none", edgecolor=INK, linewidth=0.8))
    for degrees in (-60, -30, 0, 30, 60):
        around, up = np.radians(np.linspace(-179.9, 179.9, 49)), np.radians(degrees)
        circle = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.full_like(around, np.sin(up))]
        line = equal_area(np.stack(circle, axis=-1))
        axis.plot(*line, color="#d1d5db", linewidth=0.6, linestyle=":", zorder=0)
        axis.annotate(
            f"{degrees}°".replace("-", "−"),
            (line[0][0], line[1][0]),
            (-3, 0),
            ha="right",
            va="center",
            textcoords="offset points",
            fontsize=8,
        )
    for i, j in np.argwhere(np.triu(neighbours)):
        if abs(x[i] - x[j]) < 2:  # else the edge crosses the border of the map
            axis.plot(x[[i, j]], y[[i, j]], color="#d1d5db", linewidth=0.7, zorder=1)
    share = np.clip((weights - limits[0]) / max(limits[1] - limits[0], 1e-9), 0, 1)
    low, high = limits
    smaller = min(1.0, 60 / len(points))  # many views do not cover each other
    dots = axis.scatter(
        x,
        y,
        s=smaller * (15 + 75 * share),
        c=weights,
        cmap="viridis",
        vmin=low,
        vmax=high,
        edgecolors=INK,
        linewidths=0.6,
        zorder=2,
    )
    axis.scatter(
        x[maxima], y[maxima], s=smaller * 170, facecolors="none", edgecolors="#dc2626", linewidths=1.5, zorder=3
    )
    figure.colorbar(dots, ax=axis, label="normalised entropy", shrink=0.8)
    axis.set_title(title)
    axis.set_aspect("equal")
    axis.axis("off")
    return figure


def loss_curves(axis: Axes, history: Sequence[dict[str, float]], styles: Sequence[tuple[str, str, str]]) -> None:
    """Losses by epoch; `styles` are line, colour and label of training losses and of validation losses."""
    epochs = [entry["epoch"] for entry in history]
    for key, (line, colour, label) in zip(("train/loss", "val/loss"), styles, strict=True):
        axis.plot(epochs, [entry[key] for entry in history], line, color=colour, markersize=4, label=label)
    axis.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    axis.legend(frameon=False)


def losses(name: str, history: Sequence[dict[str, float]]) -> Figure:
    """Training and validation loss of a network by epoch."""
    figure, axis = plt.subplots(figsize=(_WIDTH, 2.8), layout="constrained")
    loss_curves(axis, history, (("s--", "#6b7280", "training"), ("o-", "#2563eb", "validation")))
    axis.set(xlabel="epoch", ylabel="loss", title=name)
    trained, validated = ([entry[f"{part}/loss"] for entry in history] for part in ("train", "val"))
    if len(history) > 1 and max(trained) > 5 * min(validated):
        logarithmic(axis)
    return figure
