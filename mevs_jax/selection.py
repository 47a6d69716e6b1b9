"""The selection loop: look, add up, stop if sure enough, else look where the policy says (thesis §4.4, Fig. 16).

Written for one object as a `lax.while_loop`; objects, start views, seeds and thresholds are `vmap` axes at the call site. What
looking means is an argument: `observe(view)` reads a table here, and may as well call the networks.

The views that a policy visits do not depend on when the loop would stop. So a walk with a threshold above 1, which never
stops early, holds the answer for every threshold and every limit on views at once (`stop_at`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.fusion import confidence, sum_of_logits
from mevs_jax.policies import Policy, Scene, SelectionState

NEVER_STOP = 2.0
"""A threshold that no confidence reaches."""


@flax.struct.dataclass
class Observation:
    """What one look gives: logits (classes,), and the policy network's word on every view (views,)."""

    logits: Float[Array, "*batch classes"]
    utility: Float[Array, "*batch views"]


@flax.struct.dataclass
class ViewTable:
    """All that the loop needs to know of one object, computed beforehand.

    Attributes:
        logits: (views, classes) of the classifier at each view.
        utility: (views, views); row i is what the policy's network says about every view after seeing view i.
        entropy: (views,) true depth entropies.
        label: the true class.
    """

    logits: Float[Array, "*batch views classes"]
    utility: Float[Array, "*batch views views"]
    entropy: Float[Array, "*batch views"]
    label: Int[Array, "*batch"]

    def observe(self, view: Int[Array, ""]) -> Observation:
        return Observation(self.logits[view], self.utility[view])


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


def best_unattempted(scores: Float[Array, "views"], attempted: Bool[Array, "views"]) -> Int[Array, ""]:
    """The unattempted view of highest score, the lowest index among equals; −inf and NaN come last."""
    scores = jnp.where(jnp.isnan(scores), -jnp.inf, scores)
    best = jnp.max(jnp.where(attempted, -jnp.inf, scores))
    return jnp.argmax(~attempted & (scores == best)).astype(jnp.int32)


def select_views(
    key: Array,
    observe: Callable[[Int[Array, ""]], Observation],
    scene: Scene,
    policy: Policy,
    start: int | Int[Array, ""],
    *,
    classes: int,
    threshold: float | Float[Array, ""],
    max_views: int,
) -> Episode:
    """Looks at one object from `start` on until the confidence reaches `threshold` or `max_views` views are seen.

    Args:
        key: for policies that draw.
        observe: what a look at a view gives.
        scene: the candidate views.
        policy: scores the views; see `mevs_jax.policies`.
        start: the first view, 0..views−1.
        classes: length of the logits.
        threshold: on the confidence, CT in the thesis; above 1 it never stops early.
        max_views: 1..views, MV in the thesis.

    Raises:
        ValueError: for `max_views` outside its range.
    """
    views = scene.entropy.shape[0]
    if not 1 <= max_views <= views:
        raise ValueError(f"max_views must be between 1 and the {views} candidate views, got {max_views}")

    def unsure(carry: tuple[SelectionState, Episode]) -> Bool[Array, ""]:
        _, episode = carry
        latest = episode.confidences[jnp.maximum(episode.count - 1, 0)]
        return (episode.count == 0) | ((episode.count < max_views) & (latest < threshold))

    def look(carry: tuple[SelectionState, Episode]) -> tuple[SelectionState, Episode]:
        state, episode = carry
        seen = observe(state.view)
        state = replace(
            state,
            count=state.count + 1,
            attempted=state.attempted.at[state.view].set(True),
            belief=sum_of_logits(state.belief, seen.logits),
            utility=seen.utility,
        )
        episode = Episode(
            views=episode.views.at[episode.count].set(state.view),
            predictions=episode.predictions.at[episode.count].set(jnp.argmax(state.belief).astype(jnp.int32)),
            confidences=episode.confidences.at[episode.count].set(confidence(state.belief)),
            count=state.count,
        )
        scores = policy(jax.random.fold_in(key, state.count), state, scene)
        return replace(state, view=best_unattempted(scores, state.attempted)), episode

    state = SelectionState(
        count=jnp.int32(0),
        view=jnp.asarray(start, jnp.int32),
        attempted=jnp.zeros(views, bool),
        belief=jnp.zeros(classes),
        utility=jnp.zeros(views),
    )
    nothing = jnp.full(max_views, -1, jnp.int32)
    episode = Episode(nothing, nothing, jnp.zeros(max_views), jnp.int32(0))
    return jax.lax.while_loop(unsure, look, (state, episode))[1]


def select_from_table(
    key: Array,
    table: ViewTable,
    scene: Scene,
    policy: Policy,
    start: int | Int[Array, ""],
    *,
    threshold: float | Float[Array, ""] = NEVER_STOP,
    max_views: int,
) -> Episode:
    """`select_views` where a look is a row of `table`."""
    return select_views(
        key,
        table.observe,
        scene,
        policy,
        start,
        classes=table.logits.shape[1],
        threshold=threshold,
        max_views=max_views,
    )


def stop_at(
    confidences: Float[Array, "steps"], threshold: float | Float[Array, ""], max_views: int | Int[Array, ""]
) -> Int[Array, ""]:
    """How many views a full walk would have used: up to the first confidence ≥ `threshold`, at most `max_views`."""
    sure = confidences >= threshold
    first = jnp.where(jnp.any(sure), jnp.argmax(sure), confidences.shape[0] - 1) + 1
    return jnp.minimum(first, max_views)
