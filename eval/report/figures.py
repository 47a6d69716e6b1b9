"""The report's figures: functions that take numbers and return a matplotlib figure."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from eval.projections import longitude_latitude

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

plt.rcParams.update(
    {
        "figure.dpi": 110,
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 10,
        "axes.titleweight": "bold",
        "svg.fonttype": "path",
        "svg.hashsalt": "mevs",
    }
)


_OWN_COLOURS = ("#db2777", "#65a30d", "#0891b2", "#92400e")


def _colours(own: Sequence[str]) -> dict[str, str]:
    """Colours of the policies drawn as lines: those of `COLOURS`, and the users' own."""
    return COLOURS | dict(zip(own, itertools.cycle(_OWN_COLOURS), strict=False))


def accuracy_after_views(
    policies: dict[str, dict[str, Any]], titles: dict[str, str], all_views: float, own: Sequence[str] = ()
) -> Figure:
    """Accuracy after each number of views, over all start views, with 95 % bands over objects; `own` are drawn as well."""
    figure, axis = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    for name, colour in _colours(own).items():
        values = 100 * np.array(policies[name]["after_views"])
        low, high = 100 * np.array(policies[name]["after_views_interval"]).T
        steps = np.arange(1, len(values) + 1)
        axis.plot(steps, values, "o-", color=colour, label=titles[name], markersize=3.5)
        axis.fill_between(steps, low, high, color=colour, alpha=0.06, linewidth=0)
    axis.axhline(100 * all_views, color="#111827", linestyle=":", linewidth=1, label="all views summed")
    axis.set(xlabel="number of views", ylabel="test accuracy (%)", title="Accuracy by number of views")
    axis.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def accuracy_of_choices(policies: dict[str, dict[str, Any]], titles: dict[str, str], all_views: float) -> Figure:
    """Accuracy after each number of views, coloured by what each policy knows, with 95 % bands over objects."""
    figure, axis = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    lines = {known: itertools.cycle(("o-", "s--", "^:", "v-.", "D-")) for known in KNOWS_COLOURS}
    for name, policy in policies.items():
        values, (low, high) = 100 * np.array(policy["after_views"]), 100 * np.array(policy["interval"]).T
        steps, colour = np.arange(1, len(values) + 1), KNOWS_COLOURS[policy["knows"]]
        axis.plot(steps, values, next(lines[policy["knows"]]), color=colour, label=titles[name], markersize=3.5)
        axis.fill_between(steps, low, high, color=colour, alpha=0.05, linewidth=0)
    axis.axhline(100 * all_views, color="#111827", linestyle=":", linewidth=1, label="all views fused")
    axis.set(xlabel="number of views", ylabel="test accuracy (%)", title="Accuracy by number of views")
    axis.set_xticks(range(1, 1 + max(len(policy["after_views"]) for policy in policies.values())))
    axis.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def ladder_gains(
    against: dict[str, dict[str, Any]], ladder: Sequence[dict[str, str]], views: Sequence[int], exclude: Sequence[str]
) -> Figure:
    """Gain over random in percentage points with paired 95 % intervals, a panel for each number of views.

    Markers are hollow where the interval contains zero.
    """
    rungs = [rung for rung in ladder if rung["policy"] in against and rung["policy"] not in exclude]
    figure, axes = plt.subplots(
        1, len(views), figsize=(8.4, 0.34 * len(rungs) + 1.1), sharey=True, layout="constrained", squeeze=False
    )
    for axis, count in zip(axes[0], views, strict=True):
        for row, rung in enumerate(rungs):
            result = against[rung["policy"]]
            gain = 100 * result["after_views_difference"][count - 1]
            low, high = (100 * end for end in result["after_views_interval"][count - 1])
            colour = KNOWS_COLOURS[rung["knows"]]
            axis.plot([low, high], [row, row], color=colour, linewidth=1.5)
            axis.plot(
                gain, row, "o", color=colour, markersize=5, markerfacecolor="white" if low <= 0 <= high else colour
            )
        axis.axvline(0, color="#111827", linewidth=1)
        axis.set(xlabel="gain over random (percentage points)", title=f"After {count} views")
        axis.grid(axis="x", color="#e5e7eb", linewidth=0.6)
        axis.set_axisbelow(True)
    axes[0][0].set_yticks(range(len(rungs)), [rung["title"].lstrip("— ") for rung in rungs])
    axes[0][0].invert_yaxis()
    return figure


def accuracy_by_distance(
    policies: dict[str, dict[str, Any]],
    titles: dict[str, str],
    movement: dict[str, list[dict[str, Any]]],
    own: Sequence[str] = (),
) -> Figure:
    """Accuracy against the distance that the camera travelled; the fainter lines have a movement cost."""
    figure, axis = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    for name, colour in _colours(own).items():
        if name == "belief_oracle":
            continue
        distance, values = np.degrees(policies[name]["travelled"]), 100 * np.array(policies[name]["after_views"])
        axis.plot(distance, values, "o-", color=colour, label=titles[name], markersize=3.5)
    for name, runs in movement.items():
        with_cost = [run for run in runs if run["cost"] > 0]
        for alpha, run in zip(np.linspace(0.7, 0.3, len(with_cost)), with_cost, strict=True):
            distance, values = np.degrees(run["travelled"]), 100 * np.array(run["after_views"])
            axis.plot(distance, values, "-", color=COLOURS[name], alpha=alpha, linewidth=1)
            axis.annotate(f"{run['cost']:g}", (distance[-1], values[-1]), fontsize=6, color=COLOURS[name], alpha=alpha)
    axis.set(xlabel="distance travelled (°)", ylabel="test accuracy (%)", title="Accuracy by distance travelled")
    axis.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def calibration_by_views(readings: dict[str, dict[str, Any]], titles: dict[str, str]) -> Figure:
    """Expected calibration error after each number of views, a line for each way to compute the confidence."""
    figure, axis = plt.subplots(figsize=(8.2, 3.0), layout="constrained")
    for name, colour in zip(readings, ("#d97706", "#0d9488", "#9333ea", "#dc2626", "#6b7280"), strict=True):
        values = 100 * np.array(readings[name]["ece"])
        axis.plot(np.arange(1, len(values) + 1), values, "o-", color=colour, label=titles[name], markersize=3.5)
    axis.set(xlabel="number of views", ylabel="expected calibration error (%)", title="Calibration error", ylim=0)
    figure.legend(frameon=False, fontsize=8, loc="outside right center")
    return figure


def reliability_curves(readings: dict[str, dict[str, Any]], titles: dict[str, str], views: Sequence[int]) -> Figure:
    """Accuracy against confidence in bins, a panel for each number of views; larger dots hold more of the predictions."""
    names = [name for name in readings if "reliability" in readings[name]]
    figure, axes = plt.subplots(
        1, len(views), figsize=(2.5 * len(views), 2.9), sharey=True, layout="constrained", squeeze=False
    )
    for axis, count in zip(axes[0], views, strict=True):
        axis.plot([0, 100], [0, 100], color="#9ca3af", linewidth=1, linestyle=":")
        for name, colour in zip(names, ("#d97706", "#dc2626"), strict=True):
            confidence, accuracy, share = np.array(readings[name]["reliability"])[:, count - 1]
            there = share > 0
            axis.plot(100 * confidence[there], 100 * accuracy[there], "-", color=colour, linewidth=1)
            axis.scatter(
                100 * confidence[there], 100 * accuracy[there], 4 + 120 * share[there], color=colour, label=titles[name]
            )
        axis.set(xlabel="confidence (%)", title=f"{count} view{'s' if count > 1 else ''}", xlim=(0, 102), ylim=(0, 102))
    axes[0][0].set_ylabel("accuracy (%)")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=8, ncols=2, loc="outside lower center", markerscale=0.5)
    return figure


def difference_grid(
    difference: Sequence[Sequence[float]],
    intervals: Sequence[Sequence[Sequence[float]]],
    thresholds: Sequence[float],
    max_views: Sequence[int],
    title: str,
) -> Figure:
    """The thesis's Table 7 as a figure: gain over random in points by MV and CT, bold where the interval excludes 0."""
    values = 100 * np.array(difference)
    largest = max(0.5, np.abs(values).max())
    figure, axis = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
    axis.imshow(values, cmap="RdBu", vmin=-largest, vmax=largest, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        axis.text(
            column,
            row,
            f"{value:+.1f}".replace("-", "−") if abs(value) >= 0.05 else "0.0",
            ha="center",
            va="center",
            fontsize=8,
            fontweight="normal" if intervals[row][column][0] <= 0 <= intervals[row][column][1] else "bold",
            color="white" if abs(value) > 0.65 * largest else "black",
        )
    axis.set_xticks(range(len(thresholds)), [f"{ct:g}" for ct in thresholds])
    axis.set_yticks(range(len(max_views)), [str(mv) for mv in max_views])
    axis.set(xlabel="confidence threshold", ylabel="limit on views", title=title)
    axis.spines[:].set_visible(False)
    return figure


def confusions(matrices: dict[str, np.ndarray], classes: Sequence[str]) -> Figure:
    """Confusion matrices in percent of the true class, a panel for each policy."""
    figure, axes = plt.subplots(
        1, len(matrices), figsize=(4.6 * len(matrices), 4.4), layout="constrained", sharey=True, squeeze=False
    )
    for axis, (title, matrix) in zip(axes[0], matrices.items(), strict=True):
        share = 100 * matrix / np.maximum(matrix.sum(axis=1, keepdims=True), 1e-9)
        axis.imshow(share, cmap="Blues", vmin=0, vmax=100)
        for (row, column), value in np.ndenumerate(share):
            if value >= 0.5:
                axis.text(
                    column,
                    row,
                    f"{value:.0f}",
                    ha="center",
                    va="center",
                    fontsize=7,
                    color="white" if value > 60 else "black",
                )
        axis.set_xticks(range(len(classes)), classes, rotation=60, ha="right")
        axis.set_yticks(range(len(classes)), classes)
        axis.set(xlabel="predicted", title=title)
    axes[0][0].set_ylabel("true")
    return figure


def entropy_histogram(counts: Sequence[int], mean: float, std: float) -> Figure:
    """Normalised depth entropies of the training views."""
    figure, axis = plt.subplots(figsize=(4.6, 2.8), layout="constrained")
    edges = np.linspace(0, 1, len(counts) + 1)
    axis.bar(edges[:-1], counts, width=np.diff(edges), align="edge", color="#93c5fd")
    axis.axvline(mean, color="#1d4ed8", label=f"mean {mean:.3f}, sd {std:.3f}")
    axis.set(xlabel="normalised depth entropy", ylabel="views", title="Depth entropies (training)")
    axis.legend(frameon=False)
    return figure


def entropy_errors(entropy: dict[str, Any]) -> Figure:
    """Error of the network and of two predictors that receive no view."""
    rows = [
        ("mean map", "mean_map", "#9ca3af"),
        ("class-mean map\n(given the class)", "class_mean_map", "#d1d5db"),
        ("PointNet++", "pointnet2", "#2563eb"),
    ]
    figure, axis = plt.subplots(figsize=(4.6, 2.6), layout="constrained")
    for position, (_, name, colour) in enumerate(rows):
        low, high = entropy[f"{name}_interval"]
        axis.barh(
            position,
            entropy[name],
            color=colour,
            xerr=[[max(0, entropy[name] - low)], [max(0, high - entropy[name])]],
            capsize=3,
        )
        axis.text(high, position, f"  {entropy[name]:.4f}", va="center")
    axis.set_yticks(range(len(rows)), [label for label, _, _ in rows])
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
    """Viewpoints by longitude and latitude, coloured by entropy, with rings around local maxima (thesis Figs. 7 and 11)."""
    longitude, latitude = longitude_latitude(points)
    figure, axis = plt.subplots(figsize=(4.8, 2.8), layout="constrained")
    for i, j in np.argwhere(np.triu(neighbours)):
        if abs(longitude[i] - longitude[j]) < 180:
            axis.plot(longitude[[i, j]], latitude[[i, j]], color="#d1d5db", linewidth=0.7, zorder=1)
    dots = axis.scatter(longitude, latitude, c=weights, s=70, cmap="viridis", vmin=limits[0], vmax=limits[1], zorder=2)
    axis.scatter(
        longitude[maxima], latitude[maxima], s=150, facecolors="none", edgecolors="#dc2626", linewidths=1.5, zorder=3
    )
    figure.colorbar(dots, ax=axis, label="normalised entropy")
    axis.set(xlabel="longitude (°)", ylabel="latitude (°)", title=title)
    return figure


def contact_sheet(images: np.ndarray, labels: Sequence[str]) -> Figure:
    """Images (rows, columns, height, width) uint8 as one sheet, with a label for each row."""
    rows, columns, height, width = images.shape
    sheet = images.transpose(0, 2, 1, 3).reshape(rows * height, columns * width)
    figure, axis = plt.subplots(figsize=(8, 8 * rows / columns), layout="constrained")
    axis.imshow(sheet, cmap="gray", vmin=0, vmax=255)
    axis.set_yticks(height * (np.arange(rows) + 0.5), labels)
    axis.set_xticks([])
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    return figure


def episode_strip(images: Sequence[np.ndarray], captions: Sequence[str], title: str) -> Figure:
    """The views of one walk in order, with a caption under each."""
    figure, axes = plt.subplots(1, len(images), figsize=(1.7 * len(images), 2.3), layout="constrained", squeeze=False)
    for axis, image, caption in zip(axes[0], images, captions, strict=True):
        axis.imshow(image, cmap="gray", vmin=0, vmax=255)
        axis.set_xlabel(caption, fontsize=8)
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    figure.suptitle(title, fontsize=10, fontweight="bold")
    return figure


def losses(histories: dict[str, list[dict[str, float]]]) -> Figure:
    """Training and validation loss by epoch, a panel for each network."""
    figure, axes = plt.subplots(
        1, len(histories), figsize=(4.4 * len(histories), 2.8), layout="constrained", squeeze=False
    )
    for axis, (name, history) in zip(axes[0], histories.items(), strict=True):
        epochs = [entry["epoch"] for entry in history]
        axis.plot(
            epochs, [entry["train/loss"] for entry in history], "o-", color="#9ca3af", markersize=3, label="training"
        )
        axis.plot(
            epochs, [entry["val/loss"] for entry in history], "o-", color="#2563eb", markersize=3, label="validation"
        )
        axis.set(xlabel="epoch", ylabel="loss", title=name)
        if len(epochs) > 1 and max(entry["train/loss"] for entry in history) > 5 * min(
            entry["val/loss"] for entry in history
        ):
            axis.set_yscale("log")
        axis.legend(frameon=False)
    return figure
