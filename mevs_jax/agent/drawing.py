"""One picture of a walk: what was seen, what was believed, and where the cameras were. Needs matplotlib."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from mevs_jax.agent.looking import Walk
from mevs_jax.agent.viewing import way_around
from mevs_jax.trained.system import TrainedSystem

_INK, _GREY, _MARK = "#1b2a41", "#9aa5b1", "#c1440e"
_MOST = 8


def draw_walk(walk: Walk, system: TrainedSystem, path: str | Path, title: str = "") -> None:
    """Draws a walk into an image file: a column for each view, and the cameras on the sphere.

    Args:
        walk: at most its first 8 views are drawn.
        system: that made it.
        path: of the image; its suffix is the format, as `.png` or `.svg`.
        title: above the picture.

    Raises:
        ImportError: without matplotlib.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("drawing a walk needs matplotlib: pip install matplotlib") from error
    count = min(len(walk.views), _MOST)
    figure = Figure(figsize=(2.1 * count + 3.4, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, count + 2, height_ratios=(1, 1), width_ratios=[1] * count + [0.75, 0.75])
    names = _shown(walk, system)
    for column in range(count):
        seen = figure.add_subplot(grid[0, column])
        depth = walk.history.depths[column]
        seen.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis_r")
        seen.set_axis_off()
        seen.set_title(f"{column + 1}. view {walk.views[column]}", fontsize=10, color=_INK)
        bars = figure.add_subplot(grid[1, column])
        belief = walk.beliefs[column]
        values = [belief.probabilities[label] for label in names]
        colours = [_MARK if label == belief.label else _GREY for label in names]
        bars.barh(range(len(names)), values, color=colours)
        bars.set_xlim(0, 1)
        bars.set_ylim(len(names) - 0.5, -0.5)
        bars.set_yticks(range(len(names)), [system.classes[label] for label in names] if column == 0 else [])
        bars.set_xticks([0, 1], ["0", "1"])
        bars.set_title(f"{belief.name} {100 * belief.confidence:.0f} %", fontsize=10, color=_INK)
        bars.spines[["top", "right"]].set_visible(False)
    _draw_cameras(figure.add_subplot(grid[:, count:], projection="3d"), walk, system, count)
    count_of = f"{len(walk.views)} view{'s' * (len(walk.views) > 1)}"
    answer = f"{walk.name}, {100 * walk.confidence:.0f} % confident after {count_of} ({walk.reason})"
    figure.suptitle(f"{title}: {answer}" if title else answer, color=_INK)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _shown(walk: Walk, system: TrainedSystem, most: int = 6) -> list[int]:
    """The classes that were ever the likeliest, by their largest probability."""
    largest = np.max([belief.probabilities for belief in walk.beliefs], axis=0)
    return np.argsort(-largest)[: min(most, len(system.classes))].tolist()


def _draw_cameras(axes, walk: Walk, system: TrainedSystem, count: int) -> None:
    points = system.viewpoints
    taken = np.stack([pose[:3, 3] / np.linalg.norm(pose[:3, 3]) for pose in walk.history.poses[:count]])
    axes.scatter(*points.T, s=10, color=_GREY, depthshade=True)
    for start, end in pairwise(taken):
        axes.plot(*way_around(start, end).T, color=_MARK, lw=1.5)
    axes.scatter(*taken.T, s=36, color=_MARK, depthshade=False)
    for number, point in enumerate(taken, 1):
        axes.text(*(1.15 * point), str(number), color=_INK, fontsize=11, ha="center", va="center")
    axes.quiver(0, 0, 0, 0, 0, 0.6, color=_INK, lw=1)
    axes.text(0, 0, 0.7, "up", color=_INK, fontsize=9, ha="center")
    axes.set_box_aspect((1, 1, 1))
    axes.set_axis_off()
