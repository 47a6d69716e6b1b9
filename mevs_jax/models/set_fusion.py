"""Networks that fuse the views of one object: a set transformer, and the sum of logits for comparison."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from mevs_jax.arguments import check
from mevs_jax.arrays import AnyArray


def dropped(key: Array | None, rate: float, x: Array) -> Array:
    """Dropout with a `rate` in [0, 1); without a key, returns `x` unchanged."""
    if key is None or not rate:
        return x
    return jnp.where(jax.random.bernoulli(key, 1 - rate, x.shape), x / (1 - rate), 0.0)


def with_own_token(present: Bool[Array, "*batch views"]) -> Bool[Array, "*batch tokens"]:
    """Which tokens can be attended to: a learned one, which comes first, and those of the views that are present."""
    return jnp.concatenate([jnp.ones((*present.shape[:-1], 1), bool), present], axis=-1)


class TransformerBlock(nnx.Module):
    """The layers of a pre-norm transformer block: attention, then a two-layer perceptron on each token."""

    def __init__(self, width: int, heads: int, *, rngs: nnx.Rngs):
        self.norm1, self.norm2 = nnx.LayerNorm(width, rngs=rngs), nnx.LayerNorm(width, rngs=rngs)
        self.attention = nnx.MultiHeadAttention(heads, width, decode=False, rngs=rngs)
        self.layer1, self.layer2 = nnx.Linear(width, 2 * width, rngs=rngs), nnx.Linear(2 * width, width, rngs=rngs)

    def perceptron(self, x: Array) -> Array:
        return self.layer2(jax.nn.gelu(self.layer1(x)))


class _Block(TransformerBlock):
    """Self-attention and perceptron, both with residuals and dropout."""

    def __init__(self, width: int, heads: int, dropout: float, *, rngs: nnx.Rngs):
        super().__init__(width, heads, rngs=rngs)
        self.dropout = dropout

    def __call__(self, x: Array, present: Array, key: Array | None, asked: int) -> Array:
        """The first `asked` of the tokens, each after attention to all tokens that are present."""
        mask = present[..., None, None, :]  # the same for all heads and queries
        keys = (None, None) if key is None else jax.random.split(key)
        normed, x = self.norm1(x), x[..., :asked, :]
        x = x + dropped(keys[0], self.dropout, self.attention(normed[..., :asked, :], normed, mask=mask))
        return x + dropped(keys[1], self.dropout, self.perceptron(self.norm2(x)))


def has_azimuth(directions: Float[AnyArray, "*batch views 3"]) -> Bool[Array, "*batch views"]:
    """Whether each direction is not vertical, so that its azimuth is defined."""
    return jnp.linalg.norm(jnp.asarray(directions)[..., :2], axis=-1) > 1e-6


def relative_to_first(
    directions: Float[AnyArray, "*batch views 3"], present: Bool[AnyArray, "*batch views"]
) -> tuple[Float[Array, "*batch views 3"], Float[Array, "*batch 3 3"]]:
    """Rotates directions about the vertical axis so that the first present one that is not vertical has azimuth 0.

    The result does not depend on the object's rotation about the vertical axis, so it can be used where that is unknown. If no
    present direction has an azimuth, nothing is rotated.

    Returns:
        The rotated directions, and the rotation matrix.
    """
    directions, present = jnp.asarray(directions), jnp.asarray(present)
    usable = present & has_azimuth(directions)
    first = jnp.take_along_axis(directions, jnp.argmax(usable, axis=-1)[..., None, None], axis=-2)[..., 0, :2]
    first = jnp.where(jnp.any(usable, axis=-1)[..., None], first, 0.0)
    length = jnp.linalg.norm(first, axis=-1, keepdims=True)
    x, y = jnp.moveaxis(jnp.where(length > 1e-6, first / jnp.maximum(length, 1e-6), jnp.array([1.0, 0.0])), -1, 0)
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rotation = jnp.stack([x, y, zero, -y, x, zero, zero, zero, one], axis=-1).reshape(*x.shape, 3, 3)
    return directions @ jnp.swapaxes(rotation, -1, -2), rotation


class SetFusion(nnx.Module):
    """A small set transformer that fuses the features and directions of any set of views into logits.

    It accepts any subset of views in any order, also the empty set. A learned token attends to the views that are present, and
    the logits are computed from this token. As in Set Transformer (Lee et al. 2019) and ViewFormer (Sun et al. 2023), with
    viewing directions, which the latter leaves out.

    The object's pose may be unknown. Directions are then relative to the first view that is not vertical (`relative_to_first`),
    so of the order of views only the choice of that one matters.

    Args:
        features: length of a view's feature vector.
        classes: number of logits.
        width: of the tokens.
        heads: number of attention heads.
        blocks: number of transformer blocks.
        dropout: rate within the blocks and of the features before them, in [0, 1).
        rngs: source of the initial weights.
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
        check(dropout, "dropout must be a probability below 1", lambda rate: (rate >= 0) & (rate < 1))
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
        """Logits of the object, from the views that are present.

        Args:
            features: feature vector of each view; of longer ones the first part is used.
            directions: unit vectors from the object to the cameras.
            present: True for the views to use; the values of the others are ignored.
            key: PRNG key for dropout in training; no dropout without.
            posed: whether directions are in the object's own frame; if not, in one rotated about the vertical axis by an unknown
                angle.
        """
        features, present = jnp.asarray(features), jnp.asarray(present)
        directions = jnp.where(present[..., None], jnp.asarray(directions), 0.0)
        if not posed:
            directions = relative_to_first(directions, present)[0]
        features = features[..., : self.norm.num_features]
        keys = [None] * (len(self.blocks) + 1) if key is None else list(jax.random.split(key, len(self.blocks) + 1))
        normed = dropped(keys[-1], self.dropout, self.norm(jnp.where(present[..., None], features, 0.0)))
        tokens = self.view(normed) + self.direction(directions)
        own = self.object[...] if posed else self.unposed[...]
        own = jnp.broadcast_to(own, (*tokens.shape[:-2], 1, tokens.shape[-1]))
        x = jnp.concatenate([own, tokens], axis=-2)
        attended, last = with_own_token(present), len(self.blocks) - 1
        for number, (block, block_key) in enumerate(zip(self.blocks, keys[:-1], strict=True)):
            asked = 1 if number == last else x.shape[-2]  # the head reads the first token only
            x = block(x, attended, block_key, asked)
        return self.head(self.last_norm(x[..., 0, :]))


class SumFusion(nnx.Module):
    """The thesis's sum of logits with the interface of `SetFusion`, for comparison; it ignores directions.

    Args:
        head: layer from a view's features to its logits.
        prior: (classes,) log-probabilities of the classes in training. The sum contains them once, not once per view.
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
        """Logits of the object, from the views that are present; arguments as of `SetFusion`."""
        del directions, posed
        present, prior = jnp.asarray(present), self.prior[...]
        features = jnp.asarray(features)[..., : self.head.in_features]
        logits = self.head(jnp.where(present[..., None], features, 0.0)) - prior
        return jnp.sum(jnp.where(present[..., None], logits, 0.0), axis=-2) + prior
