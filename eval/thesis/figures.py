"""The thesis's figures of data and results: 5–11 and 17–25. (1–4 and 12–16 are diagrams of ideas and networks.)"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.inputs import metric_depth
from eval.report import figures
from eval.thesis import graphs
from eval.thesis.layout import Drawn, FigureInputs, ThesisFigure, extremes
from train.many.thesis import BACKBONES, Frame

_MEDIAN = {"color": figures.INK, "linewidth": 2}


# ------------------------------------------------------------------------------------------------------------- data, 5–9


def class_distribution(inputs: FigureInputs) -> Drawn:
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
    return figure, (
        f"Bars of {len(train)} classes. Objects to train on: {extremes(train, statistics.classes)}. Test objects: "
        f"{extremes(test, statistics.classes)}."
    )


def points_per_view(inputs: FigureInputs) -> Drawn:
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
    medians = extremes([middle for _, _, middle, *_ in statistics.points_by_class], statistics.classes)
    return figure, (
        f"Boxes of the points in a view, by class. Medians are {medians}; a dotted line is at the mean, "
        f"{statistics.points_mean:.0f}."
    )


def entropy_distribution(inputs: FigureInputs) -> Drawn:
    statistics = inputs.statistics[40]
    figure, train = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    test = train.twinx()
    edges, said = np.linspace(0, 1, 51), []
    for axis, split, colour in ((train, "train", "#93c5fd"), (test, "test", "#d97706")):
        counts = statistics.entropy_histograms[split]
        centres, called = (np.arange(len(counts)) + 0.5) / len(counts), "training" if split == "train" else split
        mean, highest = np.average(centres, weights=np.array(counts, float)), centres[np.argmax(counts)]
        said.append(f"{called} views, mean {mean:.2f}, highest bin at {highest:.2f}")
        axis.stairs(counts, edges, label=split, color=colour, fill=split == "train", linewidth=1.8)
        axis.set_ylabel(f"{split} views ({'filled' if split == 'train' else 'line'})")
        axis.set_ylim(0, 1.05 * max(counts))
    test.spines.right.set_visible(True)
    train.set(
        xlabel="normalised depth entropy",
        title=f"training views: mean {statistics.entropy_mean:.3f}, sd {statistics.entropy_std:.3f} "
        f"(thesis, all views: 0.329, 0.156)",
    )
    return figure, f"Two histograms of depth entropy on top of each other: {'; '.join(said)}."


def best_and_worst_depths(inputs: FigureInputs) -> Drawn:
    weights = inputs.entropies
    depth = np.asarray(metric_depth(open_split(inputs.folder.data(40), "test")[inputs.example]["depth"]))
    nearest = inputs.statistics[40].camera.distance - 1
    order = np.argsort(weights)
    highest, lowest = order[::-1][:3], order[:3]
    figure, axes = plt.subplots(2, 3, figsize=(6.6, 4.8), layout="constrained")
    for row, chosen in zip(axes, (highest, lowest), strict=True):
        for axis, view in zip(row, chosen, strict=True):
            axis.imshow(
                np.where(depth[view] > 0, depth[view], np.nan), cmap="viridis_r", vmin=nearest, vmax=nearest + 2
            )
            axis.set_title(f"view {view}: {weights[view]:.3f}", fontsize=9)
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
    axes[0][0].set_ylabel("highest")
    axes[1][0].set_ylabel("lowest")
    above, below = (", ".join(map(str, views)) for views in (highest, lowest))
    return figure, (
        f"Six depth images of {inputs.example_name}: above, views {above} of highest entropy; below, views {below} of lowest."
    )


# ---------------------------------------------------------------------------------------------------------- losses, 17–19


def _losses(axis: Axes, history: list[dict[str, float]], colour: str, label: str = "", marker: str = "o") -> str:
    """Training losses by dashed lines, validation losses by solid ones; `marker` differs between networks. In words, too."""
    lines = (("--", "training"), ("-", "validation"))
    figures.loss_curves(axis, history, [(marker + line, colour, f"{label}{called}") for line, called in lines])
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    first, last = history[0], history[-1]
    return (
        f"training loss from {first['train/loss']:.4f} to {last['train/loss']:.4f}, validation loss from "
        f"{first['val/loss']:.4f} to {last['val/loss']:.4f}, in {len(history)} epochs"
    )


def entropy_losses(inputs: FigureInputs) -> Drawn:
    figure, axes = plt.subplots(2, 1, figsize=(4.2, 5.6), layout="constrained")
    styles: dict[Frame, tuple[str, str]] = {"world": ("#2563eb", "o"), "camera": ("#d97706", "s")}
    said = []
    for axis, views, letter in zip(axes, inputs.statistics, "ab", strict=True):
        for frame, (colour, marker) in styles.items():
            history = inputs.histories[f"entropy_{views}_{frame}"]
            curves = _losses(axis, history, colour, f"{frame} frame, ", marker)
            said.append(f"{views} views, {frame} frame: {curves}")
        axis.set(xlabel="epoch", ylabel="mean squared error", title=f"({letter}) {views} views")
        figures.logarithmic(axis)
        axis.legend(frameon=False, fontsize=9)
    return figure, f"Curves of losses. {'; '.join(said)}."


def backbone_losses(inputs: FigureInputs, indices: Sequence[int]) -> Drawn:
    figure, axes = plt.subplots(2, 1, figsize=(4.2, 5.6), layout="constrained", sharey=True)
    said = []
    for axis, index, letter in zip(axes, indices, "ab", strict=True):
        backbone = BACKBONES[index]
        said.append(f"{backbone.title}: {_losses(axis, inputs.histories[backbone.name], '#2563eb')}")
        axis.set(xlabel="epoch", ylabel="cross entropy", title=f"({letter}) {backbone.title}")
        axis.legend(frameon=False, fontsize=9)
    axes[0].set_ylim(bottom=0)
    return figure, f"Curves of losses. {'; '.join(said)}."


# -------------------------------------------------------------------------------------------------- accuracies, 20, 23–25


def accuracy_grid(inputs: FigureInputs, views: int) -> Drawn:
    found, thresholds = inputs.results.pipeline[views], inputs.results.thresholds
    random, predicted = (
        100 * found.policies[name].accuracy.mean(axis=0) for name in ("random", "predicted_entropy")
    )  # (MV, CT)
    figure, axis = plt.subplots(figsize=(8.6, 4.4), layout="constrained")
    limits = found.max_views
    offsets, alphas = np.linspace(-0.3, 0.3, len(limits)), np.linspace(0.25, 1, len(limits))
    for row, (offset, alpha) in enumerate(zip(offsets, alphas, strict=True)):
        x = np.arange(len(thresholds)) + offset
        for at, before, after in zip(x, random[row], predicted[row], strict=True):
            colour, line = ("#059669", "-") if after > before else ("#dc2626", ":")
            axis.plot([at, at], [before, after], line, color=colour, linewidth=1.5)
        for values, colour, marker, name in (
            (random, "#6b7280", "o", "random"),
            (predicted, "#2563eb", "s", "PointNet++"),
        ):
            label = name if row == len(limits) - 1 else None
            axis.scatter(x, values[row], s=18, color=colour, marker=marker, alpha=alpha, label=label, zorder=3)
    axis.set_xticks(range(len(thresholds)), [f"{ct:g}" for ct in thresholds])
    axis.set(
        xlabel=f"confidence threshold (for each, left to right: limit of {limits[0]} to {limits[-1]} views)",
        ylabel="accuracy (%)",
        title=f"{views} views, mean of the three backbones",
    )
    axis.legend(frameon=False, loc="lower right")
    return figure, (
        f"Pairs of dots for each limit on views and each threshold. PointNet++ is above random in "
        f"{(predicted > random).sum()} of {random.size} cells. Random: {random.min():.1f} to {random.max():.1f} %; "
        f"PointNet++: {predicted.min():.1f} to {predicted.max():.1f} %."
    )


def _confusions(inputs: FigureInputs) -> dict[str, np.ndarray]:
    policies = inputs.results.pipeline[10].confusion.policies
    return {"random": policies["random"], "PointNet++": policies["predicted_entropy"]}


def confusion_matrices(inputs: FigureInputs) -> Drawn:
    classes, said, matrices = inputs.results.classes, [], _confusions(inputs)
    for name, matrix in matrices.items():
        share = figures.shares_of(matrix)
        right, wrong = np.diag(share), share * (1 - np.eye(len(classes)))
        true, taken = np.unravel_index(wrong.argmax(), wrong.shape)
        said.append(
            f"{name}: classes are right in {right.min():.0f} to {right.max():.0f} %, and {wrong.max():.0f} % of "
            f"{classes[true]} are taken for {classes[taken]}"
        )
    return (
        figures.confusions(matrices, classes),
        f"Two matrices of true and predicted classes. {'; '.join(said)}.",
    )


def confusion_difference(inputs: FigureInputs) -> Drawn:
    classes = inputs.results.classes
    random, predicted = map(figures.shares_of, _confusions(inputs).values())
    gain = predicted - random

    def text_of(row: int, column: int) -> str:
        value = gain[row, column]
        return f"{value:+.1f}".replace("-", "−") if abs(value) >= 0.05 else ""

    largest = max(1.0, np.abs(gain).max())
    figure, axis = plt.subplots(figsize=(5.4, 4.8), layout="constrained")
    names = classes, classes
    figures.heat_map(axis, gain, text_of, names, rotation=60, cmap="RdBu", vmin=-largest, vmax=largest)
    axis.set(xlabel="predicted", ylabel="true", title="PointNet++ minus random (points)")
    gains = extremes([round(float(value), 1) + 0.0 for value in np.diag(gain)], classes, "{:+.1f}")
    return figure, f"A matrix of differences. On its diagonal, gains in points: {gains}."


_LINES = "Solid, green lines: PointNet++ is above random; dotted, red lines: below."

FIGURES = (
    ThesisFigure(
        5, "Number of objects in each class; validation objects are taken from the training split.", class_distribution
    ),
    ThesisFigure(
        6, "Fibonacci lattices of 10 and 40 viewpoints; the 10 viewpoints are not among the 40.", graphs.lattices
    ),
    ThesisFigure(
        7,
        "The 40 viewpoints: their order, and the depth entropies of one test object. The Mercator projection, which the thesis "
        "uses, enlarges what is near the poles.",
        graphs.mercator_order_and_entropies,
    ),
    ThesisFigure(8, "Points per view by class: median, quartiles, 5th and 95th percentiles.", points_per_view),
    ThesisFigure(9, "Depth entropies of all views by split; each split has its own scale.", entropy_distribution),
    ThesisFigure(
        10,
        "Viewpoints with the entropies of one test object, the view graph (convex hull), and both.",
        graphs.view_graphs,
    ),
    ThesisFigure(
        11,
        "The view graph and the local maxima (red rings) of one test object; dotted edges cross ±180° longitude.",
        graphs.graph_with_maxima,
    ),
    ThesisFigure(
        17,
        "Losses of PointNet++. Training losses are means over an epoch, with augmentation if it is on.",
        entropy_losses,
    ),
    ThesisFigure(
        18,
        "ResNet-18 on images: training on 10 views, and fine-tuning on 40 views.",
        partial(backbone_losses, indices=(0, 1)),
    ),
    ThesisFigure(
        19,
        "ResNet-18 on depth, initialised from images, and ResNet-34 on depth.",
        partial(backbone_losses, indices=(2, 3)),
    ),
    ThesisFigure(20, "Table 10 as a figure. " + _LINES, partial(accuracy_grid, views=10)),
    ThesisFigure(21, "The thesis's example graph, with local maxima E, D, C and I.", graphs.example_graph),
    ThesisFigure(
        22, "Depth images of one test object from the views of highest and lowest entropy.", best_and_worst_depths
    ),
    ThesisFigure(
        23,
        "Confusion matrices in % of the true class: 10 views, CT 0.99, MV 4, ResNet-18 on images.",
        confusion_matrices,
    ),
    ThesisFigure(24, "Difference between the two confusion matrices of Figure 23.", confusion_difference),
    ThesisFigure(25, "Table 11 as a figure. " + _LINES, partial(accuracy_grid, views=40)),
)
