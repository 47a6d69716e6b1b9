"""A trained system on objects of other makers: which are used, and what is measured."""

from __future__ import annotations

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import mevs_jax
from data_pipeline.errors import DataError
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.sources import objects_to_test
from eval.checks.promise import auroc, promises, strangers
from eval.checks.transfer import STRANGER, Transfer, check_transfer, matched
from eval.checks.walks import Walker, Walks
from mevs_jax.beliefs.strangeness import Strangeness
from mevs_jax.cli.checks import transfer_text
from mevs_jax.meshes.reading import read_mesh
from mevs_jax.selection.loop import ViewTable
from tests.mevs_jax.trained import making
from train.results.records import as_json, from_json


def write_off(path, vertices, faces) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    lines += [" ".join(f"{x:.6g}" for x in vertex) for vertex in vertices]
    lines += ["3 " + " ".join(map(str, face)) for face in faces]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    """Five objects in metres: chairs under another name, sofas, and spikes, which no furniture is; one file is damaged."""
    folder = tmp_path_factory.mktemp("others")
    for folder_name, kind in (("Chairs", "chair"), ("couch", "sofa")):
        for seed in (7_000_001, 7_000_002):
            write_off(folder / folder_name / f"{seed}.off", *FurniturePiece(kind, seed).load())
    random = np.random.default_rng(0)
    tips = random.normal(size=(30, 3))
    base = np.cross(tips, random.normal(size=(30, 3))) * 0.03
    corners = np.stack([tips, base, -base], axis=1).reshape(-1, 3)
    write_off(folder / "spikes" / "one.off", corners, np.arange(90).reshape(-1, 3))
    (folder / "spikes" / "two.off").write_text("OFF\n3 1 0\n0 0")
    return folder


@pytest.fixture(scope="module")
def found(others):
    system = mevs_jax.load("furniture10")
    return check_transfer(system, str(others), renamed={"couch": "sofa"}, max_views=3, draws=1)


def test_objects_are_matched_counted_and_named(found):
    assert (found.known, found.strangers) == (4, 1)
    assert found.known_as == {"Chairs": "chair", "couch": "sofa"}
    assert list(found.left_out) == ["spikes/two.off"]
    assert found.classes == {"Chairs": 2, "couch": 2, "spikes": 1}
    assert [row.name for row in found.by_class] == ["chair", "sofa"]


def test_results_are_what_json_keeps_of_them(found):
    kept = json.loads(json.dumps(as_json(found)))
    assert as_json(from_json(Transfer, kept, "transfer.json")) == kept
    assert [row["class"] for row in kept["by_class"]] == ["chair", "sofa"]
    assert len(kept["by_class"][0]["chosen"]) == 3


def test_other_furniture_of_known_kinds_is_recognised(found):
    rows = {(row.policy, row.views): row for row in found.policies}
    assert {views for _, views in rows} == {1, 2, 3}
    assert rows["random", 1].accuracy == found.single_view.accuracy > 0.6
    assert rows["random", 2].gain_interval == [0, 0]
    for (policy, views), row in rows.items():
        assert row.gain == pytest.approx(row.accuracy - rows["random", views].accuracy)
        if views == 1:  # the same first views
            assert row.accuracy == rows["random", 1].accuracy, policy
    assert [row.views for row in found.unknown_objects.after] == [1, 2]
    assert found.unknown_objects.objects == 1
    single = np.mean([answer.single for answer in found.answers])
    assert single == pytest.approx(found.single_view.accuracy)


def test_walks_without_yaw_use_policies_that_need_none(others):
    system = mevs_jax.load("furniture10")
    found = check_transfer(system, str(others), renamed={"couch": "sofa"}, posed=False, max_views=2, draws=1)
    assert found.best == system.description.best_unposed
    assert "fixed_order" not in {row.policy for row in found.policies}


def test_names_of_classes(tmp_path):
    known = ("chair", "night_stand", "glass")
    assert matched(["Night Stands", "CHAIR", "Glass", "lamp"], known, {}) == {
        "Night Stands": 1,
        "CHAIR": 0,
        "Glass": 2,
        "lamp": STRANGER,
    }
    assert matched(["unknown object", "lamp"], (*known, "unknown object"), {}) == {
        "unknown object": STRANGER,
        "lamp": STRANGER,
    }
    with pytest.raises(DataError, match="the objects have no class couch, but lamp"):
        matched(["lamp"], known, {"couch": "chair"})
    with pytest.raises(DataError, match="the system knows no class sofa, but chair"):
        matched(["lamp"], known, {"lamp": "sofa"})


def test_only_test_objects_are_used_where_there_are_any(tmp_path):
    for split in ("train", "test"):
        write_off(tmp_path / "chair" / split / "a.off", *FurniturePiece("chair", len(split)).load())
    found = objects_to_test(str(tmp_path), "auto")
    assert [(entry.name, entry.split) for entry in found.entries] == [("chair/test/a.off", "test")]
    assert found.notes == ("1 files for training or validation are not used",)


def test_strangers_are_told_apart_by_as_many_views_as_the_row_says(random):
    """One view of each object, and not the mean of many: the plain share of pairs of views in the right order."""
    system = making.system()
    views = len(system.viewpoints)
    known = np.arange(40) < 25
    logits = random.normal(0, 3, (40, views, len(system.classes))) + 2.0 * known[:, None, None]
    energy = -np.log(np.exp(logits).sum(axis=-1))
    quantiles = np.quantile(energy[known], np.linspace(0, 1, 2001))
    strangeness = Strangeness(jnp.asarray(np.tile(quantiles, (views, 1)), jnp.float32))
    system = replace(system, parts=replace(system.parts, strangeness=strangeness))
    table = ViewTable(jnp.asarray(logits, jnp.float32), None, None, jnp.zeros(40, jnp.int32))
    found = strangers(Walker(system).walk(table, "random", 4, draws=2), known).after
    pairs = np.mean(energy[~known].reshape(-1, 1) > energy[known].reshape(1, -1))
    assert found[0].auroc == pytest.approx(pairs, abs=0.03)
    assert found[0].auroc + 0.03 < found[1].auroc < found[2].auroc
    assert found[0].known_refused == pytest.approx(0.05, abs=0.02)


def test_what_walks_end_with_is_counted_as_an_agent_would_say_it():
    """Two known objects and two strangers, of two walks of three views each."""
    confidence = np.array(
        [
            [[0.5, 0.96, 0.99], [0.5, 0.6, 0.7]],  # right and sure at the second view; never sure
            [[0.97, 0.97, 0.97], [0.5, 0.5, 0.96]],  # wrong and sure at once; an unknown object at the third
            [[0.6, 0.7, 0.96], [0.5, 0.5, 0.5]],  # sure at the third; never
            [[0.99, 0.2, 0.2], [0.5, 0.96, 0.2]],  # unknown at once; sure at the second
        ]
    )
    unknown = np.zeros(confidence.shape, bool)
    unknown[1, 1] = unknown[2, 1, 2] = unknown[3, 0] = True
    right = np.zeros(confidence.shape, bool)
    right[0] = True
    walks = Walks(right, confidence, np.zeros(confidence.shape, int), np.full(confidence.shape, 0.5), unknown)
    known = np.array([True, True, False, False])
    two, three = promises(walks, known, [0.95], [2, 3])
    assert (two.stop, two.views, three.views) == (0.95, 2, 3)
    assert (two.sure, two.wrong, two.refused) == (0.5, 0.5, 0.25)
    assert (three.sure, three.wrong, three.refused) == (0.5, 0.5, 0.25)
    assert (two.strangers_sure, two.strangers_refused) == (0.25, 0.25)
    assert (three.strangers_sure, three.strangers_refused) == (0.5, 0.5)
    (alone,) = promises(walks.some(~known), known[2:], [0.95], [3])
    assert (alone.wrong, alone.excess, alone.sure, alone.refused) == (None, None, None, None)
    assert alone.strangers_sure == 0.5


def test_strangers_alone_are_checked(others, tmp_path):
    write_off(tmp_path / "lamp" / "a.off", *read_mesh(others / "spikes" / "one.off"))
    found = check_transfer(mevs_jax.load("furniture10"), str(tmp_path), max_views=2, draws=1)
    assert (found.known, found.strangers, found.single_view) == (0, 1, None)
    assert any("the system knows none of these classes" in note for note in found.notes)
    assert {row.views for row in found.promises} == {1, 2}
    assert "of unknown classes that end sure" in transfer_text(found)


def test_area_under_the_curve(random):
    scores, positive = random.normal(size=200).round(1), random.random(200) < 0.3  # rounded, so that some are equal
    above = np.sign(scores[positive][:, None] - scores[~positive])
    assert auroc(scores, positive) == pytest.approx(np.mean((above + 1) / 2))
