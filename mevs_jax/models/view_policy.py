"""ViewPolicy: how much each candidate direction is expected to raise the utility of the belief, given what was seen.

A query for each candidate attends to the views seen and to the belief. Candidates are directions, not numbers of a lattice, so a
lattice that was never trained on will do. It sees what single views say (log-probabilities), not the encoder's features: those
mean other things in another encoder, which the policy would not do for. Should the object be of some class, a view moves that
class's log-odds by so much: that is what is learned, and probabilities stay probabilities.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.models.set_fusion import about_the_first

Utility = Literal["probability", "log"]
"""What a belief is worth: the true class's probability, or its logarithm."""


def utility_of(
    log_probability: Float[AnyArray, "*any"], utility: Utility = "log", floor: float = 0.01
) -> Float[Array, "*any"]:
    """The utility of a belief that gives the true class this log-probability; in a logarithm, `floor` is added first."""
    if utility == "probability":
        return jnp.exp(jnp.asarray(log_probability))
    return jnp.logaddexp(jnp.asarray(log_probability), jnp.log(floor))


def direction_features(directions: Float[AnyArray, "*batch 3"]) -> Float[Array, "*batch 19"]:
    """All monomials of degree 1 to 3 of a unit vector: what a layer needs to tell top from side and corner from face."""
    directions = jnp.asarray(directions)
    found = [directions[..., i] for i in range(3)]
    for i in range(3):
        for j in range(i, 3):
            found.append(directions[..., i] * directions[..., j])
    for i in range(3):
        for j in range(i, 3):
            for k in range(j, 3):
                found.append(directions[..., i] * directions[..., j] * directions[..., k])
    return jnp.stack(found, axis=-1)


class _CrossBlock(nnx.Module):
    """Queries look at what is known, not at each other, so a candidate's worth does not depend on which others there are."""

    def __init__(self, width: int, heads: int, *, rngs: nnx.Rngs):
        self.norm1, self.norm2 = nnx.LayerNorm(width, rngs=rngs), nnx.LayerNorm(width, rngs=rngs)
        self.attention = nnx.MultiHeadAttention(heads, width, decode=False, rngs=rngs)
        self.layer1, self.layer2 = nnx.Linear(width, 2 * width, rngs=rngs), nnx.Linear(2 * width, width, rngs=rngs)

    def __call__(self, queries: Array, known: Array, present: Array) -> Array:
        queries = queries + self.attention(self.norm1(queries), known, mask=present[..., None, None, :])
        return queries + self.layer2(jax.nn.gelu(self.layer1(self.norm2(queries))))


class ViewPolicy(nnx.Module):
    """Scores candidate directions.

    Args:
        classes: of the belief.
        width: of queries and tokens.
        heads: of attention.
        blocks: of attention and layers.
        cloud: length of the vector beside each view, PointNet++'s embedding of its partial cloud; 0 for none.
        posed: whether directions are in the object's own frame, else in one that is turned about the vertical.
        utility, floor: what it expects to rise; see `worth`.
        rngs: source of the initial weights.
    """

    def __init__(
        self,
        classes: int,
        *,
        width: int = 96,
        heads: int = 4,
        blocks: int = 2,
        cloud: int = 0,
        posed: bool = True,
        utility: Utility = "log",
        floor: float = 0.01,
        rngs: nnx.Rngs,
    ):
        self.classes, self.posed, self.utility, self.floor = classes, posed, utility, floor
        self.direction = nnx.Linear(19, width, rngs=rngs)
        self.view, self.belief = nnx.Linear(classes, width, rngs=rngs), nnx.Linear(classes + 1, width, rngs=rngs)
        self.token1, self.token2 = nnx.Linear(width, 2 * width, rngs=rngs), nnx.Linear(2 * width, width, rngs=rngs)
        self.blocks = nnx.List([_CrossBlock(width, heads, rngs=rngs) for _ in range(blocks)])
        self.known_norm, self.last_norm = nnx.LayerNorm(width, rngs=rngs), nnx.LayerNorm(width, rngs=rngs)
        nothing = nnx.initializers.zeros_init()  # is expected, to begin with
        self.gain = nnx.Linear(width, 1, kernel_init=nothing, rngs=rngs)
        self.log_odds_if = nnx.Linear(width, classes, kernel_init=nothing, rngs=rngs)
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
        """The worth of each candidate, said twice.

        Args:
            belief: log-probabilities of all that was seen, fused.
            views: log-probabilities of each view seen alone.
            directions: unit vectors to the cameras of those.
            present: which of them there are; the rest is padding.
            candidates: unit vectors to where the camera may go.
            clouds: an embedding of the partial cloud of each view seen, for a network that was made with `cloud`.

        Returns:
            By how much the utility is expected to rise; and [j, y]: by how much with candidate j should the class be y.

        Raises:
            ValueError: where the network wants clouds and is given none.
        """
        if self.cloud is not None and clouds is None:
            raise ValueError("this view policy needs the embeddings of partial clouds, which are not given")
        belief, views, present = jnp.asarray(belief), jnp.asarray(views), jnp.asarray(present)
        if not self.posed:
            directions, turn = about_the_first(directions, present)
            candidates = jnp.asarray(candidates) @ jnp.swapaxes(turn, -1, -2)
        spare = present[..., None]
        least = -12.0  # a belief of 6 in a million is as good as none
        tokens = self.view(jnp.where(spare, jnp.maximum(views, least), 0.0))
        tokens = tokens + self.direction(direction_features(jnp.where(spare, jnp.asarray(directions), 0.0)))
        if self.cloud is not None:
            tokens = tokens + self.cloud(jnp.where(spare, jnp.asarray(clouds), 0.0))
        count = jnp.log(jnp.maximum(jnp.sum(present, axis=-1, keepdims=True), 1).astype(belief.dtype))
        own = self.belief(jnp.concatenate([jnp.maximum(belief, least), count], axis=-1))
        tokens = jnp.concatenate([own[..., None, :], tokens], axis=-2)
        tokens = self.known_norm(tokens + self.token2(jax.nn.gelu(self.token1(tokens))))
        there = jnp.concatenate([jnp.ones((*present.shape[:-1], 1), bool), present], axis=-1)
        queries = self.direction(direction_features(candidates)) + own[..., None, :]
        for block in self.blocks:
            queries = block(queries, tokens, there)
        queries = self.last_norm(queries)
        before = jnp.clip(belief, least, -1e-5)[..., None, :]
        after = jax.nn.log_sigmoid(before - jnp.log(-jnp.expm1(before)) + self.log_odds_if(queries))
        gain_if = utility_of(after, self.utility, self.floor) - utility_of(before, self.utility, self.floor)
        return self.gain(queries)[..., 0], gain_if


def expected_gain(
    belief: Float[AnyArray, "*batch classes"], gain_if: Float[AnyArray, "*batch candidates classes"]
) -> Float[Array, "*batch candidates"]:
    """What is expected for each class, weighed by the belief: Σ_y p(y) gain_if[j, y].

    The belief's log-probabilities have to keep their word.

    Of gains in log-probability this is the expected information gain: with p′ the belief after the view,
    Σ_y p(y) E[log p′(y) | y] + H(p). The mean of logarithms is what is predicted, not the logarithm of a mean belief, whose
    entropy would be too high.
    """
    return jnp.einsum("...y,...jy->...j", jnp.exp(jnp.asarray(belief)), jnp.asarray(gain_if))
