"""Strangers: shapes that are none of the ten classes, each kind in one split."""

import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.capture.workers import capture_path
from data_pipeline.dataset.config import DataConfig
from data_pipeline.dataset.origin import open_objects
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import MODELNET10_CLASSES, UNKNOWN_OBJECT, ObjectEntry, normalise
from data_pipeline.objects.names import plain_class
from data_pipeline.objects.recipes import FamilyPiece, Stranger
from data_pipeline.objects.sources import load_object, objects_to_test, open_source
from data_pipeline.objects.strangers import KINDS, SPLITS, household, living, outdoors, plain, small, stranger, tools
from mevs_jax.trained import description


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_seeded_varied_and_a_usable_mesh(kind):
    np.testing.assert_array_equal(stranger(kind, 3).vertices, stranger(kind, 3).vertices)
    shapes = set()
    for seed in range(8):
        solid = stranger(kind, seed)
        assert np.isfinite(solid.vertices).all()
        assert solid.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        assert 0.02 < solid.extents.max() < 15
        mesh = normalise(solid.vertices, solid.faces, kind)
        assert 4 <= len(mesh.faces) <= 5_000
        shapes.add(mesh.vertices.tobytes())
    assert len(shapes) == 8 or (kind == "sphere" and len(shapes) > 3)  # a sphere has its tessellation alone


def test_unknown_kinds_are_refused():
    with pytest.raises(ValueError, match="no stranger 'sofa'"):
        stranger("sofa", 0)


def test_no_kind_is_a_class_and_each_has_one_split():
    assert not {plain_class(kind) for kind in KINDS} & {plain_class(name) for name in MODELNET10_CLASSES}
    listed = [
        build
        for module in (plain, household, small, tools, outdoors, living)
        for splits in module.GROUPS.values()
        for builders in splits.values()
        for build in builders
    ]
    assert len(listed) == len(set(listed)) == len(KINDS)  # no builder, and no name, twice
    shares = Counter(kind.split for kind in KINDS.values())
    assert set(shares) == set(SPLITS)
    assert shares["train"] > shares["test"] > shares["val"] >= 10
    splits = {
        group: {kind.split for kind in KINDS.values() if kind.group == group}
        for group in {k.group for k in KINDS.values()}
    }
    assert splits["animals"] == splits["instruments"] == {"test"}  # whole groups that nothing was fitted on


def test_the_source_has_other_kinds_in_every_split():
    source = open_source("strangers", train_per_class=12, test_per_class=4)
    assert source.classes == (UNKNOWN_OBJECT,)
    assert UNKNOWN_OBJECT == description.UNKNOWN_OBJECT
    assert Counter(entry.split for entry in source.entries) == {"train": 120, "val": 40, "test": 40}
    kinds = {split: {entry.recipe.kind for entry in source.entries if entry.split == split} for split in SPLITS}
    assert set.union(*kinds.values()) == set(KINDS)
    for split, some in kinds.items():
        assert some == {name for name, kind in KINDS.items() if kind.split == split}
    for entry in source.entries[::10]:
        assert entry.name.startswith(f"{entry.recipe.kind}_{entry.split}_")
        assert np.linalg.norm(load_object(entry).vertices, axis=1).max() == pytest.approx(1, abs=1e-5)
    assert len({(entry.recipe.kind, entry.recipe.seed) for entry in source.entries}) == 200
    with pytest.raises(DataError, match="strangers needs at least 2 training"):
        open_source("strangers", train_per_class=1, test_per_class=1)


@pytest.mark.parametrize("recipe", [Stranger("mug", 0), FamilyPiece("chair", "train", "stool", 0)])
def test_captures_of_shapes_made_otherwise_are_not_used(recipe, monkeypatch):
    entry = ObjectEntry("one", 0, "train", recipe)
    before = capture_path(Path("x"), entry)
    assert capture_path(Path("x"), replace(entry, recipe=replace(recipe))) == before
    monkeypatch.setattr(type(recipe), "stamp", "2")
    assert capture_path(Path("x"), entry) != before


def test_strangers_go_beside_others():
    tested = objects_to_test("strangers")
    assert {entry.split for entry in tested.entries} == {"test"}
    both = open_objects(DataConfig(more=("strangers",), train_per_class=2, test_per_class=1))
    assert both.classes == (*MODELNET10_CLASSES, UNKNOWN_OBJECT)
    with pytest.raises(DataError, match=r"give --data others and add --dataset\.more strangers"):
        open_objects(DataConfig(source="strangers"))
    with pytest.raises(DataError, match="not with strangers"):
        open_source("strangers", train_per_class=2, test_per_class=1, split="0.5")


def test_workers_that_make_strangers_do_not_import_jax():
    code = "import sys; from data_pipeline.objects.recipes import Stranger; Stranger('mug', 0).load()"
    code += "; print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
