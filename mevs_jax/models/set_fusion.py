"""Fusion of the views of one object by a set transformer, or by the sum of their logits."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arrays import AnyArray


def _drop_out(key: Array | None, rate: float, x: Array) -> Array:
    """Without a key, `x` as it is."""
    if key is None or not rate:
        return x
    return jnp.where(jax.random.bernoulli(key, 1 - rate, x.shape), x / (1 - rate), 0.0)


class _Block(nnx.Module):
    """Attention among tokens, then two layers on each, beside what they are added to (pre-norm)."""

    def __init__(self, width: int, heads: int, dropout: float, *, rngs: nnx.Rngs):
        self.norm1, self.norm2 = nnx.LayerNorm(width, rngs=rngs), nnx.LayerNorm(width, rngs=rngs)
        self.attention = nnx.MultiHeadAttention(heads, width, decode=False, rngs=rngs)
        self.layer1, self.layer2 = nnx.Linear(width, 2 * width, rngs=rngs), nnx.Linear(2 * width, width, rngs=rngs)
        self.dropout = dropout

    def __call__(self, x: Array, present: Array, key: Array | None) -> Array:
        seen = present[..., None, None, :]  # one query like another, over all heads
        keys = (None, None) if key is None else jax.random.split(key)
        x = x + _drop_out(keys[0], self.dropout, self.attention(self.norm1(x), mask=seen))
        hidden = self.layer2(jax.nn.gelu(self.layer1(self.norm2(x))))
        return x + _drop_out(keys[1], self.dropout, hidden)


def about_the_first(
    directions: Float[AnyArray, "*batch views 3"], present: Bool[AnyArray, "*batch views"]
) -> tuple[Float[Array, "*batch views 3"], Float[Array, "*batch 3 3"]]:
    """Directions turned about the vertical so that the first present one points to azimuth 0, and the turn.

    What is known of directions where nobody knows which way the object faces: the same however it is turned about the vertical.
    """
    directions, present = jnp.asarray(directions), jnp.asarray(present)
    first = jnp.take_along_axis(directions, jnp.argmax(present, axis=-1)[..., None, None], axis=-2)[..., 0, :2]
    length = jnp.linalg.norm(first, axis=-1, keepdims=True)
    x, y = jnp.moveaxis(jnp.where(length > 1e-6, first / jnp.maximum(length, 1e-6), jnp.array([1.0, 0.0])), -1, 0)
    nothing, one = jnp.zeros_like(x), jnp.ones_like(x)
    turn = jnp.stack([x, y, nothing, -y, x, nothing, nothing, nothing, one], axis=-1).reshape(*x.shape, 3, 3)
    return directions @ jnp.swapaxes(turn, -1, -2), turn


class SetFusion(nnx.Module):
    """What several views say together: a small set transformer over features and viewing directions.

    Any subset of views in any order, also none: a token of its own attends to those that are there, and becomes the belief. As
    in Set Transformer (Lee et al. 2019) and ViewFormer (Sun et al. 2023), with directions, which the latter leaves out.

    It can do without knowing which way the object faces: directions then are relative to the first view's (`about_the_first`), so
    only which view comes first matters of their order.

    Args:
        features: length of a view's feature vector.
        classes: number of logits.
        width: of the tokens.
        heads: of attention.
        blocks: of attention and layers.
        dropout: within blocks, and of whole feature channels before them.
        rngs: source of initial weights.
    """

    def __init__(
        self,
        features: int,
        classes: int,
        *,
        width: int = 128,
        heads: int = 4,
        blocks: int = 2,
        dropout: float = 0.1,
        rngs: nnx.Rngs,
    ):
        self.norm = nnx.LayerNorm(features, rngs=rngs)
        self.dropout = dropout
        self.view = nnx.Linear(features, width, rngs=rngs)
        self.direction = nnx.Linear(3, width, rngs=rngs)
        self.object, self.unposed = (nnx.Param(0.02 * jax.random.normal(rngs.params(), (width,))) for _ in range(2))
        self.blocks = nnx.List([_Block(width, heads, dropout, rngs=rngs) for _ in range(blocks)])
        self.last_norm = nnx.LayerNorm(width, rngs=rngs)
        self.head = nnx.Linear(width, classes, rngs=rngs)

    def __call__(
        self,
        features: Float[AnyArray, "*batch views features"],
        directions: Float[AnyArray, "*batch views 3"],
        present: Bool[AnyArray, "*batch views"],
        key: Array | None = None,
        *,
        posed: bool = True,
    ) -> Float[Array, "*batch classes"]:
        """Logits of what was seen.

        Args:
            directions: unit vectors from the object to the cameras.
            present: which views were looked at; what the others hold does not matter.
            key: for dropout, in training; nothing is dropped without.
            posed: whether directions are in the object's own frame, else in one that is turned about the vertical.
        """
        features, directions, present = jnp.asarray(features), jnp.asarray(directions), jnp.asarray(present)
        if not posed:
            directions = about_the_first(directions, present)[0]
        keys = [None] * (len(self.blocks) + 1) if key is None else list(jax.random.split(key, len(self.blocks) + 1))
        known = _drop_out(keys[-1], self.dropout, self.norm(jnp.where(present[..., None], features, 0.0)))
        tokens = self.view(known) + self.direction(directions)
        own = self.object[...] if posed else self.unposed[...]
        own = jnp.broadcast_to(own, (*tokens.shape[:-2], 1, tokens.shape[-1]))
        x = jnp.concatenate([own, tokens], axis=-2)
        there = jnp.concatenate([jnp.ones((*present.shape[:-1], 1), bool), present], axis=-1)
        for block, drops in zip(self.blocks, keys[:-1], strict=True):
            x = block(x, there, drops)
        return self.head(self.last_norm(x[..., 0, :]))


class SumFusion(nnx.Module):
    """The thesis's sum of logits in the place of a `SetFusion`, to compare with: it knows no directions.

    Args:
        head: from a view's features to its logits.
        prior: (classes,) log-probabilities of the classes in training, which count once, not with every view.
    """

    def __init__(self, head: nnx.Linear, prior: Float[Array, " classes"]):
        self.head, self.prior = head, nnx.Variable(prior)

    def __call__(
        self,
        features: Float[AnyArray, "*batch views features"],
        directions: Float[AnyArray, "*batch views 3"],
        present: Bool[AnyArray, "*batch views"],
        *,
        posed: bool = True,
    ) -> Float[Array, "*batch classes"]:
        """Logits of what was seen."""
        del directions, posed
        present, prior = jnp.asarray(present), self.prior[...]
        logits = self.head(jnp.where(present[..., None], jnp.asarray(features), 0.0)) - prior
        return jnp.sum(jnp.where(present[..., None], logits, 0.0), axis=-2) + prior
