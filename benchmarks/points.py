"""Point operations and PointNet++, compared with other implementations: `make bench`, or `python benchmarks/points.py`.

Farthest-point sampling and ball query of one cloud and of sixteen; PointNet++ on sixteen clouds of 4,096 points with the
same weights, and the matrix products of its forward pass alone; decisions. All results are compared before they are
timed. Calls take turns, except training steps, which need gigabytes that they would have to allocate again. The relevant
number is the ratio of the times. Peers that are not installed are left out with a message.

The table is written to `benchmarks/results/points.json` and `points.md`. With `--guard` nothing is written or trained,
and the exit code is 1 if a ratio is below a third of the stored one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx
from scipy.spatial import cKDTree

from benchmarks.comparing import (
    COMPARED,
    FLOOR,
    UNITS,
    TrainingStep,
    compare,
    end_by_guard,
    entropy_loss,
    forward_of,
    installed,
    take_turns,
    torch_peers,
)
from benchmarks.reporting import RESULTS, Row, Table, keep, machine_name
from eval.thesis.timing import time_local_maxima
from mevs_jax import (
    NextView,
    PointNet2,
    ViewGraph,
    ball_query,
    farthest_point_sample,
    fibonacci_sphere,
    pointnet2_from_torch,
)
from tests.reference import numpy_rules

PATH = RESULTS / "points.json"
CLOUDS, POINTS, CENTRES, RADIUS, SAMPLES = 16, 4096, 512, 0.2, 64
DECISIONS = Table(
    "points | clouds | p50, ms | p99, ms | ms a cloud | memory, MB",
    "{points:,} | {batch} | {p50_ms:.3g} | {p99_ms:.3g} | {ms_a_cloud:.3g} | {memory_mb:.0f}",
)


def partial_clouds(count: int = CLOUDS, points: int = POINTS) -> np.ndarray:
    """Partial clouds (count, points, 3) float32 of uneven spheres seen from above, in the unit sphere."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(count, points, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    directions[..., 2] = np.abs(directions[..., 2])
    return (directions * random.uniform(0.8, 0.97, (count, points, 1))).astype(np.float32)


def first_within(tree: cKDTree, centres: np.ndarray) -> np.ndarray:
    """Ball query by a k-d tree: the first hits in index order, padded with the first hit."""
    out = np.zeros((len(centres), SAMPLES), np.int32)
    for row, hits in enumerate(tree.query_ball_point(centres, np.nextafter(RADIUS, 0), return_sorted=True)):
        if hits:
            out[row] = hits[0]
            out[row, : len(hits[:SAMPLES])] = hits[:SAMPLES]
    return out


def equal(a: np.ndarray, b: np.ndarray, digits: int) -> str:
    return f"{np.mean(np.asarray(a) == np.asarray(b)):.{digits}%} of indices equal"


def farthest_points(cloud: np.ndarray, centres: int, name: str, rounds: int) -> Iterator[Row]:
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
        notes = {peer: equal(call(), chosen, 1) for peer, call in peers.items() if peer != "NumPy loop"}
    if installed("open3d"):
        import open3d

        theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud))
        peers["Open3D"] = lambda: theirs.farthest_point_down_sample(centres)
    np.testing.assert_array_equal(peers["NumPy loop"](), chosen)
    yield from compare(name, lambda: sample(cloud, centres), peers, rounds, notes)


def point_operations(clouds: np.ndarray, torch_peer: Any, rounds: int) -> Iterator[Row]:
    sample = partial(farthest_point_sample, k=CENTRES)
    sample_all = jax.jit(lambda clouds: jax.lax.map(sample, clouds, batch_size=4))
    query = jax.jit(lambda cloud, centres: ball_query(cloud, centres, RADIUS, SAMPLES))
    query_all = jax.jit(jax.vmap(query))
    cloud = clouds[0]
    chosen = np.asarray(sample_all(clouds))
    centres = np.take_along_axis(clouds, chosen[..., None], axis=1)
    neighbours = np.asarray(query_all(clouds, centres))
    yield from farthest_points(cloud, CENTRES, "farthest points, one cloud", rounds)
    yield from farthest_points(clouds[:4].reshape(-1, 3), 1024, "farthest points, one cloud of 16,384", rounds)

    def by_tree() -> np.ndarray:
        return first_within(cKDTree(cloud), centres[0])

    tree = "SciPy's k-d tree"
    np.testing.assert_array_equal(numpy_rules.ball_query(cloud, centres[0], RADIUS, SAMPLES), neighbours[0])
    notes = {tree: equal(by_tree(), neighbours[0], 2)}
    yield from compare("ball query, one cloud", lambda: query(cloud, centres[0]), {tree: by_tree}, rounds, notes)
    if torch_peer:
        sample_peer = torch_peer.call(torch_peer.farthest_point_sample, clouds, k=CENTRES)
        query_peer = torch_peer.call(torch_peer.ball_query, clouds, centres, radius=RADIUS, k=SAMPLES)
        np.testing.assert_array_equal(torch_peer.array(sample_peer()), chosen)
        peers = {"PyTorch": sample_peer}
        yield from compare("farthest points, 16 clouds", lambda: sample_all(clouds), peers, rounds)
        notes, peers = {"PyTorch": equal(torch_peer.array(query_peer()), neighbours, 3)}, {"PyTorch": query_peer}
        few = max(3, rounds // 3)
        yield from compare("ball query, 16 clouds", lambda: query_all(clouds, centres), peers, few, notes)


def matrix_products(network: PointNet2) -> Callable[[], jax.Array]:
    """Only the matrix products and maxima of the forward pass, on prepared arrays in cache-sized pieces."""
    random = np.random.default_rng(0)
    perceptrons = (*network.perceptrons, network.whole)
    kernels = [[layer.kernel[...] for layer in perceptron.linear] for perceptron in perceptrons]
    sizes, groups = ((8, 4096), (2, 4096), (1, 128)), (64, 64, 128)
    arrays = [
        jnp.asarray(random.normal(size=(*size, first.shape[0])), jnp.float32)
        for size, (first, *_) in zip(sizes, kernels, strict=True)
    ]

    def largest(x: jax.Array, kernels: list[jax.Array], group: int) -> jax.Array:
        for kernel in kernels:
            x = x @ kernel
        return jnp.max(x.reshape(-1, group, x.shape[-1]), axis=1)

    @jax.jit
    def products(arrays, kernels, shifts):
        def cloud(shift):
            calls = [partial(largest, kernels=some, group=group) for some, group in zip(kernels, groups, strict=True)]
            return sum(jnp.sum(jax.lax.map(call, x + shift)) for call, x in zip(calls, arrays, strict=True))

        return jax.lax.map(cloud, shifts)

    return partial(products, arrays, kernels, jnp.arange(CLOUDS, dtype=jnp.float32))


def networks(clouds: np.ndarray, torch_peer: Any, rounds: int, training: bool) -> Iterator[Row]:
    network = PointNet2(views=40, dropout=0.0, rngs=nnx.Rngs(0))
    targets = np.random.default_rng(1).uniform(0, 1, (CLOUDS, 40)).astype(np.float32)
    if torch_peer:
        weights, forward_peer, train_peer = torch_peer.pointnet2(clouds, targets)
        pointnet2_from_torch(network, weights)
    forward = jax.jit(forward_of(network))
    peers: dict[str, Callable] = {}
    notes: dict[str, str] = {}
    if torch_peer:
        largest = float(np.abs(np.asarray(forward(clouds)) - torch_peer.array(forward_peer())).max())
        assert largest < 1e-3
        peers["PyTorch"], notes["PyTorch"] = forward_peer, f"outputs equal to {largest:.0e}"
    if torch_peer and training:
        step, shown, wanted = TrainingStep(network, entropy_loss), jnp.asarray(clouds), jnp.asarray(targets)
        apart = abs(float(step(shown, wanted)) / train_peer().item() - 1)
        assert apart < 1e-3
        yield from compare(
            "PointNet++ training step, 16 clouds",
            lambda: step(shown, wanted),
            {"PyTorch": train_peer},
            max(3, rounds // 4),
            {"PyTorch": f"first loss equal to {apart:.0e}"},
            turns=False,
        )
    peers[FLOOR] = matrix_products(network)
    yield from compare("PointNet++ forward, 16 clouds", lambda: forward(clouds), peers, max(3, rounds // 2), notes)


def decisions(clouds: np.ndarray, calls: int = 200) -> Iterator[Row]:
    """Time from clouds to the next of 40 views: single clouds by size, as on a robot, and 256 clouds of 4,096 points."""
    network = PointNet2(views=40, rngs=nnx.Rngs(0))
    choose = NextView(network, ViewGraph.from_points(fibonacci_sphere(40)), columns=3)
    structure, state = nnx.split(network)
    for size, batch in [(size, 1) for size in choose.sizes] + [(POINTS, 256)]:
        some = [cloud[: size - 7] for cloud in np.resize(clouds, (batch, *clouds.shape[1:]))]  # padded to `size`
        p50, p99 = np.quantile(take_turns([partial(choose.of_many, some)], calls if batch == 1 else 5), (0.5, 0.99))
        arguments = (state, jnp.zeros((batch, size, 3)))
        plan = jax.jit(lambda state, clouds: nnx.merge(structure, state)(clouds)).lower(*arguments).compile()
        memory = plan.memory_analysis()
        used = memory.argument_size_in_bytes + memory.temp_size_in_bytes if memory else np.nan
        row = {"points": size, "batch": batch, "p50_ms": float(p50), "p99_ms": float(p99), "memory_mb": used / 1e6}
        yield row | {"ms_a_cloud": row["p50_ms"] / batch}


def main(guard: bool = False) -> None:
    """Measures, shows and keeps.

    Args:
        guard: compare ratios with the stored ones.
    """
    rounds = 3 if guard else 15
    print(f"Measured on: {machine_name()}. {UNITS}")
    torch_peer, clouds = torch_peers(), partial_clouds()
    rows = COMPARED.show(networks(clouds, torch_peer, rounds, not guard))
    rows += COMPARED.show(point_operations(clouds, torch_peer, rounds))
    if guard:
        end_by_guard(rows, PATH)
    decided = DECISIONS.show(decisions(clouds))
    maxima = {name: 1000 * taken for name, taken in vars(time_local_maxima(40, objects=1000)).items()}
    last = f"Local maxima of a map of 40 views: {maxima['alone']:.0f} µs alone, {maxima['batched']:.2f} µs as one of 1,000."
    print(last)
    parts = (
        UNITS,
        COMPARED.markdown(rows),
        "One decision, cloud to next of 40 views:",
        DECISIONS.markdown(decided),
        last,
    )
    keep(PATH, {"rows": rows, "decisions": decided, "local_maxima_us": maxima}, *parts)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
