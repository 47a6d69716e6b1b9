"""Results stored under an identity are computed once for each identity."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipeline.errors import DataError
from data_pipeline.files import read_json, write_json
from train.kept import check_config, kept_array, kept_json


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
    with pytest.raises(DataError, match="holds a network trained with other settings; choose another --out"):
        check_config(tmp_path, {"seed": 2}, "a network trained")
