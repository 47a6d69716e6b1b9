"""Meshes are read by the library alone, and what needs another package says which."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import mevs_jax
from mevs_jax.errors import DataError
from tests.data_pipeline.objects.making import U_AREA, area, box, obj, off, stl, u_profile

READ = """
import sys, mevs_jax
vertices, triangles = mevs_jax.read_mesh(sys.argv[1])
assert triangles.shape == (12, 3) and vertices.shape == (8, 3)
print({"jax", "scipy", "data_pipeline"} & {name.split(".")[0] for name in sys.modules})
"""


def test_a_file_is_read_without_jax(tmp_path):
    (tmp_path / "box.off").write_bytes(off(*box()))
    command = [sys.executable, "-c", READ, str(tmp_path / "box.off")]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "set()\n"


def test_what_needs_another_package_says_which(tmp_path, monkeypatch):
    (tmp_path / "u.obj").write_bytes(obj(*u_profile()))
    assert area(*mevs_jax.read_mesh(tmp_path / "u.obj")) == pytest.approx(U_AREA)
    monkeypatch.setitem(sys.modules, "mapbox_earcut", None)
    with pytest.raises(DataError, match=r"u\.obj has concave polygons, .* pip install 'mevs-jax\[mesh\]'"):
        mevs_jax.read_mesh(tmp_path / "u.obj")


@pytest.mark.parametrize(("up", "size"), [("auto", (1, 2, 3)), ("z", (1, 2, 3)), ("y", (1, 3, 2))])
def test_the_axis_that_is_up(up, size, tmp_path):
    (tmp_path / "box.stl.obj").write_bytes(obj(*box()))
    np.testing.assert_allclose(np.ptp(mevs_jax.read_mesh(tmp_path / "box.stl.obj", up)[0], axis=0), size)


@pytest.mark.parametrize(("name", "reason"), [("box.fbx", "no suffix of a mesh"), ("no.ply", "No such file")])
def test_what_cannot_be_read_is_said(name, reason, tmp_path):
    with pytest.raises(DataError, match=rf"{name} .*{reason}"):
        mevs_jax.read_mesh(tmp_path / name)


def test_a_byte_too_many_in_a_binary_stl_is_noticed(tmp_path):
    """Also where the last byte of the file looks like what fills one up."""
    sound = stl(*box())
    for at, filler in ((len(sound), b"\0\n"), (200, b"\0")):
        (tmp_path / "box.stl").write_bytes(sound[:at] + filler + sound[at:])
        if at == len(sound):
            assert area(*mevs_jax.read_mesh(tmp_path / "box.stl")) == pytest.approx(22)
        else:
            with pytest.raises(DataError, match="declares 12 triangles and holds more"):
                mevs_jax.read_mesh(tmp_path / "box.stl")
