"""Real meshes by other makers, where they lie beside the checkout, against a second reader."""

from __future__ import annotations

import io
import json
import zipfile

import numpy as np
import pytest
import trimesh

from data_pipeline.objects.archives import ZipMember
from data_pipeline.objects.mesh import normalise
from data_pipeline.objects.voxels import FEWEST_VOXELS, voxel_archive
from mevs_jax.meshes import parse_mesh
from tests.conftest import beside_the_checkout
from tests.data_pipeline.objects.making import area, extent


def test_household_meshes_are_as_trimesh_reads_them():
    path = beside_the_checkout("data", "household_cc0.zip")
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith(".off")]
        sizes = json.loads(archive.read("sizes.json"))
        contents = {name: archive.read(name) for name in names}
    assert len(names) == 39
    assert sizes
    for name, content in contents.items():
        ours = ZipMember(str(path), name).load()
        theirs = trimesh.load(io.BytesIO(content), file_type="off", process=False)
        np.testing.assert_allclose(extent(*ours), extent(theirs.vertices, theirs.faces), rtol=1e-12)
        assert area(*ours) == pytest.approx(theirs.area, rel=1e-9), name
        normalise(*ours, name)


def test_modelnet_meshes_have_the_counts_of_their_headers(real_meshes):
    for path in sorted(real_meshes.glob("*.off")):
        content = path.read_bytes()
        counts = content[:64].removeprefix(b"OFF").split()[:2]
        vertices, triangles = parse_mesh(content, ".off", path.name)
        assert [len(vertices), len(triangles)] == [int(count) for count in counts]
        assert np.linalg.norm(normalise(vertices, triangles, path.name).vertices, axis=1).max() == pytest.approx(1)
        if content.startswith(b"OFF\n"):  # as trimesh needs it
            theirs = trimesh.load(io.BytesIO(content), file_type="off", process=False)
            np.testing.assert_allclose(vertices, theirs.vertices)


def test_surfaces_of_voxel_grids_are_half_a_cell_outside_of_them(real_voxels):
    """Marching cubes at 0.5 between full and empty cells, against the cells themselves."""
    entries = voxel_archive(real_voxels).entries
    for entry in entries[:: len(entries) // 60]:
        grid = np.unpackbits(np.frombuffer(entry.recipe.bits, np.uint8), count=32**3).reshape(32, 32, 32)
        if grid.sum() < FEWEST_VOXELS:
            continue
        vertices, faces = entry.recipe.load()
        cells = np.argwhere(grid)
        np.testing.assert_allclose(vertices.min(axis=0), cells.min(axis=0) - 0.5, atol=1e-6)
        np.testing.assert_allclose(vertices.max(axis=0), cells.max(axis=0) + 0.5, atol=1e-6)
        surface = trimesh.Trimesh(vertices, faces, process=False)
        _, times = np.unique(surface.edges_sorted, axis=0, return_counts=True)
        assert (times % 2 == 0).all()  # closed; four faces meet where two cells touch along an edge
        corners_cut = 0.5 * area(vertices, faces)  # no part of the surface is further from the cells' than half a cell
        assert grid.sum() - corners_cut < surface.volume < grid.sum()
