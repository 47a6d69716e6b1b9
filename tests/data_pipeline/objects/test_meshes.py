"""Sources of objects, the quirks of their files, and what is said of files that cannot be used."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
import trimesh

from data_pipeline.errors import DamagedMesh, DataError, EmptyMesh
from data_pipeline.objects.furniture import CLASSES, VARIANTS, furniture
from data_pipeline.objects.mesh import normalise
from data_pipeline.objects.sources import load_object, open_source
from data_pipeline.objects.voxels import VoxelGrid
from mevs_jax.meshes import parse_mesh
from tests.data_pipeline.objects.making import members, opened, write

CUBE = trimesh.creation.box((1, 1, 1))


def off_of(mesh: trimesh.Trimesh, header: str = "OFF\n{v} {f} 0\n") -> str:
    lines = [header.format(v=len(mesh.vertices), f=len(mesh.faces)).rstrip("\n")]
    lines += [" ".join(f"{x:.6f}" for x in vertex) for vertex in mesh.vertices]
    lines += ["3 " + " ".join(map(str, face)) for face in mesh.faces]
    return "\n".join(lines) + "\n"


# -------------------------------------------------------------------------------------------------------------- OFF files


@pytest.mark.parametrize(
    "text",
    [
        off_of(CUBE),
        off_of(CUBE, "OFF{v} {f} 0\n"),  # ModelNet's quirk: counts on the first line
        off_of(CUBE, "OFF {v} {f} 0\n"),
        off_of(CUBE, "# made by hand\nOFF\n# counts\n{v} {f} 0\n"),
        off_of(CUBE).replace("\n", "\r\n"),
        off_of(CUBE).replace("\n", "\n\n"),
        "\n".join(line + " 255 0 0" if line.startswith("3 ") else line for line in off_of(CUBE).splitlines()),
    ],
    ids=["plain", "joined", "one-line", "comments", "windows", "blank-lines", "colours"],
)
def test_off_quirks_are_read(text):
    vertices, faces = parse_mesh(text.encode(), ".off", "cube.off")
    np.testing.assert_allclose(vertices, CUBE.vertices, atol=1e-6)
    np.testing.assert_array_equal(faces, CUBE.faces)


def test_polygons_become_fans():
    text = "OFF\n5 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n4 0 1 2 3\n3 0 1 4\n"
    _, faces = parse_mesh(text.encode(), ".off", "square.off")
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3], [0, 1, 4]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"hello", "does not begin with 'OFF'"),
        (b"OFF\n", "counts are missing"),
        (b"OFF\nmany faces 0\n", "counts are missing"),
        (off_of(CUBE)[:60].encode(), "cut short: .* of 8 vertices"),
        ("\n".join(off_of(CUBE).splitlines()[:-3]).encode(), "cut short: 9 of 12 faces"),
        (off_of(CUBE)[:-3].encode(), "cut short: 11 of 12 faces"),
        (b"\xff\xfe\x00", "not text"),
    ],
)
def test_damaged_off_files_are_described(content, message):
    with pytest.raises(DamagedMesh, match=message) as caught:
        parse_mesh(content, ".off", "bad.off")
    assert "bad.off" in str(caught.value)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------------------------------------------- normalisation


def test_normalised_meshes_are_centred_in_the_unit_sphere():
    mesh = normalise(CUBE.vertices * (4, 1, 2) + 7, CUBE.faces, "box")
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
    np.testing.assert_allclose(mesh.vertices.min(0) + mesh.vertices.max(0), 0, atol=1e-6)
    np.testing.assert_allclose(mesh.extent, [4, 1, 2], rtol=1e-6)


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int), EmptyMesh, "no faces"),
        (CUBE.vertices, np.zeros((0, 3), int), EmptyMesh, "no faces"),
        (np.zeros((3, 3)), [[0, 1, 2]], EmptyMesh, "single point"),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], EmptyMesh, "no area"),
        ([[0, 0, np.nan], [1, 0, 0], [2, 1, 0]], [[0, 1, 2]], DamagedMesh, "1 vertices that are not finite"),
        ([[0, 0, np.inf], [1, 0, 0], [2, 1, 0]], [[0, 1, 2]], DamagedMesh, "not finite"),
        ([[0, 0, 0], [1, 0, 0], [2, 1, 0]], [[0, 1, 3]], DamagedMesh, "beyond its 3"),
    ],
)
def test_unusable_meshes_are_told_apart(vertices, faces, error, message):
    with pytest.raises(error, match=message):
        normalise(np.array(vertices, float), np.array(faces, int), "thing")


# ---------------------------------------------------------------------------------------------------------------- sources


@pytest.mark.parametrize(
    "member", ["../evil/train/a.off", "/etc/train/a.off", "cup/../../train/a.off", "C:/x/train/a.off"]
)
def test_a_zip_whose_paths_leave_its_folder_is_refused(tmp_path, member):
    archive = tmp_path / "bad.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr(member, off_of(CUBE))
    with pytest.raises(DataError, match="leaves its folder"):
        opened(archive)


def test_voxels_become_surfaces(tmp_path):
    grid = np.zeros((1, 8, 8, 8), np.int32)
    grid[0, 2:6, 3:5, 2:7] = 1
    vertices, faces = VoxelGrid(np.packbits(grid[0].reshape(-1) > 0).tobytes(), 8).load()
    surface = trimesh.Trimesh(vertices, faces)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(40, rel=0.2)  # corners are cut off; outward faces have positive volume
    np.testing.assert_allclose(surface.bounds, [[1.5, 2.5, 1.5], [5.5, 4.5, 6.5]], atol=0.01)

    path = tmp_path / "voxels.npz"
    empty = np.zeros((2, 8, 8, 8), np.int32)
    np.savez(path, X_train=np.concatenate([grid, empty]), y_train=[0, 1, 1], X_test=grid, y_test=[1])
    source = opened(path)
    assert [entry.name for entry in source.entries][:2] == ["class_0_train_0000", "class_1_train_0001"]
    with pytest.raises(EmptyMesh, match="0 of 512 cells"):
        load_object(source.entries[1])


def test_real_voxels_have_the_official_split(real_voxels):
    source = opened(real_voxels)
    splits = [entry.split for entry in source.entries]
    assert (splits.count("train"), splits.count("test")) == (3991, 908)
    assert source.classes == CLASSES
    empty = 0
    for entry in source.entries:
        filled = np.unpackbits(np.frombuffer(entry.recipe.bits, np.uint8)).sum()
        empty += filled < 5
    assert empty == 40


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda root: root / "nowhere", "no such file or folder"),
        (lambda root: (root / "a.txt").write_text("x") and root / "a.txt", "not a data set"),
        (lambda root: (root / "a.off").write_text(off_of(CUBE)) and root / "a.off", "single mesh"),
        (lambda root: (root / "a.off").write_text("x") and root / "a.off", "does not begin with 'OFF'"),
        (lambda root: (root / "a.zip").write_text("x") and root / "a.zip", "not a readable zip"),
        (lambda root: (root / "a.npz").write_text("x") and root / "a.npz", "not a readable .npz"),
        (lambda root: write(root / "one", members(("cup",))), "one class only"),
        (lambda root: (root / "empty").mkdir() or root / "empty", "no meshes laid out"),
    ],
)
def test_unusable_data_is_described_in_one_sentence(tmp_path, make, message):
    with pytest.raises(DataError, match=message) as caught:
        opened(make(tmp_path))
    assert "\n" not in str(caught.value)


def test_an_empty_class_folder_is_named(tmp_path):
    root = write(tmp_path / "set", members())
    (root / "vase").mkdir()
    with pytest.raises(DataError, match="vase is empty"):
        opened(root)
    (root / "vase" / "train").mkdir()
    with pytest.raises(DataError, match="train is empty"):
        opened(root)


# -------------------------------------------------------------------------------------------------------------- furniture


def test_furniture_is_seeded_and_varied():
    for name in CLASSES:
        assert len(VARIANTS[name]) >= 4
        a, b = furniture(name, 3), furniture(name, 3)
        np.testing.assert_array_equal(a.vertices, b.vertices)
        shapes = {furniture(name, seed).vertices.tobytes() for seed in range(20)}
        assert len(shapes) == 20
    with pytest.raises(ValueError, match="no class 'lamp'"):
        furniture("lamp", 0)


@pytest.mark.parametrize("name", CLASSES)
def test_every_variant_stands_on_the_floor_at_a_plausible_size(name):
    for variant in VARIANTS[name]:
        for seed in range(3):
            piece = trimesh.util.concatenate(variant(np.random.default_rng(seed)))
            low, high = piece.bounds
            assert np.isfinite(piece.vertices).all()
            assert -0.05 < low[2] < 0.15, variant.__name__
            assert 0.2 < (high - low).max() < 3, variant.__name__
            normalise(piece.vertices, piece.faces, variant.__name__)


def test_training_and_test_furniture_differ():
    source = open_source("furniture10", train_per_class=3, test_per_class=2)
    assert len(source.entries) == 50
    shapes = {load_object(entry).vertices.tobytes() for entry in source.entries}
    assert len(shapes) == 50
    with pytest.raises(DataError, match="at least 2 training"):
        open_source("furniture10", train_per_class=1, test_per_class=1)
