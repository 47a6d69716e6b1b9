"""The thesis's figures of data and results: 5–11 and 17–25. (1–4 and 12–16 are diagrams of ideas and networks.)"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.dataset.statistics import DatasetStatistics
from eval.projections import mercator, mercator_ordinate
from eval.report import figures
from eval.thesis.results import LatticeTables
from mevs_jax.geometry.viewpoints import ViewGraph, local_maxima
from train.many.thesis import BACKBONES, FRAMES, Frame, ThesisFolder

_MEDIAN = {"color": figures.INK, "linewidth": 2}
_RING: dict[str, Any] = {"facecolors": "none", "edgecolors": "#dc2626", "linewidths": 1.6}


@dataclass(frozen=True)
class FigureInputs:
    """The data that the figures show.

    Attributes:
        folder: folder of the run.
        results: content of `thesis.json`.
        statistics, tables: by number of views; the tables are of the test objects.
        histories: training history of each network, by the name of its folder.
        example: index of the test object that is shown as an example.
    """

    folder: ThesisFolder
    results: dict[str, Any]
    statistics: dict[int, DatasetStatistics]
    tables: dict[int, LatticeTables]
    histories: dict[str, list[dict[str, float]]]
    example: int

    def graph(self, views: int) -> ViewGraph:
        return self.statistics[views].graph


@dataclass(frozen=True)
class ThesisFigure:
    """A figure of the thesis: its number, the function that draws it, and its caption."""

    number: str
    draw: Callable[[FigureInputs], Figure]
    caption: str


# ------------------------------------------------------------------------------------------------------------- data, 5–9


def class_distribution(inputs: FigureInputs) -> Figure:
    statistics = inputs.statistics[40]
    train = [statistics.counts["train"][name] + statistics.counts["val"][name] for name in statistics.classes]
    test = [statistics.counts["test"][name] for name in statistics.classes]
    figure, axis = plt.subplots(figsize=(7.2, 3.4), layout="constrained")
    at = np.arange(len(train))
    axis.bar(at - 0.2, train, 0.4, color="#2563eb", label="training (and validation)")
    axis.bar(at + 0.2, test, 0.4, color="#d97706", label="test", hatch="///", edgecolor=figures.INK, linewidth=0)
    axis.set_xticks(at, statistics.classes, rotation=40, ha="right")
    axis.set(ylabel="objects")
    views = axis.twinx()
    views.set_ylim(0, axis.get_ylim()[1] * statistics.views)
    views.spines.right.set_visible(True)
    views.set_ylabel(f"views ({statistics.views} per object)")
    figure.legend(frameon=False, ncols=2, loc="outside upper center")
    return figure


def points_per_view(inputs: FigureInputs) -> Figure:
    statistics = inputs.statistics[40]
    boxes = [
        {"label": name, "whislo": low, "q1": first, "med": middle, "q3": third, "whishi": high, "fliers": []}
        for name, (low, first, middle, third, high) in zip(statistics.classes, statistics.points_by_class, strict=True)
    ]
    figure, axis = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
    axis.bxp(boxes, showfliers=False, patch_artist=True, boxprops={"facecolor": "#93c5fd"}, medianprops=_MEDIAN)
    axis.axhline(statistics.points_mean, color="#1d4ed8", linewidth=1, linestyle=":")
    axis.tick_params(axis="x", rotation=40)
    pixels = statistics.camera.resolution**2
    axis.set(
        ylabel="points in a view",
        title=f"mean {statistics.points_mean:,.0f} ± {statistics.points_std:,.0f} of {pixels:,} pixels",
    )
    return figure


def entropy_distribution(inputs: FigureInputs) -> Figure:
    statistics = inputs.statistics[40]
    figure, train = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    test = train.twinx()
    edges = np.linspace(0, 1, 51)
    for axis, split, colour in ((train, "train", "#93c5fd"), (test, "test", "#d97706")):
        counts = statistics.entropy_histograms[split]
        axis.stairs(counts, edges, label=split, color=colour, fill=split == "train", linewidth=1.8)
        axis.set_ylabel(f"{split} views ({'filled' if split == 'train' else 'line'})")
        axis.set_ylim(0, 1.05 * max(counts))
    test.spines.right.set_visible(True)
    train.set(
        xlabel="normalised depth entropy",
        title=f"training views: mean {statistics.entropy_mean:.3f}, sd {statistics.entropy_std:.3f} "
        f"(thesis, all views: 0.329, 0.156)",
    )
    return figure


# ---------------------------------------------------------------------------------------------- lattices and graphs, 6–11


def _sphere(axis: Any, points: np.ndarray) -> None:
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 30j, -np.pi / 2 : np.pi / 2 : 16j]
    x, y, z = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    axis.plot_wireframe(0.97 * x, 0.97 * y, 0.97 * z, color="#e5e7eb", linewidth=0.4)
    for side in (axis.xaxis, axis.yaxis, axis.zaxis):
        side.set_pane_color((1, 1, 1, 0))  # the page's ground is seen through
    axis.set_box_aspect((1, 1, 1), zoom=0.88)
    axis.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xlabel="x", ylabel="y", zlabel="z")
    axis.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1], zticks=[-1, 0, 1])


def _sphere_axes(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.6 * columns, 3.4 * rows), subplot_kw={"projection": "3d"}, squeeze=False
    )
    figure.subplots_adjust(left=0.01, right=0.93, bottom=0.05, top=0.93, wspace=0.12, hspace=0.15)
    return figure, axes


def lattices(inputs: FigureInputs) -> Figure:
    figure, axes = _sphere_axes(1, len(inputs.statistics))
    for axis, (views, statistics) in zip(axes[0], inputs.statistics.items(), strict=True):
        points = np.array(statistics.viewpoints)
        _sphere(axis, points)
        axis.scatter(*points.T, c=points[:, 2], cmap="coolwarm", s=26, depthshade=False)
        axis.set_title(f"{views} views")
    return figure


def view_graphs(inputs: FigureInputs) -> Figure:
    figure, axes = _sphere_axes(len(inputs.statistics), 3)
    dots: Any = None
    for row, (views, statistics) in zip(axes, inputs.statistics.items(), strict=True):
        points, weights = np.array(statistics.viewpoints), inputs.tables[views].entropy[inputs.example]
        edges = np.argwhere(np.triu(np.asarray(inputs.graph(views).neighbours)))
        for axis, coloured, connected in zip(row, (True, False, True), (False, True, True), strict=True):
            _sphere(axis, points)
            if connected:
                for edge in edges:
                    axis.plot(*points[edge].T, color="#6b7280", linewidth=0.8)
            colour: dict[str, Any] = (
                {"c": weights, "cmap": "viridis", "vmin": 0, "vmax": 1} if coloured else {"color": "#111827"}
            )
            drawn = axis.scatter(*points.T, s=30, depthshade=False, **colour)
            dots = drawn if coloured else dots
            axis.set_title(f"{views} views" + (f", {len(edges)} edges" if connected else ""))
    figure.colorbar(dots, ax=axes, label="normalised depth entropy", shrink=0.6, pad=0.06)
    return figure


def _map(axis: Axes, points: np.ndarray, **colour: Any) -> Any:
    longitude, height = mercator(points)
    parallels = np.array([-80, -60, -30, 0, 30, 60, 80])
    axis.set_yticks(mercator_ordinate(parallels), [f"{p}°".replace("-", "−") for p in parallels])
    axis.set(xlim=(-185, 185), xticks=[-180, -90, 0, 90, 180], xlabel="longitude (°)", ylabel="latitude")
    axis.grid(color="#e5e7eb", linewidth=0.7)
    axis.set_axisbelow(True)
    return axis.scatter(longitude, height, s=130, zorder=3, **colour)


def _map_edges(axis: Axes, points: np.ndarray, neighbours: np.ndarray) -> None:
    """Draws the edges of the graph; edges across ±180° leave the map on one side and continue on the other."""
    longitude, height = mercator(points)
    for i, j in np.argwhere(np.triu(neighbours)):
        x, y = longitude[[i, j]], height[[i, j]]
        if abs(x[0] - x[1]) <= 180:
            axis.plot(x, y, color="#9ca3af", linewidth=0.8, zorder=1)
            continue
        east, west = (0, 1) if x[0] > x[1] else (1, 0)
        axis.plot([x[east], x[west] + 360], [y[east], y[west]], color="#9ca3af", linewidth=0.8, zorder=1, linestyle=":")
        axis.plot([x[east] - 360, x[west]], [y[east], y[west]], color="#9ca3af", linewidth=0.8, zorder=1, linestyle=":")


def mercator_order_and_entropies(inputs: FigureInputs) -> Figure:
    points, weights = np.array(inputs.statistics[40].viewpoints), inputs.tables[40].entropy[inputs.example]
    figure, (order, entropies) = plt.subplots(2, 1, figsize=(6.4, 8), layout="constrained")
    _map(order, points, color="#bfdbfe")
    for number, (x, y) in enumerate(zip(*mercator(points), strict=True)):
        order.annotate(str(number), (x, y), ha="center", va="center", fontsize=8, zorder=4, color="black")
    order.set_title("(a) canonical order")
    dots = _map(entropies, points, c=weights, cmap="viridis", vmin=0, vmax=1)
    entropies.set_title(f"(b) {inputs.tables[40].names[inputs.example]}")
    figure.colorbar(dots, ax=entropies, label="normalised depth entropy")
    return figure


def graph_with_maxima(inputs: FigureInputs) -> Figure:
    graph = inputs.graph(40)
    points, weights = np.asarray(graph.points), inputs.tables[40].entropy[inputs.example]
    maxima = np.asarray(local_maxima(jnp.asarray(weights), graph.neighbours))
    figure, axes = plt.subplots(2, 1, figsize=(6.4, 8), layout="constrained")
    for axis in axes:
        _map_edges(axis, points, np.asarray(graph.neighbours))
    _map(axes[0], points, color="#bfdbfe")
    axes[0].set_title("(a) neighbours")
    dots = _map(axes[1], points, c=weights, cmap="viridis", vmin=0, vmax=1)
    longitude, height = mercator(points)
    axes[1].scatter(longitude[maxima], height[maxima], s=240, zorder=4, **_RING)
    axes[1].set_title(f"(b) {maxima.sum()} local maxima")
    figure.colorbar(dots, ax=axes[1], label="normalised depth entropy")
    return figure


_EXAMPLE_NODES = {
    "A": (1, 0.5, 5), "B": (2, 0, 8), "C": (3, 0, 31), "D": (3, 0.5, 7), "E": (4.5, 0.5, 35),
    "F": (6, 0.5, 6), "G": (1, 1, 4), "H": (2.5, 0.8, 24), "I": (3, 1.2, 11), "J": (4, 1, 10),
}  # fmt: skip
_EXAMPLE_EDGES = ("AB", "AC", "AD", "BC", "BE", "CF", "CG", "DG", "EF", "EH", "EJ", "FI", "GJ")
"""The graph of the thesis's Fig. 21 (positions, weights, edges), from `check_functionality.py` of its published code."""


def example_graph(inputs: FigureInputs) -> Figure:
    names = list(_EXAMPLE_NODES)
    x, y, weights = np.array(list(_EXAMPLE_NODES.values())).T
    neighbours = np.zeros((len(names), len(names)), bool)
    for edge in _EXAMPLE_EDGES:
        i, j = names.index(edge[0]), names.index(edge[1])
        neighbours[i, j] = neighbours[j, i] = True
    maxima = np.asarray(local_maxima(jnp.asarray(weights, jnp.float32), jnp.asarray(neighbours)))
    figure, axis = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for i, j in np.argwhere(np.triu(neighbours)):
        axis.plot(x[[i, j]], y[[i, j]], color="#9ca3af", linewidth=1, zorder=1)
    axis.scatter(x, y, s=150, color="#bfdbfe", zorder=2)
    axis.scatter(x[maxima], y[maxima], s=300, zorder=3, **_RING)
    for name, place, weight in zip(names, zip(x, y, strict=True), weights, strict=True):
        axis.annotate(f"{weight:g}", place, (0, 10), textcoords="offset points", ha="center", fontsize=8)
        axis.annotate(name, place, ha="center", va="center", fontsize=8, fontweight="bold", color="black")
    axis.set_axis_off()
    axis.margins(0.08, 0.2)
    return figure


def best_and_worst_depths(inputs: FigureInputs) -> Figure:
    weights = inputs.tables[40].entropy[inputs.example]
    depth = np.asarray(metric_depth(open_split(inputs.folder.data(40), "test")[inputs.example]["depth"]))
    nearest = inputs.statistics[40].camera.distance - 1
    order = np.argsort(weights)
    figure, axes = plt.subplots(2, 3, figsize=(6.6, 4.8), layout="constrained")
    for row, chosen in zip(axes, (order[::-1][:3], order[:3]), strict=True):
        for axis, view in zip(row, chosen, strict=True):
            axis.imshow(
                np.where(depth[view] > 0, depth[view], np.nan), cmap="viridis_r", vmin=nearest, vmax=nearest + 2
            )
            axis.set_title(f"view {view}: {weights[view]:.3f}", fontsize=9)
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
    axes[0][0].set_ylabel("highest")
    axes[1][0].set_ylabel("lowest")
    return figure


# ---------------------------------------------------------------------------------------------------------- losses, 17–19


def _losses(axis: Axes, history: list[dict[str, float]], colour: str, label: str, marker: str = "o") -> None:
    """Training losses by dashed lines, validation losses by solid ones; `marker` differs between networks."""
    epochs = [entry["epoch"] for entry in history]
    for key, line, called in (("train/loss", "--", "training"), ("val/loss", "-", "validation")):
        losses = [entry[key] for entry in history]
        axis.plot(epochs, losses, marker + line, color=colour, markersize=4, label=f"{label}{called}")


def entropy_losses(inputs: FigureInputs) -> Figure:
    figure, axes = plt.subplots(2, 1, figsize=(4.2, 5.6), layout="constrained")
    styles: dict[Frame, tuple[str, str]] = {"world": ("#2563eb", "o"), "camera": ("#d97706", "s")}
    for axis, views, letter in zip(axes, inputs.statistics, "ab", strict=True):
        for frame in FRAMES:
            colour, marker = styles[frame]
            _losses(axis, inputs.histories[f"entropy_{views}_{frame}"], colour, f"{frame} frame, ", marker)
        axis.set(xlabel="epoch", ylabel="mean squared error", title=f"({letter}) {views} views")
        figures.logarithmic(axis)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.legend(frameon=False, fontsize=9)
    return figure


def backbone_losses(indices: Sequence[int]) -> Callable[[FigureInputs], Figure]:
    def draw(inputs: FigureInputs) -> Figure:
        figure, axes = plt.subplots(2, 1, figsize=(4.2, 5.6), layout="constrained", sharey=True)
        for axis, index, letter in zip(axes, indices, "ab", strict=True):
            backbone = BACKBONES[index]
            _losses(axis, inputs.histories[backbone.name], "#2563eb", "")
            axis.set(xlabel="epoch", ylabel="cross entropy", title=f"({letter}) {backbone.title}")
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
            axis.legend(frameon=False, fontsize=9)
        axes[0].set_ylim(bottom=0)
        return figure

    return draw


# -------------------------------------------------------------------------------------------------- accuracies, 20, 23–25


def accuracy_grid(views: int) -> Callable[[FigureInputs], Figure]:
    def draw(inputs: FigureInputs) -> Figure:
        found, thresholds = inputs.results["pipeline"][str(views)], inputs.results["thresholds"]
        random, predicted = (
            100 * np.mean(found["policies"][name]["accuracy"], axis=0) for name in ("random", "predicted_entropy")
        )  # (MV, CT)
        figure, axis = plt.subplots(figsize=(8.6, 4.4), layout="constrained")
        limits = np.array(found["max_views"])
        offsets = np.linspace(-0.3, 0.3, len(limits))
        for row, offset, alpha in zip(range(len(limits)), offsets, np.linspace(0.25, 1, len(limits)), strict=True):
            x = np.arange(len(thresholds)) + offset
            for column, at in enumerate(x):
                before, after = random[row, column], predicted[row, column]
                colour, line = ("#059669", "-") if after > before else ("#dc2626", ":")
                axis.plot([at, at], [before, after], line, color=colour, linewidth=1.5)
            last = row == len(limits) - 1
            for values, colour, marker, name in (
                (random, "#6b7280", "o", "random"),
                (predicted, "#2563eb", "s", "PointNet++"),
            ):
                label = name if last else None
                axis.scatter(x, values[row], s=18, color=colour, marker=marker, alpha=alpha, label=label, zorder=3)
        axis.set_xticks(range(len(thresholds)), [f"{ct:g}" for ct in thresholds])
        axis.set(
            xlabel=f"confidence threshold (for each, left to right: limit of {limits[0]} to {limits[-1]} views)",
            ylabel="accuracy (%)",
            title=f"{views} views, mean of the three backbones",
        )
        axis.legend(frameon=False, loc="lower right")
        return figure

    return draw


def confusion_matrices(inputs: FigureInputs) -> Figure:
    policies = inputs.results["pipeline"]["10"]["confusion"]["policies"]
    titles = {"random": "random", "predicted_entropy": "PointNet++"}
    return figures.confusions(
        {title: np.array(policies[name]) for name, title in titles.items()}, inputs.results["classes"]
    )


def confusion_difference(inputs: FigureInputs) -> Figure:
    policies, classes = inputs.results["pipeline"]["10"]["confusion"]["policies"], inputs.results["classes"]
    random, predicted = (
        100 * np.array(policies[name]) / np.maximum(np.sum(policies[name], axis=1, keepdims=True), 1e-9)
        for name in ("random", "predicted_entropy")
    )
    gain = predicted - random
    largest = max(1.0, np.abs(gain).max())
    figure, axis = plt.subplots(figsize=(5.4, 4.8), layout="constrained")
    cells = axis.imshow(gain, cmap="RdBu", vmin=-largest, vmax=largest)
    for (row, column), value in np.ndenumerate(gain):
        if abs(value) >= 0.05:
            colour = figures.ink_on(cells.to_rgba(value))
            text = f"{value:+.1f}".replace("-", "−")
            axis.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
    axis.set_xticks(range(len(classes)), classes, rotation=60, ha="right")
    axis.set_yticks(range(len(classes)), classes)
    axis.set(xlabel="predicted", ylabel="true", title="PointNet++ minus random (points)")
    return figure


_LINES = "Solid, green lines: PointNet++ is above random; dotted, red lines: below."

FIGURES = (
    ThesisFigure(
        "5",
        class_distribution,
        "Number of objects in each class; validation objects are taken from the training split.",
    ),
    ThesisFigure("6", lattices, "Fibonacci lattices of 10 and 40 viewpoints; the 10 viewpoints are not among the 40."),
    ThesisFigure(
        "7",
        mercator_order_and_entropies,
        "The 40 viewpoints: their order, and the depth entropies of one test object. The Mercator projection, which the thesis "
        "uses, enlarges what is near the poles.",
    ),
    ThesisFigure("8", points_per_view, "Points per view by class: median, quartiles, 5th and 95th percentiles."),
    ThesisFigure("9", entropy_distribution, "Depth entropies of all views by split; each split has its own scale."),
    ThesisFigure(
        "10", view_graphs, "Viewpoints with the entropies of one test object, the view graph (convex hull), and both."
    ),
    ThesisFigure(
        "11",
        graph_with_maxima,
        "The view graph and the local maxima (red rings) of one test object; dotted edges cross ±180° longitude.",
    ),
    ThesisFigure(
        "17",
        entropy_losses,
        "Losses of PointNet++. Training losses are means over an epoch, with augmentation if it is on.",
    ),
    ThesisFigure(
        "18", backbone_losses((0, 1)), "ResNet-18 on images: training on 10 views, and fine-tuning on 40 views."
    ),
    ThesisFigure("19", backbone_losses((2, 3)), "ResNet-18 on depth, initialised from images, and ResNet-34 on depth."),
    ThesisFigure("20", accuracy_grid(10), "Table 10 as a figure. " + _LINES),
    ThesisFigure("21", example_graph, "The thesis's example graph, with local maxima E, D, C and I."),
    ThesisFigure(
        "22", best_and_worst_depths, "Depth images of one test object from the views of highest and lowest entropy."
    ),
    ThesisFigure(
        "23",
        confusion_matrices,
        "Confusion matrices in % of the true class: 10 views, CT 0.99, MV 4, ResNet-18 on images.",
    ),
    ThesisFigure("24", confusion_difference, "Difference between the two confusion matrices of Figure 23."),
    ThesisFigure("25", accuracy_grid(40), "Table 11 as a figure. " + _LINES),
)
