"""The picture of the README: a walk of the system that comes with the package, and accuracy by number of views.

`python docs/images/overview.py` writes `overview.png` beside this file. The curves are those of the table "Forty candidates" in
`docs/results.md`; the object is one that the system was not trained on.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import mevs_jax
from data_pipeline.objects.furniture import furniture
from mevs_jax.agent.looking import Walk
from mevs_jax.geometry.triangles import centred_triangles

INK, GREY, MARK, LIGHT = "#1b2a41", "#6b7785", "#c1440e", "#c9d1da"
PIECE = ("table", 900)
RESULTS = Path(__file__).parents[1] / "results.md"
POLICIES = (
    ("greedy label oracle", "oracle that knows the class", GREY, "--", -1.4),
    ("expected information gain", "expected information gain", MARK, "-", 1.0),
    ("random", "random views", GREY, "-", 0.7),
    ("PointNet++ entropy (thesis)", "the thesis's policy", INK, ":", -1.3),
)


def draw_views(figure: Figure, grid: Any, walk: Walk, system: mevs_jax.TrainedSystem) -> None:
    """A column for each view: what was seen, and the beliefs after it."""
    largest = np.max([belief.probabilities for belief in walk.beliefs], axis=0)
    shown = np.argsort(-largest)[:4]
    for column, (depth, belief) in enumerate(zip(walk.history.depths, walk.beliefs, strict=True)):
        seen = figure.add_subplot(grid[0, column])
        seen.imshow(np.where(depth > 0, depth, np.nan), cmap="cividis_r")
        seen.set_axis_off()
        seen.set_title(f"view {column + 1}", fontsize=13, color=INK)
        bars = figure.add_subplot(grid[1, column])
        colours = [MARK if label == belief.label else LIGHT for label in shown]
        bars.barh(range(len(shown)), belief.probabilities[shown], color=colours)
        bars.set(xlim=(0, 1), ylim=(len(shown) - 0.5, -0.5), xticks=[])
        names = [system.classes[label].replace("_", " ") for label in shown]
        bars.set_yticks(range(len(shown)), names if column == 0 else [], fontsize=12)
        bars.tick_params(length=0)
        bars.set_title(f"{belief.name} {100 * belief.confidence:.0f} %", fontsize=12, color=INK, loc="left")
        bars.spines[["top", "right", "bottom"]].set_visible(False)


def gains_after_first(walk: Walk, system: mevs_jax.TrainedSystem) -> np.ndarray:
    """Expected gain of every candidate after the first view of a walk, in nats."""
    agent = system.agent(policy="information_gain", stop=2.0)
    agent.reset(center=(0, 0, 0), radius=1.0, yaw=0.0)
    agent.observe_view(walk.history.depths[0], walk.history.poses[0])
    return np.array([agent.decide(reachable=[view]).expected_gain for view in range(len(system.viewpoints))])


def draw_cameras(axes: Any, walk: Walk, system: mevs_jax.TrainedSystem, triangles: np.ndarray) -> None:
    """The object among the candidate cameras, coloured by the expected gain after the first view, and the walk."""
    gains = gains_after_first(walk, system)
    surface = Poly3DCollection(0.62 * triangles, facecolor="#e8ddcf", edgecolor="#8a7b66", linewidths=0.15, alpha=0.95)
    axes.add_collection3d(surface)
    taken = [int(view) for view in walk.views]
    others = np.setdiff1d(np.arange(len(system.viewpoints)), taken)
    axes.scatter(*system.viewpoints[others].T, c=gains[others], cmap="Oranges", s=60, ec=GREY, lw=0.6, depthshade=False)
    for start, end in pairwise(system.viewpoints[taken]):
        shares = np.linspace(0, 1, 100)[:, None]
        arc = (1 - shares) * start + shares * end
        axes.plot(*(arc / np.linalg.norm(arc, axis=1, keepdims=True)).T, color=MARK, lw=2)
    axes.scatter(*system.viewpoints[taken].T, s=260, color=MARK, depthshade=False)
    for number, point in enumerate(system.viewpoints[taken], 1):
        axes.text(*point, str(number), color="white", fontsize=12, ha="center", va="center", weight="bold", zorder=10)
    axes.set(xlim=(-0.75, 0.75), ylim=(-0.75, 0.75), zlim=(-0.75, 0.75))
    axes.set_box_aspect((1, 1, 1), zoom=1.25)
    axes.view_init(elev=22, azim=-58)
    axes.set_axis_off()
    axes.set_title("the cameras (darker: more gain expected)", fontsize=13, color=INK)


def curves() -> tuple[list[int], dict[str, list[float]]]:
    """Numbers of views, and accuracies of every policy after them, as the page of results has them."""
    page = RESULTS.read_text().partition("## Forty candidates")[2]
    found = re.search(r"One view: ([\d.]+) %", page)
    assert found is not None
    header, _, *rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("|")][:15]
    views = [int(cell.split()[0]) for cell in header[1:6]]
    return [1, *views], {
        row[0]: [float(found[1]), *(float(cell.partition("<br>")[0]) for cell in row[1:6])] for row in rows
    }


def draw_curves(axes: Any) -> None:
    """Accuracy by number of views."""
    views, accuracies = curves()
    for name, title, colour, style, above in POLICIES:
        axes.plot(views, accuracies[name], style, marker="o", markersize=5, color=colour, lw=2.6)
        axes.text(4.9, accuracies[name][3] + above, title, color=colour, fontsize=13)
    axes.set_xlabel("views", fontsize=13, color=INK)
    axes.set_title("recognised, % of 901 test objects (ModelNet10)", fontsize=13, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=12)
    axes.grid(axis="y", color="#eceff2")


def main() -> None:
    system, piece = mevs_jax.load("furniture10_classifier"), furniture(*PIECE)
    walk = mevs_jax.look(system, piece.vertices, piece.faces, policy="information_gain", stop=0.95, max_views=5)
    print(walk)
    count = len(walk.views)
    figure = Figure(figsize=(18, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, count + 2, width_ratios=[1] * count + [2.1, 2.7], height_ratios=(1.5, 1))
    draw_views(figure, grid, walk, system)
    triangles, _ = centred_triangles(piece.vertices, piece.faces)
    draw_cameras(figure.add_subplot(grid[:, count], projection="3d"), walk, system, triangles)
    draw_curves(figure.add_subplot(grid[:, count + 1]))
    figure.savefig(Path(__file__).with_name("overview.png"), dpi=80, facecolor="white")


if __name__ == "__main__":
    main()
