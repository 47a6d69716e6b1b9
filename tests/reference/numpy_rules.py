"""The rules, written as slowly and plainly as they can be: loops over NumPy arrays, no JAX."""

from __future__ import annotations

import numpy as np


def farthest_point_sample(points: np.ndarray, k: int) -> np.ndarray:
    """Start at point 0; then always the point farthest from all chosen; a tie goes to the smallest index."""
    chosen = [0]
    nearest = np.full(len(points), np.inf, np.float32)
    while len(chosen) < k:
        offset = points - points[chosen[-1]]
        squared = offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2
        nearest = np.minimum(nearest, squared)
        chosen.append(int(np.argmax(nearest)))
    return np.array(chosen)


def ball_query(points: np.ndarray, centres: np.ndarray, radius: float, k: int) -> np.ndarray:
    """The first k points in index order strictly within the radius, padded with the first; point 0 where there is none."""
    rows = []
    squared_radius = np.float32(radius) * np.float32(radius)
    for centre in centres:
        found = []
        for index, point in enumerate(points):
            x, y, z = centre - point
            if x * x + y * y + z * z < squared_radius:
                found.append(index)
            if len(found) == k:
                break
        rows.append((found + [found[0]] * (k - len(found))) if found else [0] * k)
    return np.array(rows)


def local_maxima(weights: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Thesis Algorithm 1: a node is a result unless some neighbour weighs as much or more."""
    result = []
    for node in range(len(weights)):
        highest = True
        for neighbour in range(len(weights)):
            if neighbours[node, neighbour] and weights[neighbour] >= weights[node]:
                highest = False
        result.append(highest)
    return np.array(result)


def hull_edges(points: np.ndarray) -> set[tuple[int, int]]:
    """Edges of the convex hull: of every three points whose plane has all others strictly on one side."""
    edges = set()
    count = len(points)
    for a in range(count):
        for b in range(a + 1, count):
            for c in range(b + 1, count):
                normal = np.cross(points[b] - points[a], points[c] - points[a])
                side = np.delete(points @ normal - points[a] @ normal, [a, b, c])
                if (side > 1e-9).all() or (side < -1e-9).all():
                    edges |= {(a, b), (a, c), (b, c)}
    return edges


def softmax_confidence(belief: np.ndarray) -> float:
    shifted = np.exp(belief - belief.max())
    return float(shifted.max() / shifted.sum())


def expected_calibration_error(confidences: np.ndarray, right: np.ndarray, bins: int) -> float:
    """Guo et al. 2017, eq. (3): bins are (i/bins, (i+1)/bins]."""
    error = 0.0
    for i in range(bins):
        inside = [n for n, c in enumerate(confidences) if i / bins < c <= (i + 1) / bins]
        if inside:
            accuracy = sum(right[n] for n in inside) / len(inside)
            confidence = sum(confidences[n] for n in inside) / len(inside)
            error += len(inside) / len(confidences) * abs(accuracy - confidence)
    return float(error)


def walk(
    logits: np.ndarray,
    weights_after: np.ndarray,
    neighbours: np.ndarray | None,
    start: int,
    threshold: float,
    max_views: int,
) -> tuple[list[int], list[int], list[float]]:
    """The selection loop for one object: views, predictions and confidences.

    Args:
        weights_after: (views, views); row i is what the policy goes by after looking at view i; or for a policy that draws,
            (max_views + 1, views) scores by the number of views seen, with `neighbours` None.
        neighbours: of the view graph; local maxima come first. None for plain best-first.
    """
    belief = np.zeros(logits.shape[1], np.float32)
    views, predictions, confidences = [start], [], []
    while True:
        belief = belief + logits[views[-1]]
        predictions.append(int(belief.argmax()))
        confidences.append(softmax_confidence(belief))
        if confidences[-1] >= threshold or len(views) == max_views:
            return views, predictions, confidences
        weights = weights_after[views[-1]] if neighbours is not None else weights_after[len(views)]
        candidates = [view for view in range(len(weights)) if view not in views]
        if neighbours is not None:
            maxima = local_maxima(weights, neighbours)
            candidates = [view for view in candidates if maxima[view]] or candidates
        views.append(max(candidates, key=lambda view: (weights[view], -view)))
