"""What `benchmarks/choices.py` keeps of walks is what they said."""

import json
from dataclasses import fields

import numpy as np
import pytest

from benchmarks import choices
from eval.learned.comparison import BASELINES, ByObject, compared, seeds_together

POLICIES = (*BASELINES, "learned", "belief_oracle")
OBJECTS, STARTS = 30, 40


def test_what_is_kept_says_what_the_walks_said(tmp_path, monkeypatch, random):
    folder = tmp_path / "run" / "learned" / "seed_0"
    folder.mkdir(parents=True)
    each = {
        name: ByObject(
            random.integers(0, STARTS + 1, (4, OBJECTS)) / STARTS,
            random.normal(-0.5, 0.3, (4, OBJECTS)).astype(np.float32),
            random.integers(0, 9, (4, OBJECTS)) / 8,
        )
        for name in POLICIES
    }
    policies = {
        name: {"title": name, "knows": "views", "calibration_error": [0.01] * 4, "interval": []} for name in POLICIES
    }
    found = {"objects": OBJECTS, "views": STARTS, "trying_starts": 8, "single_view": 0.8, "policies": policies}
    arrays = {f"{name} {field.name}": getattr(one, field.name) for name, one in each.items() for field in fields(one)}
    np.savez(folder / "walks_lattice_40.npz", **arrays)
    (folder / "walks_lattice_40.json").write_text(json.dumps(found))
    names = [f"chair_{i}" for i in range(OBJECTS)]
    monkeypatch.setattr(choices, "read_index", lambda folder, split, *columns: {"name": names})
    monkeypatch.setattr(choices, "RESULTS", tmp_path)
    gain = {"difference": [0.0, 0.015, 0.01], "interval": [[0.0, 0.0], [0.008, 0.022], [-0.001, 0.02]]}
    novel = {"objects": OBJECTS, "pairs": [{}], "gain": {"expected_views_without": gain}}
    (folder / "walks_novel.json").write_text(json.dumps(novel))
    np.savez(folder / "walks_novel.npz", random=np.ones((4, OBJECTS)))
    choices.main(tmp_path / "run", "others")

    assert json.loads((tmp_path / "others" / "seed_0_novel.json").read_text()) == novel
    told, mine = choices.kept(tmp_path / "others" / "seed_0_lattice_40.npz")
    for name, one in each.items():
        np.testing.assert_allclose(mine[name].right, one.right, atol=1e-12)
        np.testing.assert_allclose(mine[name].from_some, one.from_some, atol=1e-12)
        np.testing.assert_allclose(mine[name].likelihood, one.likelihood, atol=1e-3)
    again = seeds_together([told], [mine], "learned")
    gain = compared(each, "learned")["against"]["random"]["learned"]
    np.testing.assert_allclose(again["against"]["random"]["learned"]["interval"], gain["interval"], atol=1e-6)
    page = (tmp_path / "others.md").read_text()
    assert "| expected views without those of the two classes | **+1.5 [+0.8, +2.2]** | +1.0 [−0.1, +2.0] |" in page
    low, high = gain["interval"][1]
    assert f"{100 * gain['difference'][1]:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]".replace("-", "−") in page


def test_shares_that_would_not_be_exact_are_refused():
    with pytest.raises(ValueError, match="the shares are no multiples of 1/240 or 1/720"):
        choices._packed("random right", np.array([1 / 7]))


def test_shares_of_nine_starts_are_exact_in_two_bytes():
    packed = choices._packed("random from_some", np.arange(10) / 9)
    assert packed.dtype == np.uint16
    np.testing.assert_allclose(choices._shares(packed), np.arange(10) / 9, atol=1e-12)
