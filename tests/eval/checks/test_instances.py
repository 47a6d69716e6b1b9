"""Enrolled objects are measured: from meshes and from depth images, with strangers among them."""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import pytest
import trimesh

from data_pipeline.errors import DataError
from eval.checks import instances
from eval.checks.instances import Condition, instances_text, study_instances
from mevs_jax.enrolment import AlikeWarning
from mevs_jax.trained import load
from tests.eval.checks.test_transfer import write_off
from tests.mevs_jax.gallery.conftest import CAMERA, matcher  # noqa: F401
from train.tasks.matcher import objects_system


def test_objects_in_another_unit_are_refused(tmp_path):
    from data_pipeline.objects.furniture import furniture

    for name in ("chair", "sofa", "table"):
        (tmp_path / name).mkdir()
        piece = furniture(name, 40)
        write_off(tmp_path / name / f"{name}.off", 100 * piece.vertices, piece.faces)
    with pytest.raises(DataError, match=r"metres large, .* such as --metres 0\.01 for centimetres"):
        study_instances(load("objects"), str(tmp_path), tmp_path)


@pytest.mark.slow
def test_objects_are_measured_from_meshes_and_from_images(matcher, tmp_path, monkeypatch):  # noqa: F811
    from data_pipeline.objects.furniture import furniture

    for number, name in enumerate(("chair", "bathtub", "table", "toilet")):
        (tmp_path / "meshes" / name).mkdir(parents=True)
        furniture(name, 40 + number).export(tmp_path / "meshes" / name / f"{name}.ply")
    (tmp_path / "meshes" / "chair" / "broken.ply").write_text("ply")
    conditions = [Condition("mesh, perfect views", errors=False), Condition("3 images", frames=3, sized=True)]
    system, meshes = objects_system(matcher, CAMERA, views=12), str(tmp_path / "meshes")
    study = partial(study_instances, system, meshes, tmp_path, sizes=(3, 4), yaws=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AlikeWarning)
        found = study(conditions=conditions)
    monkeypatch.setattr(instances, "_measure", None)  # everything is kept
    assert study(conditions=conditions) == found
    assert len(found.objects) == 4
    assert [*found.left_out] == ["broken"] or len(found.left_out) == 1
    assert [(one.condition, one.enrolled) for one in found.measured] == [
        ("mesh, perfect views", 3),
        ("mesh, perfect views", 4),
        ("3 images", 3),
        ("3 images", 4),
    ]
    perfect = found.measured[1]
    by_policy = {row.policy: row.accuracy for row in perfect.policies if row.views == 4}
    assert min(by_policy.values()) > 0.9
    assert perfect.poses[-1].right > 0.9
    assert perfect.unknown_objects is not None
    assert perfect.unknown_objects.objects == 1
    assert all(0 <= row.auroc <= 1 for row in perfect.unknown_objects.after)
    text = instances_text(found)
    assert "3 images" in text
    assert "information_gain" in text
    assert np.isfinite([row.accuracy for one in found.measured for row in one.policies]).all()


@pytest.mark.slow
def test_boxes_of_one_shape_are_measured_by_their_colours(tmp_path, monkeypatch):
    """By depth they are the same. By their colours, in changing light, plain boxes are told apart, but some are unknown."""
    monkeypatch.setattr(instances, "POLICIES", ("random",))
    for name, colour in {"red": (200, 30, 30), "green": (30, 160, 60), "blue": (30, 60, 200)}.items():
        (tmp_path / "meshes" / name).mkdir(parents=True)
        carton = trimesh.creation.box((0.1, 0.07, 0.2))
        carton.visual.vertex_colors = (*colour, 255)
        carton.export(tmp_path / "meshes" / name / f"{name}.ply")
    gallery = load("objects").parts.gallery
    system = objects_system(gallery.matcher, CAMERA, views=12, colours=gallery.colours.matcher)
    conditions = [Condition("depth"), Condition("both", compared="both")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AlikeWarning)
        found = study_instances(system, str(tmp_path / "meshes"), tmp_path, conditions=conditions, yaws=1)
    by_depth, by_both = (np.mean([row.accuracy for row in one.policies]) for one in found.measured)
    assert by_depth < 0.4  # a third, by chance
    assert by_both > 0.7  # 0.79, and the rest is unknown
    assert len(found.measured[0].twins) == 3
    assert len(found.measured[1].twins) < 3
