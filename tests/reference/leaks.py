"""Other test objects in place of a data set's own, and what was fitted compared bit by bit: what tests of leaks share.

Whatever is fitted, chosen or learned must be the same whatever the test objects are. Each test makes everything twice or more:
with some test objects, and with others in their place. Walks and networks that take long to compute are replaced by random ones
whose seed is a hash of all that they are given, so that whatever leaks into them changes everything that follows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import data_pipeline.dataset.builder as builder
import eval.numbers.comparison as comparison
from data_pipeline.dataset.config import DataConfig
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.objects.mesh import ObjectEntry, ObjectSource
from data_pipeline.objects.recipes import FurniturePiece
from eval.learned.walks import OnLattice
from eval.settings import TINY
from eval.tables import ViewTables
from eval.walks.grid import Results, of_backbones, read_object
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import as_tree
from mevs_jax.policies.registry import PolicyRecord
from mevs_jax.selection.loop import ViewTable

Network = TypeVar("Network", bound=nnx.Module)

_SLOWLY = replace(TINY.learned.recogniser.optimiser, learning_rate=1e-4)
LEARNED = replace(
    TINY,
    learned=replace(
        TINY.learned,
        seeds=2,
        recogniser=replace(TINY.learned.recogniser, optimiser=_SLOWLY),
        ablations=("crossed", "cloud", "summed"),
    ),
)
"""A run with a learned study that is compared with others. Its recognisers learn slowly, so that rounding changes little."""
CHANGES = ("labels", "outputs")
"""What is changed about test objects: all of their labels, or everything that networks say about them."""


def other_labels(labels: np.ndarray, classes: int) -> np.ndarray:
    """The next label in place of each; the last and the first become one, so that classes have other numbers of objects."""
    return np.where(labels == classes - 1, 1, labels + 1).astype(labels.dtype)


def other_tables(tables: ViewTables, change: str | None) -> ViewTables:
    """View tables of other test objects: None for the same."""
    if change is None:
        return tables
    if change == "labels":
        return replace(tables, labels=other_labels(tables.labels, tables.logits.shape[-1]))
    random = np.random.default_rng(99)
    shapes = {name: getattr(tables, name).shape for name in ("predicted_entropy", "entropy")}
    changed = {name: random.uniform(0, 1, shape).astype(np.float32) for name, shape in shapes.items()}
    return replace(tables, logits=random.normal(0, 3, tables.logits.shape).astype(np.float32), **changed)


@contextmanager
def other_test_objects() -> Iterator[None]:
    """Data sets that are made within have other test objects: two of every second class, and none of the others."""
    opened = builder.open_objects

    def open_objects(config: DataConfig) -> ObjectSource:
        source = opened(config)
        entries = [entry for entry in source.entries if entry.split != "test"]
        for label in range(1, len(source.classes), 2):
            for seed in range(2):
                piece = FurniturePiece(source.classes[label - 1], 5_000_000 + seed)
                entries.append(ObjectEntry(f"other_{label}_{seed}", label, "test", piece))
        return replace(source, entries=tuple(entries))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(builder, "open_objects", open_objects)
        yield


def other_statistics(statistics: DatasetStatistics) -> DatasetStatistics:
    """Statistics of a data set with other test objects: all that they say about these is changed."""
    counts = {name: 3 + 7 * number for number, name in enumerate(statistics.classes)}
    return replace(
        statistics,
        counts=statistics.counts | {"test": counts},
        entropy_histograms=statistics.entropy_histograms | {"test": list(range(50))},
    )


def bits(tree: Any) -> dict[str, Any]:
    """Every array and number of a tree by its place, so that equal ones are equal to the last bit."""
    found = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        place = jax.tree_util.keystr(path)
        if isinstance(leaf, np.ndarray | np.generic | jax.Array):
            array = np.asarray(leaf)
            found[place] = array.dtype, array.shape, array.tobytes()
        else:
            found[place] = repr(leaf)
    return found


def differing(one: Any, other: Any) -> list[str]:
    """The places at which two trees differ."""
    before, after = bits(one), bits(other)
    return [place for place in sorted({*before, *after}) if before.get(place) != after.get(place)]


def check_fitted(one: Any, other: Any) -> None:
    """Fails if what was fitted differs between runs with different test objects."""
    assert bits(one), "nothing is compared"
    places = differing(one, other)
    assert not places, f"fitted on test objects: {', '.join(places[:8])}{' …' * (len(places) > 8)}"


def check_tested(one: Any, other: Any) -> None:
    """Fails if a result on test objects does not differ between runs with different ones: nothing would have been changed."""
    places = {*bits(one)} - {*differing(one, other)}
    assert not places, f"the same for other test objects: {', '.join(sorted(places))}"


def seed_of(tree: Any) -> int:
    """A hash of all of a tree."""
    seed = 0
    for place, content in sorted(bits(tree).items()):
        for part in (place, *(map(str, content[:-1]) if isinstance(content, tuple) else (content,))):
            seed = crc32(part.encode(), seed)
        seed = crc32(content[-1], seed) if isinstance(content, tuple) else seed
    return seed


def filled(network: Network, seed: int) -> Network:
    """A network of the same structure, with random weights that the seed decides."""
    structure, weights, rest = nnx.split(network, nnx.Param, ...)
    random = np.random.default_rng(seed)
    drawn = jax.tree.map(lambda leaf: random.normal(0, 0.1, leaf.shape).astype(leaf.dtype), weights)
    return nnx.merge(structure, drawn, rest)


def without_bootstrap(patch: pytest.MonkeyPatch) -> None:
    """Replaces 95 % intervals, which take long, by two means."""
    patch.setattr(comparison, "_intervals", lambda values: np.repeat(np.mean(values, axis=-1)[..., None], 2, axis=-1))


def some_walks(
    seed: int, objects: int, starts: Sequence[int], views: int, steps: int, second: int | None = None
) -> np.ndarray:
    """Random walks (objects, starts, steps) from the start views, without repetition; their second view may be given."""
    scores = np.random.default_rng(seed).random((objects, len(starts), views))
    if second is not None:
        scores[..., second] = -0.5
    np.put_along_axis(scores, np.broadcast_to(np.array(starts)[:, None], (objects, len(starts), 1)), -1, axis=-1)
    return scores.argsort(axis=-1)[..., :steps].astype(np.int32)


def _given(tables: ViewTable, knows_the_truth: bool) -> ViewTable:
    """What a policy is given; most are not given the label."""
    return tables if knows_the_truth else replace(tables, label=jnp.zeros_like(tables.label))


@jax.jit
def _read(tables: ViewTable, distances: jax.Array, views: jax.Array) -> tuple[jax.Array, ...]:
    weights = jnp.full(views.shape[2], 1 / views.shape[2])
    of_backbones = jax.vmap(read_object, (0, None, None, 0, None))
    of_objects = jax.vmap(of_backbones, (0, 0, None, 1, None), 1)
    return of_objects(tables.logits, tables.label, distances, views.swapaxes(-1, -2), weights)


def walk_grid_anyhow(
    key: jax.Array,
    tables: ViewTable,
    graph: ViewGraph,
    knowledge: Any,
    policies: Sequence[PolicyRecord],
    second: Mapping[str, int] | None = None,
    **rest: Any,
) -> dict[str, Results]:
    """In place of `run_grid`: the results of random walks, which depend on everything but the labels.

    Args:
        second: the second view of all walks of some policies; what else they see is random, too.
    """
    shown, found = of_backbones(tables), {}
    objects, backbones, views, _ = shown.logits.shape
    for policy in policies:
        given = _given(tables, policy.knows == "truth"), graph, knowledge, policy.name, sorted(rest.items())
        seed = seed_of((jax.random.key_data(key), given))
        planted = (second or {}).get(policy.name)
        one = some_walks(seed, objects * backbones, range(views), views, rest["max_views"], planted)
        walks = jnp.asarray(one.reshape(backbones, objects, views, -1))
        found[policy.name] = Results(*_read(shown, graph.distances, walks), walks[:, :, :, None])
    return found


def walk_all_anyhow(
    key: jax.Array,
    policy: PolicyRecord,
    fusion: Any,
    lattice: OnLattice,
    knowledge: Any,
    *,
    max_views: int,
    draws: int = 1,
    every: int = 1,
) -> np.ndarray:
    """In place of `eval.learned.walks.walk_all`: random walks, which depend on everything but the labels."""
    tables, directions = lattice.table(policy.needs), lattice.features.directions
    parameters = jax.tree.leaves(as_tree(policy.score))
    if not policy.needs & {"order", "expected_views"}:
        knowledge = None
    given = _given(tables, policy.knows == "truth"), parameters, fusion, directions, knowledge, lattice.neighbours
    seed = seed_of((jax.random.key_data(key), policy.name, max_views, given))
    objects, views, _ = directions.shape
    starts = np.repeat(np.arange(0, views, every), policy.draws(draws))
    return some_walks(seed, objects, starts, views, max_views)
