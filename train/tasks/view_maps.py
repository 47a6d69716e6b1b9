"""Predictors of a value of every view from one cloud, beside the thesis's: of other values, with other outputs, other layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from data_pipeline.dataset.batches import ViewBatches
from mevs_jax.models.expected_views import harmonics
from train.step import view_batches
from train.tasks.entropy import EntropyTask
from train.tasks.vector_neurons import VectorPointNet2

DEGREE = 4
"""Largest degree of the harmonics: 25 coefficients, which vary over about 45°."""
_PLACES = 3
"""Largest degree of the harmonics that tell the graph network where a view is."""

Viewpoints = tuple[tuple[float, ...], ...]
Output = Literal["linear", "harmonics", "graph", "vectors"]


class HarmonicOutput(nnx.Module):
    """The values of all views as a sum of spherical harmonics, whose coefficients are a linear layer's outputs."""

    def __init__(self, inputs: int, viewpoints: Viewpoints, *, rngs: nnx.Rngs):
        self.viewpoints = viewpoints
        self.coefficients = nnx.Linear(inputs, (DEGREE + 1) ** 2, rngs=rngs)

    def __call__(self, x: Float[Array, "clouds inputs"]) -> Float[Array, "clouds views"]:
        return self.coefficients(x) @ harmonics(jnp.array(self.viewpoints), DEGREE).T


class GraphOutput(nnx.Module):
    """A graph network over the views: each knows the cloud and where it is, and hears the mean of its neighbours three times."""

    def __init__(
        self,
        inputs: int,
        viewpoints: Viewpoints,
        neighbours: tuple[tuple[bool, ...], ...],
        *,
        width: int = 64,
        rounds: int = 3,
        rngs: nnx.Rngs,
    ):
        self.viewpoints, self.neighbours = viewpoints, neighbours
        self.cloud = nnx.Linear(inputs, width, rngs=rngs)
        self.place = nnx.Linear((_PLACES + 1) ** 2, width, rngs=rngs)
        self.own = nnx.List(nnx.Linear(width, width, rngs=rngs) for _ in range(rounds))
        self.heard = nnx.List(nnx.Linear(width, width, use_bias=False, rngs=rngs) for _ in range(rounds))
        self.out = nnx.Linear(width, 1, rngs=rngs)

    def __call__(self, x: Float[Array, "clouds inputs"]) -> Float[Array, "clouds views"]:
        near = jnp.array(self.neighbours, x.dtype)
        near = near / jnp.sum(near, axis=1, keepdims=True)
        places = harmonics(jnp.array(self.viewpoints), _PLACES)
        nodes = jax.nn.relu(self.cloud(x)[:, None] + self.place(places))
        for own, heard in zip(self.own, self.heard, strict=True):
            nodes = nodes + jax.nn.relu(own(nodes) + heard(jnp.einsum("vn,bnc->bvc", near, nodes)))
        return self.out(nodes)[..., 0]


@dataclass(frozen=True)
class MapTask(EntropyTask):
    """Training of a predictor of some value of every view, by mean squared error.

    Attributes:
        target: name of the value, one of `train.tasks.view_values.VALUES`; empty for entropies. Values are divided by
            `entropy_max`, as entropies are.
        made_by: identifies the values.
        output: what the last layer of PointNet++ is, or `vectors` for a network of Vector Neurons.
        viewpoints: directions of the views.
        neighbours: which views are neighbours.
    """

    target: str = ""
    made_by: str = ""
    output: Output = "linear"
    viewpoints: Viewpoints = ()
    neighbours: tuple[tuple[bool, ...], ...] = ()

    @property
    def batches(self) -> ViewBatches:
        config, points = self.optimiser, self.network_config.points
        return view_batches(config, points=points, validation_by=config.validation_by, target=self.target)

    def network(self, rngs: nnx.Rngs) -> Any:
        shape, places = self.network_config, self.viewpoints
        if self.output == "vectors":
            return VectorPointNet2(
                viewpoints=places,
                abstractions=shape.abstractions,
                global_layers=shape.global_layers,
                head_layers=shape.head_layers,
                dropout=shape.dropout,
                rngs=rngs,
            )
        network, width = super().network(rngs), shape.head_layers[-1]
        if self.output == "harmonics":
            network.out = HarmonicOutput(width, places, rngs=rngs)
        elif self.output == "graph":
            network.out = GraphOutput(width, places, self.neighbours, rngs=rngs)
        return network
