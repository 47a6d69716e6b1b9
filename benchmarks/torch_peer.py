"""The usual pure-PyTorch PointNet++, reimplemented as the peer of the benchmarks.

Its algorithm is the well-known one: farthest-point sampling as a loop over whole batches; ball query as a matrix of all
distances, where indices outside the ball are replaced by the number of points and sorted; gathering; shared layers as 1×1
convolutions. It has the layers, names and weights of the reference network (`tests/reference/torch_networks.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
import torch
from torch import nn

from tests.reference import torch_networks
from tests.reference.weights import made_up_weights

Call = Callable[[], torch.Tensor]


def farthest_point_sample(points: torch.Tensor, k: int) -> torch.Tensor:
    """Indices (batch, k) of the sampled points of (batch, points, 3); the first is 0."""
    batch, count, _ = points.shape
    rows = torch.arange(batch, device=points.device)
    chosen = torch.zeros(batch, k, dtype=torch.long, device=points.device)
    nearest = torch.full((batch, count), 1e10, device=points.device)
    last = torch.zeros(batch, dtype=torch.long, device=points.device)
    for i in range(k):
        chosen[:, i] = last
        distance = torch.sum((points - points[rows, last][:, None]) ** 2, -1)
        nearest = torch.minimum(nearest, distance)
        last = torch.argmax(nearest, -1)
    return chosen


def ball_query(points: torch.Tensor, centres: torch.Tensor, radius: float, k: int) -> torch.Tensor:
    """Indices (batch, centres, k) of points in each ball, padded with the first; from (batch, points, 3), (batch, centres, 3)."""
    batch, count, _ = points.shape
    squared = -2 * centres @ points.transpose(1, 2)
    squared += torch.sum(centres**2, -1)[:, :, None] + torch.sum(points**2, -1)[:, None]
    index = torch.arange(count, device=points.device).expand(batch, centres.shape[1], count).clone()
    index[squared >= radius**2] = count
    index = index.sort(dim=-1)[0][:, :, :k]
    first = index[:, :, :1].expand_as(index)
    return torch.where(index == count, first, index)


def gather(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """The values (batch, points, channels) at indices (batch, …)."""
    rows = torch.arange(len(values), device=values.device).view(-1, *[1] * (index.ndim - 1))
    return values[rows, index]


class Abstraction(torch_networks.Abstraction):
    def forward(self, points, features):
        if self.centres is None:
            return super().forward(points, features)
        centres = gather(points, farthest_point_sample(points, self.centres))
        index = ball_query(points, centres, self.radius, self.samples)
        grouped = torch.cat([gather(points, index) - centres[:, :, None], gather(features, index)], dim=3)
        out = self.mlps[0](grouped.permute(0, 3, 2, 1))  # (batch, channels, samples, centres)
        return centres, out.amax(dim=2).transpose(1, 2)


def device() -> str:
    """The GPU if JAX uses one and PyTorch can, otherwise the CPU."""
    return "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"


def array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy()


def call(function: Callable[..., torch.Tensor], *arrays: np.ndarray, **options: Any) -> Callable[[], torch.Tensor]:
    """A call on arrays that are on the device already, which returns after the device has finished."""
    tensors = [torch.from_numpy(one).to(device()) for one in arrays]

    def until_done() -> torch.Tensor:
        out = function(*tensors, **options)
        if device() == "cuda":
            torch.cuda.synchronize()
        return out

    return until_done


def with_weights(network: nn.Module) -> dict[str, np.ndarray]:
    """Gives a network made-up weights, and returns them."""
    weights = made_up_weights({name: tuple(value.shape) for name, value in network.state_dict().items()})
    network.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return weights


def forward_and_step(
    network: nn.Module, loss_of: Callable[..., torch.Tensor], dtype: str = "float32"
) -> tuple[Callable[..., torch.Tensor], Callable[..., torch.Tensor]]:
    """Functions of inputs, and of inputs and targets: a forward pass, and a training step of Adam, which returns the loss.

    With `bfloat16` they compute with automatic mixed precision.
    """
    adam = torch.optim.Adam(network.parameters(), 1e-5)
    precision = partial(torch.autocast, device(), torch.bfloat16, enabled=dtype == "bfloat16")

    def forward(inputs: torch.Tensor) -> torch.Tensor:
        with torch.no_grad(), precision():
            return network.eval()(inputs)

    def step(inputs: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        adam.zero_grad()
        with precision():
            loss = loss_of(network.train()(inputs), targets)
        loss.backward()
        adam.step()
        return loss

    return forward, step


def pointnet2(clouds: np.ndarray, entropies: np.ndarray) -> tuple[dict[str, np.ndarray], Call, Call]:
    """The weights of a PointNet++ without dropout, its forward pass, and its training step, as calls on these arrays."""
    network = torch_networks.PointNet2(entropies.shape[1], Abstraction)
    weights = with_weights(network)
    forward, step = forward_and_step(network.to(device()), nn.functional.mse_loss)
    return weights, call(forward, clouds), call(step, clouds, entropies)


def resnet18(
    images: np.ndarray, labels: np.ndarray, dtype: str
) -> tuple[dict[str, np.ndarray], dict[str, tuple[Call, Call]]]:
    """The weights of a ResNet-18, and its forward pass and training step in each of PyTorch's two layouts."""
    calls = {}
    for name, layout in (("PyTorch", torch.contiguous_format), ("PyTorch, channels-last", torch.channels_last)):
        network = torch_networks.ResNet(18)
        weights = with_weights(network)
        network = network.to(device()).to(memory_format=layout)
        forward, step = forward_and_step(network, nn.functional.cross_entropy, dtype)
        shown = torch.from_numpy(images).permute(0, 3, 1, 2).to(device()).contiguous(memory_format=layout)
        wanted = torch.from_numpy(labels).to(device())
        calls[name] = call(partial(forward, shown)), call(partial(step, shown, wanted))
    return weights, calls
