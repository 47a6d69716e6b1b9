"""The selection loop: look, add up, stop if sure enough, else look where the policy says (thesis §4.4, Fig. 16).

Written for one object as a `lax.while_loop`; objects, start views, seeds and thresholds are `vmap` axes at the call site. What
looking means is an argument: `observe(view)` reads a table here, and may as well call the networks.

The views that a policy visits do not depend on when the loop would stop. So a walk without a threshold, which never stops
early, holds the answer for every threshold and every limit on views at once (`stop_at`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.beliefs import CalibratedFusion, confidence, sum_of_logits
from mevs_jax.policies.base import Knowledge, Observation, Policy, Scene, SelectionState, candidates
from mevs_jax.viewpoints import ViewGraph


@flax.struct.dataclass
class ViewTable:
    """All that the loop needs to know of one object, computed beforehand.

    Attributes:
        logits: (views, classes) of the classifier at each view; an axis of its own where several classifiers are compared.
        predicted_entropy: (views, views); row i is what the entropy predictor says about every view after seeing view i.
        entropy: (views,) true depth entropies.
        label: the true class.
        ascent_scores: (views, views) by policy; row i is where differentiable rendering would look after seeing view i.
        features: (views, features) of the encoder, for a learned fusion.
        clouds: (views, embedding) of the partial clouds, for a policy that uses them.
    """

    logits: Float[Array, "*batch_and_backbones views classes"]
    predicted_entropy: Float[Array, "*batch views views"] | None
    entropy: Float[Array, "*batch views"] | None
    label: Int[Array, "*batch"]
    ascent_scores: dict[str, Float[Array, "*batch views views"]] | None = None
    features: Float[Array, "*batch views features"] | None = None
    clouds: Float[Array, "*batch views embedding"] | None = None

    def observe(self, view: Int[Array, ""]) -> Observation:
        return Observation(
            self.logits[view],
            None if self.predicted_entropy is None else self.predicted_entropy[view],
            None if self.features is None else self.features[view],
            None if self.clouds is None else self.clouds[view],
        )

    def scene(
        self, graph: ViewGraph, knowledge: Knowledge | None = None, reachable: Bool[Array, " views"] | None = None
    ) -> Scene:
        """The scene with everything that an oracle may ask for."""
        return Scene(
            graph, self.entropy, self.logits, self.label, knowledge, reachable, self.ascent_scores, self.features
        )


@flax.struct.dataclass
class Episode:
    """One object looked at; entries beyond `count` are −1 or 0.

    Attributes:
        views: (max_views,) in the order they were looked at.
        predictions: (max_views,) the most likely class after each.
        confidences: (max_views,) its probability.
        count: how many views were looked at.
    """

    views: Int[Array, "*batch max_views"]
    predictions: Int[Array, "*batch max_views"]
    confidences: Float[Array, "*batch max_views"]
    count: Int[Array, "*batch"]


def best_view(scores: Float[Array, " views"], allowed: Bool[Array, " views"]) -> Int[Array, ""]:
    """The allowed view of highest score, the lowest index among equals; −inf and NaN come last.

    A score of +inf is an order: that view is taken even where it is not allowed, having been seen before.
    """
    scores = jnp.where(jnp.isnan(scores), -jnp.inf, scores)
    allowed = allowed | (scores == jnp.inf)
    best = jnp.max(jnp.where(allowed, scores, -jnp.inf))
    return jnp.argmax(allowed & (scores == best)).astype(jnp.int32)


Fuse = Callable[[SelectionState, Scene], Float[Array, " classes"]]
"""The belief once the latest look is among those `seen`; `belief` is still that before it."""


def adding(state: SelectionState, scene: Scene) -> Float[Array, " classes"]:
    """The thesis's fusion (§4.4): the sum of logits."""
    del scene
    return sum_of_logits(state.belief, state.latest.logits)


def by_attention(fusion: CalibratedFusion) -> Fuse:
    """A learned fusion of the features that were seen; the belief is its log-probabilities."""

    def fuse(state: SelectionState, scene: Scene) -> Float[Array, " classes"]:
        if state.seen.features is None:
            raise ValueError("a learned fusion needs the features of every look, which are not given")
        present = jnp.arange(len(state.views)) < state.count
        return fusion(state.seen.features, scene.graph.points[state.views], present)

    return fuse


def select_views(
    key: Array,
    observe: Callable[[Int[Array, ""]], Observation],
    scene: Scene,
    policy: Policy,
    start: int | Int[Array, ""],
    *,
    threshold: float | Float[Array, ""] | None = None,
    max_views: int,
    fuse: Fuse = adding,
) -> Episode:
    """Looks at one object from `start` on until the confidence reaches `threshold` or `max_views` views are seen.

    It ends earlier where no view that can be reached is left.

    Args:
        key: for policies that draw.
        observe: what a look at a view gives.
        scene: the candidate views, and what else the policy may know.
        policy: scores the views; see `mevs_jax.policies`.
        start: the first view, 0..views−1.
        threshold: on the confidence, CT in the thesis; None never stops early.
        max_views: 1..views, MV in the thesis.
        fuse: how looks become a belief.

    Raises:
        ValueError: for `max_views` outside its range, or a scene that lacks what the policy asks for.
    """
    views = scene.graph.points.shape[0]
    if not 1 <= max_views <= views:
        raise ValueError(f"max_views must be between 1 and the {views} candidate views, got {max_views}")
    start = jnp.asarray(start, jnp.int32)
    limit: int | Array = max_views
    if scene.reachable is not None:
        limit = jnp.minimum(max_views, jnp.sum(scene.reachable.at[start].set(True)))

    def unsure(carry: tuple[SelectionState, Episode]) -> Bool[Array, ""]:
        state, episode = carry
        if threshold is None:
            return state.count < limit
        latest = episode.confidences[jnp.maximum(state.count - 1, 0)]
        return (state.count == 0) | ((state.count < limit) & (latest < threshold))

    def look(carry: tuple[SelectionState, Episode]) -> tuple[SelectionState, Episode]:
        state, episode = carry
        latest = observe(state.view)
        state = replace(
            state,
            count=state.count + 1,
            attempted=state.attempted | (jnp.arange(views) == state.view),
            latest=latest,
            views=_put(state.views, state.count, state.view),
            seen=jax.tree.map(lambda history, now: _put(history, state.count, now), state.seen, latest),
        )
        belief = fuse(state, scene)
        state = replace(state, belief=belief)
        episode = Episode(
            views=state.views,
            predictions=_put(episode.predictions, state.count - 1, jnp.argmax(belief).astype(jnp.int32)),
            confidences=_put(episode.confidences, state.count - 1, confidence(belief)),
            count=state.count,
        )
        scores = policy(jax.random.fold_in(key, state.count), state, scene)
        return replace(state, view=best_view(scores, candidates(state, scene))), episode

    kind = []  # of tree, once `observe` was traced

    def leaves_of(view: Int[Array, ""]) -> list[Array]:
        leaves, tree = jax.tree.flatten(observe(view))
        kind.append(tree)
        return leaves

    shapes = jax.eval_shape(leaves_of, start)
    blank = jax.tree.unflatten(kind[0], [jnp.zeros(shape.shape, shape.dtype) for shape in shapes])
    nothing = jnp.full(max_views, -1, jnp.int32)
    state = SelectionState(
        count=jnp.int32(0),
        view=start,
        attempted=jnp.zeros(views, bool),
        belief=jnp.zeros_like(blank.logits),
        latest=blank,
        views=nothing,
        seen=jax.tree.map(lambda leaf: jnp.zeros((max_views, *leaf.shape), leaf.dtype), blank),
    )
    episode = Episode(nothing, nothing, jnp.zeros(max_views), jnp.int32(0))
    return jax.lax.while_loop(unsure, look, (state, episode))[1]


def _put(history: Array, index: Int[Array, ""], now: Array) -> Array:
    return jax.lax.dynamic_update_index_in_dim(history, now, index, 0)


def select_from_table(
    key: Array,
    table: ViewTable,
    scene: Scene,
    policy: Policy,
    start: int | Int[Array, ""],
    *,
    threshold: float | Float[Array, ""] | None = None,
    max_views: int,
    fuse: Fuse = adding,
) -> Episode:
    """`select_views` where a look is a row of `table`."""
    return select_views(key, table.observe, scene, policy, start, threshold=threshold, max_views=max_views, fuse=fuse)


def stop_at(
    confidences: Float[Array, " steps"], threshold: float | Float[Array, ""], max_views: int | Int[Array, ""]
) -> Int[Array, ""]:
    """How many views a full walk would have used: up to the first confidence ≥ `threshold`, at most `max_views`.

    Confidences beyond the walk's end are 0.
    """
    sure = confidences >= threshold
    first = jnp.where(jnp.any(sure), jnp.argmax(sure), confidences.shape[0] - 1) + 1
    return jnp.minimum(first, max_views)
