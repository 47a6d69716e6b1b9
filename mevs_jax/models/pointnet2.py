"""PointNet++ with single-scale grouping: predicts the depth entropy of every candidate view from one partial cloud.

Source: Qi et al., *PointNet++*, 2017, and the thesis §4.3.2. The thesis's network reads six numbers per point: the coordinates
and three zeros in place of a normal. This network has the same inputs, so the thesis's weights and parameter counts (1,471,509
for 10 views, 1,479,219 for 40) carry over. If the camera's pose is known, the direction from each point to the camera can
replace the zeros.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from mevs_jax.arguments import check, whole
from mevs_jax.arrays import AnyArray
from mevs_jax.models.batch_norm import BatchNorm
from mevs_jax.models.calling import TrainedByCall
from mevs_jax.models.neighbours import Layer, first_layer, infer, largest_by_kernel, largest_of_neighbours, suits_kernel
from mevs_jax.models.product import product
from mevs_jax.points.farthest import LARGE
from mevs_jax.points.ops import ball_query, farthest_point_sample


@dataclass(frozen=True)
class Abstraction:
    """One set-abstraction level of PointNet++.

    Attributes:
        centres: number of points kept by farthest-point sampling.
        radius: of the neighbourhood of each centre, in units of the cloud.
        samples: number of neighbours per centre.
        layers: number of outputs of each layer applied to the neighbours.
    """

    centres: int
    radius: float
    samples: int
    layers: tuple[int, ...]


THESIS_ABSTRACTIONS = (
    Abstraction(centres=512, radius=0.2, samples=64, layers=(64, 64, 128)),
    Abstraction(centres=128, radius=0.4, samples=64, layers=(128, 128, 256)),
)
THESIS_GLOBAL_LAYERS = (256, 512, 1024)
THESIS_HEAD_LAYERS = (512, 256)


class Perceptron(nnx.Module):
    """Linear layers without bias, each with batch norm and ReLU: the "shared MLP" of the paper."""

    def __init__(self, inputs: int, layers: Sequence[int], *, rngs: nnx.Rngs, dtype: jnp.dtype | None = None):
        sizes = [inputs, *layers]
        self.linear = nnx.List(
            nnx.Linear(a, b, use_bias=False, kernel_init=nnx.initializers.he_normal(), dtype=dtype, rngs=rngs)
            for a, b in pairwise(sizes)
        )
        self.norm = nnx.List(BatchNorm(size) for size in layers)

    def __call__(self, x: Array, *, momentum: float | Array) -> Array:
        """The outputs of all layers in training, with batch norm by the statistics of the batch."""
        for linear, norm in zip(self.linear, self.norm, strict=True):
            x = jax.nn.relu(norm(linear(x), train=True, momentum=momentum))
        return x

    def largest(
        self, x: Float[Array, "*batch rows columns"], *, momentum: float | Array, passed: int = 0
    ) -> Float[Array, "*batch outputs"]:
        """Maximum over rows of the outputs in training; the first `passed` linear layers have already been applied to `x`."""
        # Rows keep their groups: where they are one long matrix, a TPU writes the gradient of the maximum three times.
        last = len(self.linear) - 1
        for number, (linear, norm) in enumerate(zip(self.linear, self.norm, strict=True)):
            x = x if number < passed else product(x, linear.kernel[...]).astype(x.dtype)
            if number < last:
                x = jax.nn.relu(norm(x, train=True, momentum=momentum))
        return self.norm[last].largest(x, momentum=momentum)

    def layers(self) -> list[Layer]:
        """The layers in inference, with batch norm by its running statistics."""
        return [(linear.kernel[...], *norm.folded()) for linear, norm in zip(self.linear, self.norm, strict=True)]


def _passes_first(kernel: Float[Array, "inputs outputs"]) -> bool:
    """Whether the first layer is applied to points before they are gathered into neighbourhoods.

    This is possible since the layer is linear, and it computes each point once instead of once for every neighbourhood. With
    few inputs it is not worthwhile: gathering them costs less than gathering the outputs.
    """
    return kernel.shape[0] > 8


def _passed(
    points: Float[Array, "points 3"], features: Float[Array, "points channels"], kernel: Float[Array, "inputs outputs"]
) -> Float[Array, "points columns"]:
    """The columns to gather for every neighbour: first-layer outputs if `_passes_first`, else the inputs."""
    if _passes_first(kernel):
        return _placed(points, kernel) + product(features, kernel[3:])
    return jnp.concatenate([points, features.astype(points.dtype)], axis=-1)


def _placed(points: Float[Array, "points 3"], kernel: Float[Array, "inputs outputs"]) -> Float[Array, "points outputs"]:
    """The contribution of the coordinates to the first layer."""
    # In full precision, since differences of two such contributions are small.
    return jnp.matmul(points, kernel[:3], precision=jax.lax.Precision.HIGHEST)


def _offsets(
    centres: Float[Array, "centres 3"], kernel: Float[Array, "inputs outputs"], columns: int
) -> tuple[Float[Array, "centres columns"], Float[Array, "columns outputs"] | None]:
    """What to subtract from the columns that are gathered for a centre, and the weights that are then left to apply."""
    if _passes_first(kernel):
        return _placed(centres, kernel), None
    return jnp.pad(centres, ((0, 0), (0, columns - 3))), kernel[:columns]


def _map(function: Callable, clouds: Any, at_once: int) -> Any:
    """Applies `function` to every cloud in inference, in batches of `at_once`.

    A symbolic number of clouds, in exported programs, cannot be divided into batches: clouds are then processed one by one.
    """
    symbolic = not isinstance(jax.tree.leaves(clouds)[0].shape[0], int)
    return jax.lax.map(function, clouds, batch_size=None if symbolic else at_once)


def _centres(
    clouds: Float[Array, "clouds points 3"], k: int, first: bool, at_once: int | None = None
) -> Float[Array, "clouds {k} 3"]:
    """The centres of a level, `at_once` clouds at a time or all together.

    Centres are in the order in which farthest-point sampling chose them. Sampled again, they are chosen in the same order, also
    among equal distances. So the first of them are the centres of the next level.
    """
    if not first and k <= clouds.shape[1]:
        return clouds[:, :k]
    sample = partial(farthest_point_sample, k=k)
    chosen = jax.vmap(sample)(clouds) if at_once is None else _map(sample, clouds, at_once)
    return jnp.take_along_axis(clouds, chosen[..., None], axis=1)


def _abstract(
    points: Float[Array, "points 3"],
    features: Float[Array, "points channels"],
    centres: Float[Array, "centres 3"],
    *,
    level: Abstraction,
    layers: list[Layer],
    pieces: int,
) -> Float[Array, "centres outputs"]:
    """One level of one cloud in inference, in equal pieces of its centres."""
    neighbours = ball_query(points, centres, level.radius, level.samples)
    (kernel, *normalised), *others = layers
    passed = _passed(points, features, kernel)
    offsets, left = _offsets(centres, kernel, passed.shape[-1])
    flat = [*([] if left is None else [left]), *normalised, *(array for layer in others for array in layer)]
    if pieces == 1 and suits_kernel(level.samples, level.layers, features.dtype):
        return largest_by_kernel(int(left is None), passed, offsets, neighbours, *flat)

    def some(piece: tuple[Array, Array]) -> Array:
        return largest_of_neighbours(passed, *piece, *flat, k=int(left is None), dtype=features.dtype)

    split = jax.tree.map(lambda array: array.reshape(pieces, -1, array.shape[-1]), (offsets, neighbours))
    return jax.lax.map(some, split).reshape(level.centres, -1)


def _pieces(level: Abstraction) -> int:
    """Number of equal pieces of a level's centres, of at most 4,096 neighbours or of one centre, which stay in a CPU's cache."""
    fewest = min(-(-level.centres * level.samples // 4096), level.centres)
    return next(count for count in range(fewest, level.centres + 1) if level.centres % count == 0)


class PointNet2(TrainedByCall):
    """PointNet++ SSG regressor with one output per candidate view.

    Args:
        views: number of candidate views, at least 2.
        abstractions: sizes of the set abstraction layers; the thesis's by default.
        global_layers: widths of the layers before the pooling over all centres.
        head_layers: widths of the layers after it.
        dropout: rate before the last layer, in [0, 1).
        rngs: source of the initial weights.
        dtype: type in which the hidden layers compute; that of the clouds by default. Coordinates, weights, batch-norm
            statistics and the last layer keep their own types.

    Raises:
        ValueError: for fewer than 2 views, a dropout outside its range, or abstractions of impossible sizes.
    """

    def __init__(
        self,
        *,
        views: int,
        abstractions: Sequence[Abstraction] = THESIS_ABSTRACTIONS,
        global_layers: Sequence[int] = THESIS_GLOBAL_LAYERS,
        head_layers: Sequence[int] = THESIS_HEAD_LAYERS,
        dropout: float = 0.5,
        rngs: nnx.Rngs,
        dtype: jnp.dtype | None = None,
    ):
        self.views = whole(views, "PointNet2 needs at least 2 candidate views", 2, 2**20)
        self.levels = tuple(abstractions)
        for level in self.levels:
            whole(level.centres, "an abstraction needs at least 1 centre", 1, 2**31 - 1)
            whole(level.samples, "an abstraction needs at least 1 sample", 1, 2**31 - 1)
            check(level.radius, "radius of an abstraction must be above 0", lambda far: (far > 0) & (far < jnp.inf))
        check(dropout, "dropout must be a probability below 1", lambda rate: (rate >= 0) & (rate < 1))
        channels = 3  # in place of normals
        perceptrons = []
        for level in self.levels:
            perceptrons.append(Perceptron(3 + channels, level.layers, rngs=rngs, dtype=dtype))
            channels = level.layers[-1]
        self.perceptrons = nnx.List(perceptrons)
        self.whole = Perceptron(3 + channels, global_layers, rngs=rngs, dtype=dtype)
        self.head = Perceptron(global_layers[-1], head_layers, rngs=rngs, dtype=dtype)
        self.dropout, self.dtype = dropout, dtype
        self.out = nnx.Linear(head_layers[-1], views, rngs=rngs)

    def __call__(
        self,
        points: Float[AnyArray, "*batch points columns"],
        *,
        train: bool = False,
        key: Array | None = None,
        momentum: float | Float[Array, ""] = 0.1,
        dropout: float | Float[Array, ""] | None = None,
    ) -> Float[Array, "*batch views"]:
        """Predicted entropy of every view, in units of the largest entropy of the training split.

        Args:
            points: one cloud (points, 3) or a batch of clouds, in the unit sphere; or (points, 6) with a direction per point.
            train: whether to normalise by the batch, update the running statistics, and apply dropout.
            key: PRNG key for dropout; required if `train`.
            momentum: weight of the new batch in the running statistics, in [0, 1].
            dropout: rate that replaces the network's own, in [0, 1).

        Raises:
            ValueError: for clouds of other than 3 or 6 columns or without points, or training without a key.
        """
        points = jnp.asarray(points)
        if points.shape[-1] not in (3, 6):
            raise ValueError(f"PointNet2 needs clouds of 3 or 6 columns, got {points.shape[-1]}")
        if not points.shape[-2]:
            raise ValueError("PointNet2 needs clouds of at least one point, got none")
        batch, dtype = points.shape[:-2], self.dtype or points.dtype
        clouds = points.reshape(-1, *points.shape[-2:])
        if not train:
            embedded = self._embed(clouds)
            return self.out(infer(self.head.layers(), embedded).astype(points.dtype)).reshape(*batch, self.views)
        if key is None:
            raise ValueError("PointNet2 needs a key for its dropout in training")
        coordinates, features = clouds[..., :3], clouds[..., 3:].astype(dtype)
        for level, perceptron in zip(self.levels, self.perceptrons, strict=True):
            centres = _centres(coordinates, level.centres, level is self.levels[0])
            neighbours = jax.vmap(partial(ball_query, radius=level.radius, k=level.samples))(coordinates, centres)
            kernel = perceptron.linear[0].kernel[...]
            passed = jax.vmap(_passed, in_axes=(0, 0, None))(coordinates, features, kernel)
            offsets, left = jax.vmap(partial(_offsets, columns=passed.shape[-1]), (0, None), (0, None))(centres, kernel)
            x = jax.vmap(first_layer, in_axes=(0, 0, 0, None))(passed, offsets, neighbours, left)
            features = perceptron.largest(x.astype(dtype), momentum=momentum, passed=1)
            coordinates = centres
        everything = jnp.concatenate([coordinates.astype(dtype), features], axis=-1)
        features = self.whole.largest(everything, momentum=momentum)
        hidden = self.head(features, momentum=momentum).astype(points.dtype)
        # Flax's dropout layer does not accept a traced rate.
        kept = 1 - (self.dropout if dropout is None else dropout)
        hidden = jnp.where(jax.random.bernoulli(key, kept, hidden.shape), hidden / kept, 0.0)
        return self.out(hidden).reshape(*batch, self.views)

    def embed(self, points: Float[AnyArray, "*batch points columns"]) -> Float[Array, "*batch embedding"]:
        """The embedding of each cloud, the input of the head, in inference; `points` as in `__call__`."""
        points = jnp.asarray(points)
        embedded = self._embed(points.reshape(-1, *points.shape[-2:])).astype(points.dtype)
        return embedded.reshape(*points.shape[:-2], -1)

    def _embed(self, clouds: Float[Array, "clouds points columns"]) -> Float[Array, "clouds embedding"]:
        """The embeddings of a batch of clouds, with batch norm by the running statistics."""
        small, large = (partial(self._embed_in_parts, in_cache=fits) for fits in (True, False))
        return jax.lax.platform_dependent(clouds, cpu=small, default=large)

    def _embed_in_parts(self, clouds: Array, *, in_cache: bool) -> Array:
        """`_embed` in parts that stay in a CPU's cache; or else of up to 64 clouds, which keep an accelerator busy and bound its
        memory (64 clouds of the thesis's size take 2 GB)."""
        points, features = clouds[..., :3], clouds[..., 3:].astype(self.dtype or clouds.dtype)
        for level, perceptron in zip(self.levels, self.perceptrons, strict=True):
            at_once = 4 if points.shape[1] <= LARGE else 1  # four larger clouds leave the cache
            centres = _centres(points, level.centres, level is self.levels[0], at_once if in_cache else None)
            pieces = _pieces(level) if in_cache else 1
            abstract = partial(_abstract, level=level, layers=perceptron.layers(), pieces=pieces)
            features = _map(lambda cloud, of=abstract: of(*cloud), (points, features, centres), 1 if in_cache else 64)
            points = centres
        everything = jnp.concatenate([points.astype(features.dtype), features], axis=-1)
        return jnp.max(infer(self.whole.layers(), everything), axis=1)
