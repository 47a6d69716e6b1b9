"""The thesis's figures of viewpoints and their graphs: 6, 7, 10, 11 and 21."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.projections import mercator, mercator_ordinate
from eval.thesis.layout import Drawn, FigureInputs, extremes
from mevs_jax.geometry.viewpoints import local_maxima

_RING: dict[str, Any] = {"facecolors": "none", "edgecolors": "#dc2626", "linewidths": 1.6}


def _entropies(inputs: FigureInputs) -> str:
    return extremes(inputs.entropies, [f"view {view}" for view in range(len(inputs.entropies))], "{:.2f}")


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


def lattices(inputs: FigureInputs) -> Drawn:
    figure, axes = _sphere_axes(1, len(inputs.statistics))
    for axis, (views, statistics) in zip(axes[0], inputs.statistics.items(), strict=True):
        points = np.array(statistics.viewpoints)
        _sphere(axis, points)
        axis.scatter(*points.T, c=points[:, 2], cmap="coolwarm", s=26, depthshade=False)
        axis.set_title(f"{views} views")
    return figure, f"Spheres with {' and '.join(map(str, inputs.statistics))} dots, evenly spread from pole to pole."


def view_graphs(inputs: FigureInputs) -> Drawn:
    figure, axes = _sphere_axes(len(inputs.statistics), 3)
    dots: Any = None
    counted = []
    for row, (views, statistics) in zip(axes, inputs.statistics.items(), strict=True):
        points, weights = np.array(statistics.viewpoints), inputs.tables[views].entropy[inputs.example]
        edges = np.argwhere(np.triu(np.asarray(inputs.graph(views).neighbours)))
        counted.append(f"{len(edges)} edges between {views} views")
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
    return figure, (
        f"Spheres in two rows, with the viewpoints coloured by entropy, the graph of neighbours, and both: "
        f"{' and '.join(counted)}."
    )


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


def mercator_order_and_entropies(inputs: FigureInputs) -> Drawn:
    points, weights = np.array(inputs.statistics[40].viewpoints), inputs.entropies
    figure, (order, entropies) = plt.subplots(2, 1, figsize=(6.4, 8), layout="constrained")
    _map(order, points, color="#bfdbfe")
    for number, (x, y) in enumerate(zip(*mercator(points), strict=True)):
        order.annotate(str(number), (x, y), ha="center", va="center", fontsize=8, zorder=4, color="black")
    order.set_title("(a) canonical order")
    dots = _map(entropies, points, c=weights, cmap="viridis", vmin=0, vmax=1)
    entropies.set_title(f"(b) {inputs.example_name}")
    figure.colorbar(dots, ax=entropies, label="normalised depth entropy")
    way = "north to south" if points[0, 2] > points[-1, 2] else "south to north"
    return figure, (
        f"Two maps of 40 dots. Above, they are numbered in a spiral from {way}. Below, they are coloured by the entropies of "
        f"{inputs.example_name}, {_entropies(inputs)}."
    )


def graph_with_maxima(inputs: FigureInputs) -> Drawn:
    graph = inputs.graph(40)
    points, weights = np.asarray(graph.points), inputs.entropies
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
    return figure, (
        f"Two maps of 40 dots joined by lines to their neighbours. Below, entropies {_entropies(inputs)}, with rings around the "
        f"local maxima: views {', '.join(map(str, np.flatnonzero(maxima)))}."
    )


_EXAMPLE_NODES = {
    "A": (1, 0.5, 5), "B": (2, 0, 8), "C": (3, 0, 31), "D": (3, 0.5, 7), "E": (4.5, 0.5, 35),
    "F": (6, 0.5, 6), "G": (1, 1, 4), "H": (2.5, 0.8, 24), "I": (3, 1.2, 11), "J": (4, 1, 10),
}  # fmt: skip
_EXAMPLE_EDGES = ("AB", "AC", "AD", "BC", "BE", "CF", "CG", "DG", "EF", "EH", "EJ", "FI", "GJ")
"""The graph of the thesis's Fig. 21 (positions, weights, edges), from `check_functionality.py` of its published code."""


def example_graph(inputs: FigureInputs) -> Drawn:
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
    return figure, "A graph of ten nodes, A to J, with their weights; rings are around the local maxima E, D, C and I."
