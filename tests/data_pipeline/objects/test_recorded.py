"""Meshes from recordings: their surfaces, what is left out of them, and what is made again."""

from __future__ import annotations

import os

import numpy as np
import pytest

from data_pipeline.errors import DataError
from data_pipeline.objects.recorded import meshes_of_recordings
from mevs_jax.meshes.reading import read_mesh
from tests.data_pipeline.frames import forms


def recorded(folder, **arrays):
    """The ball in three images, and one that looks away from it."""
    depth, _ = forms.depth_and_mask()
    away = forms.poses()[0]
    away[:3, :3] = away[:3, :3] @ np.diag([-1.0, 1, -1])
    given = {
        "depth": np.concatenate([depth, depth[:1]]).astype(np.float32),
        "K": forms.K,
        "T_world_camera": np.concatenate([forms.poses(), away[None]]),
        "center": np.asarray(forms.CENTER),
        "radius": np.array(1.5 * forms.RADIUS),
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    np.savez(folder, **(given | arrays))


def test_the_mesh_is_where_images_show_a_surface(tmp_path):
    recorded(tmp_path / "in" / "ball" / "red.npz")
    (made,) = meshes_of_recordings(tmp_path / "in", tmp_path / "out")
    assert (made.mesh, made.images) == ("ball/red.ply", 3)
    assert made.left_out == ("1 of 4 images do not show the object, and are left out",)
    vertices, _ = read_mesh(tmp_path / "out" / made.mesh)
    cell = 2 * 1.5 * forms.RADIUS / 64
    cameras = forms.poses()[:, :3, 3] - forms.CENTER
    cameras /= np.linalg.norm(cameras, axis=1, keepdims=True)
    directions = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    shown = (directions @ cameras.T).max(axis=1) > 0.8  # what faces a camera
    assert shown.sum() > 100
    assert np.quantile(np.abs(np.linalg.norm(vertices[shown], axis=1) - forms.RADIUS), 0.95) < 1.5 * cell


def test_a_mesh_is_kept_until_its_recording_changes(tmp_path):
    path = tmp_path / "in" / "ball" / "red.npz"
    recorded(path)
    first = meshes_of_recordings(tmp_path / "in", tmp_path / "out")
    mesh = tmp_path / "out" / "ball" / "red.ply"
    os.utime(mesh, (1, 1))
    assert meshes_of_recordings(tmp_path / "in", tmp_path / "out") == first
    assert mesh.stat().st_mtime == 1
    recorded(path, radius=np.array(1.4 * forms.RADIUS))
    meshes_of_recordings(tmp_path / "in", tmp_path / "out")
    assert mesh.stat().st_mtime > 1


def test_recordings_without_an_object_are_refused(tmp_path):
    with pytest.raises(DataError, match="has no recordings"):
        meshes_of_recordings(tmp_path, tmp_path / "out")
    recorded(tmp_path / "in" / "ball" / "red.npz", center=np.array((9.0, 9, 9)))
    with pytest.raises(DataError, match=r"red.npz: no frame shows anything within the object's sphere"):
        meshes_of_recordings(tmp_path / "in", tmp_path / "out")
