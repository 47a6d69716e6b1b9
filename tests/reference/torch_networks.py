"""Plain PyTorch versions of both networks, with torchvision's and pointnet2_ops' names; the standard that ours are held to.

Run as a program it writes `golden.npz`, outputs and gradients for made-up weights, and two small files of weights in PyTorch's
two formats, so that parity is checked where PyTorch is not installed too.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from tests.reference.weights import made_up_inputs, made_up_weights, small_state

GOLDEN = Path(__file__).with_name("golden.npz")


class Block(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int):
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x):
        out = self.bn2(self.conv2(functional.relu(self.bn1(self.conv1(x)))))
        return functional.relu(out + (x if self.downsample is None else self.downsample(x)))


class ResNet(nn.Module):
    def __init__(self, depth: int, classes: int = 10):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        inputs = 64
        for stage, repeats in enumerate({18: (2, 2, 2, 2), 34: (3, 4, 6, 3)}[depth]):
            outputs = 64 * 2**stage
            blocks = [
                Block(inputs if i == 0 else outputs, outputs, 2 if stage and i == 0 else 1) for i in range(repeats)
            ]
            setattr(self, f"layer{stage + 1}", nn.Sequential(*blocks))
            inputs = outputs
        self.fc = nn.Linear(512, classes)

    def forward(self, x):
        x = functional.max_pool2d(functional.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return self.fc(x.mean(dim=(2, 3)))


def farthest_point_sample(points: torch.Tensor, k: int) -> torch.Tensor:
    chosen = torch.zeros(k, dtype=torch.long)
    nearest = torch.full((len(points),), float("inf"), dtype=points.dtype)
    for i in range(1, k):
        offset = points - points[chosen[i - 1]]
        nearest = torch.minimum(nearest, offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2)
        chosen[i] = int(torch.argmax(nearest))
    return chosen


def ball_query(points: torch.Tensor, centres: torch.Tensor, radius: float, k: int) -> torch.Tensor:
    offset = centres[:, None] - points[None]
    inside = (
        offset[..., 0] ** 2 + offset[..., 1] ** 2 + offset[..., 2] ** 2 < torch.tensor(radius, dtype=points.dtype) ** 2
    )
    rows = torch.zeros(len(centres), k, dtype=torch.long)
    for row, hits in enumerate(inside):
        found = torch.nonzero(hits)[:k, 0]
        if len(found):
            rows[row] = found[0]
            rows[row, : len(found)] = found
    return rows


class Abstraction(nn.Module):
    def __init__(self, centres: int | None, radius: float, samples: int, layers: list[int]):
        super().__init__()
        self.centres, self.radius, self.samples = centres, radius, samples
        parts: list[nn.Module] = []
        for a, b in pairwise(layers):
            parts += [nn.Conv2d(a, b, 1, bias=False), nn.BatchNorm2d(b), nn.ReLU()]
        self.mlps = nn.ModuleList([nn.Sequential(*parts)])

    def forward(self, points, features):
        if self.centres is None:
            grouped = torch.cat([points, features], dim=2)[:, None]  # (batch, 1, points, channels)
            centres = None
        else:
            all_centres, all_grouped = [], []
            for cloud, feature in zip(points, features, strict=True):
                centre = cloud[farthest_point_sample(cloud, self.centres)]
                index = ball_query(cloud, centre, self.radius, self.samples)
                all_centres.append(centre)
                all_grouped.append(torch.cat([cloud[index] - centre[:, None], feature[index]], dim=2))
            centres, grouped = torch.stack(all_centres), torch.stack(all_grouped)
        out = self.mlps[0](grouped.permute(0, 3, 1, 2))  # (batch, channels, centres, samples)
        return centres, out.amax(dim=3).transpose(1, 2)


class PointNet2(nn.Module):
    """Without dropout, whose random numbers cannot be shared; `nn.Identity` keeps its place in the names."""

    def __init__(self, views: int, abstraction: type[Abstraction] = Abstraction):
        super().__init__()
        self.SA_modules = nn.ModuleList(
            [
                abstraction(512, 0.2, 64, [6, 64, 64, 128]),
                abstraction(128, 0.4, 64, [131, 128, 128, 256]),
                abstraction(None, 0, 0, [259, 256, 512, 1024]),
            ]
        )
        self.fc_layer = nn.Sequential(
            *(nn.Linear(1024, 512, bias=False), nn.BatchNorm1d(512), nn.ReLU()),
            *(nn.Linear(512, 256, bias=False), nn.BatchNorm1d(256), nn.ReLU()),
            *(nn.Identity(), nn.Linear(256, views)),
        )

    def forward(self, points):
        features = torch.zeros_like(points)
        for module in self.SA_modules:
            points, features = module(points, features)
        return self.fc_layer(features[:, 0])


def build(kind: str) -> nn.Module:
    return {"resnet18": lambda: ResNet(18), "resnet34": lambda: ResNet(34), "pointnet2": lambda: PointNet2(40)}[kind]()


def run(kind: str) -> dict[str, Any]:
    """Outputs in evaluation mode, and in double precision gradients of the mean squared output in training mode."""
    network = build(kind)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    network.load_state_dict({name: torch.from_numpy(value) for name, value in made_up_weights(shapes).items()})
    inputs = torch.from_numpy(made_up_inputs(kind.rstrip("0123456789") if "resnet" in kind else kind))
    if "resnet" in kind:
        inputs = inputs.permute(0, 3, 1, 2).contiguous()
    with torch.no_grad():
        outputs = network.eval()(inputs).numpy()
    network.double().train()
    network(inputs.double()).square().mean().backward()
    gradients = {name: parameter.grad.numpy() for name, parameter in network.named_parameters()}
    running = {name: value.numpy() for name, value in network.state_dict().items() if "running" in name}
    return {"shapes": shapes, "outputs": outputs, "gradients": gradients, "running": running}


def fingerprint(array: np.ndarray) -> np.ndarray:
    """Norm, sum and first six entries: enough to tell a wrong gradient, small enough to store."""
    flat = np.zeros(6, np.float32)
    flat[: min(6, array.size)] = array.reshape(-1)[:6]
    return np.concatenate([[np.linalg.norm(array), array.sum()], flat]).astype(np.float32)


def write_golden() -> None:
    stored: dict[str, Any] = {}
    for kind in ("resnet18", "resnet34", "pointnet2"):
        result = run(kind)
        names = sorted(result["gradients"])
        stored[f"{kind}/names"] = np.array(list(result["shapes"]))
        stored[f"{kind}/shapes"] = np.array([" ".join(map(str, shape)) for shape in result["shapes"].values()])
        stored[f"{kind}/outputs"] = result["outputs"]
        stored[f"{kind}/gradient_names"] = np.array(names)
        stored[f"{kind}/gradients"] = np.stack([fingerprint(result["gradients"][name]) for name in names])
    np.savez_compressed(GOLDEN, **stored)


def small_tensors() -> dict[str, torch.Tensor]:
    """`small_state` as tensors, with what PyTorch's files may hold: parameters, views of a storage, half precisions."""
    tensors: dict[str, torch.Tensor] = {name: torch.from_numpy(array) for name, array in small_state().items()}
    tensors["transposed"] = torch.from_numpy(small_state()["transposed"].T.copy()).T
    tensors["part"] = torch.cat([torch.zeros(3), tensors["part"], torch.zeros(2)])[3:-2]
    tensors["parameter"] = nn.Parameter(tensors["parameter"])
    tensors["bfloat16"] = tensors["bfloat16"].bfloat16()
    return tensors


def write_small_files() -> None:
    for name, new in (("zip", True), ("legacy", False)):
        path = Path(__file__).with_name(f"weights_{name}.pth")
        torch.save(small_tensors(), path, _use_new_zipfile_serialization=new)


if __name__ == "__main__":
    write_golden()
    write_small_files()
    print(f"wrote {GOLDEN} with PyTorch {torch.__version__}", file=sys.stderr)
