"""ViewPolicy: a network that predicts how much each candidate view raises the utility of the belief.

A query for each candidate attends to the views seen and to the belief. Candidates are directions, not indices into a lattice,
so the network also works on lattices that it was not trained on. Its inputs are the log-probabilities of single views, not the
encoder's features: features differ from encoder to encoder, so the network would be tied to one. For each class, the network
predicts the change of that class's log-odds if the object is of that class. The resulting probabilities stay in (0, 1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations_with_replacement
from operator import mul
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.set_fusion import TransformerBlock, has_azimuth, relative_to_first, with_own_token

Utility = Literal["probability", "log"]
"""The utility of a belief: the probability of the true class, or its logarithm."""


def utility_of(
    log_probability: Float[AnyArray, "*any"], utility: Utility = "log", floor: float = 0.01
) -> Float[Array, "*any"]:
    """The utility of a belief that assigns `log_probability` to the true class.

    Args:
        log_probability: log p of the true class.
        utility: `probability` for p, `log` for log(p + floor).
        floor: a positive probability that keeps the logarithm finite.
    """
    if utility == "probability":
        return jnp.exp(jnp.asarray(log_probability))
    return jnp.logaddexp(jnp.asarray(log_probability), jnp.log(floor))


def direction_features(directions: Float[AnyArray, "*batch 3"]) -> Float[Array, "*batch 19"]:
    """All monomials of degree 1 to 3 of a unit vector: a linear layer on them can tell top from side and corner from face."""
    coordinates = [jnp.asarray(directions)[..., axis] for axis in range(3)]
    factors = (these for degree in (1, 2, 3) for these in combinations_with_replacement(coordinates, degree))
    return jnp.stack([reduce(mul, these) for these in factors], axis=-1)


def _without_azimuth(directions: Float[Array, "*batch candidates 3"]) -> Float[Array, "*batch candidates 3"]:
    """Each direction turned about the vertical axis to azimuth 0, so that only its elevation is left."""
    level = jnp.linalg.norm(directions[..., :2], axis=-1)
    return jnp.stack([level, jnp.zeros_like(level), directions[..., 2]], axis=-1)


class _CrossBlock(TransformerBlock):
    """Cross-attention from queries to the known tokens.

    Queries do not attend to each other, so the score of a candidate does not depend on the other candidates.
    """

    def __call__(self, queries: Array, known: Array, present: Array) -> Array:
        queries = queries + self.attention(self.norm1(queries), known, mask=present[..., None, None, :])
        return queries + self.perceptron(self.norm2(queries))


@dataclass(frozen=True)
class ViewPolicyShape:
    """Arguments of `ViewPolicy`, without embeddings of clouds.

    Attributes:
        width: of queries and tokens.
        heads: number of attention heads.
        blocks: number of cross-attention blocks.
        posed: whether directions are in the object's own frame; if not, in one rotated about the vertical axis by an unknown
            angle.
        utility: whose gain is predicted; see `utility_of`.
        floor: of that utility.
    """

    width: int
    heads: int
    blocks: int
    posed: bool
    utility: Utility
    floor: float

    def network(self, classes: int, rngs: nnx.Rngs) -> ViewPolicy:
        """Returns a network of this shape with random weights."""
        return ViewPolicy(classes, rngs=rngs, **vars(self))


_SHAPE = ViewPolicyShape(width=96, heads=4, blocks=2, posed=True, utility="log", floor=0.01)


class ViewPolicy(nnx.Module):
    """Predicts the gain in utility of every candidate direction.

    Args:
        classes: number of classes of the belief.
        cloud: length of PointNet++'s embedding of the partial cloud of each view; 0 for none.
        rngs: source of the initial weights.
        shape: the attributes of `ViewPolicyShape`: width 96, heads 4, blocks 2, posed, the utility `log` and its floor 0.01 by
            default.
    """

    def __init__(self, classes: int, *, cloud: int = 0, rngs: nnx.Rngs, **shape: Any):
        chosen = replace(_SHAPE, **shape)
        width = chosen.width
        self.classes, self.posed, self.utility, self.floor = classes, chosen.posed, chosen.utility, chosen.floor
        self.direction = nnx.Linear(19, width, rngs=rngs)
        self.view, self.belief = nnx.Linear(classes, width, rngs=rngs), nnx.Linear(classes + 1, width, rngs=rngs)
        self.token1, self.token2 = nnx.Linear(width, 2 * width, rngs=rngs), nnx.Linear(2 * width, width, rngs=rngs)
        self.blocks = nnx.List([_CrossBlock(width, chosen.heads, rngs=rngs) for _ in range(chosen.blocks)])
        self.known_norm, self.last_norm = nnx.LayerNorm(width, rngs=rngs), nnx.LayerNorm(width, rngs=rngs)
        zeros = nnx.initializers.zeros_init()  # an untrained network predicts no gain
        self.gain = nnx.Linear(width, 1, kernel_init=zeros, rngs=rngs)
        self.log_odds_if = nnx.Linear(width, classes, kernel_init=zeros, rngs=rngs)
        self.cloud = (
            nnx.Sequential(nnx.LayerNorm(cloud, rngs=rngs), nnx.Linear(cloud, width, rngs=rngs)) if cloud else None
        )

    def __call__(
        self,
        belief: Float[AnyArray, "*batch classes"],
        views: Float[AnyArray, "*batch seen classes"],
        directions: Float[AnyArray, "*batch seen 3"],
        present: Bool[AnyArray, "*batch seen"],
        candidates: Float[AnyArray, "*batch candidates 3"],
        clouds: Float[AnyArray, "*batch seen embedding"] | None = None,
    ) -> tuple[Float[Array, "*batch candidates"], Float[Array, "*batch candidates classes"]]:
        """Expected gain in utility of every candidate, overall and for each class.

        Args:
            belief: log-probabilities of the fused belief.
            views: log-probabilities of each view seen, from that view alone.
            directions: unit vectors to the cameras of the views seen.
            present: True for the views seen; the others are padding.
            candidates: unit vectors to the positions that the camera may go to.
            clouds: embedding of the partial cloud of each view seen, for a network that was made with `cloud`.

        Returns:
            The expected gain of each candidate; and the gain [j, y] of candidate j if the true class is y.

        Raises:
            ValueError: if the network uses clouds and none are given.
        """
        if self.cloud is not None and clouds is None:
            raise ValueError("this view policy needs the embeddings of partial clouds, which are not given")
        belief, views, present = jnp.asarray(belief), jnp.asarray(views), jnp.asarray(present)
        if not self.posed:
            # If all views seen are vertical, the azimuth of a candidate relative to the object is unknown.
            has_forward = jnp.any(present & has_azimuth(directions), axis=-1)
            directions, rotation = relative_to_first(directions, present)
            candidates = jnp.asarray(candidates) @ jnp.swapaxes(rotation, -1, -2)
            candidates = jnp.where(has_forward[..., None, None], candidates, _without_azimuth(candidates))
        seen = present[..., None]
        least = -12.0  # log-probabilities below this (6 in a million) make no difference
        tokens = self.view(jnp.where(seen, jnp.maximum(views, least), 0.0))
        tokens = tokens + self.direction(direction_features(jnp.where(seen, jnp.asarray(directions), 0.0)))
        if self.cloud is not None:
            tokens = tokens + self.cloud(jnp.where(seen, jnp.asarray(clouds), 0.0))
        count = jnp.log(jnp.maximum(jnp.sum(present, axis=-1, keepdims=True), 1).astype(belief.dtype))
        own = self.belief(jnp.concatenate([jnp.maximum(belief, least), count], axis=-1))
        tokens = jnp.concatenate([own[..., None, :], tokens], axis=-2)
        tokens = self.known_norm(tokens + self.token2(jax.nn.gelu(self.token1(tokens))))
        attended = with_own_token(present)
        queries = self.direction(direction_features(candidates)) + own[..., None, :]
        for block in self.blocks:
            queries = block(queries, tokens, attended)
        queries = self.last_norm(queries)
        before = jnp.clip(belief, least, -1e-5)[..., None, :]
        after = jax.nn.log_sigmoid(before - jnp.log(-jnp.expm1(before)) + self.log_odds_if(queries))
        gain_if = utility_of(after, self.utility, self.floor) - utility_of(before, self.utility, self.floor)
        return self.gain(queries)[..., 0], gain_if


def expected_gain(
    belief: Float[AnyArray, "*batch classes"], gain_if: Float[AnyArray, "*batch candidates classes"]
) -> Float[Array, "*batch candidates"]:
    """Expected gain of each candidate: its gain for each class, weighted by the belief, Σ_y p(y) gain_if[j, y].

    The belief's log-probabilities must be calibrated.

    For gains in log-probability this is the expected information gain: with p′ the belief after the view,
    Σ_y p(y) E[log p′(y) | y] + H(p). The network predicts the mean of logarithms, not the logarithm of a mean belief, whose
    entropy would be too high.
    """
    return jnp.einsum("...y,...jy->...j", jnp.exp(jnp.asarray(belief)), jnp.asarray(gain_if))
