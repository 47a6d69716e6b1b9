"""The selection loop: observe a view, update the belief, stop if confident, else go to the policy's view (thesis §4.4, Fig. 16).

The loop is a `lax.while_loop` for one object; objects, start views, seeds and thresholds are `vmap` axes at the call site. The
function `observe(view)` is an argument: `select_from_table` reads a table, and live walks call the networks.

The views that a policy visits do not depend on when the loop stops. One walk without a threshold, which never stops early,
therefore contains the result for every threshold and every limit on the number of views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arguments import check, check_indices, whole
from mevs_jax.arrays import first_true
from mevs_jax.beliefs.fusing import CalibratedFusion, confidence
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Observation, Policy, Scene, SelectionState, candidates


@flax.struct.dataclass
class ViewTable:
    """The outputs of all networks for all views of one object, computed beforehand.

    Attributes:
        logits: (views, classes) of the classifier at each view; with a leading axis if several classifiers are compared.
        predicted_entropy: (views, views); row i holds the entropies of all views predicted from view i; with a leading axis if
            several predictors are compared.
        entropy: (views,) true depth entropies.
        label: the true class.
        ascent_scores: by policy name, (views, views); row i scores the views after view i, by gradient ascent on a rendering.
        features: (views, features) of the encoder, for a learned fusion.
        clouds: (views, embedding) of the partial clouds, for a policy that uses them.
        pose_evidence: (views, classes, poses) of each view; see `Observation`.
    """

    logits: Float[Array, "*batch_and_backbones views classes"]
    predicted_entropy: Float[Array, "*batch_and_predictors views views"] | None
    entropy: Float[Array, "*batch views"] | None
    label: Int[Array, "*batch"]
    ascent_scores: dict[str, Float[Array, "*batch views views"]] | None = None
    features: Float[Array, "*batch views features"] | None = None
    clouds: Float[Array, "*batch views embedding"] | None = None
    pose_evidence: Float[Array, "*batch views classes poses"] | None = None

    def observe(self, view: Int[Array, ""]) -> Observation:
        """Returns the observation of one view."""
        whole = Observation(self.logits, self.predicted_entropy, self.features, self.clouds, self.pose_evidence)
        return jax.tree.map(lambda values: values[view], whole)

    def scene(
        self, graph: ViewGraph, knowledge: Knowledge | None = None, reachable: Bool[Array, " views"] | None = None
    ) -> Scene:
        """Returns the scene of this object, with everything that an oracle uses."""
        return Scene(
            graph, self.entropy, self.logits, self.label, knowledge, reachable, self.ascent_scores, self.features
        )


@flax.struct.dataclass
class Episode:
    """The views of one object and the predictions after each; entries beyond `count` are −1 or 0.

    Attributes:
        views: (max_views,) indices of the views, in order.
        predictions: (max_views,) the most likely class after each view.
        confidences: (max_views,) the probability of that class.
        count: number of views seen.
    """

    views: Int[Array, "*batch max_views"]
    predictions: Int[Array, "*batch max_views"]
    confidences: Float[Array, "*batch max_views"]
    count: Int[Array, "*batch"]


def best_view(
    scores: Float[Array, " views"], allowed: Bool[Array, " views"], reachable: Bool[Array, " views"] | None = None
) -> Int[Array, ""]:
    """Index of the allowed view with the highest score, the lowest index among equals; −inf and NaN come last.

    A view with a score of +inf is chosen even if it is not allowed, because it was seen before, unless it is not `reachable`.
    `random_with_repetition` uses this to repeat views.
    """
    scores = jnp.where(jnp.isnan(scores), -jnp.inf, scores)
    ordered = scores == jnp.inf
    allowed = allowed | (ordered if reachable is None else ordered & reachable)
    best = jnp.max(jnp.where(allowed, scores, -jnp.inf))
    first = first_true(allowed & (scores == best))
    return jnp.where(first < scores.shape[0], first, 0)


Fuse = Callable[[SelectionState, Scene], Float[Array, " classes"]]
"""A function of (state, scene) that returns the new belief.

The state already contains the latest observation in `latest` and `seen`; its `belief` is the one before that observation.
"""


def sum_of_logits(state: SelectionState, scene: Scene) -> Float[Array, " classes"]:
    """The thesis's fusion (§4.4): the belief plus the logits of the latest view. The belief before any view is zero."""
    del scene
    return state.belief + state.latest.logits


def by_attention(fusion: CalibratedFusion) -> Fuse:
    """Returns a fusion whose belief is the log-probabilities that `fusion` computes from the features of all views seen.

    Raises:
        ValueError: when called, if the observations hold no features.
    """

    def fuse(state: SelectionState, scene: Scene) -> Float[Array, " classes"]:
        if state.seen.features is None:
            raise ValueError("a learned fusion needs the features of every view, but the observations have none")
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
    fuse: Fuse = sum_of_logits,
) -> Episode:
    """Observes one object view by view until the confidence reaches `threshold`, `max_views` are seen, or none is left to reach.

    Args:
        key: PRNG key for policies that draw at random.
        observe: returns the observation of a view.
        scene: the candidate views, and what else the policy may use.
        policy: scores the views; see `mevs_jax.policies`. Its scores after the last view are not used.
        start: index of the first view, 0..views−1.
        threshold: on the confidence, CT in the thesis; None never stops early.
        max_views: 1..views, MV in the thesis.
        fuse: computes the belief after each observation.

    Raises:
        ValueError: for `start`, `threshold` or `max_views` outside their ranges, a scene without a field that the policy needs,
            or a policy that returns other than a score for each view.
    """
    views = scene.graph.points.shape[0]
    max_views = whole(max_views, f"max_views must be between 1 and the {views} candidate views", 1, views)
    check_indices(start, "start", views)
    check(threshold if threshold is not None else 1.0, "threshold must be a probability", lambda share: share >= 0)
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

    def step(carry: tuple[SelectionState, Episode]) -> tuple[SelectionState, Episode]:
        state, episode = carry
        state = _with_observation(state, _observed(observe, state.view))
        state = replace(state, belief=fuse(state, scene).astype(jnp.float32))
        episode = _with_prediction(episode, state)

        def next_view() -> Int[Array, ""]:
            scores = policy(jax.random.fold_in(key, state.count), state, scene)
            if scores.shape != (views,):
                raise ValueError(f"a policy must return a score for each of {views} views, got shape {scores.shape}")
            return best_view(scores, candidates(state, scene), scene.reachable)

        # After the last view nothing is chosen.
        return replace(state, view=jax.lax.cond(state.count < limit, next_view, lambda: state.view)), episode

    return jax.lax.while_loop(unsure, step, _begun(_blank(observe, start), start, views, max_views))[1]


def _observed(observe: Callable[[Int[Array, ""]], Observation], view: Int[Array, ""]) -> Observation:
    """The observation of a view, with logits in float32."""
    found = observe(view)
    return replace(found, logits=found.logits.astype(jnp.float32))


def _blank(observe: Callable[[Int[Array, ""]], Observation], view: Int[Array, ""]) -> Observation:
    """An observation of zeros, of the shapes that `observe` returns."""
    structures = []  # receives the tree structure of an observation when `observe` is traced

    def leaves_of(view: Int[Array, ""]) -> list[Array]:
        leaves, structure = jax.tree.flatten(_observed(observe, view))
        structures.append(structure)
        return leaves

    shapes = jax.eval_shape(leaves_of, view)
    return jax.tree.unflatten(structures[0], [jnp.zeros(shape.shape, shape.dtype) for shape in shapes])


def _begun(blank: Observation, start: Int[Array, ""], views: int, max_views: int) -> tuple[SelectionState, Episode]:
    """State and episode before the first view is observed."""
    unset = jnp.full(max_views, -1, jnp.int32)
    state = SelectionState(
        count=jnp.int32(0),
        view=start,
        attempted=jnp.zeros(views, bool),
        belief=jnp.zeros_like(blank.logits),
        latest=blank,
        views=unset,
        seen=jax.tree.map(lambda leaf: jnp.zeros((max_views, *leaf.shape), leaf.dtype), blank),
    )
    return state, Episode(unset, unset, jnp.zeros(max_views, jnp.float32), jnp.int32(0))


def _with_observation(state: SelectionState, latest: Observation) -> SelectionState:
    """The state after the observation of `state.view`, with the belief before it."""
    return replace(
        state,
        count=state.count + 1,
        attempted=state.attempted | (jnp.arange(len(state.attempted)) == state.view),
        latest=latest,
        views=_put(state.views, state.count, state.view),
        seen=jax.tree.map(lambda history, now: _put(history, state.count, now), state.seen, latest),
    )


def _with_prediction(episode: Episode, state: SelectionState) -> Episode:
    """The episode with the latest belief's prediction and confidence."""
    step, prediction = state.count - 1, jnp.argmax(state.belief).astype(jnp.int32)
    return Episode(
        views=state.views,
        predictions=_put(episode.predictions, step, prediction),
        confidences=_put(episode.confidences, step, confidence(state.belief).astype(jnp.float32)),
        count=state.count,
    )


def _put(history: Array, index: Int[Array, ""], value: Array) -> Array:
    """Returns `history` with row `index` replaced by `value`."""
    return jax.lax.dynamic_update_index_in_dim(history, value, index, 0)


def select_from_table(
    key: Array,
    table: ViewTable,
    scene: Scene,
    policy: Policy,
    start: int | Int[Array, ""],
    *,
    threshold: float | Float[Array, ""] | None = None,
    max_views: int,
    fuse: Fuse = sum_of_logits,
) -> Episode:
    """`select_views` with observations from `table`."""
    return select_views(key, table.observe, scene, policy, start, threshold=threshold, max_views=max_views, fuse=fuse)
