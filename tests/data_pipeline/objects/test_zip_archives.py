"""Zip archives as other programs write them, and damaged ones."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from data_pipeline.errors import DamagedMesh, DataError
from data_pipeline.objects import archives
from data_pipeline.objects.sources import load_object
from tests.data_pipeline.objects.making import Glb, box, members, off, opened, triangles_of, zipped

FILES = members(("mug", "rack"))


def archive_of(folder: Path, content: bytes) -> Path:
    path = folder / "set.zip"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "rename",
    [
        lambda name: f"objects\\{name}".replace("/", "\\"),
        lambda name: f"./{name}",
        lambda name: name.replace("/", "//"),
        lambda name: f"set/./{name}",
    ],
    ids=["backslashes", "dot", "double", "inner-dot"],
)
def test_names_as_other_programs_write_them(tmp_path, rename):
    source = opened(archive_of(tmp_path, zipped({rename(name): content for name, content in FILES.items()})))
    assert [entry.name for entry in source.entries] == sorted(FILES)
    for entry in source.entries:
        load_object(entry)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_python_reads(tmp_path, method):
    for entry in opened(archive_of(tmp_path, zipped(FILES, method))).entries:
        load_object(entry)
    assert [path.name for path in tmp_path.iterdir()] == ["set.zip"]  # nothing is unpacked


def test_of_a_member_that_is_there_twice_the_later_counts(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in FILES.items():
            archive.writestr(name, content)
        archive.writestr("./mug/train/mug_0.off", off(*box((1, 1, 4))))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("mug/train/mug_0.off", off(*box((1, 1, 5))))
    source = opened(archive_of(tmp_path, buffer.getvalue()))
    assert len(source.entries) == 6
    (entry,) = [entry for entry in source.entries if entry.name == "mug/train/mug_0.off"]
    assert load_object(entry).extent[2] == 5
    assert source.said == ("members replaced by later ones of the same name: 2",)


def changed(content: bytes, *, flags: int | None = None, method: int | None = None) -> bytes:
    """An archive whose members say that they are encrypted, or compressed with another method."""
    found = bytearray(content)
    for mark, at_flags, at_method in ((b"PK\3\4", 6, 8), (b"PK\1\2", 8, 10)):
        start = found.find(mark)
        while start >= 0:
            if flags is not None:
                found[start + at_flags] = flags
            if method is not None:
                found[start + at_method] = method
            start = found.find(mark, start + 4)
    return bytes(found)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"flags": 1},
            "every mesh in it, such as mug/train/mug_0.off, is encrypted; unpack the archive with its password",
        ),
        ({"method": 9}, r"method 9 \(Deflate64\), which Python cannot read; .* pack it again"),
        ({"method": 93}, r"method 93 \(Zstandard\)"),
        ({"method": 77}, r"method 77 \(unknown\)"),
    ],
)
def test_archives_that_python_cannot_read_are_described(tmp_path, change, message):
    with pytest.raises(DataError, match=message) as caught:
        opened(archive_of(tmp_path, changed(zipped(FILES), **change)))
    assert "\n" not in str(caught.value)


def test_one_damaged_member_is_named(tmp_path):
    content = bytearray(zipped(FILES))
    at = content.find(b"rack/train/rack_1.off") + len("rack/train/rack_1.off") + 20
    content[at : at + 20] = bytes(byte ^ 0xFF for byte in content[at : at + 20])
    for entry in opened(archive_of(tmp_path, bytes(content))).entries:
        if entry.name == "rack/train/rack_1.off":
            with pytest.raises(DamagedMesh, match=r"^rack/train/rack_1.off in .* cannot be unpacked"):
                load_object(entry)
        else:
            load_object(entry)


@pytest.mark.parametrize("end", [0, 100, -1, -30, -200])
def test_archives_that_are_cut_short_are_described(tmp_path, end):
    with pytest.raises(DataError, match="not a readable zip file"):
        opened(archive_of(tmp_path, zipped(FILES)[:end]))


def test_sizes_are_capped(tmp_path, monkeypatch):
    """A bomb declares its size, or declares a small one."""
    monkeypatch.setattr(archives, "LARGEST_MEMBER", 10_000)
    bomb = zipped(FILES | {"mug/train/bomb.off": b"OFF\n" + b"0 " * 100_000})
    for content in (bomb, bomb.replace((200_004).to_bytes(4, "little"), (9_000).to_bytes(4, "little"))):
        (entry,) = [entry for entry in opened(archive_of(tmp_path, content)).entries if "bomb" in entry.name]
        with pytest.raises(DamagedMesh, match=r"unpacks to more than|cannot be unpacked"):
            load_object(entry)


def test_the_directory_is_read_once(tmp_path, monkeypatch):
    many = {
        f"{name}/{split}/{at}.off": off(*box())
        for name in ("a", "b")
        for split in ("train", "test")
        for at in range(50)
    }
    path = archive_of(tmp_path, zipped(many))
    opens = []
    real = zipfile.ZipFile.__init__
    monkeypatch.setattr(zipfile.ZipFile, "__init__", lambda self, *a, **k: opens.append(a) or real(self, *a, **k))
    for entry in opened(path).entries:
        load_object(entry)
    assert len(opens) == 1
    path.write_bytes(zipped(FILES))  # another archive of this name is another archive
    assert len(opened(path).entries) == 6


def test_files_of_gltf_are_found_in_the_archive(tmp_path):
    made = Glb()
    made.node(mesh=made.mesh(made.primitive(box()[0], triangles_of(box()[1]))))
    document = made.gltf("numbers.bin")
    more = {"mug/train/a/scene.gltf": document, "mug/train/a/numbers.bin": made.binary, "rack/train/b.gltf": document}
    source = opened(archive_of(tmp_path, zipped(FILES | more)))
    by_name = {entry.name: entry for entry in source.entries}
    assert load_object(by_name["mug/train/a/scene.gltf"]).extent.tolist() == [1, 3, 2]
    with pytest.raises(DamagedMesh, match=r"needs 'numbers.bin', which is not in the archive"):
        load_object(by_name["rack/train/b.gltf"])


def test_links_and_other_files_in_archives_are_named(tmp_path):
    link = zipfile.ZipInfo("mug/train/link.off")
    link.external_attr = 0o120777 << 16
    buffer = io.BytesIO(zipped(FILES | {"mug/train/a.fbx": b"", "__MACOSX/._a.off": b""}))
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(link, "mug_0.off")
    source = opened(archive_of(tmp_path, buffer.getvalue()))
    assert list(source.left_out["train"]) == ["mug/train/a.fbx"]
    (entry,) = [entry for entry in source.entries if "link" in entry.name]
    with pytest.raises(DamagedMesh, match="is a link, which is not followed in an archive"):
        load_object(entry)


def test_archives_without_splits_take_the_option(tmp_path):
    files = {f"{name}/{at}.off": off(*box((1, 1, at + 1))) for name in ("mug", "rack") for at in range(5)}
    path = archive_of(tmp_path, zipped(files))
    with pytest.raises(DataError, match=r"add --dataset.split 0.8"):
        opened(path)
    splits = [entry.split for entry in opened(path, split="0.8").entries]
    assert (splits.count("train"), splits.count("test")) == (8, 2)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_no_method_unpacks_more_than_the_archive_declares(tmp_path, method):
    """Python's readers of these methods unpack all of a chunk, whatever is asked for."""
    content = zipped(FILES | {"mug/train/mug_9.off": bytes(64 << 20)}, method)
    path = archive_of(tmp_path, content.replace(struct.pack("<L", 64 << 20), struct.pack("<L", 8)))
    (entry,) = (entry for entry in opened(path).entries if "mug_9" in entry.name)
    tracemalloc.start()
    with pytest.raises(DamagedMesh, match="not of the size and checksum that the archive declares"):
        load_object(entry)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()
