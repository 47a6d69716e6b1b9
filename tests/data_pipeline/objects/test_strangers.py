"""Strangers: shapes that are none of the ten classes, each kind in one split."""

import subprocess
import sys
from collections import Counter

import numpy as np
import pytest

from data_pipeline.dataset.config import DataConfig
from data_pipeline.dataset.origin import open_objects
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import MODELNET10_CLASSES, normalise
from data_pipeline.objects.names import plain_class
from data_pipeline.objects.sources import load_object, objects_to_test, open_source
from data_pipeline.objects.strangers import KINDS, SPLITS, household, living, outdoors, plain, small, stranger, tools


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


def test_sources_of_splits_share_no_kind():
    parts = [set(open_source(f"strangers-{split}", train_per_class=2, test_per_class=1).classes) for split in SPLITS]
    assert sum(map(len, parts)) == len(set.union(*parts)) == len(KINDS)


def test_every_kind_loads_through_the_source():
    source = open_source("strangers", train_per_class=2, test_per_class=1)
    assert source.classes == tuple(KINDS)
    assert Counter((entry.label, entry.split) for entry in source.entries) == {
        (label, split): count for label in range(len(KINDS)) for split, count in (("train", 2), ("test", 1))
    }
    shapes = set()
    for entry in source.entries:
        assert entry.name.startswith(source.classes[entry.label])
        mesh = load_object(entry)
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-5)
        shapes.add(mesh.vertices.tobytes())
    assert len(shapes) >= len(source.entries) - 2
    with pytest.raises(DataError, match="strangers needs at least 2 training"):
        open_source("strangers", train_per_class=1, test_per_class=1)


def test_strangers_are_named_as_furniture_is():
    tested = objects_to_test("strangers-test")
    assert {entry.split for entry in tested.entries} == {"test"}
    both = open_objects(DataConfig(more=("strangers-val",), train_per_class=2, test_per_class=1, split="0.5"))
    assert both.classes[:10] == MODELNET10_CLASSES
    assert both.classes[10:] == tuple(name for name, kind in KINDS.items() if kind.split == "val")
    with pytest.raises(DataError, match="given twice"):
        open_objects(DataConfig(source="strangers", more=("strangers",)))
    with pytest.raises(DataError, match="not with strangers"):
        open_source("strangers", train_per_class=2, test_per_class=1, split="0.5")


def test_workers_that_make_strangers_do_not_import_jax():
    code = "import sys; from data_pipeline.objects.recipes import Stranger; Stranger('mug', 0).load()"
    code += "; print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
