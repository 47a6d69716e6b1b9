"""Results stored under an identity are computed once for each identity."""

from __future__ import annotations

import ast
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from data_pipeline.errors import DataError, Unreadable
from data_pipeline.files import CHECKS, keep_json, read_json, write_json
from tests.reference.evaluation import some_statistics, some_tables
from train.results import kept as keeping
from train.results.identity import VERSIONS, identity_of, made_by, stamp_of
from train.results.kept import keep_beside, kept_array, kept_json, kept_record, kept_with_arrays
from train.results.networks import check_config


def test_content_is_computed_once_for_each_identity(tmp_path):
    path, computed = tmp_path / "a" / "found.json", []

    def content() -> dict:
        computed.append(1)
        return {"values": (1, 2), "by_number": {3: np.float32(0.5)}}

    first = kept_json(path, {"seeds": (0, 1)}, content)
    assert first == kept_json(path, {"seeds": [0, 1]}, content) == read_json(path)
    assert first == {"values": [1, 2], "by_number": {"3": 0.5}, "identity": {"seeds": [0, 1]}}
    assert list(first) == ["values", "by_number", "identity"]
    assert len(computed) == 1
    assert kept_json(path, "another", lambda: {"identity": None, "last": 2}) == {"identity": "another", "last": 2}
    assert list(read_json(path)) == ["identity", "last"]


def test_an_array_is_computed_once_for_each_identity(tmp_path):
    path = tmp_path / "array.npz"
    for made, number, expected in (("a", 1.0, 1.0), ("a", 2.0, 1.0), ("b", 3.0, 3.0)):
        found = kept_array(path, made, lambda number=number: np.full((2, 3), number, np.float32))
        np.testing.assert_array_equal(found, np.full((2, 3), expected))
        assert found.dtype == np.float32


def test_a_failed_computation_leaves_what_is_stored(tmp_path):
    path = tmp_path / "found.json"
    kept_json(path, 1, lambda: {"value": 1})

    def fails() -> dict:
        raise DataError("no")

    with pytest.raises(DataError):
        kept_json(path, 2, fails)
    assert kept_json(path, 1, fails)["value"] == 1


def test_a_folder_of_another_run_is_refused(tmp_path):
    check_config(tmp_path, {"seed": 1}, "a network trained")
    write_json(tmp_path / "config.json", {"seed": 1})
    check_config(tmp_path, {"seed": 1}, "a network trained")
    with pytest.raises(DataError, match=r"holds a network trained with other settings \(.*\); choose another --out"):
        check_config(tmp_path, {"seed": 2}, "a network trained")


@pytest.mark.parametrize(
    "content", [b"", b'{"value": 1', b"[1]", b'{"value": 1}', b"\xff\xfe", b'{"value": 2, "identity": 1}']
)
def test_damaged_content_is_computed_again(tmp_path, content, capsys):
    path = tmp_path / "found.json"
    kept_json(path, 1, lambda: {"value": 1})
    path.write_bytes(content)
    assert kept_json(path, 1, lambda: {"value": 3}) == {"value": 3, "identity": 1}
    assert f"{path} cannot be read" in capsys.readouterr().err
    assert kept_json(path, 1, lambda: {"value": 4})["value"] == 3


def test_a_file_of_an_older_version_has_no_check_and_is_accepted(tmp_path):
    write_json(tmp_path / "found.json", {"value": 1, "identity": 1})
    assert kept_json(tmp_path / "found.json", 1, lambda: {"value": 2})["value"] == 1


def test_damaged_arrays_are_computed_again(tmp_path, random):
    path = tmp_path / "array.npz"
    whole = kept_array(path, "a", lambda: np.arange(60, dtype=np.float32))
    content = path.read_bytes()
    damaged = [b"", content[: len(content) // 2], b"PK", content[:200] + bytes(20) + content[220:]]
    for at in random.integers(0, 8 * len(content), 20):
        flipped = bytearray(content)
        flipped[at // 8] ^= 1 << (at % 8)
        damaged.append(bytes(flipped))
    for one in damaged:
        path.write_bytes(one)
        np.testing.assert_array_equal(kept_array(path, "a", lambda: np.arange(60, dtype=np.float32)), whole)


def test_a_folder_in_place_of_a_file_is_named_before_anything_is_computed(tmp_path):
    (tmp_path / "found.json").mkdir()
    with pytest.raises(DataError, match="it is a folder"):
        kept_json(tmp_path / "found.json", 1, dict)


def test_a_damaged_configuration_is_written_again_if_its_check_proves_it(tmp_path):
    path, identity = tmp_path / "config.json", {"seed": 1}
    keep_json(path, identity)
    (tmp_path / "latest").mkdir()
    for damage in (lambda: path.write_text('{"seed": 2}\n'), path.unlink):
        damage()
        check_config(tmp_path, identity, "a network trained")
        assert read_json(path) == identity
        damage()
        with pytest.raises(DataError, match="with other settings"):
            check_config(tmp_path, {"seed": 2}, "a network trained")
    (tmp_path / CHECKS).unlink()
    with pytest.raises(DataError, match="it is missing"):
        check_config(tmp_path, identity, "a network trained")


def test_a_file_that_follows_from_another_is_kept(tmp_path, capsys):
    path = tmp_path / "table.csv"
    keep_beside(path, b"a,b\n")
    made = path.stat().st_mtime_ns
    keep_beside(path, b"a,b\n")
    assert path.stat().st_mtime_ns == made
    for damage in (lambda: path.write_bytes(b"a"), path.unlink, lambda: (tmp_path / CHECKS).unlink()):
        damage()
        keep_beside(path, b"a,b\n")
        assert path.read_bytes() == b"a,b\n"
    assert capsys.readouterr().err.count("is not as it was written, so it is made again") == 1
    keep_beside(path, b"c\n")  # of other content
    assert path.read_bytes() == b"c\n"
    path.unlink()
    path.mkdir()
    with pytest.raises(Unreadable, match="it is a folder"):
        keep_beside(path, b"c\n")


def test_what_a_result_is_made_of_is_named(tmp_path):
    """A data set, and how each network was trained and how well; not how long that took."""
    statistics, folder = some_statistics(some_tables()), tmp_path / "network"
    summary = {"best_epoch": 2, "best": {"accuracy": 0.5}, "epoch": 3, "best_loss": 1.0, "seconds": 1.0, "steps": 9}
    keep_json(folder / "config.json", {"task": {"seed": 0}})
    keep_json(folder / "summary.json", summary | {"start": "random weights"})
    one = made_by(statistics, folder)
    assert made_by(replace(statistics, points_mean=99.0), folder) != one
    assert made_by(statistics) != one
    for name, changed in (("seconds", 2.0), ("best_epoch", 1), ("best", {"accuracy": 0.6})):
        keep_json(folder / "summary.json", summary | {"start": "random weights", name: changed})
        assert (made_by(statistics, folder) == one) == (name == "seconds")
    keep_json(folder / "summary.json", summary | {"start": "random weights"})
    assert made_by(statistics, folder) == one
    keep_json(folder / "config.json", {"task": {"seed": 1}})
    assert made_by(statistics, folder) != one


def numbers(scale: float) -> tuple[dict, dict[str, np.ndarray]]:
    return {"scale": scale}, {"numbers": scale * np.arange(4.0)}


def scale_of(path, identity, scale: float) -> float:
    """The scale of the stored content and arrays, which are one result; computed with `scale` if they are stale."""
    content, arrays = kept_with_arrays(path, identity, lambda: numbers(scale))
    np.testing.assert_array_equal(arrays["numbers"], content["scale"] * np.arange(4.0))
    return content["scale"]


def test_arrays_are_one_result_with_the_file_beside_them(tmp_path, capsys):
    path = tmp_path / "walks.json"
    assert scale_of(path, 1, 1.0) == scale_of(path, 1, 2.0) == 1.0
    np.savez(path.with_suffix(".npz"), numbers=3 * np.arange(4.0))  # edited
    assert scale_of(path, 1, 4.0) == 4.0
    path.with_suffix(".npz").unlink()
    assert scale_of(path, 1, 5.0) == 5.0
    said = " ".join(capsys.readouterr().err.split())
    assert "walks.npz holds other arrays than those that were stored with it" in said
    assert "walks.npz, which belongs to it, is missing" in said


def test_a_job_that_ends_between_two_files_mixes_no_results(tmp_path, monkeypatch):
    path = tmp_path / "walks.json"
    assert scale_of(path, {"reach": 0}, 1.0) == 1.0

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(keeping, "keep", killed)  # which writes the JSON file, last
        with pytest.raises(KeyboardInterrupt):
            scale_of(path, {"reach": 1}, 2.0)
    assert scale_of(path, {"reach": 0}, 3.0) == 3.0  # the arrays are those of the other reach
    assert scale_of(path, {"reach": 0}, 4.0) == 3.0


def test_arrays_that_were_edited_are_computed_again(tmp_path, capsys):
    path = tmp_path / "array.npz"
    kept_array(path, "a", lambda: np.zeros(3))
    np.savez(path, array=np.ones(3), made_by=np.array("a"))
    np.testing.assert_array_equal(kept_array(path, "a", lambda: np.full(3, 2.0)), np.full(3, 2.0))
    assert "it is not as it was written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("now", "version", "sentence"),
    [
        ({"made_by": "other networks"}, 1, "the data, networks or results that it was made from are others now"),
        ({"reach": {"lowest": 20}}, 1, "its settings were others: reach.lowest 0, not 20"),
        ({}, 2, "it is of version 1 of such results, and this program has version 2"),
    ],
)
@pytest.mark.parametrize("older", [False, True])
def test_a_stale_result_is_computed_anew_and_says_why(tmp_path, monkeypatch, capsys, now, version, sentence, older):
    """Also one that was made before there were versions."""
    path, settings = tmp_path / "found.json", {"made_by": "networks", "reach": {"lowest": 0}}
    monkeypatch.setitem(VERSIONS, "metrics", 1)
    identity = identity_of("metrics", **settings)
    if older:
        write_json(path, {"value": 1, "identity": settings})
    assert kept_json(path, identity, lambda: {"value": 1})["value"] == 1
    assert capsys.readouterr().err == ""
    monkeypatch.setitem(VERSIONS, "metrics", version)
    assert kept_json(path, identity_of("metrics", **settings | now), lambda: {"value": 2})["value"] == 2
    assert f"{path} is computed anew: {sentence}" in " ".join(capsys.readouterr().err.split())


def test_arrays_of_another_version_are_computed_anew(tmp_path, monkeypatch, capsys):
    path = tmp_path / "array.npz"
    monkeypatch.setitem(VERSIONS, "tables", 1)
    assert stamp_of("tables", "made") == "made"  # as before there were versions
    kept_array(path, "made", lambda: np.zeros(1))
    monkeypatch.setitem(VERSIONS, "tables", 2)
    assert kept_array(path, stamp_of("tables", "made"), lambda: np.ones(1))[0] == 1
    assert "it is of version 1 of such results" in " ".join(capsys.readouterr().err.split())
    assert (
        kept_array(path, stamp_of("tables", "other 1.0"), lambda: np.full(1, 2.0))[0] == 2
    )  # with a dot, as FITTED_AS has
    assert "the data, networks or results that it was made from are others now" in " ".join(
        capsys.readouterr().err.split()
    )


@dataclass(frozen=True)
class Value:
    value: float


def test_a_record_is_kept_under_its_identity(tmp_path, capsys):
    path = tmp_path / "found.json"
    assert kept_record(path, Value, {"version": 1}, lambda: Value(1.0)) == Value(1.0)
    assert kept_record(path, Value, {"version": 1}, lambda: Value(2.0)) == Value(1.0)
    assert read_json(path) == {"value": 1.0, "identity": {"version": 1}}
    keep_json(path, {"share": 1.0, "identity": {"version": 1}})  # of another form
    assert kept_record(path, Value, {"version": 1}, lambda: Value(3.0)) == Value(3.0)
    assert "another form" in " ".join(capsys.readouterr().err.split())


def test_every_kind_of_result_has_a_version_that_is_used():
    root, used = Path(__file__).parents[2], set()
    for path in (*(root / "train").rglob("*.py"), *(root / "eval").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            called = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id
            if called in ("identity_of", "stamp_of") and isinstance(node.args[0], ast.Constant):
                used.add(node.args[0].value)
    assert used == set(VERSIONS)
