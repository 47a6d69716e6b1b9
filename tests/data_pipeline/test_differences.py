"""What differs between two configurations."""

from __future__ import annotations

from data_pipeline.differences import differences, in_words


def test_differences_are_named_by_place():
    was = {"seed": 0, "capture": {"views": 40, "lattice": "rings"}, "same": [1, 2], "old": 1}
    now = {"seed": 1, "capture": {"views": 10, "lattice": "rings"}, "same": [1, 2], "new": ""}
    found = differences(was, now)
    assert list(found)[:3] == ["seed", "capture.views", "old"]
    assert in_words(found) == 'seed 0, not 1; capture.views 40, not 10; old 1, not nothing; new nothing, not ""'
    assert list(differences(was, now, "data", shared=True)) == ["data.seed", "data.capture.views"]
    assert differences(was, was) == {}
    assert differences({"a": {"b": 1}}, {"a": None}) == {"a": ({"b": 1}, None)}


def test_a_message_stays_short():
    found = differences(dict.fromkeys("abcdefg", 0), dict.fromkeys("abcdefg", "x" * 100))
    said = in_words(found)
    assert said.count("not") == 4
    assert said.endswith("…; 3 more")
    assert len(said) < 350
