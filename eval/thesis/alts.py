"""What the thesis's figures show, in words, for those who do not see them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from eval.thesis.figures import FigureInputs
from mevs_jax.geometry.viewpoints import local_maxima
from train.many.thesis import BACKBONES, FRAMES


def _extremes(values: Sequence[float] | np.ndarray, names: Sequence[str], form: str = "{:.0f}") -> str:
    """The lowest and the highest value, with their names."""
    low, high = int(np.argmin(values)), int(np.argmax(values))
    return f"from {form.format(values[low])} ({names[low]}) to {form.format(values[high])} ({names[high]})"


def _counts(inputs: FigureInputs) -> str:
    counts, classes = inputs.statistics[40].counts, inputs.statistics[40].classes
    train = [counts["train"][name] + counts["val"][name] for name in classes]
    test = [counts["test"][name] for name in classes]
    return (
        f"Bars of {len(classes)} classes. Objects to train on: {_extremes(train, classes)}. Test objects: "
        f"{_extremes(test, classes)}."
    )


def _lattices(inputs: FigureInputs) -> str:
    views = " and ".join(map(str, inputs.statistics))
    return f"Spheres with {views} dots, evenly spread from pole to pole."


def _entropies(inputs: FigureInputs) -> str:
    weights = inputs.tables[40].entropy[inputs.example]
    return _extremes(weights, [f"view {view}" for view in range(len(weights))], "{:.2f}")


def _order(inputs: FigureInputs) -> str:
    first, last = (inputs.statistics[40].viewpoints[at][2] for at in (0, -1))
    way = "north to south" if first > last else "south to north"
    return (
        f"Two maps of 40 dots. Above, they are numbered in a spiral from {way}. Below, they are coloured by the entropies of "
        f"{inputs.tables[40].names[inputs.example]}, {_entropies(inputs)}."
    )


def _points(inputs: FigureInputs) -> str:
    statistics = inputs.statistics[40]
    medians = [quantiles[2] for quantiles in statistics.points_by_class]
    return (
        f"Boxes of the points in a view, by class. Medians are {_extremes(medians, statistics.classes)}; a dotted line is at "
        f"the mean, {statistics.points_mean:.0f}."
    )


def _histograms(inputs: FigureInputs) -> str:
    parts = []
    for split, called in (("train", "training"), ("test", "test")):
        counts = np.array(inputs.statistics[40].entropy_histograms[split], float)
        centres = (np.arange(len(counts)) + 0.5) / len(counts)
        parts.append(
            f"{called} views, mean {np.average(centres, weights=counts):.2f}, highest bin at {centres[counts.argmax()]:.2f}"
        )
    return f"Two histograms of depth entropy on top of each other: {'; '.join(parts)}."


def _graphs(inputs: FigureInputs) -> str:
    edges = {views: int(np.triu(np.asarray(inputs.graph(views).neighbours)).sum()) for views in inputs.statistics}
    counted = " and ".join(f"{count} edges between {views} views" for views, count in edges.items())
    return (
        f"Spheres in two rows, with the viewpoints coloured by entropy, the graph of neighbours, and both: {counted}."
    )


def _maxima(inputs: FigureInputs) -> str:
    weights, graph = jnp.asarray(inputs.tables[40].entropy[inputs.example]), inputs.graph(40)
    found = ", ".join(map(str, np.flatnonzero(np.asarray(local_maxima(weights, graph.neighbours)))))
    return (
        f"Two maps of 40 dots joined by lines to their neighbours. Below, entropies {_entropies(inputs)}, with rings around the "
        f"local maxima: views {found}."
    )


def _curve(history: list[dict[str, float]]) -> str:
    first, last = history[0], history[-1]
    return (
        f"training loss from {first['train/loss']:.4f} to {last['train/loss']:.4f}, validation loss from "
        f"{first['val/loss']:.4f} to {last['val/loss']:.4f}, in {len(history)} epochs"
    )


def _entropy_losses(inputs: FigureInputs) -> str:
    parts = [
        f"{views} views, {frame} frame: {_curve(inputs.histories[f'entropy_{views}_{frame}'])}"
        for views in inputs.statistics
        for frame in FRAMES
    ]
    return f"Curves of losses. {'; '.join(parts)}."


def _backbone_losses(indices: Sequence[int]) -> Callable[[FigureInputs], str]:
    def say(inputs: FigureInputs) -> str:
        shown = [BACKBONES[index] for index in indices]
        return f"Curves of losses. {'; '.join(f'{one.title}: {_curve(inputs.histories[one.name])}' for one in shown)}."

    return say


def _accuracies(views: int) -> Callable[[FigureInputs], str]:
    def say(inputs: FigureInputs) -> str:
        policies = inputs.results["pipeline"][str(views)]["policies"]
        random, predicted = (
            100 * np.mean(policies[name]["accuracy"], axis=0) for name in ("random", "predicted_entropy")
        )
        return (
            f"Pairs of dots for each limit on views and each threshold. PointNet++ is above random in "
            f"{int((predicted > random).sum())} of {random.size} cells. Random: {random.min():.1f} to {random.max():.1f} %; "
            f"PointNet++: {predicted.min():.1f} to {predicted.max():.1f} %."
        )

    return say


def _example(_: FigureInputs) -> str:
    return "A graph of ten nodes, A to J, with their weights; rings are around the local maxima E, D, C and I."


def _depths(inputs: FigureInputs) -> str:
    order = np.argsort(inputs.tables[40].entropy[inputs.example])
    highest, lowest = (", ".join(map(str, views)) for views in (order[::-1][:3], order[:3]))
    return (
        f"Six depth images of {inputs.tables[40].names[inputs.example]}: above, views {highest} of highest entropy; below, "
        f"views {lowest} of lowest."
    )


def _shares(inputs: FigureInputs) -> tuple[np.ndarray, np.ndarray]:
    """The confusions of random and PointNet++ in percent of the true class."""
    policies = inputs.results["pipeline"]["10"]["confusion"]["policies"]
    random, predicted = (
        100 * np.array(policies[name]) / np.maximum(np.sum(policies[name], axis=1, keepdims=True), 1e-9)
        for name in ("random", "predicted_entropy")
    )
    return random, predicted


def _confusions(inputs: FigureInputs) -> str:
    classes, parts = inputs.results["classes"], []
    for name, share in zip(("random", "PointNet++"), _shares(inputs), strict=True):
        wrong = share * (1 - np.eye(len(classes)))
        true, said = np.unravel_index(wrong.argmax(), wrong.shape)
        parts.append(
            f"{name}: classes are right in {np.diag(share).min():.0f} to {np.diag(share).max():.0f} %, and "
            f"{wrong.max():.0f} % of {classes[true]} are taken for {classes[said]}"
        )
    return f"Two matrices of true and predicted classes. {'; '.join(parts)}."


def _difference(inputs: FigureInputs) -> str:
    random, predicted = _shares(inputs)
    gains = [round(float(gain), 1) + 0.0 for gain in np.diag(predicted - random)]
    return f"A matrix of differences. On its diagonal, gains in points: {_extremes(gains, inputs.results['classes'], '{:+.1f}')}."


ALTS: dict[str, Callable[[FigureInputs], str]] = {
    "5": _counts,
    "6": _lattices,
    "7": _order,
    "8": _points,
    "9": _histograms,
    "10": _graphs,
    "11": _maxima,
    "17": _entropy_losses,
    "18": _backbone_losses((0, 1)),
    "19": _backbone_losses((2, 3)),
    "20": _accuracies(10),
    "21": _example,
    "22": _depths,
    "23": _confusions,
    "24": _difference,
    "25": _accuracies(40),
}
"""By the number of the figure."""
