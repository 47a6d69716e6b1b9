"""Rendering as array programs: what they show is what casting rays shows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.capture.casting import CaptureConfig, capture, rig_for
from data_pipeline.capture.rasterise import capture_by_rasterising
from data_pipeline.capture.workers import capture_all, capture_path
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.sources import load_object, open_source
from mevs_jax import Camera, look_at_origin, rendering
from mevs_jax.rendering import pad_triangles

render_depth = jax.jit(rendering.render_depth)


def furniture(name: str, seed: int = 5) -> Mesh:
    return load_object(ObjectEntry(name, 0, "train", FurniturePiece(name, seed)))


def agreement(mesh: Mesh, config: CaptureConfig) -> float:
    """The share of pixels where both hit, to two steps of the stored depth and of grey, or both miss."""
    rig = rig_for(config)
    cast, drawn = capture(mesh, rig), capture_by_rasterising(mesh, rig)
    np.testing.assert_array_equal(cast.extent, drawn.extent)
    depth = np.abs(cast.depth.astype(int) - drawn.depth) <= 2
    grey = np.abs(cast.image.astype(int) - drawn.image) <= 2
    assert grey.mean() > 0.99  # of two faces that lie on each other, either may be seen
    return depth.mean()


@pytest.mark.parametrize("name", ["chair", "bathtub", "toilet"])
@pytest.mark.parametrize("resolution", [32, 57])
def test_rasterising_sees_what_rays_see(name, resolution):
    assert agreement(furniture(name), CaptureConfig(views=12, resolution=resolution)) > 0.999


@pytest.mark.parametrize("counts", [(1, 1), pytest.param((3, 2), marks=pytest.mark.slow)], ids=["some", "more"])
def test_rasterising_sees_real_meshes_and_voxels_as_rays_do(counts, real_meshes, real_voxels):
    for path, count in zip((real_voxels, real_meshes), counts, strict=True):
        if path.suffix:
            entries = open_source(str(path), train_per_class=0, test_per_class=0).entries
        else:
            from data_pipeline.objects.recipes import MeshFile

            entries = [ObjectEntry(file.stem, 0, "train", MeshFile(str(file))) for file in sorted(path.glob("*.off"))]
        for index in np.linspace(0, len(entries) - 1, count).astype(int):
            assert agreement(load_object(entries[index]), CaptureConfig(views=6, resolution=64)) > 0.995


def test_a_camera_inside_sees_only_what_is_before_it():
    """Nothing is clipped, and what is behind does not shine through."""
    wall = [[[-5, -5, z], [5, -5, z], [0, 9, z]] for z in (1.0, -3.0)]
    pose = jnp.eye(4)  # at the origin, looking along +z
    seen = render_depth(np.array(wall, np.float32), Camera(pose, np.pi / 3, 16))
    np.testing.assert_allclose(seen.depth, 1.0, rtol=1e-6)
    assert (np.asarray(seen.face) == 0).all()
    turned = pose.at[:3, :3].set(jnp.diag(jnp.array([1.0, -1.0, -1.0])))
    seen = render_depth(np.array(wall, np.float32), Camera(turned, np.pi / 3, 16))
    np.testing.assert_allclose(seen.depth, 3.0, rtol=1e-6)
    assert (np.asarray(seen.face) == 1).all()


def test_many_faces_in_one_tile_are_all_seen(random):
    """More faces than a tile takes at a time, one behind the other: the nearest is seen."""
    count = 300
    depths = random.permutation(np.linspace(1, 2, count))
    triangles = np.stack([[[-9, -9, -z], [9, -9, -z], [0, 20, -z]] for z in depths]).astype(np.float32)
    pose = jnp.eye(4).at[:3, :3].set(jnp.diag(jnp.array([1.0, -1.0, -1.0])))
    seen = jax.jit(lambda triangles: render_depth(triangles, Camera(pose, np.pi / 3, 20)))(triangles)
    assert (np.asarray(seen.face) == np.argmin(depths)).all()
    np.testing.assert_allclose(seen.depth, 1, rtol=1e-6)


def test_padding_is_never_seen_and_an_empty_view_is_infinite():
    camera = Camera(look_at_origin(np.array([0, 0, 2.0])), np.pi / 3, 24)
    nothing = render_depth(pad_triangles(np.zeros((0, 3, 3), np.float32)), camera)
    assert np.isinf(nothing.depth).all()
    assert (np.asarray(nothing.face) == -1).all()
    mesh = furniture("desk")
    triangles = mesh.vertices[mesh.faces]
    padded = pad_triangles(triangles)
    assert len(padded) & (len(padded) - 1) == 0
    for a, b in zip(
        jax.tree.leaves(render_depth(triangles, camera)), jax.tree.leaves(render_depth(padded, camera)), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_a_data_set_can_be_captured_by_rasterising(tmp_path):
    entries = [ObjectEntry(f"c{i}", 0, "train", FurniturePiece("chair", i)) for i in range(3)]
    by_rays, drawn = (CaptureConfig(views=4, resolution=32, backend=kind) for kind in ("raycast", "rasterise"))
    for config in (by_rays, drawn):
        assert capture_all(entries, config, tmp_path / config.backend, workers=2) == {}
    from data_pipeline.capture.casting import load_capture

    for entry in entries:
        a, b = (load_capture(capture_path(tmp_path / kind, entry)) for kind in ("raycast", "rasterise"))
        assert (np.abs(a.depth.astype(int) - b.depth) <= 2).mean() > 0.999
