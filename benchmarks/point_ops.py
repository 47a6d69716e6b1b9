"""How fast the point operations and PointNet++ are, each beside a peer in the same run.

`make bench` runs it; the peer is the plain NumPy rule of `tests/reference` or, where PyTorch is installed, the plain PyTorch
version. Times are medians over repeats; a ratio is quoted, never a time alone.
"""

from __future__ import annotations

import importlib.util
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import numpy as np
from flax import nnx

from data_pipeline.files import write_json
from mevs_jax import PointNet2, ball_query, farthest_point_sample
from tests.reference import numpy_rules


def median_seconds(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median and spread (largest minus smallest) of `repeats` calls after one to warm up."""
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return float(np.median(times)), max(times) - min(times)


def rows() -> list[dict[str, object]]:
    random = np.random.default_rng(0)
    cloud = random.uniform(-0.6, 0.6, (4096, 3)).astype(np.float32)
    centres = cloud[np.asarray(farthest_point_sample(cloud, 512))]
    sample = jax.jit(lambda points: farthest_point_sample(points, 512))
    query = jax.jit(lambda points, centres: ball_query(points, centres, 0.2, 64))
    cases: list[tuple[str, Callable, str, Callable]] = [
        (
            "farthest-point sampling, 4,096 → 512",
            lambda: sample(cloud),
            "NumPy loop",
            lambda: numpy_rules.farthest_point_sample(cloud, 512),
        ),
        (
            "ball query, 4,096 points, 512 centres, 64 samples",
            lambda: query(cloud, centres),
            "NumPy loop (8 centres, scaled)",
            lambda: numpy_rules.ball_query(cloud, centres[:8], 0.2, 64),
        ),
    ]
    scale = {1: 512 / 8}
    if importlib.util.find_spec("torch"):
        import torch

        from tests.reference import torch_networks

        clouds = random.uniform(-0.6, 0.6, (4, 4096, 3)).astype(np.float32)
        ours, theirs = PointNet2(views=40, rngs=nnx.Rngs(0)), torch_networks.PointNet2(40).eval()
        forward = nnx.jit(lambda network, points: network(points))
        tensor = torch.from_numpy(clouds)

        def peer() -> object:
            with torch.no_grad():
                return theirs(tensor).numpy()

        cases.append(("PointNet++ forward, 4 clouds of 4,096", lambda: forward(ours, clouds), "plain PyTorch", peer))
    out = []
    for number, (name, call, peer_name, peer_call) in enumerate(cases):
        mine, spread = median_seconds(call, 10)
        other, other_spread = median_seconds(peer_call, 3)
        factor = scale.get(number, 1)
        out.append(
            {
                "what": name,
                "seconds": mine,
                "spread": spread,
                "peer": peer_name,
                "peer_seconds": other * factor,
                "peer_spread": other_spread * factor,
                "times_faster": other * factor / mine,
            }
        )
    return out


def main() -> None:
    table = rows()
    machine = f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, JAX {jax.__version__}"
    print(f"Measured on: {machine}\n")
    print("| what | ours, ms | peer | peer, ms | ratio |\n|---|---|---|---|---|")
    for row in table:
        print(
            f"| {row['what']} | {1e3 * row['seconds']:.1f} ± {500 * row['spread']:.1f} | {row['peer']} "
            f"| {1e3 * row['peer_seconds']:.0f} | {row['times_faster']:.1f}× |"
        )
    path = Path(__file__).parent / "results" / "point_ops.json"
    write_json(path, {"machine": machine, "rows": table})
    print(f"\nWritten to {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}")


if __name__ == "__main__":
    main()
