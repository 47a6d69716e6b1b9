"""Typed results are written to JSON and CSV, and read back; what has another form is refused."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest
from jaxtyping import Bool, Float, Int

from data_pipeline.errors import DataError
from train.results.records import as_json, csv_of, ends, from_json, named, numbered


@dataclass(frozen=True)
class Inner:
    share: float
    interval: Float[np.ndarray, "2"]
    reached: float | None = None


@dataclass(frozen=True)
class Outer:
    title: str
    accuracy: Float[np.ndarray, "limits thresholds"] = named("after_views")
    reachable: Bool[np.ndarray, " views"]
    counts: Int[np.ndarray, " views"]
    by_views: dict[int, Inner]
    pair: tuple[float, float]
    names: list[str]
    source: dict[str, str] | None = named("own", omitted=True)


def outer(**other: object) -> Outer:
    content = {
        "title": "a title",
        "accuracy": np.float32([[0.1, 1.0], [0.25, 0.5]]),
        "reachable": np.array([True, False]),
        "counts": np.array([1, 2]),
        "by_views": {10: Inner(0.5, np.array([0.25, 0.75]), None)},
        "pair": (0.0, 1.0),
        "names": ["a", "b"],
    }
    return Outer(**(content | other))


def read(content: object) -> Outer:
    return from_json(Outer, json.loads(json.dumps(content)), "a file")


def test_a_record_is_read_as_it_was_written():
    written = as_json(outer())
    assert list(written) == ["title", "after_views", "reachable", "counts", "by_views", "pair", "names"]
    again = read(written)
    assert as_json(again) == written
    assert again.accuracy.dtype == np.float64
    np.testing.assert_array_equal(again.accuracy, np.float32([[0.1, 1.0], [0.25, 0.5]]))
    assert again.reachable.dtype == bool
    assert again.counts.dtype == np.int64
    assert again.by_views[10].share == 0.5
    assert again.by_views[10].reached is None
    assert again.pair == (0.0, 1.0)
    assert again.names == ["a", "b"]
    assert again.source is None
    assert read(as_json(outer(source={"module": "mine"}))).source == {"module": "mine"}


def test_whole_numbers_and_empty_lists_are_arrays_of_numbers():
    again = read(as_json(outer()) | {"after_views": [[1, 0]], "reachable": [], "counts": []})
    assert again.accuracy.dtype == np.float64
    assert again.reachable.dtype == bool
    assert again.reachable.shape == (0,)


@pytest.mark.parametrize(
    ("entry", "value", "place"),
    [
        ("title", 3, "content.title"),
        ("after_views", [[0.1], [0.2, 0.3]], "content.after_views"),
        ("after_views", [0.1, 0.2], "content.after_views"),
        ("after_views", [["a"]], "content.after_views"),
        ("after_views", [[float("nan")]], "content.after_views"),
        ("reachable", [0, 1], "content.reachable"),
        ("counts", [0.5], "content.counts"),
        ("by_views", {"ten": {}}, "ten"),
        ("by_views", {"10": {"share": 0.5}}, "lacks 'interval'"),
        ("by_views", {"10": {"share": 0.5, "interval": [1, 2, 3]}}, "content.by_views.10.interval"),
        ("pair", [1.0], "content.pair"),
        ("names", [1], r"content.names\[0\]"),
        ("unknown", 1, "unknown"),
    ],
)
def test_content_of_another_form_is_refused_by_its_place(entry, value, place):
    with pytest.raises(DataError, match=f"^a file has another form than results of this version: .*{place}"):
        read(as_json(outer()) | {entry: value})


def test_an_entry_that_is_missing_is_named():
    content = as_json(outer())
    del content["after_views"]
    with pytest.raises(DataError, match="lacks 'after_views'"):
        read(content)


def test_csv_has_the_digits_of_float32():
    rows = [
        {
            "name": "a, b",
            "share": float(np.float32(0.15)),
            **ends("share", [0.1, 1 / 3]),
            **numbered("training", [0, 1.0]),
        },
        {"name": "c", "share": 1.0, "share_low": 0.5, "share_high": 2, "training_0": 1e-9, "training_1": 0.25},
    ]
    lines = csv_of(rows).decode().splitlines()
    assert lines == [
        "name,share,share_low,share_high,training_0,training_1",
        '"a, b",0.15,0.1,0.33333334,0.0,1.0',
        "c,1.0,0.5,2,1e-09,0.25",
    ]
    assert np.float32(float(lines[1].split(",")[4])) == np.float32(1 / 3)
