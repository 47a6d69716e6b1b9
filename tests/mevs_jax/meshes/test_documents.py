"""glTF, COLLADA and 3MF as documents: what of them is shown, what they name and declare, and what is not read."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from data_pipeline.errors import DamagedMesh, EmptyMesh
from data_pipeline.objects.mesh import normalise
from data_pipeline.objects.recipes import MeshFile
from mevs_jax.meshes import parse_mesh
from tests.data_pipeline.objects.making import (
    BOX_AREA,
    Glb,
    area,
    box,
    check,
    dae,
    extent,
    threemf,
    triangles_of,
    zipped,
)

BOX = box()


def refused(content: bytes, suffix: str, kind: type[Exception] = DamagedMesh) -> str:
    with pytest.raises(kind) as caught:
        normalise(*parse_mesh(content, suffix, f"thing{suffix}"), f"thing{suffix}")
    assert "\n" not in str(caught.value)
    return str(caught.value)


# -------------------------------------------------------------------------------------------------------------------- glTF


def boxes(change: Callable[[Any], object] = lambda document: None) -> bytes:
    """Two boxes, the second 50 to the right, of a document that is then changed."""
    made = Glb()
    mesh = made.mesh(made.primitive(BOX[0], triangles_of(BOX[1])))
    made.node(mesh=mesh)
    made.node(children=[made.node(root=False, mesh=mesh)], translation=[50, 0, 0])
    change(made.document)
    return made.bytes()


def test_hidden_nodes_are_not_seen():
    hidden = {"extensions": {"KHR_node_visibility": {"visible": False}}}
    check(boxes(), ".glb", (51, 2, 3), 2 * BOX_AREA, up="z")
    for node in (1, 2):  # itself, or what it hangs on
        check(boxes(lambda document, node=node: document["nodes"][node].update(hidden)), ".glb", up="z")
    nothing = boxes(lambda document: [node.update(hidden) for node in document["nodes"]])
    assert "its scene shows none of its 1 meshes" in refused(nothing, ".glb", EmptyMesh)


@pytest.mark.parametrize("place", ["meshes", "nodes"])
def test_morph_targets_have_their_default_weights(place):
    made = Glb()
    entry = made.primitive(BOX[0], triangles_of(BOX[1]))
    made.node(mesh=made.mesh(entry))
    by = np.zeros((8, 3), np.float32)
    by[BOX[0][:, 2] > 0, 2] = 4
    entry["targets"] = [{"POSITION": made.accessor(by)}, {}]
    check(made.bytes(), ".glb", up="z")
    made.document["meshes"][0]["weights"] = [1, 0]
    made.document[place][0]["weights"] = [0.5, 1]  # those of a node count before those of its mesh
    check(made.bytes(), ".glb", (1, 2, 5), 2 * (2 + 10 + 5), up="z")
    made.document[place][0]["weights"] = [0.5]
    assert "1 weights of 2 morph targets" in refused(made.bytes(), ".glb")


@pytest.mark.parametrize("name", ["my numbers.bin", "my%20numbers.bin"])
@pytest.mark.parametrize("written", ["my%20numbers.bin", "my%2520numbers.bin"])
def test_names_of_buffers_may_have_escapes_or_be_literal(tmp_path, name, written):
    made = Glb()
    made.node(mesh=made.mesh(made.primitive(BOX[0], triangles_of(BOX[1]))))
    (tmp_path / "thing.gltf").write_bytes(made.gltf(written))
    (tmp_path / name).write_bytes(made.binary)
    if "25" in written and " " in name:
        with pytest.raises(DamagedMesh, match=r"needs 'my%20numbers.bin', which cannot be read"):
            MeshFile(str(tmp_path / "thing.gltf")).load()
    else:
        np.testing.assert_allclose(extent(*MeshFile(str(tmp_path / "thing.gltf")).load()), (1, 3, 2))


def test_data_addresses_in_any_capitals():
    made = Glb()
    made.node(mesh=made.mesh(made.primitive(BOX[0], triangles_of(BOX[1]))))
    packed = base64.b64encode(made.binary).decode()
    for begin in ("data:;base64,", "DATA:application/octet-stream;BASE64,"):
        check(made.gltf(begin + packed), ".gltf", up="z")
    assert "not a readable glTF" in refused(made.gltf(f"data:;base64,{packed[:8]}?{packed[8:]}"), ".gltf")


def _of_accessor(index: int, **entries: Any) -> Callable[[Any], object]:
    return lambda document: document["accessors"][index].update(entries)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_of_accessor(1, componentType=5126, count=18), "indices are SCALAR of the type 5126, not unsigned integers"),
        (_of_accessor(1, count=35), "35 corners are no whole number of triangles"),
        (_of_accessor(0, type="VEC2"), "positions are not VEC3"),
        (lambda document: document["accessors"][0].pop("bufferView"), "accessor 0 has no data"),
        (lambda document: document["meshes"][0]["primitives"][0].update(Indices=1), "'Indices', which glTF writes"),
        (lambda document: document["meshes"][0]["primitives"][0]["attributes"].clear(), "no attribute POSITION"),
        (lambda document: document["nodes"][0].update(Scale=[2, 2, 2]), "'Scale', which glTF writes 'scale'"),
        (lambda document: document["nodes"][0].update(matrix=[1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]),
         "last row is not 0 0 0 1"),
        (lambda document: document["nodes"][0].update(matrix=np.eye(4).reshape(-1).tolist(), scale=[2, 2, 2]),
         "a node has a matrix and other transforms"),
        (lambda document: document["asset"].update(minVersion="2.1"), "is not glTF 2.0 but '2.1'"),
        (lambda document: document["nodes"][0].update(mesh=1), "1 is no index of its meshes"),
        (lambda document: document["bufferViews"][0].pop("byteLength"), "it has no 'byteLength'"),
        (lambda document: document.update(extensionsRequired=["KHR_node_scaling"]), "requires the extension KHR_node_scaling"),
    ],
)  # fmt: skip
def test_gltf_that_would_be_read_wrongly_is_refused(change, message):
    assert message in refused(boxes(change), ".glb")


def test_gltf_of_names_given_twice_or_more_than_it_declares():
    assert "one of them twice" in refused(b'{"asset": {"version": "2.0", "version": "2.0"}}', ".gltf")
    assert "declares" in refused(boxes() + b"more", ".glb")
    check(boxes() + b"\0\0", ".glb", (51, 2, 3), 2 * BOX_AREA, up="z")


# ------------------------------------------------------------------------------------------------------------------ COLLADA

COLLADA = dae(*BOX)


def changed(*pairs: tuple[str, str], of: bytes = COLLADA) -> bytes:
    for was, now in pairs:
        assert was.encode() in of
        of = of.replace(was.encode(), now.encode())
    return of


SCENE = '<scene><instance_visual_scene url="#s"/></scene>'
NODE = '<node id="n">'
TURNS = "<translate>1 2 3</translate><rotate>0 0 1 180</rotate><rotate>0 0 0 0</rotate><scale>1 1 -1</scale>"
POLYGONS = "</p><p>".join(" ".join(map(str, face)) for face in BOX[1])


@pytest.mark.parametrize(
    "content",
    [
        changed((SCENE, "")),
        changed((' xmlns="http://www.collada.org/2005/11/COLLADASchema"', "")),
        changed(("2005/11", "2008/03"), ("1.4.1", "1.5.0")),
        changed(("Z_UP", " z_up\n")),
        changed(("7 5 ", "7 5</p><p>")),
        changed(("4 4 4 4", "4 4</vcount><vcount>4 4")),
        changed(
            ("polylist", "polygons"), ("<vcount>4 4 4 4 4 4</vcount>", ""), (POLYGONS.replace("</p><p>", " "), POLYGONS)
        ),
        changed(('count="8"', 'count="8" offset="1"'), ('count="24">', 'count="25">9 ')),
        changed((NODE, NODE + TURNS)),
        COLLADA.decode().replace("utf-8", "utf-16").encode("utf-16"),
    ],
    ids=[
        "no-scene",
        "no-namespace",
        "1.5",
        "axis",
        "two-p",
        "two-vcount",
        "polygons",
        "offset",
        "transforms",
        "utf-16",
    ],
)
def test_variants_of_collada(content):
    check(content, ".dae")


def test_collada_without_a_scene_has_the_transforms_of_its_only_one():
    two = '<node><translate>5 0 0</translate><instance_geometry url="#g"/></node><node id="n">'
    check(changed((SCENE, ""), ('<node id="n">', two)), ".dae", (6, 2, 3), 2 * BOX_AREA)
    one = changed((SCENE, ""), ("<library_visual_scenes>", '<library_visual_scenes><visual_scene id="t"/>'))
    assert "has 2 scenes and does not say which is shown" in refused(one, ".dae")


def test_nan_of_collada_stays_nan():
    """pycollada makes zeros of it."""
    assert "1 vertices that are not finite" in refused(changed(("1.5</float_array>", "NaN</float_array>")), ".dae")
    check(
        changed(
            ('count="24"', 'count="27"'), ('count="8"', 'count="9"'), ("1.5</float_array>", "1.5 NaN 0 0</float_array>")
        ),
        ".dae",
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (changed((NODE, f"{NODE}<skew>45 0 1 0 1 0 0</skew>")), "places a mesh by <skew>"),
        (changed((NODE, f"{NODE}<lookat>1 0 0 0 0 0 0 0 1</lookat>")), "places a mesh by <lookat>"),
        (changed((NODE, f"{NODE}<Scale>2 2 2</Scale>")), "a node with <Scale>, which is not read"),
        (changed(("<matrix>1 0 0 0 ", "<matrix>1 0 0 ")), "a <matrix> has 15 numbers instead of 16"),
        (changed(("0 1</matrix>", "5 1</matrix>")), "a <matrix> whose last row is not 0 0 0 1"),
        (changed(("Z_UP", "W_UP")), "declares 'W_UP' as its axis that is up; write X_UP, Y_UP or Z_UP"),
        (changed(('polylist count="6"', 'polylist count="5"')), "a <polylist> that declares 5 and holds 6"),
        (changed((" 4 4</vcount>", " 4</vcount>")), "a <polylist> of 20 corners that holds 24"),
        (changed(('count="24"', 'count="23"')), "a <float_array> that declares 23 and holds 24"),
        (changed(('count="8"', 'count="9"')), "declares 9 positions, and holds 24 numbers"),
        (changed(('count="8"', 'count="7"')), "vertices beyond its 7"),
        (changed(("1.5</float_array>", "1.5_0</float_array>")), "'1.5_0' is not a number"),
        (changed(('stride="3"', "")), "have 3 numbers each, and a stride of 1"),
        (changed(("1.5</float_array>", "1.5<more>9</more></float_array>")), "a <float_array> holds other elements"),
        (changed(('name="Z"', 'name="Y"')), "the axes ['X', 'Y', 'Y'] and not X, Y, Z"),
        (changed(("<vcount>", "<ph><p>0 1 3 2</p><h>0 1 3</h></ph><vcount>")), "polygons with holes"),
        (changed(("</vcount>", "</vcount><P>0 1 2</P>")), "a <polylist> with <P>, which is not read"),
        (changed(("<geometry ", '<geometry id="g"/><geometry ')), "has 2 elements 'geometry' of the id 'g'"),
        (changed(("<mesh>", "<brep>"), ("</mesh>", "</brep>")), "a geometry that is no mesh (<brep>)"),
        (changed(('url="#g"', 'url="other.dae#g"')), "names 'other.dae#g' in another file"),
        (changed(("COLLADA", "Collada")), "its root is <Collada> and not <COLLADA>"),
        (changed(('source="#a"', 'source="#b"')), "its positions are those of '#b'"),
    ],
)
def test_collada_that_would_be_read_wrongly_is_refused(content, message):
    assert message in refused(content, ".dae")


def test_collada_whose_scene_shows_nothing_says_so():
    nothing = changed(('<instance_geometry url="#g"/>', ""))
    assert "its scene shows none of its 1 geometries" in refused(nothing, ".dae", EmptyMesh)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("suffix", [".dae", ".3mf"])
def test_entities_are_refused_in_every_encoding(suffix, encoding):
    text = "<!DOCTYPE a [<!ENTITY e '1'>]><COLLADA>&e;</COLLADA>".encode(encoding)
    content = text if suffix == ".dae" else zipped({"3D/3dmodel.model": text})
    assert "defines XML entities" in refused(content, suffix)
    if suffix == ".dae":  # a comment defines none
        comment = COLLADA.decode().replace("<asset>", "<!-- <!ENTITY e> --><asset>").replace("utf-8", encoding)
        check(comment.encode(encoding), ".dae")


def test_collada_as_a_second_reader_reads_it():
    """Nodes within nodes, instances of nodes, strips, fans, several inputs, a skin."""
    import collada

    shapes = """<tristrips count="2"><input semantic="VERTEX" source="#v" offset="1"/>
      <input semantic="NORMAL" source="#p" offset="0"/><p>0 0 0 1 0 2 0 3</p><p>1 4 1 6 1 5</p></tristrips>
      <trifans count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 6 4</p></trifans>
      <triangles count="2"><input semantic="VERTEX" source="#v" offset="0"/><p>1 5 7 1 7 3</p></triangles>
      <lines count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 7</p></lines></mesh>"""
    nodes = """<library_nodes><node id="l"><rotate>0.6 0 0.8 40</rotate><instance_geometry url="#g"/>
      <node><scale>1 2 0.5</scale><translate>4 5 6</translate><instance_geometry url="#g"/></node></node></library_nodes>
      <library_visual_scenes>"""
    more = '<node id="n"><translate>-9 0 2</translate><rotate>0 1 0 30</rotate><instance_node url="#l"/>'
    content = changed(("</mesh>", shapes), ("<library_visual_scenes>", nodes), ('<node id="n">', more))
    ours = parse_mesh(content, ".dae", "thing.dae")
    theirs = []
    for bound in collada.Collada(io.BytesIO(content)).scene.objects("geometry"):
        for primitive in bound.primitives():
            if not isinstance(primitive, collada.lineset.BoundLineSet):
                triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
                theirs.append(triangles.vertex[triangles.vertex_index])
    middles = ours[0][ours[1]].mean(axis=1), np.concatenate(theirs).mean(axis=1)
    apart = np.linalg.norm(middles[0][:, None] - middles[1], axis=2)
    assert apart.shape[0] == apart.shape[1]
    assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 1e-3


# ---------------------------------------------------------------------------------------------------------------------- 3MF

CORE = 'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"'
RELATIONSHIP = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"


def model(resources: str, build: str, attributes: str = CORE) -> bytes:
    return f"<model {attributes}><resources>{resources}</resources><build>{build}</build></model>".encode()


def thing(name: str, at: float = 0, kind: str = "") -> str:
    vertices, faces = box(at=(at, 0, 0))
    points = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in vertices)
    corners = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in triangles_of(faces))
    mesh = f"<mesh><vertices>{points}</vertices><triangles>{corners}</triangles></mesh>"
    return f'<object id="{name}"{kind and f" type={kind!r}"}>{mesh}</object>'


def packed(*documents: bytes, start: str | None = None) -> bytes:
    parts = {f"3D/{letter}.model": document for letter, document in zip("abc", documents, strict=False)}
    if start is not None:
        relationship = f'<Relationship Id="r" Type="{RELATIONSHIP}" Target="{start}"/>'
        parts["_rels/.rels"] = f"<Relationships xmlns='a'>{relationship}</Relationships>".encode()
    return zipped(parts)


def test_3mf_begins_where_its_relationships_say():
    first, second = (model(thing("1", at), '<item objectid="1"/>') for at in (0, 20))
    for start, centre in (("/3D/a.model", 0), ("/3d/B.model", 20), ("3D/b.model", 20)):
        vertices, _ = parse_mesh(packed(first, second, start=start), ".3mf", "thing.3mf")
        assert vertices[:, 0].mean() == pytest.approx(centre)
    assert "has '/3D/c.model' 0 times in its archive" in refused(packed(first, second, start="/3D/c.model"), ".3mf")
    assert "has 2 models and no _rels/.rels" in refused(packed(first, second), ".3mf")
    check(packed(first), ".3mf")


def test_3mf_builds_its_items_alone():
    both = thing("1") + thing("2", 20)
    check(packed(model(both, '<item objectid="1"/>')), ".3mf")
    check(packed(model(both, '<item objectid="1"/><item objectid="2"/>')), ".3mf", (21, 2, 3), 2 * BOX_AREA)
    group = '<object id="3"><components><component objectid="1"/><component objectid="2" transform="1 0 0 0 1 0 0 0 1 5 0 0"/>'
    check(
        packed(model(f"{both}{group}</components></object>", '<item objectid="3"/>')), ".3mf", (26, 2, 3), 2 * BOX_AREA
    )
    twice = '<item objectid="3" transform="2 0 0 0 1 0 0 0 1 0 0 0"/>'  # and the transforms of its components
    check(packed(model(f"{both}{group}</components></object>", twice)), ".3mf", (52, 2, 3), 2 * 2 * (4 + 6 + 6))
    assert "none of its 2 objects is built" in refused(packed(model(both, "")), ".3mf", EmptyMesh)
    for kind in ("support", "solidsupport"):
        resources = thing("1") + thing("2", 20, kind)
        check(packed(model(resources, '<item objectid="1"/><item objectid="2"/>')), ".3mf")
        assert "builds supports only" in refused(packed(model(resources, '<item objectid="2"/>')), ".3mf", EmptyMesh)


ITEM = '<item objectid="1"/>'


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (model(thing("1") + thing("1", 20), ITEM), "has two objects of the id '1'"),
        (model(thing("1"), '<item objectid="2"/>'), "builds an object of the id '2', which it does not have"),
        (model(thing("1", kind="other"), ITEM), "builds an object of the type 'other'"),
        (model(thing("1"), ITEM, f'{CORE} xmlns:q="http://x.org/q" requiredextensions="q"'), "the extension http://x.org/q"),
        (model(thing("1"), ITEM, f'{CORE} requiredextensions="q"'), "requires the extension q"),
        (model(thing("1"), ITEM, CORE.replace("2015/02", "2013/01")), "core/2013/01}model', not of 3MF's core/2015/02"),
        (model(thing("1").replace("</mesh>", "<beams/></mesh>"), ITEM), "has a mesh with"),
        (model(thing("1").replace("<triangle ", "<Triangle ", 1), ITEM), "Triangle' in its 'triangles'"),
        (model(thing("1"), f"{ITEM}<Item objectid='1'/>"), "Item' in its 'build'"),
        (model('<object id="1"><volume/></object>', ITEM), "an object '1' that is no mesh"),
        (model(thing("1").replace('x="0.5"', 'x="0_5"'), ITEM), "'0_5' is not a number"),
        (model(thing("1").replace(' y="1.0"', "", 1), ITEM), "a <vertex> has no 'y'"),
        (model(thing("1").replace('v1="7"', 'v1="8"').replace('v2="7"', 'v2="8"'), ITEM), "vertices beyond its 8"),
        (model(thing("1"), '<item objectid="1" transform="1 0 0 0 1 0 0 0 1 0 0"/>'), "11 numbers instead of 12"),
    ],
)  # fmt: skip
def test_3mf_that_would_be_read_wrongly_is_refused(document, message):
    assert message in refused(packed(document), ".3mf")


def test_3mf_with_extensions_that_leave_the_geometry_as_it_is():
    names = "xmlns:m='http://schemas.microsoft.com/3dmanufacturing/material/2015/02' requiredextensions='m'"
    check(packed(model(thing("1"), ITEM, f"{CORE} {names}")), ".3mf")
    assert area(*parse_mesh(threemf(*BOX), ".3mf", "thing.3mf")) == pytest.approx(BOX_AREA)
