"""Every format and its variants: geometry against what was written, and against a second reader."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import trimesh

from data_pipeline.errors import DamagedMesh, EmptyMesh
from data_pipeline.objects.mesh import normalise
from mevs_jax.meshes import MESH_SUFFIXES, parse_mesh
from tests.data_pipeline.objects.making import (
    BOX_AREA,
    U_AREA,
    area,
    box,
    check,
    dae,
    extent,
    obj,
    off,
    ply,
    stl,
    triangles_of,
    u_profile,
)

BOX, U = box(), u_profile()


# -------------------------------------------------------------------------------------------------------------------- OFF


@pytest.mark.parametrize(
    "content",
    [
        off(*BOX, "COFF", " 255 0 0 255"),
        off(*BOX, "NOFF", " 0 0 1"),
        off(*BOX, "CNOFF", " 0 0 1 0.5 0.5 0.5 1"),
        off(*BOX, "STOFF", " 0.5 0.5"),
        off(*BOX, "STCNOFF", " 0 0 1 1 2 3 255 0.5 0.5"),
        off(*BOX, "COFF", " 255 0 0 255", joined=True),
        off(*BOX, "NCOFF", " 0 0 1 255 0 0 255"),
        off(*BOX, "noff", " 0 0 1"),
        off(*BOX, "4OFF", " 1"),
        off(*BOX).replace(b" 6 0\n", b" 6\n"),
        off(*BOX).replace(b"8 6 0\n", b"8\n6\n0\n", 1).replace(b"6\n0\n", b"6 0\n"),
        b"\xef\xbb\xbf" + off(*BOX),
        off(*BOX).replace(b"OFF\n", "OFF\n# Jürgen Åström … \x85\n".encode()),
        off(*BOX).replace(b"OFF\n", b"OFF\n# J\xfcrgen \x85 5\n"),
        off(*BOX).decode().encode("utf-16"),
        off(*BOX).replace(b"\n", b"\r"),
        off(*BOX).replace(b" 0 1 3 2\n", b" 0 1 3 2 0.5 0.25 1\n"),
    ],
    ids=["coff", "noff", "cnoff", "stoff", "stcnoff", "joined", "ncoff", "lower", "4off", "no-edges", "counts-apart",
         "bom", "utf8", "latin1",
         "utf16", "old-mac", "face-colours"],
)  # fmt: skip
def test_variants_of_off(content):
    check(content, ".off")


def test_binary_off():
    content = b"OFF BINARY\n" + np.array([8, 6, 0], ">i4").tobytes() + BOX[0].astype(">f4").tobytes()
    content += b"".join(np.array([4, *face, 1], ">i4").tobytes() + np.float32(0.5).tobytes() for face in BOX[1])
    check(content, ".off")
    with pytest.raises(DamagedMesh, match="cut short: 5 of 6 faces"):
        parse_mesh(content[:-4], ".off", "thing.off")


def test_off_of_any_dimension_is_refused():
    with pytest.raises(DamagedMesh, match="nOFF mesh, which may have any number of dimensions"):
        parse_mesh(b"nOFF\n3\n" + off(*BOX)[4:], ".off", "thing.off")


@pytest.mark.parametrize("nan", ["nan", "-nan(ind)", "1.#QNAN", "-1.#IND", "NaN"])
@pytest.mark.parametrize("suffix", [".off", ".ply", ".obj"])
def test_vertices_that_no_face_uses_may_be_nan(suffix, nan):
    """As in an organised depth image, where pixels without depth are NaN."""
    vertices = np.concatenate([[[7.5, 7.5, 7.5]], BOX[0]])
    faces = [[corner + 1 for corner in face] for face in BOX[1]]
    content = {".off": off, ".ply": ply, ".obj": obj}[suffix](vertices, faces).replace(b"7.5", nan.encode())
    mesh = normalise(*parse_mesh(content, suffix, "kinect"), "kinect")
    np.testing.assert_allclose(mesh.extent, (1, 2, 3))
    used = {".off": off, ".ply": ply, ".obj": obj}[suffix](vertices, [[0, 1, 2], *faces]).replace(b"7.5", nan.encode())
    with pytest.raises(DamagedMesh, match="1 vertices that are not finite"):
        normalise(*parse_mesh(used, suffix, "kinect"), "kinect")


# --------------------------------------------------------------------------------------------------------------- polygons


@pytest.mark.parametrize("suffix", [".off", ".obj", ".ply", ".dae"])
def test_concave_polygons_keep_their_notch(suffix):
    content = {".off": off, ".obj": obj, ".ply": ply, ".dae": dae}[suffix](*U)
    check(content, suffix, (3, 3, 0.5), U_AREA)
    for turn in range(1, 8):  # whichever corner comes first
        turned = [face[turn:] + face[:turn] if len(face) == 8 else face for face in U[1]]
        vertices, triangles = parse_mesh(off(U[0], turned), ".off", "u.off")
        assert area(vertices, triangles) == pytest.approx(U_AREA)
        above = vertices[triangles].mean(axis=1)
        assert not ((above[:, 0] > 1.01) & (above[:, 0] < 1.99) & (above[:, 1] > 1.01)).any()  # nothing in the notch


def test_tilted_concave_polygons():
    angle = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
    vertices, triangles = parse_mesh(off(U[0] @ angle.T * 1e-3 + 5, U[1]), ".off", "u.off")
    assert area(vertices, triangles) == pytest.approx(U_AREA * 1e-6, rel=1e-6)


def test_corners_of_polygons_that_are_not_flat_are_kept():
    """A square and a corner above its edge, in one polygon, which ear clipping in its plane would cut off."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 1, 1]], float)
    _, triangles = parse_mesh(off(vertices, [[0, 1, 2, 3, 4]]), ".off", "sail.off")
    assert set(triangles[area_of(vertices, triangles) > 0].reshape(-1)) == {0, 1, 2, 3, 4}


def area_of(vertices, triangles):
    a, b, c = (vertices[triangles[:, at]] for at in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def test_polygons_without_area_or_corners_do_no_harm():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [0, 1, 0]], float)
    faces = [[0, 1, 2, 3], [0], [0, 1], [0, 0, 0, 0, 0], [0, 1, 4]]
    mesh = normalise(*parse_mesh(off(vertices, faces), ".off", "flat"), "flat")
    np.testing.assert_allclose(mesh.extent, (1, 1, 0))
    assert len(mesh.faces) == 1


# -------------------------------------------------------------------------------------------------------------------- OBJ


def test_relative_indices_name_the_newest_vertices():
    parts = b"".join(obj(*box((1, 1, 1), (at, 0, 0)), relative=True) for at in (0, 3, 6))
    check(parts, ".obj", (7, 1, 1), 18)
    check(obj(*box((1, 1, 1))) + obj(*box((1, 1, 1), (4, 0, 0)), relative=True), ".obj", (5, 1, 1), 12)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace(" ", "\t"),
        lambda text: "\t" + text.replace("\n", "\n\t"),
        lambda text: text.replace("v 0", "v\t0"),
        lambda text: text.replace("\nv ", "\nv   ").replace("f 1", "f  1"),
        lambda text: text.replace("f 1 2 ", "f 1/1/1 2//2 \\\n"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("f 1", "usemtl a # f 1 2 3\nl 1 2\np 1\nf 1"),
        lambda text: "\n".join(f"{line} 0.5 0.5 0.5" if line.startswith("v") else line for line in text.split("\n")),
        lambda text: "\n".join(f"{line} 1.0" if line.startswith("v 0") else line for line in text.split("\n")),
        lambda text: "# Jürgen\n" + text,
        lambda text: text.rstrip(),
    ],
    ids=[
        "tabs",
        "indented",
        "some-tabs",
        "spaces",
        "corners",
        "windows",
        "lines",
        "colours",
        "weights",
        "latin1",
        "no-end",
    ],
)
def test_variants_of_obj(change):
    check(change(obj(*BOX).decode()).encode("latin-1"), ".obj")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"f 1 2 3\n", "it has no vertices"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "names vertex 0"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "beyond its 3"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "beyond its 3"),
        (b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "2 numbers instead of 3"),
        (b"v 0,5 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "'0,5' is not a number"),
        (obj(*BOX)[:-5], "cut short: its last face has 2 corners"),
    ],
)
def test_damaged_obj_files_are_described(content, message):
    with pytest.raises(DamagedMesh, match=message):
        normalise(*parse_mesh(content, ".obj", "thing.obj"), "thing.obj")


# ------------------------------------------------------------------------------------------------------------- STL and PLY


def test_binary_stl_may_say_solid_and_text_stl_may_have_many():
    check(stl(*BOX), ".stl")
    check(stl(*BOX, text=True), ".stl")
    far = stl(*box(at=(5, 0, 0)), text=True).replace(b"one", b"two").replace(b"vertex", b"VERTEX")
    check(stl(*BOX, text=True) + far, ".stl", (6, 2, 3), 2 * BOX_AREA)
    check(stl(*BOX) + b"\0" * 20, ".stl")


@pytest.mark.parametrize("part", range(0, 100, 7))
def test_stl_files_that_are_cut_short_are_noticed(part):
    for content in (stl(*BOX), stl(*BOX, text=True), stl(*BOX, text=True) * 2):
        if len(content[: len(content) * part // 100]) < len(content) - 20:
            with pytest.raises((DamagedMesh, EmptyMesh)):
                normalise(*parse_mesh(content[: len(content) * part // 100], ".stl", "thing.stl"), "thing.stl")


MIXED = (BOX[0], [[0, 1, 3], [0, 3, 2], *BOX[1][1:]])


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
@pytest.mark.parametrize("shape", [BOX, MIXED], ids=["quads", "mixed"])
def test_ply_with_lists_of_any_length(shape, order):
    check(ply(*shape, order), ".ply")
    check(ply(*shape, order, comment="Jürgen \x85".encode("latin-1")), ".ply")
    check(ply(*shape, order).replace(b"end_header\n", b"end_header\r\n"), ".ply")
    check(ply(*shape, order).replace(b"uchar int", b"uint8 int32").replace(b"vertex_indices", b"vertex_index"), ".ply")


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
@pytest.mark.parametrize("part", range(0, 100, 9))
def test_ply_files_that_are_cut_short_are_noticed(order, part):
    content = ply(*MIXED, order)
    with pytest.raises(DamagedMesh, match=r"cut short|does not (begin|end)"):
        parse_mesh(content[: len(content) * part // 100], ".ply", "thing.ply")


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
def test_ply_with_other_elements_and_properties(order):
    """Lists in vertices, elements before and after, properties in another order, doubles, several lists in a face."""
    name = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = (
        f"ply\nformat {name} 1.0\nobj_info scanner\nelement camera 1\nproperty float f\nelement vertex 8\nproperty uchar red\n"
        "property double z\nproperty list uchar short near\nproperty double y\nproperty double x\nelement edge 2\n"
        "property int a\nelement face 6\nproperty list uchar float texcoord\nproperty int flags\n"
        "property list ushort uint vertex_indices\nelement material 1\nproperty float shine\nend_header\n"
    ).encode()
    rows: list[tuple[str, tuple]] = [("f", (1.5,))]
    rows += [(f"BdB{at % 3}hdd", (9, z, at % 3, *range(at % 3), y, x)) for at, (x, y, z) in enumerate(BOX[0])]
    rows += [("i", (4,)), ("i", (5,))]
    rows += [(f"B{at}fiH{len(face)}I", (at, *[0.5] * at, 7, len(face), *face)) for at, face in enumerate(MIXED[1][1:])]
    rows += [("f", (0.5,))]
    if order == "ascii":
        body = "\n".join(" ".join(map(str, values)) for _, values in rows).encode() + b"\n"
    else:
        body = b"".join(struct.pack(order + form, *values) for form, values in rows)
    content = head + body
    vertices, triangles = parse_mesh(content, ".ply", "thing.ply")
    np.testing.assert_allclose(extent(vertices, triangles), (1, 2, 3))
    assert len(triangles) == 11


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
def test_ply_triangle_strips(order):
    """A box as VRIP writes it: one list of all strips, with −1 between them."""
    strips = [0, 1, 2, 3, -1, 4, 6, 5, 7, -1, 0, 4, 1, 5, -1, 2, 3, 6, 7, -1, 0, 2, 4, 6, -1, 1, 5, 3, 7]
    head = ply(BOX[0], [[0]], order)
    head = head.replace(b"element face 1\nproperty list uchar int", b"element tristrips 1\nproperty list int int")
    body = head[: -5 if order != "ascii" else -len(b"1 0\n")]

    def packed(strips: list[int]) -> bytes:
        if order == "ascii":
            return body + f"{len(strips)} {' '.join(map(str, strips))}\n".encode()
        return body + struct.pack(f"{order}{len(strips) + 1}i", len(strips), *strips)

    check(packed(strips), ".ply")
    with pytest.raises(DamagedMesh, match="vertices beyond its 8"):
        parse_mesh(packed([-2 if at == -1 else at for at in strips]), ".ply", "thing.ply")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((b"property list uchar int", b"property list float int"), "no integer"),
        ((b"property float z\n", b""), "not a readable .ply|cut short|no vertices x, y, z"),
        ((b"element face 6", b"element face 99999999999"), "cut short"),
        ((b"element vertex 8", b"element vertex -8"), "negative count"),
        ((b"format ascii 1.0", b"format gzip 1.0"), "the line 'format gzip 1.0'"),
        ((b"property float z", b"property float x"), "a property twice"),
        ((b"property float z", b"property quad z"), "the line 'property quad z'"),
        ((b"4 0 1 3 2", b"-4 0 1 3 2"), "the length -4"),
        ((b"4 0 1 3 2", b"4 0 1.5 3 2"), "not whole numbers"),
        ((b"4 0 1 3 2", b"4 0 nan 3 2"), "not whole numbers"),
        ((b"4 0 1 3 2", b"4 0 1 3 1e30"), "beyond its 8"),
    ],
)
def test_damaged_ply_files_are_described(change, message):
    with pytest.raises(DamagedMesh, match=message):
        parse_mesh(ply(*BOX).replace(*change), ".ply", "thing.ply")


@pytest.mark.parametrize("suffix", [".off", ".obj", ".ply"])
def test_scans_without_faces_are_named_as_clouds(suffix):
    content = {".off": off, ".obj": obj, ".ply": ply}[suffix](BOX[0], [])
    with pytest.raises(EmptyMesh, match="no faces: it is a point cloud of 8 points"):
        normalise(*parse_mesh(content, suffix, "scan"), "scan")


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1e25])
def test_tiny_and_huge_coordinates(scale):
    if scale < 1e-100:
        with pytest.raises(EmptyMesh, match="a single point"):
            normalise(BOX[0] * scale, triangles_of(BOX[1]), "thing")
        return
    mesh = normalise(BOX[0] * scale, triangles_of(BOX[1]), "thing")
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
    with pytest.raises(DamagedMesh, match="coordinates beyond 1e"):
        normalise(BOX[0] * 1e300, triangles_of(BOX[1]), "thing")


@pytest.mark.parametrize("suffix", [".off", ".obj", ".stl", ".ply", ".glb"])
def test_a_second_reader_agrees(suffix):
    """On files that trimesh writes, all but OFF of thousands of triangles, and reads itself."""
    shape = trimesh.creation.torus(1, 0.3)
    content = shape.export(file_type=suffix[1:])
    content = content if isinstance(content, bytes) else content.encode()
    ours = parse_mesh(content, suffix, "torus", up="z")
    theirs = trimesh.load_mesh(io.BytesIO(content), file_type=suffix[1:], process=False)
    np.testing.assert_array_equal(ours[0], np.asarray(theirs.vertices, np.float64))
    np.testing.assert_array_equal(ours[1], theirs.faces)


def test_every_suffix_has_a_reader_and_damage_is_one_sentence():
    for suffix in MESH_SUFFIXES:
        for content in (b"", b"\0" * 100, b"this is not a mesh", b"\xff" * 300):
            with pytest.raises((DamagedMesh, EmptyMesh)) as caught:
                normalise(*parse_mesh(content, suffix, f"bad{suffix}"), f"bad{suffix}")
            assert "\n" not in str(caught.value)


def test_a_polygon_of_many_corners():
    count = 20_000
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    radius = 1 + 0.5 * (np.arange(count) % 2)
    star = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    vertices, triangles = parse_mesh(off(star, [[*range(1, count), 0]]), ".off", "star.off")
    true = 0.5 * abs(np.sum(star[:, 0] * np.roll(star[:, 1], -1) - star[:, 1] * np.roll(star[:, 0], -1)))
    assert area(vertices, triangles) == pytest.approx(true)


def test_flat_meshes_and_lines_beside_faces():
    sheet = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], float)
    for content, suffix in (
        (off(sheet, [[0, 1, 2, 3]]), ".off"),
        (obj(sheet, [[0, 1, 2, 3]]) + b"v 9 9 9\nl 1 5\np 5\n", ".obj"),
    ):
        mesh = normalise(*parse_mesh(content, suffix, "sign"), "sign")
        np.testing.assert_allclose(mesh.extent, (2, 0, 2))
        assert area(mesh.vertices, mesh.faces) == pytest.approx(2)
    with pytest.raises(EmptyMesh, match="no area"):
        normalise(*parse_mesh(off(sheet[:3] * (1, 0, 0), [[0, 1, 2]]), ".off", "line"), "line")


def test_polygons_that_would_take_minutes_are_refused(monkeypatch):
    monkeypatch.setattr("mevs_jax.meshes.polygons.MOST_WORK", 1000)
    with pytest.raises(DamagedMesh, match="concave polygons of up to 40 corners, too many to cut"):
        parse_mesh(off(np.random.default_rng(0).random((40, 3)), [list(range(40))]), ".off", "tangle.off")
