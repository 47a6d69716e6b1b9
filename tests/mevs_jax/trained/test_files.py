"""A trained system is the same after it was written and read, and nothing damaged is read."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mevs_jax
from mevs_jax.trained import ImageInput, UnreadableSystem, load, save, verify
from mevs_jax.trained.arrays import DESCRIPTION, WEIGHTS
from mevs_jax.trained.files import check
from mevs_jax.trained.writing import hash_of
from tests.mevs_jax.trained import making


@pytest.fixture(scope="module", params=["classifier", "sized"])
def written(request, tmp_path_factory):
    made = making.system(request.param)
    folder = tmp_path_factory.mktemp(request.param) / "system"
    save(made, folder)
    return made, folder


def test_a_system_is_read_as_it_was_written(written):
    made, folder = written
    read = load(folder)
    assert read.description == made.description
    assert verify(folder) == made.description
    for one, other in zip(jax.tree.leaves(read.parts), jax.tree.leaves(made.parts), strict=True):
        np.testing.assert_array_equal(one, other)
    depth = making.depth_of_ball(made.viewpoints[3])
    pose = np.asarray(mevs_jax.look_at_origin(jnp.asarray(made.viewpoints[3]) * 2))
    seen, again = made.observe(depth, pose), read.observe(depth, pose)
    np.testing.assert_array_equal(seen.logits, again.logits)
    assert sorted(path.name for path in folder.iterdir()) == ["README.md", DESCRIPTION, WEIGHTS]


def test_a_mirrored_system_takes_an_object_and_its_mirror_image_for_one_but_for_the_pose():
    plain = making.system("parts")
    made = replace(
        plain, description=replace(plain.description, image=ImageInput("depth_and_normals", 5, mirrored=True))
    )
    side = made.description.camera.resolution
    depth = 2 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (side, side)).astype(np.float32)
    depth[:4], depth[:, -9:] = 0.0, np.nan
    pose = np.asarray(mevs_jax.look_at_origin(2 * jnp.asarray([0.6, 0.0, 0.8])))
    one, other, as_it_is = (
        system.observe(image, pose) for system, image in ((made, depth), (made, depth[:, ::-1]), (plain, depth))
    )
    np.testing.assert_allclose(one.features, other.features, atol=1e-4)
    np.testing.assert_allclose(one.logits, other.logits, atol=1e-3)
    np.testing.assert_allclose(one.pose_evidence, as_it_is.pose_evidence, atol=1e-4)
    assert np.abs(one.features - as_it_is.features).max() > 1e-2 < np.abs(one.pose_evidence - other.pose_evidence).max()
    with pytest.raises(ValueError, match="mirror images are of depth and normals"):
        check(replace(making.description("classifier"), image=ImageInput("depth", 1, mirrored=True)))


def test_the_card_names_classes_camera_and_figures(written):
    _, folder = written
    card = (folder / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: mevs_jax\n")
    for part in (
        "bed, chair, sofa, table",
        "32×32 pixels",
        "field of view 60°",
        "| `farthest` | 50.0 | 70.0 |",
        "## Limits",
    ):
        assert part in card


def test_half_the_size_gives_nearly_the_same(written, tmp_path):
    made, folder = written
    save(made, tmp_path / "half", half=True)
    assert (tmp_path / "half" / WEIGHTS).stat().st_size < 0.75 * (folder / WEIGHTS).stat().st_size
    read = load(tmp_path / "half")
    depth, pose = making.depth_of_ball(made.viewpoints[3]), jnp.eye(4).at[2, 3].set(2.0)
    np.testing.assert_allclose(read.observe(depth, pose).logits, made.observe(depth, pose).logits, rtol=0.02, atol=0.02)
    assert read.parts.encoder.weights["head"]["kernel"][...].dtype == jnp.float32


def test_writing_replaces_a_system_and_nothing_else(written, tmp_path):
    made, _ = written
    folder = tmp_path / "there"
    save(made, folder)
    save(replace(made, description=replace(made.description, chosen_by="again")), folder)
    assert load(folder).description.chosen_by == "again"
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="holds other files; choose another folder"):
        save(made, folder)
    with pytest.raises(FileExistsError, match="is a file"):
        save(made, folder / "notes.txt")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there"]


@pytest.mark.parametrize("linked", [False, True])
def test_a_system_is_not_lost_where_the_new_one_cannot_stand(written, tmp_path, monkeypatch, linked):
    made, _ = written
    folder = tmp_path / "there"
    if linked:
        (tmp_path / "target").mkdir()
        folder.symlink_to(tmp_path / "target")
    save(made, folder)
    before, rename = sorted(tmp_path.iterdir()), Path.rename

    def failing(path, target):
        if (path / WEIGHTS).exists() and Path(target) == folder.resolve() and not str(path).endswith("before"):
            raise OSError("the disk is away")
        return rename(path, target)

    again = replace(made, description=replace(made.description, chosen_by="again"))
    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OSError, match="the disk is away"):
        save(again, folder)
    assert load(folder).description == made.description
    assert sorted(tmp_path.iterdir()) == before
    monkeypatch.undo()
    save(again, folder)
    assert load(folder).description.chosen_by == "again"
    assert sorted(tmp_path.iterdir()) == before


def test_a_system_is_found_if_the_computer_stopped_while_it_was_replaced(written, tmp_path):
    made, folder = written
    shutil.copytree(folder, tmp_path / ".mine.k3x9.before")
    assert load(tmp_path / "mine").description == made.description
    (tmp_path / "mine").mkdir()
    with pytest.raises(FileNotFoundError, match="is no trained system"):
        load(tmp_path / "mine")


def test_names_of_the_package_win_over_folders(written, tmp_path, monkeypatch):
    made, folder = written
    shutil.copytree(folder, tmp_path / "furniture10")
    monkeypatch.chdir(tmp_path)
    assert "desk" in load("furniture10").classes
    for path in ("./furniture10", Path("furniture10")):
        assert load(path).description == made.description
    shutil.rmtree("furniture10")
    assert "desk" in load(Path("furniture10")).classes


def test_what_is_not_there_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match="no folder nothing, and no system of this name"):
        load("nothing")
    with pytest.raises(FileNotFoundError, match=r"has no trained\.json"):
        load(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match="finish it with: mevs run --out"):
        load(tmp_path)


def test_a_run_is_loaded_by_its_folder(written, tmp_path):
    made, folder = written
    shutil.copytree(folder, tmp_path / "run" / "system")
    assert load(tmp_path / "run").description == made.description


def damaged(folder, tmp_path, change):
    """A copy of a system whose description is changed, with a hash that fits."""
    copy = tmp_path / f"copy{len(list(tmp_path.iterdir()))}"
    shutil.copytree(folder, copy)
    content = json.loads((copy / DESCRIPTION).read_text())
    change(content)
    content["sha256"] = hash_of(content)
    (copy / DESCRIPTION).write_text(json.dumps(content))
    return copy


CHANGES = {
    "another width": lambda c: c["encoder"].update(width=9),
    "a huge width": lambda c: c["encoder"].update(width=2**40),
    "no width": lambda c: c["encoder"].pop("width"),
    "a width of text": lambda c: c["encoder"].update(width="8"),
    "a negative width": lambda c: c["encoder"].update(width=-8),
    "a width beyond all": lambda c: c["encoder"].update(width=10**5),
    "an unknown depth": lambda c: c["encoder"].update(depth=11),
    "no classes": lambda c: c.update(classes=[]),
    "two classes of one name": lambda c: c.update(classes=["a", "a", "b", "c"]),
    "one class more": lambda c: c["classes"].append("desk"),
    "sizes of nothing": lambda c: c.update(size={"smallest": 0.0, "largest": 5.0, "steps": 10}),
    "sizes in no order": lambda c: c.update(size={"smallest": 9.0, "largest": 5.0, "steps": 10}),
    "another number of sizes": lambda c: c.update(size={"smallest": 0.1, "largest": 5.0, "steps": 11}),
    "an unknown setting": lambda c: c.update(colour="red"),
    "a camera within the object": lambda c: c["camera"].update(distance=0.5),
    "an infinite camera": lambda c: c["camera"].update(distance=float("inf")),
    "pixels without bound": lambda c: c["camera"].update(resolution=4096),
    "pixels and width without bound": lambda c: (c["camera"].update(resolution=1024), c["encoder"].update(width=256)),
    "classes without bound": lambda c: c.update(classes=[str(number) for number in range(2049)]),
    "a million pixels": lambda c: c["camera"].update(resolution=10**6),
    "an unknown policy": lambda c: c.update(best="luck"),
    "another kind": lambda c: c.update(kind="oracle"),
    "the other kind": lambda c: c.update(kind="recogniser" if c["kind"] == "classifier" else "classifier"),
    "more channels": lambda c: c["image"].update(channels=7),
    "a list of nothing": lambda c: c.update(encoder=[]),
    "another size of the weights": lambda c: c["weights"].update(bytes=3),
    "no weights": lambda c: c.pop("weights"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_description_that_is_wrong_is_one_sentence(written, tmp_path, name):
    _, folder = written
    with pytest.raises(UnreadableSystem) as caught:
        load(damaged(folder, tmp_path, CHANGES[name]))
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith("export the system again, or enrol its objects again")


def test_an_edited_description_and_other_versions_are_refused(written, tmp_path):
    _, folder = written
    copy = shutil.copytree(folder, tmp_path / "copy")
    text = (copy / DESCRIPTION).read_text()
    (copy / DESCRIPTION).write_text(text.replace('"bed"', '"bad"'))
    with pytest.raises(UnreadableSystem, match="was changed or damaged"):
        load(copy)
    (copy / DESCRIPTION).write_text(text.replace('"form": 1', '"form": 2'))
    with pytest.raises(UnreadableSystem, match="its form is 2, this version reads 1"):
        load(copy)
    for content in ("", "{", "[]", "null", "[" * 100_000):
        (copy / DESCRIPTION).write_text(content)
        with pytest.raises(UnreadableSystem, match="cannot be read"):
            load(copy)


def restamped(folder, weights):
    """Writes weights into a system's folder, with a hash that fits."""
    (folder / WEIGHTS).write_bytes(weights)
    content = json.loads((folder / DESCRIPTION).read_text())
    content["weights"] = {"sha256": hashlib.sha256(weights).hexdigest(), "bytes": len(weights)}
    content["sha256"] = hash_of(content)
    (folder / DESCRIPTION).write_text(json.dumps(content))


def test_weights_of_another_form_are_refused(written, tmp_path):
    from safetensors.numpy import load_file
    from safetensors.numpy import save as as_bytes

    _, folder = written
    copy = shutil.copytree(folder, tmp_path / "copy")
    content = (copy / WEIGHTS).read_bytes()
    (copy / WEIGHTS).write_bytes(content[:-1])
    with pytest.raises(UnreadableSystem, match="bytes instead of"):
        load(copy)
    (copy / WEIGHTS).write_bytes(bytes([content[0] ^ 1]) + content[1:])
    with pytest.raises(UnreadableSystem, match="is damaged, since its hash differs"):
        load(copy)
    arrays = load_file(folder / WEIGHTS)
    changes = {
        "not at least two unit vectors": {"viewpoints": arrays["viewpoints"] * 2},
        "not finite": {"viewpoints": arrays["viewpoints"] * np.float32(np.nan)},
        "not positive": {"single": np.zeros((), np.float32)},
        "has shape": {"encoder.head.bias": np.zeros(3, np.float32)},
        "does not describe": {"spare": np.zeros(3, np.float32)},
    }
    for message, change in changes.items():
        restamped(copy, as_bytes(arrays | change))
        with pytest.raises(UnreadableSystem, match=message):
            load(copy)
    restamped(copy, as_bytes({name: array for name, array in arrays.items() if name != "encoder.head.bias"}))
    with pytest.raises(UnreadableSystem, match=r"lacks encoder\.head\.bias"):
        load(copy)
    restamped(copy, b"nothing of this kind")
    with pytest.raises(UnreadableSystem, match="is no safetensors file"):
        load(copy)
    (copy / WEIGHTS).unlink()
    with pytest.raises(UnreadableSystem, match="is missing"):
        load(copy)


def test_expected_views_that_cannot_be_used_are_refused(tmp_path):
    from safetensors.numpy import load_file
    from safetensors.numpy import save as as_bytes

    folder = tmp_path / "system"
    save(making.system("recogniser"), folder)
    arrays = load_file(folder / WEIGHTS)
    classes = arrays["expected"].shape[0]
    for terms in (5, 18**2):
        changed = np.zeros((classes, terms, classes), np.float32)
        copy = shutil.copytree(folder, tmp_path / str(terms))
        restamped(copy, as_bytes(arrays | {"expected": changed}))
        with pytest.raises(UnreadableSystem, match=f"expected in {WEIGHTS} has {terms} terms"):
            load(copy)
    copy = shutil.copytree(folder, tmp_path / "none")
    restamped(copy, as_bytes({name: array for name, array in arrays.items() if name != "expected"}))
    with pytest.raises(UnreadableSystem, match="lacks expected"):
        load(copy)

    def poseless(content):
        content.update(pose=None, best_unposed="expected_views")

    with pytest.raises(UnreadableSystem, match="without a pose, expected views cannot be used for an unknown yaw"):
        load(damaged(folder, tmp_path, poseless))


@pytest.mark.parametrize(
    "change",
    [
        lambda level, entropy: level.update(centres=10**9),
        lambda level, entropy: level.update(centres=-1),
        lambda level, entropy: level.update(samples=0),
        lambda level, entropy: level.update(radius=float("nan")),
        lambda level, entropy: level.update(centres=65_536, samples=65_536),
        lambda level, entropy: entropy.update(head_layers=[8] * 200_000),
        lambda level, entropy: entropy.update(abstractions=[level] * 100),
    ],
)
def test_networks_of_impossible_sizes_are_not_made(change, tmp_path):
    save(making.system("classifier"), tmp_path / "system")

    def changed(content):
        change(content["entropy"]["abstractions"][0], content["entropy"])

    with pytest.raises(
        UnreadableSystem, match=r"a network has (the size|\d+ layers|[\d,]+ outputs)|radius is nan, not a finite number"
    ):
        load(damaged(tmp_path / "system", tmp_path, changed))


def test_any_damage_of_the_files_is_one_sentence(written, tmp_path):
    """Flipped bits and truncation anywhere, with hashes that fit and that do not."""
    _, folder = written
    copy, random = shutil.copytree(folder, tmp_path / "copy"), np.random.default_rng(0)
    for trial in range(60):
        for name in (DESCRIPTION, WEIGHTS):
            shutil.copy(folder / name, copy / name)
        name = (DESCRIPTION, WEIGHTS)[trial % 2]
        content = bytearray((folder / name).read_bytes())
        if trial % 3 == 0:
            content = content[: random.integers(len(content))]
        else:
            content[random.integers(len(content))] ^= 1 << int(random.integers(8))
        (copy / name).write_bytes(bytes(content))
        if name == WEIGHTS and trial % 4 == 1:
            restamped(copy, bytes(content))
            if _reads(copy):
                continue  # another finite number in its place
        with pytest.raises(UnreadableSystem) as caught:
            load(copy)
        assert "\n" not in str(caught.value)


def _reads(folder):
    try:
        load(folder)
    except UnreadableSystem:
        return False
    return True
