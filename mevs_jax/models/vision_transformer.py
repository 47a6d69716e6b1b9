"""ViT-Tiny (Dosovitskiy et al., 2021; Touvron et al., 2021): logits from the image of one view, by attention between patches.

Arithmetic and order of layers are timm's, so its weights carry over (`mevs_jax.models.pretrained`). There is no dropout.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from mevs_jax.models.image_encoder import ImageEncoder

WIDTH, HEADS, BLOCKS = 192, 3, 12


class Block(nnx.Module):
    """Attention and a two-layer perceptron on each token, each after a layer norm and with a residual."""

    def __init__(self, *, rngs: nnx.Rngs):
        self.norm1, self.norm2 = nnx.LayerNorm(WIDTH, rngs=rngs), nnx.LayerNorm(WIDTH, rngs=rngs)
        self.qkv, self.proj = nnx.Linear(WIDTH, 3 * WIDTH, rngs=rngs), nnx.Linear(WIDTH, WIDTH, rngs=rngs)
        self.layer1, self.layer2 = nnx.Linear(WIDTH, 4 * WIDTH, rngs=rngs), nnx.Linear(4 * WIDTH, WIDTH, rngs=rngs)

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        qkv = self.qkv(self.norm1(x)).reshape(*x.shape[:2], 3, HEADS, -1)
        x = x + self.proj(jax.nn.dot_product_attention(*jnp.moveaxis(qkv, 2, 0)).reshape(x.shape))
        return x + self.layer2(jax.nn.gelu(self.layer1(self.norm2(x)), approximate=False))


class VisionTransformer(ImageEncoder):
    """ViT-Tiny: 12 blocks of 192 channels and 3 heads. The features are those of the class token.

    Args:
        resolution: of the images in pixels along each side; positions are learned for one resolution.
        patch: side of a patch in pixels.
        classes: number of logits.
        channels: of the image.
        standardise: whether to map images in [0, 1] to [−1, 1], as ImageNet's weights expect.
        rngs: source of the initial weights.

    Raises:
        ValueError: if patches do not fill the images.
    """

    STATISTICS = (0.5,) * 3, (0.5,) * 3

    def __init__(
        self,
        *,
        resolution: int,
        patch: int = 16,
        classes: int = 10,
        channels: int = 3,
        standardise: bool = True,
        rngs: nnx.Rngs,
    ):
        super().__init__(channels, standardise)
        if resolution % patch or resolution < patch:
            raise ValueError(f"patches of {patch}×{patch} pixels do not fill images of {resolution}×{resolution}")
        self.patch, initial = patch, nnx.initializers.truncated_normal(0.02)
        self.embedding = nnx.Linear(patch**2 * channels, WIDTH, rngs=rngs)
        self.token = nnx.Param(initial(rngs.params(), (1, 1, WIDTH)))
        self.positions = nnx.Param(initial(rngs.params(), (1, (resolution // patch) ** 2 + 1, WIDTH)))
        self.blocks = nnx.List([Block(rngs=rngs) for _ in range(BLOCKS)])
        self.norm = nnx.LayerNorm(WIDTH, rngs=rngs)
        self.head = nnx.Linear(WIDTH, classes, rngs=rngs)

    def _features(self, x: Array, train: bool, momentum: float | Array) -> Float[Array, "batch features"]:
        batch, height, width, _ = x.shape
        x = x.reshape(batch, height // self.patch, self.patch, width // self.patch, self.patch, -1).swapaxes(2, 3)
        tokens = self.embedding(x.reshape(batch, -1, self.embedding.in_features))
        tokens = jnp.concatenate([jnp.broadcast_to(self.token[...], (batch, 1, WIDTH)), tokens], axis=1)
        tokens = tokens + self.positions[...]
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens[:, 0])
