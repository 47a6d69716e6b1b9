"""Colours of mesh files are those that the files say, on the triangles that this package reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mevs_jax import read_mesh
from mevs_jax.gallery.meshes import caster_of, painted, seen_of
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.geometry.triangles import centred_triangles
from mevs_jax.meshes.paint import Paint, read_paint

# A square of two metres, standing, as one polygon of four corners; and a triangle above it without texture.
OBJ = """mtllib box.mtl
v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
v 0 0 2
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl printed
f 1/1 2/2 3/3 4/4
usemtl plain
f 4 3 5
"""
MTL = "newmtl printed\nmap_Kd {}\nnewmtl plain\nKd 0.2 0.4 0.6\n"
QUARTERS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)  # from the upper left


def written(folder: Path, image: Image.Image | None, name: str = "print.png", called: str = "") -> Path:
    (folder / "box.obj").write_text(OBJ)
    (folder / "box.mtl").write_text(MTL.format(called or name))
    if image is not None:
        image.save(folder / name)
    return folder / "box.obj"


def colours_of_points(path: Path, points: np.ndarray) -> np.ndarray:
    """Colours of points of the square, each by the triangle that contains it."""
    vertices, faces = read_mesh(path)
    paint = read_paint(path, vertices, faces)
    assert paint is not None
    found = []
    for point in points:
        for number, corners in enumerate(vertices[faces]):
            weights, *_ = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(point, 1), rcond=None)
            if weights.min() > -1e-9 and np.allclose(weights @ corners, point):
                found.append(paint.at(np.array([number]), weights[None])[0])
                break
    return np.array(found)


POINTS = np.array([[-0.5, 0, 0.6], [0.5, 0, 0.4], [-0.6, 0, -0.5], [0.4, 0, -0.5], [0, 0, 1.5]])
IMAGES = {
    "colours": (Image.fromarray(QUARTERS), QUARTERS.reshape(4, 3) / 255),
    "palette": (Image.fromarray(QUARTERS).convert("P", palette=Image.Palette.ADAPTIVE), QUARTERS.reshape(4, 3) / 255),
    "grey": (Image.fromarray(QUARTERS[..., 0]), QUARTERS[..., :1].reshape(4, 1) / 255 * np.ones(3)),
    "16 bits": (
        Image.fromarray(np.array([[1000, 30000], [50000, 65535]], np.uint16)),
        np.array([[1000], [30000], [50000], [65535]]) / 65535 * np.ones(3),
    ),
    "alpha is not used by OBJ": (
        Image.fromarray(np.dstack([QUARTERS, np.zeros((2, 2), np.uint8)])),
        QUARTERS.reshape(4, 3) / 255,
    ),
}


@pytest.mark.parametrize("kind", IMAGES)
def test_textures_and_materials_of_an_obj(tmp_path: Path, kind: str) -> None:
    image, expected = IMAGES[kind]
    found = colours_of_points(written(tmp_path, image), POINTS)
    np.testing.assert_allclose(found[:4], expected, atol=1e-5)
    np.testing.assert_allclose(found[4], (0.2, 0.4, 0.6), atol=0.003)


@pytest.mark.parametrize(
    ("called", "sentence"),
    [
        ("elsewhere.png", "needs 'elsewhere.png', which is not beside it"),
        ("", "needs 'print.png', which cannot be read"),
    ],
)
def test_a_texture_that_is_missing_or_damaged_is_said(tmp_path: Path, called: str, sentence: str) -> None:
    path = written(tmp_path, None, called=called)
    (tmp_path / "print.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    paint = read_paint(path, *read_mesh(path))
    assert paint is not None
    assert len(paint.notes) == 1
    assert sentence in paint.notes[0]
    assert np.isnan(paint.colours).any()
    assert np.isfinite(paint.colours).any()  # of the other material


def test_a_missing_file_of_materials_is_said_and_nothing_is_grey(tmp_path: Path) -> None:
    path = written(tmp_path, Image.fromarray(QUARTERS))
    (tmp_path / "box.mtl").unlink()
    paint = read_paint(path, *read_mesh(path))
    assert paint is not None
    assert "'box.mtl'" in paint.notes[0]
    assert np.isnan(paint.colours).all()


@pytest.mark.parametrize("suffix", ["glb", "ply"])
def test_other_formats_give_each_vertex_its_colour(tmp_path: Path, suffix: str) -> None:
    box = trimesh.creation.box((1, 2, 3))
    colours = np.random.default_rng(0).integers(0, 256, (len(box.vertices), 4), np.uint8)
    colours[:, 3] = 255
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=colours)
    path = tmp_path / f"box.{suffix}"
    box.export(path)
    vertices, faces = read_mesh(path, "z")
    paint = read_paint(path, vertices, faces)
    assert paint is not None
    near = np.linalg.norm(vertices[faces][..., None, :] - box.vertices, axis=-1).argmin(axis=-1)
    np.testing.assert_allclose(paint.colours, colours[near][..., :3] / 255, atol=0.005)


@pytest.mark.parametrize("named", ["print.png", "gone.png", ""])
def test_a_texture_of_a_ply_is_read_or_not_known(tmp_path: Path, named: str) -> None:
    Image.fromarray(QUARTERS).save(tmp_path / "print.png")
    corners = [(-1, 0, -1, 0, 0), (1, 0, -1, 1, 0), (1, 0, 1, 1, 1), (-1, 0, 1, 0, 1)]
    lines = [
        "ply",
        "format ascii 1.0",
        *([f"comment TextureFile {named}"] if named else []),
        "element vertex 4",
        *(f"property float {name}" for name in ("x", "y", "z", "s", "t")),
        "element face 2",
        "property list uchar int vertex_indices",
        "end_header",
        *(" ".join(map(str, corner)) for corner in corners),
        "3 0 1 2",
        "3 0 2 3",
    ]
    path = tmp_path / "square.ply"
    path.write_text("\n".join(lines) + "\n")
    paint = read_paint(path, *read_mesh(path, "z"))
    if named == "print.png":
        assert paint is not None
        weights = [[0.2, 0.2, 0.6], [0.25, 0.05, 0.7], [0.75, 0.2, 0.05], [0.3, 0.45, 0.25]]  # of the corners
        found = paint.at(np.array([1, 0, 1, 0]), np.array(weights))
        np.testing.assert_allclose(found, QUARTERS.reshape(4, 3) / 255, atol=1e-5)
    else:
        assert paint is None or np.isnan(paint.colours).all()
        assert not named or (paint is not None and "'gone.png'" in paint.notes[0])


def test_colours_of_collada_are_those_of_materials_alone(tmp_path: Path) -> None:
    box, path = trimesh.creation.box((1, 2, 3)), tmp_path / "box.dae"
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[51, 102, 153, 255])
    box.visual = trimesh.visual.TextureVisuals(material=material)
    box.export(path)
    paint = read_paint(path, *read_mesh(path, "z"))
    assert paint is not None
    np.testing.assert_allclose(paint.colours, np.broadcast_to((0.2, 0.4, 0.6), paint.colours.shape), atol=0.005)
    path.write_bytes(path.read_bytes().replace(b'semantic="NORMAL"', b'semantic="COLOR"'))
    with pytest.raises(ValueError, match=r"vertices of box.dae are not read from COLLADA; export it again as \.glb"):
        read_paint(path, np.asarray(box.vertices), np.asarray(box.faces))


def test_what_is_transparent_in_a_gltf_has_no_colour(tmp_path: Path) -> None:
    pixels = np.dstack([QUARTERS, np.array([[255, 0], [255, 255]], np.uint8)])
    square = trimesh.Trimesh([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], [[0, 1, 2], [0, 2, 3]], process=False)
    for mode in ("MASK", "OPAQUE"):
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels), alphaMode=mode)
        square.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
        square.export(tmp_path / "square.glb")
        vertices, faces = read_mesh(tmp_path / "square.glb", "z")
        paint = read_paint(tmp_path / "square.glb", vertices, faces)
        assert paint is not None
        upper_right = paint.at(np.array([0]), np.array([[0.1, 0.25, 0.65]]))
        assert np.isnan(upper_right).all() == (mode == "MASK")


def test_colours_of_another_shape_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, Image.fromarray(QUARTERS))
    other = trimesh.creation.icosphere(2)
    with pytest.raises(ValueError, match=r"belong to another shape than its triangles; export it again as \.glb"):
        read_paint(path, np.asarray(other.vertices), np.asarray(other.faces))


@pytest.mark.parametrize(
    ("colours", "sentence"),
    [
        (np.zeros((5, 3)), "must be \\(vertices, 3\\) or \\(triangles, 3\\), here 8 or 12 rows"),
        (np.full((8, 3), 200.0), "floating colours from 0 to 1; divide by 255"),
        (np.zeros((8, 3), int), "must be of type uint8 or uint16, or floating"),
        (np.zeros((8, 4)), "red, green and blue along the last axis"),
    ],
)
def test_arrays_that_are_no_colours_are_refused(colours: np.ndarray, sentence: str) -> None:
    box = trimesh.creation.box()
    with pytest.raises(ValueError, match=sentence):
        Paint.of(colours, np.asarray(box.faces), len(box.vertices))


def test_cast_colours_are_those_of_a_slow_reference() -> None:
    random, camera = np.random.default_rng(3), ViewCamera(16, 60.0, 2.0)
    ball = trimesh.creation.icosphere(1)
    vertices, faces = np.asarray(ball.vertices) * (1, 0.7, 0.5), np.asarray(ball.faces)
    texture = random.random((8, 8, 3)).astype(np.float32)
    uv = random.random((len(faces), 3, 2)).astype(np.float32)
    paint = Paint(np.ones((len(faces), 3, 3), np.float32), uv, random.integers(-1, 1, len(faces)), [texture])
    triangles = centred_triangles(vertices, faces)[0]
    pose = np.asarray(camera.around(np.array([[0.6, 0.0, 0.8]], np.float32)).pose)
    _, hit, points = seen_of(caster_of(triangles), pose, camera)
    found = painted(paint.on(vertices, faces), hit, points)[0]
    focal, checked = 8 / np.tan(np.radians(30)), 0
    for row in range(16):
        for column in range(16):
            ray = pose[0, :3, :3] @ [(column + 0.5 - 8) / focal, (row + 0.5 - 8) / focal, 1]
            nearest, colour = np.inf, np.full(3, np.nan)
            for number, corners in enumerate(triangles.astype(float)):  # o + t·d = a + u·(b − a) + v·(c − a)
                matrix = np.stack([corners[1] - corners[0], corners[2] - corners[0], -ray], axis=1)
                u, v, t = np.linalg.solve(matrix, pose[0, :3, 3] - corners[0])
                if min(u, v, 1 - u - v) >= 0 and 0 < t < nearest:
                    nearest, place = t, (1 - u - v) * uv[number, 0] + u * uv[number, 1] + v * uv[number, 2]
                    colour = np.ones(3)
                    if paint.texture[number] == 0:
                        colour = texture[int((1 - place[1]) * 8), int(place[0] * 8)]
            same = np.allclose(found[row, column], colour, atol=1e-5, equal_nan=True)
            checked += same
    assert checked >= 254  # rays through an edge, or at a pixel's border in the texture, may be either's
