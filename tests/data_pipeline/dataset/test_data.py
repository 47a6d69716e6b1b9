"""Data sets, batches and augmentation."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipeline.capture.casting import CaptureConfig, capture, rig_for
from data_pipeline.dataset.augment import CloudAugmentation, ImageAugmentation, augment_cloud, augment_image
from data_pipeline.dataset.batches import (
    ViewBatches,
    evaluation_batches,
    sample_pixels,
    steps_per_epoch,
    train_batches,
    validation_batches,
)
from data_pipeline.dataset.builder import (
    SPLITS,
    DataConfig,
    load_statistics,
    open_split,
    prepare,
    split_objects,
    view_entropies,
)
from data_pipeline.dataset.inputs import cloud_input, image_input
from data_pipeline.errors import DataError
from data_pipeline.objects.sources import load_object, open_source
from mevs_jax import Camera, depth_entropy, partial_cloud

CONFIG = DataConfig(train_per_class=5, test_per_class=2, capture=CaptureConfig(views=8, resolution=32))


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "data"
    prepare(CONFIG, folder)
    return folder


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
    entries = {entry.name: entry for entry in open_source("furniture10", train_per_class=5, test_per_class=2).entries}
    rig = rig_for(CONFIG.capture)
    assert len(source) == 20
    for index in (0, 7, 19):
        example = source[index]
        entry = entries[example["name"].decode()]
        seen = capture(load_object(entry), rig)
        np.testing.assert_array_equal(example["depth"], seen.depth)
        np.testing.assert_array_equal(example["image"], seen.image)
        np.testing.assert_allclose(example["pose"], rig.poses)
        np.testing.assert_allclose(example["extent"], seen.extent)
        assert example["label"] == entry.label
        for view in range(8):
            expected = depth_entropy((seen.depth[view] + 0.5).astype(np.float32) * (seen.depth[view] > 0) / 10_000)
            assert example["entropy"][view] == pytest.approx(float(expected), abs=1e-5)


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
    with pytest.raises(DataError, match=r"other settings \(seed\)"):
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


def test_more_records_than_memory_are_sorted_on_disk(tmp_path, data):
    """TFDS keeps 1 GiB of records in memory; beyond that its own code wants TensorFlow, and ours must do without."""
    from tensorflow_datasets.core import shuffle

    from data_pipeline.dataset.builder import _builder_class

    _builder_class()
    limit = shuffle.MAX_MEM_BUFFER_SIZE
    shuffle.MAX_MEM_BUFFER_SIZE = 1
    try:
        prepare(CONFIG, tmp_path / "data")
    finally:
        shuffle.MAX_MEM_BUFFER_SIZE = limit
    spilled, kept = open_split(tmp_path / "data", "train"), open_split(data, "train")
    assert [spilled[i]["name"] for i in range(40)] == [kept[i]["name"] for i in range(40)]
    np.testing.assert_array_equal(spilled[3]["depth"], kept[3]["depth"])


# ---------------------------------------------------------------------------------------------------------------- batches

BATCHES = ViewBatches(batch_size=12, views_per_object=3, points=50, images="depth", seed=4)


def equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def test_batches_depend_on_seed_and_step_alone(data):
    first = list(islice(train_batches(data, BATCHES), 12))
    again = list(islice(train_batches(data, BATCHES, first_step=9), 3))
    for a, b in zip(first[9:], again, strict=True):
        assert equal(a, b)
    other = next(train_batches(data, replace(BATCHES, seed=5)))
    assert not equal(first[0], other)
    assert first[0]["depth"].shape == (12, 32, 32)
    assert first[0]["pixels"].shape == (12, 50)


def test_an_epoch_shows_every_object_once(data):
    assert steps_per_epoch(40, BATCHES) == 10
    source = open_split(data, "train")
    known = {source[i]["entropy"].tobytes() for i in range(40)}
    for epoch in range(2):
        batches = list(islice(train_batches(data, BATCHES, first_step=10 * epoch), 10))
        seen = [row.tobytes() for batch in batches for row in batch["entropy"][::3]]
        assert set(seen) == known
        assert len(seen) == 40
        for batch in batches:  # distinct views of each object
            assert all(len(set(views)) == 3 for views in batch["view"].reshape(-1, 3))


def test_processes_share_every_batch(data, monkeypatch):
    whole = next(train_batches(data, BATCHES, first_step=2))
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    parts = []
    for process in range(2):
        monkeypatch.setattr(jax, "process_index", lambda p=process: p)
        parts.append(next(train_batches(data, BATCHES, first_step=2)))
    rows = [row.tobytes() for part in parts for row in part["depth"]]
    assert rows == [row.tobytes() for row in whole["depth"]]  # one after the other, as one process reads them
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    with pytest.raises(ValueError, match="cannot be shared by 3"):
        next(train_batches(data, BATCHES))


def test_validation_by_view_keeps_a_share_of_every_objects_views_apart(data):
    """The thesis's published code: an object is on both sides, a view never is."""
    by_view = replace(BATCHES, validation_by="view", batch_size=9)
    statistics = load_statistics(data)
    objects = sum(sum(statistics.counts[split].values()) for split in ("train", "val"))
    aside: dict[bytes, set[int]] = {}
    for batch in validation_batches(data, by_view, 0):
        key = batch["entropy"][0].tobytes()
        aside[key] = set(batch["view"].tolist())
    assert len(aside) == objects
    assert {len(views) for views in aside.values()} == {max(1, round(0.2 * statistics.views))}
    seen: dict[bytes, set[int]] = {}
    for batch in islice(train_batches(data, by_view), objects):
        for entropy, view in zip(batch["entropy"], batch["view"], strict=True):
            seen.setdefault(entropy.tobytes(), set()).add(int(view))
    assert seen.keys() == aside.keys()
    for key, views in seen.items():
        assert not views & aside[key]


def test_validation_views_take_turns_over_the_objects(data):
    """Evenly spaced views, one place further on for each object, so that every view of the lattice is validated on."""
    batches = list(validation_batches(data, BATCHES, 2))
    assert [batch["view"].tolist() for batch in batches] == [[index % 8, (index + 4) % 8] for index in range(10)]
    seen = [batch["view"].tolist() for batch in validation_batches(data, BATCHES, 3)]
    assert seen[:3] == [[0, 2, 5], [1, 3, 6], [2, 4, 7]]
    assert {view for views in seen for view in views} == set(range(8))
    assert [batch["view"].tolist() for batch in validation_batches(data, BATCHES, 0)] == [list(range(8))] * 10


def test_pixels_are_drawn_without_repetition_and_repeated_to_fill(random):
    depth = np.zeros((10, 10), np.uint16)
    depth[2:5, 3:7] = 9
    few = sample_pixels(depth, 8, random)
    assert len(set(few.tolist())) == 8
    many = sample_pixels(depth, 30, random)
    assert set(many.tolist()) == set(np.flatnonzero(depth).tolist())
    assert np.bincount(many).max() == 3
    np.testing.assert_array_equal(sample_pixels(np.zeros((4, 4)), 5, random), 0)


def test_evaluation_batches_hold_every_view_and_never_change(data):
    a = list(evaluation_batches(data, "test", points=20, images="image"))
    b = list(evaluation_batches(data, "test", points=20, images="image"))
    assert len(a) == 20
    assert all(equal(x, y) for x, y in zip(a, b, strict=True))
    np.testing.assert_array_equal(a[0]["view"], np.arange(8))


def test_inputs_are_what_the_stored_view_shows(data):
    example = open_split(data, "test")[0]
    camera = CONFIG.capture
    image = np.asarray(image_input(example["depth"][0], "depth", 3, camera))
    assert image.shape == (32, 32, 3)
    assert image.min() == 0
    assert image.max() <= 1
    hit = example["depth"][0] > 0
    np.testing.assert_allclose(image[hit][:, 0], (3 - example["depth"][0][hit] / 10_000) / 2, atol=1e-5)
    pixels = np.flatnonzero(example["depth"][0])[:30]
    depth = example["depth"][0].reshape(-1)[pixels]
    cloud = cloud_input(jnp.asarray(pixels), jnp.asarray(depth), jnp.asarray(example["pose"][0]), camera, "world")
    whole, _ = partial_cloud(
        example["depth"][0].astype(np.float32) / 10_000, Camera(jnp.asarray(example["pose"][0]), np.pi / 3, 32)
    )
    np.testing.assert_allclose(cloud, np.asarray(whole)[pixels], atol=1e-5)
    assert np.linalg.norm(cloud, axis=1).max() <= 1.01
    pose = example["pose"][0]
    for frame, eye in (("world", pose[:3, 3]), ("camera", np.zeros(3))):
        both = np.asarray(
            cloud_input(jnp.asarray(pixels), jnp.asarray(depth), jnp.asarray(pose), camera, frame, directions=True)
        )
        way = eye - both[:, :3]
        np.testing.assert_allclose(both[:, 3:], way / np.linalg.norm(way, axis=1, keepdims=True), atol=1e-5)
    nothing = cloud_input(jnp.zeros(2, int), jnp.zeros(2, int), jnp.asarray(pose), camera, "world", directions=True)
    np.testing.assert_allclose(nothing[:, 3:], 0, atol=1e-6)


def test_stored_entropies_are_the_librarys(data):
    example = open_split(data, "val")[0]

    class Seen:
        depth = example["depth"]

    np.testing.assert_allclose(view_entropies(Seen), example["entropy"])


# ----------------------------------------------------------------------------------------------------------- augmentation


def only(name: str) -> CloudAugmentation:
    off = dict.fromkeys(("scale", "turn", "tilt", "translate", "jitter", "drop"), False)
    return CloudAugmentation(**(off | {name: True}))


def many(name: str, cloud: np.ndarray) -> np.ndarray:
    keys = jax.random.split(jax.random.key(0), 300)
    return np.asarray(jax.vmap(augment_cloud, (0, None, None))(keys, jnp.asarray(cloud), only(name)))


def test_each_cloud_augmentation_does_what_the_thesis_says(random):
    cloud = random.normal(size=(40, 3)).astype(np.float32)
    ratio = np.linalg.norm(many("scale", cloud), axis=(1, 2)) / np.linalg.norm(cloud)
    assert 0.8 <= ratio.min() < 0.82
    assert 1.23 < ratio.max() <= 1.2501

    turned = many("turn", cloud)
    np.testing.assert_allclose(turned[..., 2], np.broadcast_to(cloud[:, 2], (300, 40)), atol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(turned, axis=2), np.broadcast_to(np.linalg.norm(cloud, axis=1), (300, 40)), atol=1e-4
    )
    assert np.abs(turned[..., 0] - cloud[:, 0]).max() > 1

    moved = many("translate", cloud) - cloud
    assert np.abs(moved).max() <= 0.1001
    np.testing.assert_allclose(moved.std(axis=1), 0, atol=1e-5)

    jittered = many("jitter", cloud) - cloud
    assert np.abs(jittered).max() <= 0.0501
    assert jittered.std() == pytest.approx(0.01, rel=0.05)

    dropped = (many("drop", cloud) == cloud[0]).all(axis=2).mean(axis=1)
    assert dropped.mean() == pytest.approx(0.4375, abs=0.06)
    assert dropped.max() < 1

    np.testing.assert_array_equal(
        augment_cloud(jax.random.key(0), jnp.asarray(cloud), CloudAugmentation(*[False] * 6)), cloud
    )


def test_tilts_are_three_clipped_normal_angles():
    """About x, then y, then z, by N(0, 0.06) each, at most 0.18 radians (thesis section 5.1)."""
    axes = 0.5 * jnp.eye(3)
    keys = jax.random.split(jax.random.key(0), 4000)
    tilted = np.asarray(jax.vmap(augment_cloud, (0, None, None))(keys, axes, only("tilt")))
    angles = Rotation.from_matrix(2 * tilted.transpose(0, 2, 1)).as_euler("xyz")
    np.testing.assert_allclose(angles.mean(axis=0), 0, atol=0.005)
    np.testing.assert_allclose(angles.std(axis=0), 0.0595, rtol=0.05)  # of 0.06, clipped at three standard deviations
    np.testing.assert_allclose(np.abs(angles).max(axis=0), 0.18, atol=1e-4)
    np.testing.assert_allclose(np.corrcoef(angles.T), np.eye(3), atol=0.06)
    np.testing.assert_allclose((np.abs(angles) > 0.06).mean(axis=0), 0.317, atol=0.03)  # a normal distribution's share


def test_directions_beside_points_turn_with_them_and_are_else_as_they_were(random):
    cloud = random.normal(size=(40, 6)).astype(np.float32)
    for name in ("scale", "translate", "jitter"):
        np.testing.assert_array_equal(many(name, cloud)[..., 3:], np.broadcast_to(cloud[:, 3:], (300, 40, 3)))
    for name in ("turn", "tilt"):
        changed = many(name, cloud)
        along = np.sum(changed[..., :3] * changed[..., 3:], axis=-1)
        np.testing.assert_allclose(
            along, np.broadcast_to(np.sum(cloud[:, :3] * cloud[:, 3:], axis=-1), (300, 40)), atol=1e-4
        )
        np.testing.assert_array_equal(changed[..., :3], many(name, cloud[:, :3]))
    dropped = many("drop", cloud)
    assert ((dropped == cloud[0]).all(axis=2) | (dropped == cloud).all(axis=2)).all()


def test_images_are_mirrored_and_shifted_and_nothing_else(random):
    image = random.uniform(0.1, 1, (9, 9, 1)).astype(np.float32)
    image[:2] = image[-2:] = image[:, :2] = image[:, -2:] = 0
    keys = jax.random.split(jax.random.key(1), 500)
    out = np.asarray(jax.vmap(augment_image, (0, None, None))(keys, jnp.asarray(image), ImageAugmentation(True, 2)))
    np.testing.assert_allclose(out.sum(axis=(1, 2, 3)), image.sum(), rtol=1e-5)  # only the empty border leaves
    assert len({each.tobytes() for each in out}) == 50  # 2 mirrors × 5 × 5 shifts
    still = augment_image(jax.random.key(0), jnp.asarray(image), ImageAugmentation(False, 0))
    np.testing.assert_array_equal(still, image)


def test_beam_makes_the_same_records(data, tmp_path):
    """Beam's own local runner, where Beam is installed."""
    pytest.importorskip("apache_beam", reason="Apache Beam is an optional extra: pip install mevs-jax[beam]")
    folder = tmp_path / "data"
    by_beam, alone = prepare(CONFIG, folder, beam="--runner=DirectRunner"), load_statistics(data)
    assert by_beam == alone
    for split in SPLITS:
        records, expected = open_split(folder, split), open_split(data, split)
        assert len(records) == len(expected)
        for mine, theirs in zip(records, expected, strict=True):
            assert mine.keys() == theirs.keys()
            for name, value in theirs.items():
                np.testing.assert_array_equal(mine[name], value, err_msg=name)
    assert not (folder / "captures").exists()


def test_beam_where_it_is_not_installed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "apache_beam.options.pipeline_options", None)
    with pytest.raises(DataError, match=r"pip install mevs-jax\[beam\]"):
        prepare(CONFIG, tmp_path / "data", beam="")
    assert not (tmp_path / "data").exists()
