"""The usual pure-PyTorch PointNet++, reimplemented as the peer of the benchmarks.

Its algorithm is the well-known one: farthest-point sampling as a loop over whole batches; ball query as a matrix of all
distances, where indices outside the ball are replaced by the number of points and sorted; gathering; shared layers as 1×1
convolutions. It has the layers, names and weights of the reference network (`tests/reference/torch_networks.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from tests.reference import torch_networks
from tests.reference.weights import made_up_weights


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


def pointnet2(views: int) -> torch_networks.PointNet2:
    return torch_networks.PointNet2(views, Abstraction)


def _resnet18() -> torch_networks.ResNet:
    network = torch_networks.ResNet(18)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    network.load_state_dict({name: torch.from_numpy(value) for name, value in made_up_weights(shapes).items()})
    return network


def resnet18_weights() -> dict[str, np.ndarray]:
    """The weights with which the peers below begin."""
    return {name: value.numpy() for name, value in _resnet18().state_dict().items()}


def resnet18(
    images: np.ndarray, labels: np.ndarray, dtype: str, device: str
) -> dict[str, tuple[Callable[[], torch.Tensor], Callable[[], torch.Tensor]]]:
    """Forward pass and training step of ResNet-18 in PyTorch's two layouts.

    Args:
        images: (batch, height, width, 3) float32.
        labels: class of each image.
        dtype: `bfloat16` computes with automatic mixed precision.
        device: where to.
    """
    found: dict[str, tuple[Callable[[], torch.Tensor], Callable[[], torch.Tensor]]] = {}
    for name, layout in (("PyTorch", torch.contiguous_format), ("PyTorch, channels-last", torch.channels_last)):
        network = _resnet18().to(device).to(memory_format=layout)
        shown = torch.from_numpy(images).permute(0, 3, 1, 2).to(device).contiguous(memory_format=layout)
        wanted = torch.from_numpy(labels).to(device)
        adam = torch.optim.Adam(network.parameters(), 1e-5)
        precision = partial(torch.autocast, device, torch.bfloat16, enabled=dtype == "bfloat16")

        def forward(network=network, shown=shown, precision=precision) -> torch.Tensor:
            with torch.no_grad(), precision():
                return network.eval()(shown)

        def step(network=network, shown=shown, wanted=wanted, adam=adam, precision=precision) -> torch.Tensor:
            adam.zero_grad()
            with precision():
                loss = torch.nn.functional.cross_entropy(network.train()(shown), wanted)
            loss.backward()
            adam.step()
            return loss

        found[name] = forward, step
    return found
