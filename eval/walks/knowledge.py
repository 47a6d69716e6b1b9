"""Knowledge of policies about other objects, from the validation split: a class × view table and a fixed order of views."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mevs_jax.policies.base import Knowledge


def class_view_table(
    logits: Float[Array, "objects views classes"], labels: Int[Array, " objects"]
) -> Float[Array, "classes views classes"]:
    """Returns mean logits: entry [y, j] is over view j of the objects of class y, zero for a class without objects."""
    member = jax.nn.one_hot(labels, logits.shape[-1])
    return jnp.einsum("oy,ovc->yvc", member, logits) / jnp.maximum(jnp.sum(member, axis=0), 1)[:, None, None]


def greedy_order(logits: Float[Array, "objects views classes"], labels: Int[Array, " objects"]) -> Int[Array, " views"]:
    """Views in the order of a greedy search, which adds the view that gives the best accuracy together with those before it.

    The accuracy is over all objects and all start views, with the start view seen first. Ties go to the lowest index.
    """
    views = logits.shape[1]

    def right_with(view: Array, beliefs: Array, holds: Array) -> Array:
        """Accuracy if every walk (by object and start view) also sees `view`; a view seen before adds nothing."""
        fused = beliefs + jnp.where(holds[:, view], 0.0, 1.0)[None, :, None] * logits[:, view][:, None]
        own = jnp.take_along_axis(fused, labels[:, None, None], axis=-1)
        return jnp.mean(jnp.all(fused <= own, axis=-1))

    def add(step: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        order, beliefs, holds = carry
        scores = jax.lax.map(lambda view: right_with(view, beliefs, holds), jnp.arange(views))
        taken = jnp.any((order[:, None] == jnp.arange(views)) & (jnp.arange(views) < step)[:, None], axis=0)
        best = jnp.argmax(jnp.where(taken, -1.0, scores)).astype(jnp.int32)
        beliefs += jnp.where(holds[:, best], 0.0, 1.0)[None, :, None] * logits[:, best][:, None]
        return order.at[step].set(best), beliefs, holds.at[:, best].set(True)

    start = jnp.full(views, -1, jnp.int32), logits, jnp.eye(views, dtype=bool)
    return jax.lax.fori_loop(0, views, add, start)[0]


@jax.jit
def learn(logits: Float[Array, "objects views classes"], labels: Int[Array, " objects"]) -> Knowledge:
    """Computes the table and the order from the logits of objects that are not test objects."""
    views = logits.shape[1]
    order = greedy_order(logits, labels)
    scores = jnp.zeros(views).at[order].set(views - jnp.arange(views, dtype=jnp.float32))
    return Knowledge(scores, class_view_table(logits, labels))
