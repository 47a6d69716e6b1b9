"""Everything that is worth measuring on one accelerator, in ten minutes: `python benchmarks/accelerator.py`.

Results are checked first: against plain NumPy rules, or against the same program on the CPU of the machine. Then rates are
measured, from single calls of a robot to full batches: point operations, PointNet++, ResNet-18, rendering, decisions, the
thesis's whole evaluation, and four networks trained at once and in turn. A measurement that fails is a row that says why; the
others go on. The table is printed and written to `benchmarks/results/accelerator.json` and `accelerator.md`.

`--quick` uses small sizes, to try the script where there is no accelerator, and writes to the folder that it names.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for a copy that is not installed

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx

from benchmarks import members
from benchmarks.capture import depths, rig_of, share_equal, wobbly_ball
from benchmarks.comparing import TrainingStep, classification_loss, entropy_loss, forward_of, take_turns
from benchmarks.evaluation import VIEWS, made_up_tables, whole_grid
from benchmarks.points import partial_clouds
from benchmarks.reporting import RESULTS, Row, Table, keep, machine_name
from data_pipeline.capture.casting import capture
from data_pipeline.dataset.builder import prepare
from eval.settings import SMALL
from mevs_jax import NextView, PointNet2, ResNet, ViewGraph, ball_query, farthest_point_sample, fibonacci_sphere
from mevs_jax.rendering import pad_triangles
from tests.reference import numpy_rules

TABLE = Table(
    "what | value | unit | target | ",
    "{what} | {value:,.4g} | {unit} | {target} | {note}",
)
TYPES = (jnp.dtype(jnp.float32), jnp.dtype(jnp.bfloat16))


def row_of(what: str, value: float, unit: str, note: str, target: str = "") -> Row:
    """A measurement: its target says what would be good, its note has further numbers, or why there is no value."""
    return {"what": what, "value": value, "unit": unit, "target": target, "note": note}


@dataclass(frozen=True)
class Sizes:
    """How much is measured: clouds in a large batch, images in a batch by their size in pixels, calls that are timed (`rounds`),
    and objects and seeds of the evaluation.
    """

    clouds: int
    images: dict[int, int]
    seeds: int
    rounds: int
    objects: int


FULL = Sizes(1024, {64: 1024, 224: 256}, 10, 20, 908)
QUICK = Sizes(8, {64: 8}, 2, 2, 20)


def timed(what: str, call: Callable[[], Any], rounds: int, note: str = "", target: str = "") -> Row:
    """Milliseconds of a call."""
    low, median, high = np.quantile(take_turns([call], rounds)[0], [0.25, 0.5, 0.75])
    notes = "; ".join(filter(None, (f"quartiles {low:.3g}, {high:.3g} ms", note)))
    return row_of(what, float(median), "ms", notes, target)


def rate(
    what: str, call: Callable[[], Any], count: int, unit: str, sizes: Sizes, note: str = "", target: str = ""
) -> Row:
    """Things a second, where a call handles `count` of them."""
    row = timed(what, call, sizes.rounds, note, target)
    notes = f"{row['value']:.3g} ms a call; {row['note']}"
    return row | {"value": 1000 * count / row["value"], "unit": f"{unit}/s", "note": notes}


def on_cpu(call: Callable[..., Any], *arguments: Any) -> np.ndarray:
    """The result of the same program on the CPU."""
    with jax.default_device(jax.devices("cpu")[0]):
        return np.asarray(jax.jit(call)(*jax.tree.map(np.asarray, arguments)))


def apart(found: Any, expected: Any) -> float:
    """The largest difference, relative to the largest value."""
    found, expected = np.asarray(found, np.float32), np.asarray(expected, np.float32)
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def point_operations(sizes: Sizes) -> Iterator[Row]:
    for points, k, target in ((4096, 512, "≤ 0.6"), (16384, 1024, "")):
        cloud = partial_clouds(1, points)[0]
        sample = jax.jit(partial(farthest_point_sample, k=k))
        same = _equal(sample(cloud), numpy_rules.farthest_point_sample(cloud, k))
        call = partial(sample, jnp.asarray(cloud))
        yield timed(f"farthest points, {points} to {k}", call, sizes.rounds, same, target)
    clouds = partial_clouds(sizes.clouds, 4096)
    sample_all = jax.jit(jax.vmap(partial(farthest_point_sample, k=512)))
    chosen = np.asarray(sample_all(clouds))
    yield rate("farthest points, a batch", partial(sample_all, jnp.asarray(clouds)), len(clouds), "clouds", sizes)
    centres = np.take_along_axis(clouds, chosen[..., None], axis=1)
    query = jax.jit(jax.vmap(partial(ball_query, radius=0.2, k=64)))
    same = _equal(query(clouds, centres)[0], numpy_rules.ball_query(clouds[0], centres[0], 0.2, 64))
    call = partial(query, jnp.asarray(clouds), jnp.asarray(centres))
    yield rate("ball query, a batch", call, len(clouds), "clouds", sizes, same)


def _equal(indices: Any, expected: np.ndarray) -> str:
    return f"indices {'equal to' if np.array_equal(indices, expected) else 'DIFFER from'} the plain rule's"


def pointnet(sizes: Sizes) -> Iterator[Row]:
    for dtype in TYPES:
        name, one = dtype.name, jnp.asarray(partial_clouds(1, 4096))
        network = PointNet2(views=VIEWS, dropout=0.0, rngs=nnx.Rngs(0), dtype=dtype)
        forward = jax.jit(forward_of(network))
        few = partial_clouds(4, 4096)
        difference = apart(forward(few), on_cpu(forward_of(network), few))
        what, note = f"PointNet++ forward, 1 clouds of 4,096, {name}", f"{difference:.0e} apart from the CPU"
        yield timed(what, partial(forward, one), sizes.rounds, note, "≤ 1.0")
        count, target = sizes.clouds, "≥ 20,000" if name == "bfloat16" else ""
        call = partial(forward, jnp.asarray(partial_clouds(count, 4096)))
        yield rate(f"PointNet++ forward, {count} clouds of 4,096, {name}", call, count, "clouds", sizes, target=target)
        count = min(count, 64)
        clouds, wanted = jnp.asarray(partial_clouds(count, 4096)), jnp.zeros((count, VIEWS))
        call = partial(TrainingStep(network, entropy_loss), clouds, wanted)
        yield rate(f"PointNet++ training step, {count} clouds, {name}", call, count, "clouds", sizes)


def resnet(sizes: Sizes) -> Iterator[Row]:
    random = np.random.default_rng(0)
    for dtype in TYPES:
        network = ResNet(rngs=nnx.Rngs(0), dtype=dtype)
        forward = jax.jit(forward_of(network))
        for side, count in sizes.images.items():
            images = random.uniform(size=(count, side, side, 3)).astype(np.float32)
            note = f"{apart(forward(images[:4]), on_cpu(forward_of(network), images[:4])):.0e} apart from the CPU"
            shown, labels = jnp.asarray(images), jnp.asarray(random.integers(0, 10, count))
            what = f"{count} images of {side}×{side}, {dtype.name}"
            yield rate(f"ResNet-18 forward, {what}", partial(forward, shown), count, "images", sizes, note)
            step = partial(TrainingStep(network, classification_loss), shown, labels)
            yield rate(f"ResNet-18 training step, {what}", step, count, "images", sizes)


def rendering(sizes: Sizes) -> Iterator[Row]:
    for faces, subdivisions in (("320", 2), ("5,120", 4)):
        mesh = wobbly_ball(subdivisions)
        triangles = jnp.asarray(pad_triangles(mesh.vertices[mesh.faces]))
        for side in sizes.images:
            rig = rig_of(side)
            call = partial(depths, triangles, jnp.asarray(rig.poses), side)
            note = f"{share_equal(call(), capture(mesh, rig).depth):.2%} of pixels equal to ray casting's"
            what, target = f"depth views of {faces} faces, {side}×{side}", "≥ 5,000" if side == 224 else ""
            yield rate(what, call, VIEWS, "views", sizes, note, target)


def decisions(sizes: Sizes) -> Iterator[Row]:
    graph = ViewGraph.from_points(fibonacci_sphere(VIEWS))
    choose = NextView(PointNet2(views=VIEWS, rngs=nnx.Rngs(0)), graph, columns=3)
    call = partial(choose.of_many, [partial_clouds(1, 4096)[0]])
    yield timed("decision, cloud in memory of the host to next view", call, 10 * sizes.rounds)


def evaluation(sizes: Sizes) -> Iterator[Row]:
    tables = jax.tree.map(lambda leaf: leaf[: sizes.objects], made_up_tables())

    def whole() -> Any:
        return [whole_grid(tables, seed) for seed in range(sizes.seeds)]

    what = f"the thesis's evaluation of {sizes.objects} objects, {sizes.seeds} seeds"
    row = timed(what, whole, max(2, sizes.rounds // 4), target="≤ 2")
    yield row | {"value": row["value"] / 1000, "unit": "s"}


def several_seeds(sizes: Sizes) -> Iterator[Row]:
    """Steps of four networks at once, relative to in turn."""
    with TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        prepare(replace(SMALL.dataset, train_per_class=members.OBJECTS, test_per_class=2), data)
        tasks = members.networks(data)
        for name in ("PointNet++, tiny",) if sizes is QUICK else ("ResNet-18, small", "PointNet++, small"):
            taken = members.compare(tasks[name], data, Path(folder) / name)
            what = f"four seeds of {name}: time of a step in turn, divided by that at once"
            ratio, note = taken["step in turn"] / taken["step at once"], f"{1000 * taken['step at once']:.3g} ms"
            yield row_of(what, ratio, "×", note)


MEASUREMENTS = (point_operations, pointnet, resnet, rendering, decisions, evaluation, several_seeds)


def measured(sizes: Sizes) -> Iterator[Row]:
    """All rows; a measurement that fails is a row that says why."""
    for measure in MEASUREMENTS:
        begun = time.perf_counter()
        try:
            yield from measure(sizes)
        except Exception as error:
            yield row_of(measure.__name__.replace("_", " "), np.nan, "", f"FAILED: {error!r}"[:300])
        print(f"({measure.__name__.replace('_', ' ')}: {time.perf_counter() - begun:.0f} s)", file=sys.stderr)


def main(quick: Path | None = None) -> None:
    """Measures, shows and keeps.

    Args:
        quick: small sizes; write to this folder.
    """
    print(machine_name())
    rows = TABLE.show(measured(QUICK if quick else FULL))
    stored = [row | {"value": None} if np.isnan(row["value"]) else row for row in rows]
    keep((quick or RESULTS) / "accelerator.json", {"rows": stored}, "", TABLE.markdown(rows))
    sys.exit(any(np.isnan(row["value"]) or "DIFFER" in row["note"] for row in rows))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
