"""The official archives: downloaded and checked, or given as a file; on an archive made here in ModelNet's layout."""

from __future__ import annotations

import hashlib
import threading
import zipfile
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset import origin
from data_pipeline.dataset.builder import DataConfig, open_split, prepare
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from data_pipeline.objects import downloads
from data_pipeline.objects.downloads import ARCHIVES, Archive, download, local


def off(mesh: trimesh.Trimesh, header: str) -> str:
    """A mesh as OFF, its first line and counts as `header` has them."""
    lines = [header.format(vertices=len(mesh.vertices), faces=len(mesh.faces))]
    lines += [" ".join(f"{x:.6f}" for x in vertex) for vertex in mesh.vertices]
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def made_archive(tmp_path_factory) -> Path:
    """ModelNet's layout and quirks: joined headers, Windows line ends, an empty mesh, Apple's folders, a README."""
    path = tmp_path_factory.mktemp("archive") / "ModelNet10.zip"
    shapes = {"bathtub": trimesh.creation.box((3, 1, 1)), "night_stand": trimesh.creation.icosphere(1)}
    headers = (
        "OFF\n{vertices} {faces} 0",
        "OFF{vertices} {faces} 0",
        "OFF\r\n{vertices} {faces} 0\r",
        "OFF {vertices} {faces} 0",
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("ModelNet10/README.txt", "ModelNet10 Dataset")
        for name, shape in shapes.items():
            for split, count in (("train", 5), ("test", 2)):
                for index in range(count):
                    member = f"{name}/{split}/{name}_{index + (500 if split == 'test' else 0):04d}.off"
                    archive.writestr(f"ModelNet10/{member}", off(shape, headers[index % len(headers)]))
                    archive.writestr(
                        f"__MACOSX/ModelNet10/{name}/{split}/._{name}_{index:04d}.off", b"\x00\x05\x16\x07"
                    )
        archive.writestr("ModelNet10/bathtub/train/bathtub_0099.off", "OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n")
        archive.writestr("ModelNet10/bathtub/train/.DS_Store", b"\x00")
    return path


@pytest.fixture
def served(made_archive):
    """The archive on a server of our own, and what was asked of it."""
    asked = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *arguments):
            asked.append(self.command)

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(made_archive.parent)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/ModelNet10.zip"
    content = made_archive.read_bytes()
    yield Archive("ModelNet10", url, hashlib.sha256(content).hexdigest(), len(content), 2, 10, 4), asked
    server.shutdown()
    server.server_close()


def test_an_archive_is_downloaded_once_and_checked(served, made_archive, tmp_path):
    archive, asked = served
    path = download(archive, tmp_path)
    assert path.read_bytes() == made_archive.read_bytes()
    assert asked == ["HEAD", "GET"]
    assert download(archive, tmp_path) == path
    assert asked == ["HEAD", "GET"]
    assert download(replace(archive, size=None), tmp_path / "again").exists()


@pytest.mark.parametrize("wrong", [{"sha256": "0" * 64}, {"size": 5}])
def test_another_file_in_its_place_is_refused(served, tmp_path, wrong):
    with pytest.raises(DataError, match=r"not ModelNet10: its size or SHA-256 differs; download .* with --archive"):
        download(replace(served[0], **wrong), tmp_path)


def test_without_a_network_the_way_out_is_named(tmp_path):
    gone = replace(ARCHIVES["modelnet40"], url="http://127.0.0.1:9/ModelNet40.zip")
    with pytest.raises(DataError, match=r"ModelNet40 could not be downloaded .* pass the file with --archive"):
        download(gone, tmp_path)


def test_a_data_set_is_made_from_the_archive(served, made_archive, tmp_path, monkeypatch, capsys):
    """By download and by `--archive`: the same objects, the empty one named, Apple's folders not looked at."""
    monkeypatch.setitem(ARCHIVES, "modelnet10", served[0])
    monkeypatch.setattr(origin, "download_folder", lambda: tmp_path / "downloads")
    config = DataConfig(source="modelnet10", capture=CaptureConfig(views=3, resolution=16))
    by_download = prepare(config, tmp_path / "a")
    by_file = prepare(replace(config, archive=str(made_archive)), tmp_path / "b")
    assert by_download == by_file == load_statistics(tmp_path / "a")
    assert by_file.source == "ModelNet10"
    assert by_file.classes == ["bathtub", "night_stand"]
    assert {split: sum(counts.values()) for split, counts in by_file.counts.items()} == {
        "train": 8,
        "val": 2,
        "test": 4,
    }
    assert by_file.left_out["train"] == {
        "bathtub/train/bathtub_0099.off": "mesh has no faces: it is a point cloud of 3 points"
    }
    depths = [open_split(tmp_path / folder, "test")[0]["depth"] for folder in "ab"]
    np.testing.assert_array_equal(*depths)
    assert "2 classes" in " ".join(capsys.readouterr().err.split())  # one training object more than was said


def test_another_archive_is_taken_and_said(made_archive, capsys):
    assert local(ARCHIVES["modelnet10"], made_archive) == made_archive
    assert "not the official ModelNet10" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(DataError, match="cannot be read"):
        local(ARCHIVES["modelnet10"], made_archive.parent / "none.zip")
    with pytest.raises(DataError, match="--archive goes with --data modelnet10 or modelnet40, not with furniture10"):
        prepare(DataConfig(archive="x.zip"), made_archive.parent / "out")


def test_downloads_lie_where_tfds_keeps_them(monkeypatch, tmp_path):
    monkeypatch.setenv("TFDS_DATA_DIR", str(tmp_path))
    assert downloads.download_folder() == tmp_path / "downloads"


def test_original_modelnet_meshes_become_a_data_set(real_meshes, tmp_path):
    """The few originals at hand, in an archive of their layout; the one toilet stands on both sides of the split."""
    path = tmp_path / "ModelNet10.zip"
    bathtubs = sorted(real_meshes.glob("bathtub_*.off"))
    (toilet,) = real_meshes.glob("toilet_*.off")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for index, mesh in enumerate(bathtubs):
            archive.write(mesh, f"ModelNet10/bathtub/{'train' if index < 3 else 'test'}/{mesh.name}")
        for split, name in (("train", "a"), ("train", "b"), ("test", "c")):
            archive.write(toilet, f"ModelNet10/toilet/{split}/toilet_{name}.off")
    config = DataConfig(source="modelnet10", archive=str(path), capture=CaptureConfig(views=10, resolution=48))
    statistics = prepare(config, tmp_path / "data")
    assert statistics.left_out_count == 0
    source = open_split(tmp_path / "data", "test")
    for index in range(len(source)):
        seen = (source[index]["depth"] > 0).mean(axis=(1, 2))
        assert seen.min() > 0.03, source[index]["name"]
        assert seen.max() < 0.9
    assert 2 < statistics.entropy_max < 6
