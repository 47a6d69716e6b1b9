"""Formats of text: every line has the numbers of its record, numbers are numbers, and nothing is left over."""

from __future__ import annotations

import re
from contextlib import suppress

import numpy as np
import pytest

from data_pipeline.errors import DamagedMesh, EmptyMesh
from data_pipeline.objects.mesh import normalise
from mevs_jax.meshes import parse_mesh
from mevs_jax.meshes.reading import read_mesh
from mevs_jax.meshes.text import number, numbers, whole_number
from tests.data_pipeline.objects.making import (
    BOX_AREA,
    area,
    box,
    check,
    extent,
    obj,
    off,
    ply,
    stl,
    triangles_of,
    u_profile,
)

BOX = box()
TETRAHEDRON = (
    np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], float),
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
)
OFF, OBJ, PLY, STL = off(*TETRAHEDRON), obj(*TETRAHEDRON), ply(*TETRAHEDRON), stl(*TETRAHEDRON, text=True)
WRITTEN = {".off": OFF, ".obj": OBJ, ".ply": PLY, ".stl": STL}


def read(content: bytes | str, suffix: str) -> tuple[np.ndarray, np.ndarray]:
    content = content if isinstance(content, bytes) else content.encode("latin-1")
    return parse_mesh(content, suffix, f"thing{suffix}")


def surface(content: bytes | str, suffix: str) -> tuple[float, ...]:
    mesh = read(content, suffix)
    return (*extent(*mesh).round(6).tolist(), round(area(*mesh), 6), len(mesh[1]))


def refused(content: bytes | str, suffix: str) -> str:
    with pytest.raises(DamagedMesh) as caught:
        read(content, suffix)
    return str(caught.value)


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize("to", ["begin", "after its keyword", "line of its own"])
def test_a_number_in_the_next_line_is_noticed_or_does_no_harm(suffix, to):
    """Totals stay the same. OFF may have a vertex in two lines; then it is the same vertex."""
    lines, true = WRITTEN[suffix].decode().split("\n"), surface(WRITTEN[suffix], suffix)
    for at in range(len(lines) - 1):
        *rest, last = lines[at].split() or [""]
        after = lines[at + 1].split()
        moved = {
            "begin": [" ".join([last, *after])],
            "after its keyword": [" ".join([*after[:1], last, *after[1:]])],
            "line of its own": [last, lines[at + 1]],
        }[to]
        changed = "\n".join([*lines[:at], " ".join(rest), *moved, *lines[at + 2 :]])
        if not re.fullmatch(r"-?[0-9.]+", last) or not rest:
            continue
        with suppress(DamagedMesh):
            assert surface(changed, suffix) == true, changed


@pytest.mark.parametrize("by", [-1, 1])
@pytest.mark.parametrize("name", [".off", "ascii", "<", ">", ".stl", "OFF BINARY"])
def test_more_or_fewer_records_than_declared_are_said(name, by):
    faces = triangles_of(BOX[1])
    suffix = {"OFF BINARY": ".off", ".off": ".off", ".stl": ".stl"}.get(name, ".ply")
    if name == ".off":
        content = off(BOX[0], faces)
        counts = [(b"\n8 ", b"\n%d " % (8 + by)), (b" 12 0\n", b" %d 0\n" % (12 + by))]
    elif name == "OFF BINARY":
        content = b"OFF BINARY\n" + np.array([8, 12, 0], ">i4").tobytes() + BOX[0].astype(">f4").tobytes()
        content += b"".join(np.array([3, *face, 0], ">i4").tobytes() for face in faces)
        pairs = ([8, 12], [8 + by, 12]), ([12, 0], [12 + by, 0])
        counts = [(np.array(was, ">i4").tobytes(), np.array(now, ">i4").tobytes()) for was, now in pairs]
    elif name == ".stl":
        content, counts = stl(BOX[0], faces), [(b"\x0c\0\0\0", bytes([12 + by, 0, 0, 0]))]
    else:
        content = ply(BOX[0], faces, name)
        counts = [(b"vertex 8", b"vertex %d" % (8 + by)), (b"face 12", b"face %d" % (12 + by))]
    check(content, suffix, surface=BOX_AREA)
    for was, now in counts:
        assert content.count(was) == 1
        refused(content.replace(was, now), suffix)
    if by < 0:
        was, now = counts[-1]
        assert re.search("holds more|more than the rows", refused(content.replace(was, now), suffix))


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize("word", ["2_0", "1e", "0x2", "2,0", "--2", "²", "2.0.0", "1d0", "2-1"])
def test_words_that_are_no_numbers_are_refused(suffix, word):
    content = WRITTEN[suffix].decode().replace("2.0", word).encode("latin-1")
    assert re.search(r"is not a number|numbers instead of|is not a whole number", refused(content, suffix))


def test_numbers_are_those_that_all_readers_take():
    assert [number(word) for word in ("1", "-.5", "+2.", "1e-3", "1E3", "inf")] == [1, -0.5, 2, 1e-3, 1e3, np.inf]
    assert [whole_number(word) for word in ("7", "-1", "+2", "9" * 30)] == [7, -1, 2, 2**62]
    for word in ("1_0", "١", "1.", "", "0x1", "1e1"):
        with pytest.raises(ValueError, match="is not a whole number"):
            whole_number(word)
    with pytest.raises(ValueError, match="'-' is not a whole number"):
        numbers(["1 - 2"], np.int64)
    for word in ("1_0", "١", "e5", ".", "", "0x1", "infinit"):
        with pytest.raises(ValueError, match="is not a number"):
            number(word)


@pytest.mark.parametrize(
    ("content", "suffix", "message"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nF 1 3 2\n", ".obj", "the line 'F 1 3 2', which is not read"),
        ("V 0 0 0\nV 1 0 0\nV 0 1 0\nF 1 2 3\n", ".obj", "the line 'V 0 0 0'"),
        ("v 0 0 0\nV 1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ".obj", "the line 'V 1 0 0'"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nsurf 0 1 0 1 1 2 3\n", ".obj", "the line 'surf 0 1 0 1 1 2 3'"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nv\nf 1 2 3\n", ".obj", "has 0 numbers instead of 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\nf 1 2 3\n", ".obj", "the face '1 2' of fewer than three corners"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/ 1 2/ 1 3/ 1\n", ".obj", "the face '1/ 1 2/ 1 3/ 1', whose corners are not"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 /1 2 /1 3 /1\n", ".obj", "not written alike"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/a 2/a 3/a\n", ".obj", "not written alike"),
        ("v 0 0 0\nv 1 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ".obj", "has 4 numbers and others have 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl C:\\x\\\nf 1 2 3\n", ".obj", "a line that goes on with 'f 1 2 3'"),
        (STL.replace(b"  endloop", b"  colour 1 0 0\n endloop", 1), ".stl", "the line 'colour 1 0 0' is out of place"),
        (STL.replace(b"vertex", b"vertex 0 0 0\n vertex", 1), ".stl", "out of place"),
        (STL + b"vertex 0 0 0\n", ".stl", "the line 'vertex 0 0 0' is out of place"),
        (b" ".join(STL.split()), ".stl", "out of place"),
        (OFF + b"3 0 1 2\n", ".off", "declares 4 vertices and 4 faces, and holds more"),
        (OFF.replace(b"3 0 2 1\n", b"3 0 2 1 3\n"), ".off", "has one number more than its corners"),
        (OFF.replace(b"3 0 2 1\n", b"3 0 2 1 3 3\n"), ".off", "has 6 numbers instead of 4"),
        ("OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 3\n1 2 0\n", ".off", "the face '1 2 0' has 3 numbers instead of 2"),
        (OFF.replace(b"0.0 2.0 0.0", b"0 2 0 9"), ".off", "the line '0 2 0 9' has 4 numbers instead of 3"),
        (
            PLY.replace(b"0.0 2.0 0.0", b"0 2 0 9"),
            ".ply",
            "has 4 numbers instead of 3, as one of its 4 rows of 'vertex'",
        ),
        (PLY.replace(b"3 0 2 1\n", b"3 0 2\n"), ".ply", "the line '3 0 2' has 3 numbers instead of 4, as one"),
        (PLY.replace(b"3 0 2 1\n", b"2 0 2\n"), ".ply", "has a face of 2 corners"),
        (
            PLY.replace(b"float x", b"uchar x").replace(b"1.0 0.0", b"0.5 0.0"),
            ".ply",
            "a coordinate x that is no number of",
        ),
        (PLY.replace(b"vertex 4", b"vertex 0_4"), ".ply", "the line 'element vertex 0_4'"),
        (PLY.replace(b"int vertex_indices", b"float x"), ".ply", "has 0 lists of vertices"),
        (ply(*TETRAHEDRON, "<") + b"more", ".ply", "more than the rows that its header declares"),
        (stl(*TETRAHEDRON) + b"more", ".stl", "declares 4 triangles and holds more"),
    ],
)
def test_lines_that_are_out_of_place_are_named(content, suffix, message):
    assert message in refused(content, suffix)


@pytest.mark.parametrize(
    "content",
    [
        "OFF\n4 4 6\n0 0 0 1 0 0\n0 2 0 0 0 3\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n",
        "OFF\n4 4 6 0 0 0 1 0 0 0 2 0 0 0 3\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n",
        "OFF\n4\n4\n0\n0\n0 0\n1 0 0\n0 2 0\n0 0\n3\n3\n0 2 1\n3 0 1 3 255 0 0\n3 0 3\n2\n3 1 2 3\n",
        "OFF 4 4 6\n0 0 0 9 9 9\n1 0 0 9 9 9\n0 2 0 9 9 9\n0 0 3 9 9 9\n3 0 2 1 5\n3 0 1 3 5\n3 0 3 2 5\n3 1 2 3 5\n",
        "COFF 4 4 6\n0 0 0 1 1 1 1\n1 0 0 1 1 1 1 0 2 0 1 1 1 1\n0 0 3\n1 1 1 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n",
    ],
    ids=["two-in-a-line", "in-line-of-counts", "one-in-two-lines", "unsaid-colours", "colours-in-next-line"],
)
def test_off_in_free_format(content):
    np.testing.assert_array_equal(surface(content, ".off"), surface(OFF, ".off"))


def test_obj_with_other_blanks_statements_in_capitals_and_the_end_of_dos():
    content = OBJ.decode().replace("f ", "f\xa0") + "Usemtl a\nG b\n\x1a"
    assert surface(content, ".obj") == surface(OBJ, ".obj")
    with pytest.raises(EmptyMesh, match="no faces: it has 2 lines"):
        read("v 0 0 0\nv 1 0 0\nl 1 2\nl 2 1\n", ".obj")


def test_what_is_there_in_place_of_faces_is_named():
    with pytest.raises(EmptyMesh, match="no faces: its 2 polygons have fewer than three corners"):
        read(off(TETRAHEDRON[0], [[0, 1], [2, 3]]), ".off")
    edges = PLY.replace(b"element face 4\nproperty list uchar int vertex_indices", b"element edge 1\nproperty int a")
    with pytest.raises(EmptyMesh, match="no faces: its element 'edge' is not read"):
        read(edges[: edges.index(b"3 0 2 1")] + b"1\n", ".ply")
    with pytest.raises(EmptyMesh, match="no faces: its element 'Face' is not read"):
        read(PLY.replace(b"element face", b"element Face"), ".ply")


# ---------------------------------------------------------------------------------------------------------- faces without area


@pytest.mark.parametrize(
    "corners",
    [
        [[25, 0, 0]] * 3,
        [[0, 0, 0], [10, 0, 0], [25, 0, 0]],
        [[0.1, 0.2, 0.7], [10.1, 20.2, 70.7], [0.3, 0.6, 2.1]],
        [[20.1, 7.3, 1.1], [20.1, 7.3, 1.1], [-30, 2, 1]],
    ],
    ids=["point", "line", "line-aslant", "needle"],
)
@pytest.mark.parametrize("suffix", [".off", ".obj", ".ply", ".stl"])
def test_faces_without_area_set_neither_centre_nor_size(suffix, corners, tmp_path):
    vertices, faces = np.concatenate([TETRAHEDRON[0], corners]), [*TETRAHEDRON[1], [4, 5, 6]]
    content = {".off": off, ".obj": obj, ".ply": ply, ".stl": stl}[suffix](vertices, faces)
    mesh = normalise(*read(content, suffix), "thing")
    assert mesh.radius == pytest.approx(np.sqrt(1 + 4 + 9) / 2)
    assert len(mesh.faces) == 4
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
    (tmp_path / f"thing{suffix}").write_bytes(content)  # as `mevs look` reads it
    kept, triangles = read_mesh(tmp_path / f"thing{suffix}")
    assert len(triangles) == 4
    np.testing.assert_allclose(np.ptp(kept, axis=0), (1, 2, 3))


def test_thin_faces_have_an_area():
    """A sheet of metal far from the origin, in millimetres, as single numbers."""
    thin = np.array([[0, 0, 0], [1e5, 0, 0], [0, 1, 0]]) + 3e5
    assert len(normalise(thin, np.array([[0, 1, 2]]), "sheet").faces) == 1
    assert len(normalise(np.float32(thin), np.array([[0, 1, 2]]), "sheet").faces) == 1


def test_a_vertex_too_few_is_not_called_a_file_that_is_cut_short():
    lines = off(*u_profile()).decode().splitlines()
    assert "its 16 vertices end within the line '8 7 6 5 4 3 2 1 0'" in refused(
        "\n".join(lines[:9] + lines[10:]), ".off"
    )
