"""Point operations and PointNet++, compared with other implementations: `make bench`, or `python benchmarks/points.py`.

The rows are farthest-point sampling of one cloud, of a large one and of sixteen, and ball query of one and of sixteen;
the forward pass and training step of PointNet++ on sixteen clouds of 4,096 points with the same weights, and the matrix
products of the forward pass alone; decisions. All results are compared before they are timed. Calls take turns, so that
other load on the machine affects all of them. Only training steps do not, because each kind needs gigabytes that it
would have to allocate again. Times are medians and quartiles; the relevant number is their ratio. Peers that are not
installed are left out with a message.

The table is written to `benchmarks/results/points.json` and `points.md`. With `--guard` nothing is written or
trained: the ratios are compared with the stored ones, and the exit code is 1 if one is below a third of the stored
ratio.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from scipy.spatial import cKDTree

from benchmarks.comparing import (
    HEADER,
    Row,
    compare,
    end_by_guard,
    finished,
    installed,
    machine_name,
    peer_device,
    row_cells,
    take_turns,
    training_step,
)
from data_pipeline.files import write_json, write_text
from eval.numbers.timing import time_local_maxima
from mevs_jax import (
    NextView,
    PointNet2,
    ViewGraph,
    ball_query,
    farthest_point_sample,
    fibonacci_sphere,
    pointnet2_from_torch,
)
from mevs_jax.markdown import markdown_row, markdown_table
from tests.reference import numpy_rules
from tests.reference.weights import made_up_weights

RESULTS = Path(__file__).parent / "results" / "points.json"
CLOUDS, POINTS, CENTRES, RADIUS, SAMPLES = 16, 4096, 512, 0.2, 64
DECISION_HEADER = ("points", "clouds", "p50, ms", "p99, ms", "ms a cloud", "memory, MB")


def partial_clouds() -> np.ndarray:
    """Partial clouds (clouds, points, 3) float32 of uneven spheres seen from above, in the unit sphere."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(CLOUDS, POINTS, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    directions[..., 2] = np.abs(directions[..., 2])
    return (directions * random.uniform(0.8, 0.97, (CLOUDS, POINTS, 1))).astype(np.float32)


def first_within(tree: cKDTree, centres: np.ndarray) -> np.ndarray:
    """Ball query by a k-d tree: the first hits in index order, padded with the first hit."""
    out = np.zeros((len(centres), SAMPLES), np.int32)
    for row, hits in enumerate(tree.query_ball_point(centres, np.nextafter(RADIUS, 0), return_sorted=True)):
        if hits:
            out[row] = hits[0]
            out[row, : len(hits[:SAMPLES])] = hits[:SAMPLES]
    return out


def share_equal(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.mean(np.asarray(a) == np.asarray(b)))


def farthest_points(cloud: np.ndarray, centres: int, name: str, rounds: int) -> list[Row]:
    sample = farthest_point_sample  # on CPU this compiles a concrete cloud
    if jax.default_backend() != "cpu":
        sample = jax.jit(farthest_point_sample, static_argnums=1)
    chosen = np.asarray(sample(cloud, centres))
    peers: dict[str, Callable] = {"NumPy loop": lambda: numpy_rules.farthest_point_sample(cloud, centres)}
    notes = {}
    if installed("fpsample"):
        import fpsample

        peers["fpsample, plain"] = lambda: fpsample.fps_sampling(cloud, centres, start_idx=0)
        peers["fpsample, buckets"] = lambda: fpsample.bucket_fps_kdline_sampling(cloud, centres, h=5, start_idx=0)
        for peer in ("fpsample, plain", "fpsample, buckets"):
            notes[peer] = f"{share_equal(peers[peer](), chosen):.1%} of indices equal"
    if installed("open3d"):
        import open3d

        theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud))
        peers["Open3D"] = lambda: theirs.farthest_point_down_sample(centres)
    np.testing.assert_array_equal(peers["NumPy loop"](), chosen)
    return compare(name, lambda: sample(cloud, centres), peers, rounds, notes)


def point_operations(clouds: np.ndarray, torch_peer: Any, rounds: int) -> list[Row]:
    sample = partial(farthest_point_sample, k=CENTRES)
    sample_all = jax.jit(lambda clouds: jax.lax.map(sample, clouds, batch_size=4))
    query = jax.jit(lambda cloud, centres: ball_query(cloud, centres, RADIUS, SAMPLES))
    query_all = jax.jit(jax.vmap(query))
    cloud = clouds[0]
    chosen = np.asarray(sample_all(clouds))
    centres = np.take_along_axis(clouds, chosen[..., None], axis=1)
    neighbours = np.asarray(query_all(clouds, centres))
    rows = farthest_points(cloud, CENTRES, "farthest points, one cloud", rounds)
    rows += farthest_points(clouds[:4].reshape(-1, 3), 1024, "farthest points, one cloud of 16,384", rounds)

    tree = "SciPy's k-d tree"
    search: dict[str, Callable] = {tree: lambda: first_within(cKDTree(cloud), centres[0])}
    np.testing.assert_array_equal(numpy_rules.ball_query(cloud, centres[0], RADIUS, SAMPLES), neighbours[0])
    notes = {tree: f"{share_equal(search[tree](), neighbours[0]):.2%} of indices equal"}
    rows += compare("ball query, one cloud", lambda: query(cloud, centres[0]), search, rounds, notes)

    if torch_peer:
        import torch

        device = peer_device()
        them, theirs_at = (torch.from_numpy(array).to(device) for array in (clouds, centres))
        found = torch_peer.farthest_point_sample(them, CENTRES).cpu().numpy()
        np.testing.assert_array_equal(found, chosen)
        rows += compare(
            "farthest points, 16 clouds",
            lambda: sample_all(clouds),
            {"PyTorch": finished(lambda: torch_peer.farthest_point_sample(them, CENTRES))},
            rounds,
        )
        query_peer = finished(lambda: torch_peer.ball_query(them, theirs_at, RADIUS, SAMPLES))
        notes = {"PyTorch": f"{share_equal(query_peer().cpu().numpy(), neighbours):.3%} of indices equal"}
        rows += compare(
            "ball query, 16 clouds",
            lambda: query_all(clouds, centres),
            {"PyTorch": query_peer},
            max(3, rounds // 3),
            notes,
        )
    return rows


def matrix_products(network: PointNet2) -> Callable[[], jax.Array]:
    """Only the matrix products and maxima of the forward pass, on prepared arrays in cache-sized pieces."""
    random = np.random.default_rng(0)
    work = []
    for rows, pieces, group, layers in (
        (4096, 8, 64, network.perceptrons[0].linear),
        (4096, 2, 64, network.perceptrons[1].linear),
        (128, 1, 128, network.whole.linear),
    ):
        kernels = [layer.kernel[...] for layer in layers]
        work.append((jnp.asarray(random.normal(size=(pieces, rows, kernels[0].shape[0])), jnp.float32), kernels, group))

    sizes = [group for *_, group in work]
    arrays = [(x, kernels) for x, kernels, _ in work]

    def largest(x: jax.Array, kernels: list[jax.Array], group: int) -> jax.Array:
        for kernel in kernels:
            x = x @ kernel
        return jnp.max(x.reshape(-1, group, x.shape[-1]), axis=1)

    @jax.jit
    def products(arrays, shifts):
        def cloud(shift):
            parts = []
            for (x, kernels), group in zip(arrays, sizes, strict=True):
                piece = partial(largest, kernels=kernels, group=group)
                parts.append(jnp.sum(jax.lax.map(piece, x + shift)))
            return sum(parts)

        return jax.lax.map(cloud, shifts)

    shifts = jnp.arange(CLOUDS, dtype=jnp.float32)
    return lambda: products(arrays, shifts)


def networks(clouds: np.ndarray, torch_peer: Any, rounds: int, training: bool) -> list[Row]:
    network = PointNet2(views=40, dropout=0.0, rngs=nnx.Rngs(0))
    peers: dict[str, Callable] = {}
    if torch_peer:
        import torch

        device = peer_device()
        theirs = torch_peer.pointnet2(40).to(device)
        state = made_up_weights({name: tuple(value.shape) for name, value in theirs.state_dict().items()})
        pointnet2_from_torch(network, state)
        theirs.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})
        tensor = torch.from_numpy(clouds).to(device)

        def forward_peer() -> Any:
            with torch.no_grad():
                return theirs.eval()(tensor)

        peers["PyTorch"] = finished(forward_peer)
    structure, parameters, *others = nnx.split(network, nnx.Param, ...)
    statistics = others[0]
    rows: list[Row] = []
    if torch_peer and training:
        targets = np.random.default_rng(1).uniform(0, 1, (CLOUDS, 40)).astype(np.float32)
        wanted = jnp.asarray(targets)

        def loss_of(network: PointNet2, clouds: jax.Array, targets: jax.Array) -> jax.Array:
            return jnp.mean(jnp.square(network(clouds, train=True, key=jax.random.key(0)) - targets))

        step, shown = training_step(network, loss_of), jnp.asarray(clouds)
        their_adam = torch.optim.Adam(theirs.parameters(), 1e-5)
        their_targets = torch.from_numpy(targets).to(device)

        def train_peer() -> Any:
            their_adam.zero_grad()
            loss = torch.mean((theirs.train()(tensor) - their_targets) ** 2)
            loss.backward()
            their_adam.step()
            return loss

        apart = abs(float(step(shown, wanted)) / train_peer().item() - 1)
        assert apart < 1e-3
        rows += compare(
            "PointNet++ training step, 16 clouds",
            lambda: step(shown, wanted),
            {"PyTorch": finished(train_peer)},
            max(3, rounds // 4),
            {"PyTorch": f"first loss equal to {apart:.0e}"},
            turns=False,
        )
    forward = jax.jit(lambda clouds: nnx.merge(structure, parameters, statistics)(clouds))
    notes = {"its matrix products alone": "a floor, not a peer"}
    if torch_peer:
        theirs.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})  # as before training
        largest = float(np.abs(np.asarray(forward(clouds)) - peers["PyTorch"]().cpu().numpy()).max())
        notes["PyTorch"] = f"outputs equal to {largest:.0e}"
        assert largest < 1e-3
    peers["its matrix products alone"] = matrix_products(network)
    rows += compare("PointNet++ forward, 16 clouds", lambda: forward(clouds), peers, max(3, rounds // 2), notes)

    return rows


def decisions(clouds: np.ndarray, calls: int = 200) -> list[dict[str, float]]:
    """Time from clouds to the next of 40 views: single clouds by size, as on a robot, and 256 clouds of 4,096 points."""
    graph = ViewGraph.from_points(fibonacci_sphere(40))
    network = PointNet2(views=40, rngs=nnx.Rngs(0))
    choose = NextView(network, graph, columns=3)
    structure, state = nnx.split(network)
    found = []
    for size, batch in [(size, 1) for size in choose.sizes] + [(POINTS, 256)]:
        some = [
            cloud[: size - 7] for cloud in np.resize(clouds, (batch, *clouds.shape[1:]))
        ]  # `choose` pads them to `size`
        taken = take_turns([partial(choose.of_many, some)], calls if batch == 1 else 5)[0]
        arguments = (state, jnp.zeros((batch, size, 3)))
        plan = jax.jit(lambda state, clouds: nnx.merge(structure, state)(clouds)).lower(*arguments).compile()
        memory = plan.memory_analysis()
        found.append(
            {
                "points": size,
                "batch": batch,
                "p50_ms": float(np.median(taken)),
                "p99_ms": float(np.quantile(taken, 0.99)),
                "memory_mb": (memory.argument_size_in_bytes + memory.temp_size_in_bytes) / 1e6
                if memory
                else float("nan"),
            }
        )
        print(markdown_row(decision_cells(found[-1])), flush=True)
    return found


def maxima(maps: int = 1000) -> dict[str, float]:
    """Time in microseconds to find the local maxima of a map of 40 views, alone and per map in a batch."""
    found = time_local_maxima(40, objects=maps)
    print(f"local maxima of 40 views: {1000 * found['alone']:.1f} µs alone, {1000 * found['batched']:.2f} µs of {maps}")
    return {name: 1000 * value for name, value in found.items()}


def decision_cells(row: dict[str, float]) -> list[str]:
    return [
        f"{row['points']:,.0f}",
        f"{row['batch']:.0f}",
        f"{row['p50_ms']:.3g}",
        f"{row['p99_ms']:.3g}",
        f"{row['p50_ms'] / row['batch']:.3g}",
        f"{row['memory_mb']:.0f}",
    ]


def main() -> None:
    guard = sys.argv[1:] == ["--guard"]
    rounds = 3 if guard else 15
    machine = machine_name()
    print(f"Measured on: {machine}. Milliseconds: median (quartiles).\n")
    print(markdown_table(HEADER, []))
    torch_peer: Any = import_module("benchmarks.torch_peer") if installed("torch") else None
    clouds = partial_clouds()
    rows = networks(clouds, torch_peer, rounds, not guard) + point_operations(clouds, torch_peer, rounds)
    if guard:
        end_by_guard(rows, RESULTS)
    found, of_maps = decisions(clouds), maxima()
    write_json(
        RESULTS,
        {"machine": machine, "rows": [asdict(row) for row in rows], "decisions": found, "local_maxima_us": of_maps},
    )
    timed = markdown_table(HEADER, [row_cells(row) for row in rows])
    decided = markdown_table(DECISION_HEADER, [decision_cells(row) for row in found])
    last = f"Local maxima of a map of 40 views: {of_maps['alone']:.0f} µs alone, {of_maps['batched']:.2f} µs as one of 1,000."
    write_text(
        RESULTS.with_suffix(".md"),
        f"{machine}. Milliseconds: median (quartiles).\n\n{timed}\n\n"
        f"One decision, cloud to next of 40 views:\n\n{decided}\n\n{last}\n",
    )


if __name__ == "__main__":
    main()
