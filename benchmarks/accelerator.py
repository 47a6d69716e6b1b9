"""Everything that is worth measuring on one accelerator, in ten minutes: `python benchmarks/accelerator.py`.

Results are checked first: against plain NumPy rules, or against the same program on the CPU of the machine. Then rates are
measured, from single calls of a robot to full batches: point operations, PointNet++, ResNet-18, rendering, decisions, the
thesis's whole evaluation, and four networks trained at once and in turn. A measurement that fails is a row that says why; the
others go on. The table is printed and written to `benchmarks/results/accelerator.json` and `accelerator.md`.

`--quick` uses small sizes, to try the script where there is no accelerator, and writes to the folder that it names.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from benchmarks import members
from benchmarks.capture import depths, wobbly_ball
from benchmarks.comparing import classification_loss, forward_of, machine_name, take_turns, training_step
from benchmarks.evaluation import BACKBONES, CLASSES, COMPARED, VIEWS, made_up_tables
from data_pipeline.capture.casting import CaptureConfig, capture, rig_for
from data_pipeline.dataset.builder import prepare
from data_pipeline.files import write_json, write_text
from eval.settings import SMALL
from eval.walks.grid import LAST_MV, run_grid
from mevs_jax import (
    Knowledge,
    NextView,
    PointNet2,
    ResNet,
    ViewGraph,
    ball_query,
    farthest_point_sample,
    fibonacci_sphere,
)
from mevs_jax.markdown import markdown_row, markdown_table
from mevs_jax.rendering import pad_triangles
from tests.reference import numpy_rules

RESULTS = Path(__file__).parent / "results"
HEADER = ("what", "value", "unit", "target", "")
TYPES = (jnp.dtype(jnp.float32), jnp.dtype(jnp.bfloat16))


@dataclass
class Row:
    """A measurement.

    Attributes:
        what: its name.
        value: its result.
        unit: of the value.
        target: what would be good, or nothing.
        note: further numbers, or why there is no value.
    """

    what: str
    value: float
    unit: str
    target: str = ""
    note: str = ""

    def cells(self) -> list[str]:
        return [self.what, f"{self.value:,.4g}", self.unit, self.target, self.note]


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        clouds: in a large batch.
        images: in a batch of images, by their size in pixels.
        seeds: of the evaluation.
        rounds: calls that are timed.
        objects: of the evaluation.
    """

    clouds: int
    images: dict[int, int]
    seeds: int
    rounds: int
    objects: int


FULL = Sizes(1024, {64: 1024, 224: 256}, 10, 20, 908)
QUICK = Sizes(8, {64: 8}, 2, 2, 20)


def milliseconds(call: Callable[[], Any], rounds: int) -> tuple[float, str]:
    """Median time of a call after a warm-up, and a note of its quartiles."""
    low, median, high = np.quantile(take_turns([call], rounds)[0], [0.25, 0.5, 0.75])
    return float(median), f"quartiles {low:.3g}, {high:.3g} ms"


def rate(what: str, call: Callable[[], Any], count: int, unit: str, sizes: Sizes, target: str = "") -> Row:
    """Things a second, where a call handles `count` of them."""
    taken, note = milliseconds(call, sizes.rounds)
    return Row(what, 1000 * count / taken, f"{unit}/s", target, f"{taken:.3g} ms a call; {note}")


def clouds_of(count: int, points: int) -> np.ndarray:
    """Partial clouds (count, points, 3) on the unit sphere's upper half."""
    found = np.random.default_rng(0).normal(size=(count, points, 3)).astype(np.float32)
    found[..., 2] = np.abs(found[..., 2])
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def on_cpu(call: Callable[..., Any], *arguments: Any) -> np.ndarray:
    """The result of the same program on the CPU."""
    with jax.default_device(jax.devices("cpu")[0]):
        return np.asarray(jax.jit(call)(*jax.tree.map(np.asarray, arguments)))


def apart(found: Any, expected: Any) -> float:
    """The largest difference, relative to the largest value."""
    found, expected = np.asarray(found, np.float32), np.asarray(expected, np.float32)
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def point_operations(sizes: Sizes) -> Iterator[Row]:
    for points, k in ((4096, 512), (16384, 1024)):
        cloud = clouds_of(1, points)[0]
        sample = jax.jit(partial(farthest_point_sample, k=k))
        right = np.array_equal(sample(cloud), numpy_rules.farthest_point_sample(cloud, k))
        taken, note = milliseconds(partial(sample, jnp.asarray(cloud)), sizes.rounds)
        target = "≤ 0.6" if points == 4096 else ""
        yield Row(f"farthest points, {points} to {k}", taken, "ms", target, f"{note}; indices {_equal(right)}")
    clouds = clouds_of(sizes.clouds, 4096)
    sample_all = jax.jit(jax.vmap(partial(farthest_point_sample, k=512)))
    chosen = np.asarray(sample_all(clouds))
    yield rate("farthest points, a batch", partial(sample_all, jnp.asarray(clouds)), len(clouds), "clouds", sizes)
    centres = np.take_along_axis(clouds, chosen[..., None], axis=1)
    query = jax.jit(jax.vmap(partial(ball_query, radius=0.2, k=64)))
    right = np.array_equal(query(clouds, centres)[0], numpy_rules.ball_query(clouds[0], centres[0], 0.2, 64))
    row = rate(
        "ball query, a batch", partial(query, *map(jnp.asarray, (clouds, centres))), len(clouds), "clouds", sizes
    )
    yield replace(row, note=f"{row.note}; indices {_equal(right)}")


def _equal(right: bool) -> str:
    return "equal to the plain rule's" if right else "DIFFER from the plain rule's"


def pointnet(sizes: Sizes) -> Iterator[Row]:
    for dtype in TYPES:
        name = dtype.name
        network = PointNet2(views=VIEWS, dropout=0.0, rngs=nnx.Rngs(0), dtype=dtype)
        forward = forward_of(network)
        few = clouds_of(4, 4096)
        difference = apart(jax.jit(forward)(few), on_cpu(forward, few))
        for count in (1, sizes.clouds):
            clouds = jnp.asarray(clouds_of(count, 4096))
            what = f"PointNet++ forward, {count} clouds of 4,096, {name}"
            if count == 1:
                taken, note = milliseconds(partial(jax.jit(forward), clouds), sizes.rounds)
                yield Row(what, taken, "ms", "≤ 1.0", f"{note}; {difference:.0e} apart from the CPU")
            else:
                target = "≥ 20,000" if dtype == jnp.dtype(jnp.bfloat16) else ""
                yield rate(what, partial(jax.jit(forward), clouds), count, "clouds", sizes, target)
        count = min(sizes.clouds, 64)
        clouds, wanted = jnp.asarray(clouds_of(count, 4096)), jnp.zeros((count, VIEWS))
        step = training_step(
            network, lambda network, x, y: jnp.mean((network(x, train=True, key=jax.random.key(0)) - y) ** 2)
        )
        yield rate(
            f"PointNet++ training step, {count} clouds, {name}", partial(step, clouds, wanted), count, "clouds", sizes
        )


def resnet(sizes: Sizes) -> Iterator[Row]:
    random = np.random.default_rng(0)
    for dtype in TYPES:
        name = dtype.name
        network = ResNet(rngs=nnx.Rngs(0), dtype=dtype)
        forward = forward_of(network)
        for side, count in sizes.images.items():
            images = random.uniform(size=(count, side, side, 3)).astype(np.float32)
            difference = apart(jax.jit(forward)(images[:4]), on_cpu(forward, images[:4]))
            shown, labels = jnp.asarray(images), jnp.asarray(random.integers(0, 10, count))
            what = f"{count} images of {side}×{side}, {name}"
            row = rate(f"ResNet-18 forward, {what}", partial(jax.jit(forward), shown), count, "images", sizes)
            yield replace(row, note=f"{row.note}; {difference:.0e} apart from the CPU")
            step = training_step(network, classification_loss)
            yield rate(f"ResNet-18 training step, {what}", partial(step, shown, labels), count, "images", sizes)


def rendering(sizes: Sizes) -> Iterator[Row]:
    for faces, subdivisions in (("320", 2), ("5,120", 4)):
        mesh = wobbly_ball(subdivisions)
        triangles = jnp.asarray(pad_triangles(mesh.vertices[mesh.faces]))
        for side in sizes.images:
            rig = rig_for(CaptureConfig(views=VIEWS, resolution=side))
            poses = jnp.asarray(rig.poses)
            ours = np.asarray(depths(triangles, poses, side))
            same = np.abs(np.where(np.isfinite(ours), ours, 0) * 10_000 - capture(mesh, rig).depth) < 5
            target = "≥ 5,000" if side == 224 else ""
            call = partial(depths, triangles, poses, side)
            row = rate(f"depth views of {faces} faces, {side}×{side}", call, VIEWS, "views", sizes, target)
            yield replace(row, note=f"{row.note}; {same.mean():.2%} of pixels equal to ray casting's")


def decisions(sizes: Sizes) -> Iterator[Row]:
    choose = NextView(
        PointNet2(views=VIEWS, rngs=nnx.Rngs(0)), ViewGraph.from_points(fibonacci_sphere(VIEWS)), columns=3
    )
    cloud = [clouds_of(1, 4096)[0]]
    taken, note = milliseconds(partial(choose.of_many, cloud), 10 * sizes.rounds)
    yield Row("decision, cloud in memory of the host to next view", taken, "ms", "", note)


def evaluation(sizes: Sizes) -> Iterator[Row]:
    tables = jax.tree.map(lambda leaf: leaf[: sizes.objects], made_up_tables())
    graph = ViewGraph.from_points(fibonacci_sphere(VIEWS))
    nothing = Knowledge(jnp.zeros((BACKBONES, VIEWS)), jnp.zeros((BACKBONES, CLASSES, VIEWS, CLASSES)))

    def whole() -> Any:
        return [
            run_grid(jax.random.key(seed), tables, graph, nothing, COMPARED, max_views=LAST_MV)
            for seed in range(sizes.seeds)
        ]

    taken, note = milliseconds(whole, max(2, sizes.rounds // 4))
    yield Row(
        f"the thesis's evaluation of {sizes.objects} objects, {sizes.seeds} seeds", taken / 1000, "s", "≤ 2", note
    )


def several_seeds(sizes: Sizes) -> Iterator[Row]:
    """Steps of four networks at once, relative to in turn."""
    with TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        prepare(replace(SMALL.dataset, train_per_class=members.OBJECTS, test_per_class=2), data)
        tasks = members.networks(data)
        for name in ("PointNet++, tiny",) if sizes is QUICK else ("ResNet-18, small", "PointNet++, small"):
            found = members.compare(tasks[name], data, Path(folder) / name)
            ratio, steps = found["step in turn"] / found["step at once"], found["step at once"]
            yield Row(
                f"four seeds of {name}: time of a step in turn, divided by that at once",
                ratio,
                "×",
                "",
                f"{1000 * steps:.3g} ms",
            )


MEASUREMENTS = (point_operations, pointnet, resnet, rendering, decisions, evaluation, several_seeds)


def measured(sizes: Sizes) -> Iterator[Row]:
    """All rows; a measurement that fails is a row that says why."""
    for measure in MEASUREMENTS:
        begun = time.perf_counter()
        try:
            yield from measure(sizes)
        except Exception as error:
            yield Row(measure.__name__.replace("_", " "), float("nan"), "", "", f"FAILED: {error!r}"[:300])
        print(f"({measure.__name__.replace('_', ' ')}: {time.perf_counter() - begun:.0f} s)", file=sys.stderr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", type=Path, help="small sizes; write to this folder")
    folder = parser.parse_args().quick
    machine, rows = machine_name(), []
    print(f"{machine}\n\n{markdown_table(HEADER, [])}")
    for row in measured(QUICK if folder else FULL):
        rows.append(row)
        print(markdown_row(row.cells()), flush=True)
    path = (folder or RESULTS) / "accelerator.json"
    write_json(path, {"machine": machine, "rows": [asdict(row) for row in rows]})
    write_text(path.with_suffix(".md"), f"{machine}.\n\n{markdown_table(HEADER, [row.cells() for row in rows])}\n")
    sys.exit(any(row.value != row.value or "DIFFER" in row.note for row in rows))


if __name__ == "__main__":
    main()
