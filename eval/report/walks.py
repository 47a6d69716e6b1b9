"""The walks that the report shows object by object: which ones, and what was believed and expected after each view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from eval.tables import ViewTables
from eval.walks.knowledge import class_view_table
from mevs_jax.beliefs.fusing import discounted
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge
from mevs_jax.policies.informed import information_gain
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection.loop import ViewTable, select_from_table
from mevs_jax.selection.walks import state_after

POLICY = "information_gain"
"""The policy that walks. Its scores are the expected gains."""
OF_EACH = 2
"""Objects shown of each kind of walk."""


@dataclass(frozen=True)
class Walks:
    """A walk around every test object, each from one start view.

    Attributes:
        views: (objects, steps) in the order in which they are seen.
        gains: (objects, steps, views) expected gain of every view after each step, in nats, as the policy computes it.
        probabilities: (objects, steps, classes) calibrated, after each step.
        labels: (objects,) the true classes.
    """

    views: Int[np.ndarray, "objects steps"]
    gains: Float[np.ndarray, "objects steps views"]
    probabilities: Float[np.ndarray, "objects steps classes"]
    labels: Int[np.ndarray, " objects"]

    @property
    def right(self) -> Bool[np.ndarray, "objects steps"]:
        """Whether the most likely class is the true one, after each step."""
        return self.probabilities.argmax(axis=-1) == self.labels[:, None]

    def kinds(self) -> dict[str, Bool[np.ndarray, " objects"]]:
        """What kinds of walks there are, and which objects are of each; together they are all objects."""
        right, steps = self.right, self.views.shape[1]
        saved = ~right[:, 0] & right[:, 1:].all(axis=1) & (steps > 1)
        return {
            "wrong after one view, right from the second on": saved,
            f"wrong after one view and after {steps}": ~right[:, 0] & ~right[:, -1],
            f"right after one view, wrong after {steps}": right[:, 0] & ~right[:, -1],
            "right from the first view on": right.all(axis=1),
            "corrected later, or changing in between": right[:, -1] & ~right.all(axis=1) & ~saved,
        }

    def chosen(self) -> dict[int, str]:
        """The objects that are shown, with the kind of their walk: the first `OF_EACH` of every kind but the last.

        Objects of a class that is not shown yet come first. Those of the last kind are shown if there are no others.
        """
        chosen: dict[int, str] = {}
        *kinds, last = self.kinds().items()
        for kind, members in kinds if any(members.any() for _, members in kinds) else [last]:
            for _ in range(OF_EACH):
                left = [index for index in np.flatnonzero(members).tolist() if index not in chosen]
                shown = {int(self.labels[index]) for index in chosen}
                new = [index for index in left if int(self.labels[index]) not in shown]
                if left:
                    chosen[(new or left)[0]] = kind
        return chosen


def walks_of(
    tables: ViewTables,
    validation: ViewTables,
    graph: ViewGraph,
    reachable: Bool[np.ndarray, " views"],
    temperatures: Float[np.ndarray, " steps"],
) -> Walks:
    """Walks around every test object as the evaluation does, the first from the first view, the second from the second, ….

    Args:
        tables: of the test objects.
        validation: of the validation objects, whose mean logits the policy knows.
        graph: the candidate views.
        reachable: the views that the camera can visit.
        temperatures: of the sum of logits after each number of views; walks are as long.
    """
    allowed = np.flatnonzero(reachable)
    steps = min(len(temperatures), len(allowed))
    starts = allowed[np.arange(len(tables.labels)) % len(allowed)]
    knowledge = Knowledge(None, class_view_table(jnp.asarray(validation.logits), jnp.asarray(validation.labels)))
    fitted = jnp.asarray(temperatures[:steps], jnp.float32)
    views, gains, log_probabilities = _walk(
        tables.stacked(), jnp.asarray(starts), graph, knowledge, jnp.asarray(reachable), fitted, steps
    )
    return Walks(np.asarray(views), np.asarray(gains), np.exp(np.asarray(log_probabilities)), np.asarray(tables.labels))


@partial(jax.jit, static_argnames="steps")
def _walk(
    tables: ViewTable,
    starts: Int[Array, " objects"],
    graph: ViewGraph,
    knowledge: Knowledge,
    reachable: Bool[Array, " views"],
    temperatures: Float[Array, " steps"],
    steps: int,
) -> tuple[Array, Array, Array]:
    key = jax.random.key(0)  # the policy does not draw

    def one(table: ViewTable, start: Int[Array, ""]) -> tuple[Array, Array, Array]:
        scene = table.scene(graph, knowledge, reachable)
        views = select_from_table(key, table, scene, POLICIES[POLICY], start, max_views=steps).views

        def after(count: Int[Array, ""]) -> tuple[Array, Array]:
            state = state_after(table, views, count)
            return information_gain(key, state, scene), state.belief

        gains, beliefs = jax.vmap(after)(jnp.arange(1, steps + 1))
        return views, gains, discounted(beliefs, temperatures)

    return jax.lax.map(lambda given: one(*given), (tables, starts), batch_size=64)
