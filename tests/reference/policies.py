"""Every policy written plainly: loops over NumPy arrays. Each gives the scores of all views after some were seen."""

from __future__ import annotations

import numpy as np

from tests.reference.numpy_rules import local_maxima


def softmax(belief: np.ndarray) -> np.ndarray:
    weights = np.exp(belief - belief.max())
    return weights / weights.sum()


def entropy_of(belief: np.ndarray) -> float:
    return float(-sum(p * np.log(p) for p in softmax(belief.astype(float)) if p > 0))


def maxima_first(weights: np.ndarray, seen: list[int], neighbours: np.ndarray) -> np.ndarray:
    maxima = [v for v in np.flatnonzero(local_maxima(weights, neighbours)) if v not in seen]
    scores = np.full(len(weights), -np.inf) if maxima else weights.copy()
    for view in maxima:
        scores[view] = weights[view]
    return scores


class Node:
    """As in the published code: a view with its neighbours and a weight that is written anew at each step."""

    def __init__(self, view: int):
        self.view, self.weight = view, 0.0


def scrambled(predicted_entropy: np.ndarray, seen: list[int], neighbours: np.ndarray) -> np.ndarray:
    """Runs the published code's walk from its start and hands back the weights as it sees them at the end."""
    nodes = [Node(view) for view in range(len(neighbours))]
    for step, view in enumerate(seen):
        for position, node in enumerate(nodes):
            node.weight = predicted_entropy[view][position]
        weights = np.zeros(len(nodes), predicted_entropy.dtype)
        for node in nodes:
            weights[node.view] = node.weight
        attempted = seen[: step + 1]
        scores = maxima_first(weights, attempted, neighbours)
        if not any(m and v not in attempted for v, m in enumerate(local_maxima(weights, neighbours))):
            nodes.sort(key=lambda node: node.weight, reverse=True)
    return scores


def scores(policy: str, seen: list[int], table: dict, graph: dict, knowledge: dict) -> np.ndarray:
    """Scores of a policy that does not draw.

    Args:
        table: logits (views, classes), predicted_entropy (views, views), entropy (views,), label;
            ascent_scores by policy, each (views, views).
        graph: neighbours and distances, each (views, views).
        knowledge: order (views,) and expected_logits (classes, views, classes).
    """
    logits, predicted_entropy, entropy, label = (
        table[name] for name in ("logits", "predicted_entropy", "entropy", "label")
    )
    neighbours, views = graph["neighbours"], len(logits)
    if policy.startswith("diff_"):
        return table["ascent_scores"][policy][seen[-1]]
    belief = logits[seen].sum(axis=0)
    if policy == "farthest":
        return np.array([min(graph["distances"][view, other] for other in seen) for view in range(views)])
    if policy == "fixed_order":
        return knowledge["order"]
    if policy == "predicted_entropy":
        return maxima_first(predicted_entropy[seen[-1]], seen, neighbours)
    if policy == "predicted_entropy_without_maxima":
        return predicted_entropy[seen[-1]]
    if policy == "remembered_entropy":
        return maxima_first(predicted_entropy[seen].mean(axis=0), seen, neighbours)
    if policy == "scrambled_entropy":
        return scrambled(predicted_entropy, seen, neighbours)
    if policy == "oracle_entropy":
        return maxima_first(entropy, seen, neighbours)
    if policy == "lowest_entropy":
        return -entropy
    if policy in ("information_gain", "expected_views"):
        probability, gain = softmax(belief) ** (1.0 if policy == "information_gain" else 0.5), np.zeros(views)
        probability /= probability.sum()
        for view in range(views):
            expected = sum(
                p * entropy_of(belief + knowledge["expected_logits"][y, view]) for y, p in enumerate(probability)
            )
            gain[view] = entropy_of(belief) - expected
        return gain
    if policy == "expected_views_by_pose":
        probability, gain = np.sqrt(softmax(belief)), np.zeros(views)
        probability /= probability.sum()
        for view in range(views):
            expected = 0.0
            for y, p in enumerate(probability):
                evidence = 0.75 * sum(table["pose_evidence"][one, y] for one in seen)
                for k, share in enumerate(softmax(evidence)):
                    expected += p * share * entropy_of(belief + knowledge["by_pose"][y, k, view])
            gain[view] = entropy_of(belief) - expected
        return gain
    if policy == "belief_oracle":
        final = softmax(logits.sum(axis=0))
        return np.array([np.sum(final * np.log(softmax(belief + logits[view]))) for view in range(views)])
    if policy == "label_oracle" or (policy == "pair_oracle" and len(seen) % 2 == 0):
        return np.array([np.log(softmax(belief + logits[view])[label]) for view in range(views)])
    if policy == "pair_oracle":
        best = np.full(views, -np.inf)
        for first in range(views):
            for second in range(views):
                if first != second and second not in seen:
                    both = belief + logits[first] + logits[second]
                    best[first] = max(best[first], np.log(softmax(both)[label]))
        return best
    raise ValueError(policy)
