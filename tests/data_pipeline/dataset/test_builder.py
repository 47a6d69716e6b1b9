"""Data sets: splits, records, statistics, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from data_pipeline.capture.casting import Capture, CaptureConfig, capture, rig_for
from data_pipeline.dataset.builder import open_split, prepare, split_objects
from data_pipeline.dataset.shards import view_entropies
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from data_pipeline.files import files_in
from data_pipeline.objects.sources import load_object, open_source
from mevs_jax import depth_entropy
from tests.data_pipeline.dataset.conftest import CONFIG


def test_splits_are_by_object_and_by_class():
    source = open_source("furniture10", train_per_class=10, test_per_class=3)
    split = split_objects(source.entries, 0.2, seed=1)
    assert {name: len(members) for name, members in split.items()} == {"train": 80, "val": 20, "test": 30}
    names = [entry.name for members in split.values() for entry in members]
    assert len(set(names)) == len(names) == 130
    for label in range(10):
        assert sum(entry.label == label for entry in split["val"]) == 2
    again = split_objects(source.entries, 0.2, seed=1)
    other = split_objects(source.entries, 0.2, seed=2)
    assert again == split
    assert other["val"] != split["val"]


def test_an_example_is_an_object_as_it_was_captured(data):
    source = open_split(data, "test")
    entries = {entry.name: entry for entry in open_source("furniture10", train_per_class=5, test_per_class=1).entries}
    rig = rig_for(CONFIG.capture)
    assert len(source) == 10
    for index in (0, 4, 9):
        example = source[index]
        entry = entries[example["name"].decode()]
        seen = capture(load_object(entry), rig)
        np.testing.assert_array_equal(example["depth"], seen.depth)
        np.testing.assert_array_equal(example["image"], seen.image)
        np.testing.assert_allclose(example["pose"], rig.poses)
        np.testing.assert_allclose(example["extent"], seen.extent)
        vertices = entry.recipe.load()[0]
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        assert example["radius"] == pytest.approx(np.linalg.norm(vertices - centre, axis=1).max(), rel=1e-6)
        assert example["label"] == entry.label
        for view in range(8):
            expected = depth_entropy((seen.depth[view] + 0.5).astype(np.float32) * (seen.depth[view] > 0) / 10_000)
            assert example["entropy"][view] == pytest.approx(float(expected), abs=1e-5)


def test_some_keys_are_read_alone(data):
    known = ("label", "name", "entropy", "depth")
    some, whole = open_split(data, "test", (*known, "not stored")), open_split(data, "test")
    assert len(some) == len(whole)
    for one, other in zip(some, whole, strict=True):
        assert one.keys() == set(known)
        assert all(np.array_equal(one[key], other[key]) and type(one[key]) is type(other[key]) for key in one)


def test_statistics_are_of_the_training_split_alone(data):
    statistics = load_statistics(data)
    source = open_split(data, "train")
    entropies = np.stack([source[i]["entropy"] for i in range(len(source))])
    assert statistics.entropy_max == pytest.approx(entropies.max())
    assert statistics.entropy_mean == pytest.approx((entropies / entropies.max()).mean(), rel=1e-5)
    np.testing.assert_allclose(statistics.mean_map, (entropies / entropies.max()).mean(axis=0), rtol=1e-5)
    labels = np.array([source[i]["label"] for i in range(len(source))])
    np.testing.assert_allclose(
        statistics.class_mean_maps[3], (entropies[labels == 3] / entropies.max()).mean(axis=0), rtol=1e-5
    )
    assert statistics.counts["train"]["desk"] == 4
    assert sum(statistics.entropy_histograms["train"]) == entropies.size
    assert sum(statistics.entropy_histograms["test"]) == 8 * sum(statistics.counts["test"].values())
    points = np.stack([np.count_nonzero(source[i]["depth"], axis=(1, 2)) for i in range(len(source))])
    np.testing.assert_allclose(statistics.points_by_class[3], np.percentile(points[labels == 3], (5, 25, 50, 75, 95)))


def test_statistics_of_another_version_are_described(tmp_path):
    (tmp_path / "summary.json").write_text('{"classes": [], "entropy_histogram": []}')
    with pytest.raises(DataError, match="another version of mevs_jax"):
        load_statistics(tmp_path)


def test_a_data_set_is_not_made_twice_nor_mixed(data):
    before = {path: path.stat().st_mtime_ns for path in data.rglob("*") if path.is_file()}
    assert prepare(CONFIG, data) == load_statistics(data)
    assert before == {path: path.stat().st_mtime_ns for path in data.rglob("*") if path.is_file()}
    assert not (data / "captures").exists()
    with pytest.raises(DataError, match=r"other settings \(seed 0, not "):
        prepare(replace(CONFIG, seed=9), data)


def test_too_few_views_and_missing_data_are_described(tmp_path):
    with pytest.raises(DataError, match="--views 1 is too few"):
        prepare(replace(CONFIG, capture=CaptureConfig(views=1)), tmp_path / "x")
    with pytest.raises(DataError, match="no data set in"):
        load_statistics(tmp_path)


def test_no_tensorflow_is_imported(data):
    code = (
        "import sys; from pathlib import Path; from data_pipeline.dataset.builder import open_split; "
        "import mevs_jax.cli.main, eval.stages; "
        "open_split(Path(sys.argv[1]), 'val')[0]; assert 'tensorflow' not in sys.modules; print('none')"
    )
    out = subprocess.run([sys.executable, "-c", code, str(data)], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "none"


def test_stored_entropies_are_the_librarys(data):
    example = open_split(data, "val")[0]
    stored = Capture(example["depth"], example["image"], example["extent"])
    np.testing.assert_allclose(view_entropies(stored), example["entropy"])


PORTABLE = "--runner=PortableRunner --job_endpoint=embed --environment_type=LOOPBACK"


@pytest.mark.parametrize("runner", ["--runner=DirectRunner", pytest.param(PORTABLE, marks=pytest.mark.slow)])
def test_beam_makes_the_same_files(runner, data, tmp_path):
    """Beam's own local runner and a portable one, where Beam is installed."""
    pytest.importorskip("apache_beam", reason="Apache Beam is an optional extra: pip install -e '.[beam]'")
    folder = tmp_path / "data"
    by_beam, alone = prepare(CONFIG, folder, beam=runner), load_statistics(data)
    assert by_beam == alone
    assert files_in(folder) == files_in(data)
    for name in files_in(data):
        assert (folder / name).read_bytes() == (data / name).read_bytes(), name
    assert not (folder / "captures").exists()


def test_beam_where_it_is_not_installed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "apache_beam.options.pipeline_options", None)
    with pytest.raises(DataError, match=r"pip install -e '\.\[beam\]'"):
        prepare(CONFIG, tmp_path / "data", beam="")
    assert not (tmp_path / "data").exists()
