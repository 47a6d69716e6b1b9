"""Files are written completely or not at all, and what is read is what was written."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal

import pytest

from data_pipeline import files
from data_pipeline.errors import DataError, Unreadable
from data_pipeline.files import (
    CHECKS,
    check_of_file,
    checks_in,
    damage_in,
    files_in,
    keep_checks,
    keep_json,
    read_json,
    size_of_file,
    was_written,
    why_not_written,
    write_bytes,
    write_json,
    write_text,
)


def test_content_is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch):
    calls = []
    real = {name: getattr(os, name) for name in ("fsync", "replace")}
    for name in real:
        monkeypatch.setattr(os, name, lambda *given, name=name: (calls.append(name), real[name](*given)))
    write_text(tmp_path / "a" / "text", "é")
    assert calls == ["fsync", "replace", "fsync"]
    assert (tmp_path / "a" / "text").read_bytes() == "é".encode()
    calls.clear()
    write_bytes(tmp_path / "capture", b"1", durable=False)
    assert calls == ["replace"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "capture"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "it is empty"), (b'{"a": 1', "it is no JSON"), (b"\xff{}", "it is no JSON"), (b"[" * 9999, "it is no JSON")],
)
def test_what_is_no_json_is_named(tmp_path, content, reason):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(Unreadable, match=reason) as error:
        read_json(tmp_path / "a.json")
    assert str(error.value).startswith(f"{tmp_path / 'a.json'} cannot be read")
    with pytest.raises(Unreadable, match="directory"):
        read_json(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "none.json")


def test_a_flipped_bit_in_a_number_is_found(tmp_path):
    path = tmp_path / "a.json"
    keep_json(path, {"loss": 0.25})
    assert read_json(path) == {"loss": 0.25}
    assert was_written(path, {"loss": 0.25})
    path.write_text(path.read_text().replace("5", "4"))
    with pytest.raises(Unreadable, match="not as it was written"):
        read_json(path)
    assert was_written(path, {"loss": 0.25})
    assert not was_written(path, {"loss": 0.24})
    (tmp_path / CHECKS).write_text('{"a.json')  # damaged itself: nothing is checked
    assert read_json(path) == {"loss": 0.24}
    keep_json(path, {"loss": 1})
    assert read_json(path) == {"loss": 1}
    assert list(checks_in(tmp_path)) == ["a.json"]


def test_a_job_that_ends_between_check_and_file_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    keep_json(path, 1)
    real = files.write_bytes
    monkeypatch.setattr(files, "write_bytes", lambda path, *rest: real(path, *rest) if path.name == CHECKS else None)
    keep_json(path, 2)
    assert read_json(path) == 1
    monkeypatch.undo()
    keep_json(path, 2)
    assert read_json(path) == 2


def test_files_of_a_folder_are_compared_with_their_checks(tmp_path):
    for name in ("a", "b/c"):
        write_bytes(tmp_path / name, name.encode())
    keep_checks(tmp_path, {name: check_of_file(tmp_path / name) for name in files_in(tmp_path)}, only=True)
    assert set(checks_in(tmp_path)) == {"a", "b/c"}
    assert damage_in(tmp_path) is None
    (tmp_path / "b" / "c").write_bytes(b"x/c")
    assert damage_in(tmp_path, check=size_of_file) is None
    assert damage_in(tmp_path) == f"{tmp_path / 'b' / 'c'} is not as it was written"
    (tmp_path / "b" / "c").write_bytes(b"x")
    assert damage_in(tmp_path, check=size_of_file) is not None
    (tmp_path / "b" / "c").unlink()
    assert damage_in(tmp_path, check=size_of_file) == f"{tmp_path / 'b' / 'c'} is missing"
    assert damage_in(tmp_path, ["a", "unchecked"]) == f"{tmp_path / 'unchecked'} is missing"


def test_a_limit_on_the_size_of_files_is_a_sentence(tmp_path):
    path, before = tmp_path / "large", resource.getrlimit(resource.RLIMIT_FSIZE)
    write_bytes(path, b"old")
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(DataError, match=r"large: it would be larger than files may be here; raise the limit"):
            write_bytes(path, bytes(2000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["large"]


def test_a_full_disk_is_recognised_in_what_libraries_raise(tmp_path):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/out/x")
    assert (
        why_not_written(full) == "cannot write /out/x: the disk is full; free some space, and the same command goes on"
    )
    library = ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device")
    assert "the disk is full" in (why_not_written(library) or "")
    wrapped = RuntimeError("save failed")
    wrapped.__cause__ = full
    assert "the disk is full" in (why_not_written(wrapped) or "")
    assert why_not_written(ValueError("another")) is None
    assert why_not_written(OSError(errno.ENOENT, "none", "x")) is None
    assert "change its permissions" in (why_not_written(PermissionError(errno.EACCES, "denied", "/x")) or "")


def test_a_folder_in_place_of_a_file_is_named(tmp_path):
    (tmp_path / "a.json").mkdir()
    with pytest.raises(DataError, match=r"a folder lies where a file belongs; remove it"):
        write_json(tmp_path / "a.json", 1)
    (tmp_path / "b").write_text("")
    with pytest.raises(DataError, match=r"a file lies where a folder belongs; remove it"):
        write_json(tmp_path / "b" / "a.json", json.loads("1"))
