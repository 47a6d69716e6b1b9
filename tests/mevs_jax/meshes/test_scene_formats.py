"""Formats of scenes: glTF, COLLADA, 3MF. Transforms, axes, compression, and small files that unfold to large meshes."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipeline.errors import DamagedMesh, EmptyMesh
from data_pipeline.objects.mesh import normalise
from data_pipeline.objects.recipes import MeshFile
from mevs_jax.meshes import parse_mesh
from tests.data_pipeline.objects.making import (
    BOX_AREA,
    Glb,
    box,
    check,
    dae,
    draco,
    extent,
    glb,
    off,
    threemf,
    triangles_of,
    u_profile,
)

BOX, U = box(), u_profile()


# -------------------------------------------------------------------------------------------------------------------- glTF


def test_gltf_is_y_up_and_turned_to_z_up():
    check(glb(*BOX), ".glb", (1, 3, 2))
    check(glb(*BOX), ".glb", (1, 3, 2), up="y")
    check(glb(*BOX), ".glb", (1, 2, 3), up="z")
    check(off(*BOX), ".off", (1, 3, 2), up="y")
    vertices, triangles = parse_mesh(glb(*BOX), ".glb", "thing.glb")
    corners = vertices[triangles]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    original = BOX[0][triangles_of(BOX[1])]
    assert volume == pytest.approx(
        np.einsum("ij,ij->i", original[:, 0], np.cross(original[:, 1], original[:, 2])).sum() / 6
    )


def test_quantised_positions_and_transforms_of_nodes():
    """As gltfpack writes it: normalised 16-bit positions, 8 bytes apart, placed by the node."""
    made = Glb()
    quantised = np.zeros((8, 4), np.int16)
    quantised[:, :3] = np.round(BOX[0] / 1.5 * 32767)
    view = made.view(quantised.tobytes(), byteStride=8)
    made.document["accessors"].append(
        {"bufferView": view, "componentType": 5122, "count": 8, "type": "VEC3", "normalized": True}
    )
    indices = made.accessor(triangles_of(BOX[1]).astype(np.uint8).reshape(-1))
    mesh = made.mesh({"attributes": {"POSITION": 0}, "indices": indices})
    child = made.node(root=False, mesh=mesh, scale=[1.5, 1.5, 1.5], translation=[5, 0, 0])
    made.node(children=[child], matrix=[0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1])
    made.require("KHR_mesh_quantization")
    check(made.bytes(), ".glb", (2, 1, 3), rtol=1e-4, up="z")
    vertices, _ = parse_mesh(made.bytes(), ".glb", "thing.glb", up="z")
    np.testing.assert_allclose(vertices.mean(axis=0), (7, 13, 9), atol=1e-3)


def test_instances_fans_and_strips():
    made = Glb()
    leg = made.mesh(made.primitive(box((1, 1, 1))[0], triangles_of(BOX[1])))
    places = np.array([[0, 0, 0], [4, 0, 0], [0, 6, 0]], np.float32)
    given = {"TRANSLATION": made.accessor(places), "SCALE": made.accessor(np.full((3, 3), 2, np.float32))}
    made.node(mesh=leg, extensions={"EXT_mesh_gpu_instancing": {"attributes": given}})
    angle = np.linspace(0, 2 * np.pi, 7)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    disc = made.primitive(np.concatenate([[[0, 0, 0]], ring]), None, mode=6)
    strip = made.primitive(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), None, mode=5)
    lines = made.primitive(ring * 100, None, mode=3)
    made.node(mesh=made.mesh(disc, strip, lines))
    made.require("EXT_mesh_gpu_instancing")
    check(made.bytes(), ".glb", (6, 8, 2), 3 * 24 + 1 + 1.5 * np.sqrt(3), up="z", rtol=1e-5)


def test_draco():
    check(draco(*BOX), ".glb", (1, 3, 2), rtol=1e-3)
    check(draco(*box((5, 1, 1))), ".glb", (5, 1, 1), 22, rtol=1e-3)


def test_sparse_accessors_and_skins():
    made = Glb()
    mesh = made.mesh(made.primitive(BOX[0], triangles_of(BOX[1])))
    attributes = made.document["meshes"][mesh]["primitives"][0]["attributes"]
    where, what = made.view(np.array([7], np.uint16).tobytes()), made.view(np.array([9, 1, 1.5], np.float32).tobytes())
    made.document["accessors"][attributes["POSITION"]]["sparse"] = {
        "count": 1, "indices": {"bufferView": where, "componentType": 5123}, "values": {"bufferView": what},
    }  # fmt: skip
    made.node(mesh=mesh)
    np.testing.assert_allclose(extent(*parse_mesh(made.bytes(), ".glb", "a", up="z")), (9.5, 2, 3))

    made = Glb()
    mesh = made.mesh(made.primitive(BOX[0], triangles_of(BOX[1])))
    attributes = made.document["meshes"][mesh]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = made.accessor(np.zeros((8, 4), np.uint8))
    attributes["WEIGHTS_0"] = made.accessor(np.tile(np.float32([1, 0, 0, 0]), (8, 1)))
    joint = made.node(scale=[2, 2, 2])
    made.document["skins"] = [{"joints": [joint]}]
    made.node(mesh=mesh, skin=0, scale=[50, 50, 50])  # which does not count for a skin
    check(made.bytes(), ".glb", (2, 4, 6), 4 * BOX_AREA, up="z")


def test_gltf_with_its_numbers_in_another_file(tmp_path):
    made = Glb()
    made.node(mesh=made.mesh(made.primitive(BOX[0], triangles_of(BOX[1]))))
    (tmp_path / "data").mkdir()
    (tmp_path / "thing.gltf").write_bytes(made.gltf("data/my%20numbers.bin"))
    with pytest.raises(DamagedMesh, match=r"'data/my numbers.bin', which cannot be read"):
        MeshFile(str(tmp_path / "thing.gltf")).load()
    (tmp_path / "data" / "my numbers.bin").write_bytes(made.binary)
    np.testing.assert_allclose(extent(*MeshFile(str(tmp_path / "thing.gltf")).load()), (1, 3, 2))
    for outside in ("../secret.bin", "/etc/passwd", "https://example.org/a.bin"):
        (tmp_path / "thing.gltf").write_bytes(made.gltf(outside))
        with pytest.raises(DamagedMesh, match="outside of its folder"):
            MeshFile(str(tmp_path / "thing.gltf")).load()


def _with(change) -> bytes:
    made = Glb()
    made.node(mesh=made.mesh(made.primitive(BOX[0], triangles_of(BOX[1]))))
    change(made)
    return made.bytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (glb(*BOX)[:-40], "cut short: .* bytes are there"),
        (_with(lambda made: made.require("EXT_meshopt_compression")), "requires the extension EXT_meshopt_compression"),
        (_with(lambda made: made.document["nodes"][0].update(children=[0])), "node 0 is in the scene twice"),
        (_with(lambda made: made.document["accessors"][0].update(count=10**9)), "has 1000000000 elements"),
        (_with(lambda made: made.document["accessors"][0].update(count=1000)), "goes beyond buffer view"),
        (_with(lambda made: made.document["asset"].update(version="1.0")), "not glTF 2.0"),
        (_with(lambda made: made.document["meshes"][0]["primitives"][0].update(mode=9)), "mode 9"),
        (_with(lambda made: made.document["nodes"][0].update(scale=["a", 1, 1])), "not a readable glTF"),
        (b"{}", "it has no asset"),
        (b"[" * 100_000, "not a readable glTF|too deeply nested"),
    ],
)
def test_damaged_gltf_files_are_described(content, message):
    with pytest.raises(DamagedMesh, match=message) as caught:
        parse_mesh(content, ".glb", "thing.glb")
    assert "\n" not in str(caught.value)


# ----------------------------------------------------------------------------------------------------- COLLADA, 3MF, others


@pytest.mark.parametrize(("up", "size"), [("Z_UP", (1, 2, 3)), ("Y_UP", (1, 3, 2)), ("X_UP", (2, 3, 1))])
def test_collada_declares_its_axis(up, size):
    check(dae(*BOX, up), ".dae", size)
    check(dae(*BOX, up), ".dae", (1, 2, 3), up="z")
    check(dae(*BOX, up, "2 0 0 5 0 1 0 5 0 0 1 5 0 0 0 1"), ".dae", (2, 2, 3), 2 * (4 + 6 + 6), up="z")


def test_damaged_collada_is_described():
    for content in (b"<COLLADA", b"", dae(*BOX)[:900], dae(*BOX).replace(b"#p", b"#q")):
        with pytest.raises(DamagedMesh, match=r"not a readable .dae mesh"):
            parse_mesh(content, ".dae", "thing.dae")
    with pytest.raises(DamagedMesh, match="XML entities"):
        parse_mesh(b'<!DOCTYPE a [<!ENTITY b "c">]>' + dae(*BOX), ".dae", "thing.dae")
    with pytest.raises(EmptyMesh, match="no faces"):
        normalise(*parse_mesh(dae(BOX[0], []), ".dae", "thing.dae"), "thing.dae")


def test_3mf():
    check(threemf(*BOX), ".3mf")
    check(threemf(*BOX, "2 0 0 0 1 0 0 0 1 5 5 5"), ".3mf", (2, 2, 3), 2 * (4 + 6 + 6))
    with pytest.raises(DamagedMesh, match=r"not a readable .3mf mesh"):
        parse_mesh(threemf(*BOX)[:-30], ".3mf", "thing.3mf")


# ------------------------------------------------------------------------------------------------- small files, large meshes


def test_small_files_that_unfold_without_end_are_refused(monkeypatch):
    made = Glb()
    mesh = made.mesh(made.primitive(BOX[0], triangles_of(BOX[1])))
    made.document["accessors"].append({"componentType": 5126, "count": 4_000_000, "type": "VEC3"})
    given = {"TRANSLATION": len(made.document["accessors"]) - 1}
    made.node(mesh=mesh, extensions={"EXT_mesh_gpu_instancing": {"attributes": given}})
    with pytest.raises(DamagedMesh, match="4,000,000 copies of a mesh"):
        parse_mesh(made.bytes(), ".glb", "bomb.glb")

    levels = "".join(
        f'<node id="l{at}">{f"<instance_node url={chr(34)}#l{at + 1}{chr(34)}/>" * 20}</node>' for at in range(6)
    )
    levels += '<node id="l6"><instance_geometry url="#g"/></node>'
    bomb = dae(*BOX).replace(
        b"<library_visual_scenes>", f"<library_nodes>{levels}</library_nodes><library_visual_scenes>".encode()
    )
    bomb = bomb.replace(b'<instance_geometry url="#g"/></node>\n', b'<instance_node url="#l0"/></node>\n')
    monkeypatch.setattr("mevs_jax.meshes.dae.MOST_COPIES", 500)
    with pytest.raises(DamagedMesh, match="unfolds to more than 500 meshes"):
        parse_mesh(bomb, ".dae", "bomb.dae")
