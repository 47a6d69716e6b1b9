"""What is fuzzed: each reader with the inputs that mutations begin from. No reader may raise anything but its own errors."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from data_pipeline.errors import DataError, EmptyMesh
from data_pipeline.objects.mesh import normalise
from data_pipeline.objects.sources import mesh_zip
from data_pipeline.objects.voxels import voxel_archive
from mevs_jax.meshes import parse_mesh
from mevs_jax.trained import UnreadableSystem, load, save
from mevs_jax.trained.arrays import DESCRIPTION, WEIGHTS
from mevs_jax.trained.writing import hash_of
from tests.data_pipeline.objects import making
from tests.fuzz.operators import changed
from tests.mevs_jax.trained import making as systems
from tests.train.weights import making as weights
from train.weights.files import read_state_dict

REFERENCE = Path(__file__).parents[1] / "reference"
CORPUS = Path(__file__).parent / "corpus"
"""Inputs that once went wrong, in a folder for each reader."""

BOX, U = making.box(), making.u_profile()


@dataclass(frozen=True)
class Target:
    """A reader, and sound inputs for it."""

    read: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]


def _is_one_line(reason: Exception) -> None:
    assert "\n" not in str(reason), reason


def _mesh(suffix: str) -> Callable[[bytes], None]:
    def read(content: bytes) -> None:
        try:
            mesh = normalise(*parse_mesh(content, suffix, f"fuzzed{suffix}"), f"fuzzed{suffix}")
        except (DataError, EmptyMesh) as reason:
            _is_one_line(reason)
            return
        assert np.isfinite(mesh.vertices).all()
        assert np.isfinite(mesh.extent).all()
        assert mesh.faces.min() >= 0
        assert mesh.faces.max() < len(mesh.vertices)

    return read


def _file(read: Callable[[Path], None], suffix: str) -> Callable[[bytes], None]:
    def from_file(content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"fuzzed{suffix}"
            path.write_bytes(content)
            try:
                read(path)
            except (DataError, EmptyMesh) as reason:
                _is_one_line(reason)

    return from_file


def _read_zip(path: Path) -> None:
    for entry in mesh_zip(path).entries:
        try:
            normalise(*entry.recipe.load(), entry.name)
        except (DataError, EmptyMesh):
            continue


def _read_npz(path: Path) -> None:
    for entry in voxel_archive(path).entries[:4]:
        try:
            normalise(*entry.recipe.load(), entry.name)
        except EmptyMesh:
            continue


def _read_weights(path: Path) -> None:
    arrays = read_state_dict(path)
    assert all(name.isprintable() for name in arrays)
    assert sum(array.nbytes for array in arrays.values()) <= 4 * path.stat().st_size + (1 << 20)


@cache
def _system() -> tuple[bytes, bytes]:
    """The description and the weights of a small trained system."""
    with tempfile.TemporaryDirectory() as folder:
        save(systems.system(), Path(folder) / "system")
        return tuple((Path(folder) / "system" / name).read_bytes() for name in (DESCRIPTION, WEIGHTS))  # type: ignore[return-value]


def _read_system(content: bytes) -> None:
    """Reads a description beside sound weights, with a hash that fits it if it is JSON."""
    try:
        described = json.loads(content)
        described["sha256"] = hash_of(described)
        content = json.dumps(described).encode()
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / DESCRIPTION).write_bytes(content)
        (Path(folder) / WEIGHTS).write_bytes(_system()[1])
        try:
            load(folder)
        except UnreadableSystem as reason:
            _is_one_line(reason)


def _systems() -> list[bytes]:
    description = json.loads(_system()[0])
    found = [_system()[0]]
    for name, value in description.items():
        for other in (None, -1, 2**70, 1e308, "text", [], {}, [value], {"a": value}):
            found.append(json.dumps(description | {name: other}).encode())
    return found


def _off() -> list[bytes]:
    binary = b"OFF BINARY\n" + np.array([8, 6, 0], ">i4").tobytes() + BOX[0].astype(">f4").tobytes()
    binary += b"".join(np.array([4, *face, 0], ">i4").tobytes() for face in BOX[1])
    return [
        making.off(*BOX),
        making.off(*U),
        making.off(*BOX, "CNOFF", " 0 0 1 255 0 0 255"),
        making.off(*BOX, "OFF", joined=True),
        making.off(*BOX).replace(b"0.5", b"nan"),
        b"# \xe4\n" + making.off(*BOX, "4OFF", " 1"),
        binary,
    ]


def _obj() -> list[bytes]:
    slashed = making.obj(*BOX).replace(b" 1 ", b" 1/1/1 ").replace(b"f ", b"f\t")
    return [
        making.obj(*BOX),
        making.obj(*U),
        making.obj(*BOX, relative=True),
        slashed,
        slashed.replace(b"f\t", b"f \\\n "),
    ]


def _stl() -> list[bytes]:
    return [making.stl(*BOX), making.stl(*BOX, text=True), making.stl(*BOX, text=True) * 2]


def _ply() -> list[bytes]:
    mixed = (BOX[0], [[0, 1, 3], [0, 3, 2], *BOX[1][1:]])
    strips = (
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
        b"property uchar red\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
        b"0 0 0 1\n1 0 0 1\n0 1 0 1\n1 1 1 1\n5 0 1 2 -1 3\n"
    )
    found = [making.ply(*shape, order) for shape in (BOX, mixed, U) for order in ("ascii", "<", ">")]
    return [
        *found,
        strips,
        strips.replace(b"red\n", b"red\nproperty list uchar float other\n").replace(b" 1\n", b" 1 0\n"),
    ]


def _glb() -> list[bytes]:
    made = making.Glb()
    made.require("EXT_mesh_gpu_instancing")
    moved = {"attributes": {"TRANSLATION": made.accessor(np.eye(3, dtype=np.float32))}}
    mesh = made.mesh(made.primitive(BOX[0], making.triangles_of(BOX[1])), made.primitive(BOX[0], None, mode=5))
    child = made.node(root=False, mesh=mesh, extensions={"EXT_mesh_gpu_instancing": moved})
    made.node(children=[child], rotation=[0, 0.6, 0, 0.8], scale=[1, 2, 3])
    data = making.Glb()
    data.node(mesh=data.mesh(data.primitive(BOX[0], making.triangles_of(BOX[1]), mode=4)))
    return [making.glb(*BOX), making.draco(*BOX), making.draco(*U), made.bytes(), data.gltf("data:;base64,AAAA")]


def _dae() -> list[bytes]:
    return [making.dae(*BOX), making.dae(*U, "X_UP"), making.dae(*BOX, "Y_UP", "0 1 0 0 1 0 0 0 0 0 2 0 0 0 0 1")]


def _3mf() -> list[bytes]:
    return [making.threemf(*BOX), making.threemf(*U, "2 0 0 0 1 0 0 0 1 0 0 0"), making.threemf(*U, named=False)]


def _zip() -> list[bytes]:
    small = making.members()
    kinds = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    awkward = {name.replace("/", "\\"): content for name, content in making.members(prefix="set/").items()}
    return [
        *(making.zipped(small, kind) for kind in kinds),
        making.zipped({**awkward, "./mug//train/mug_0.off": b"OFF"}),
    ]


def _npz() -> list[bytes]:
    grids = np.zeros((2, 6, 6, 6), np.uint8)
    grids[:, 1:5, 2:4, 1:4] = 1
    arrays = {"X_train": grids, "y_train": np.array([0, 1]), "X_test": grids[:1], "y_test": np.array([1])}
    found = []
    for write, more in ((np.savez, {}), (np.savez_compressed, {}), (np.savez, {"classes": np.array(["mug", "rack"])})):
        buffer = io.BytesIO()
        write(buffer, **arrays, **more)
        found.append(buffer.getvalue())
    return found


def _pth() -> list[bytes]:
    small = weights.state({"a": weights.tensor(), "b": weights.tensor((1, 2), (2, 1)), "c": weights.tensor(key="1")})
    numbers = {"0": bytes(8), "1": bytes(8)}
    hostile = [content for content, _ in weights.HOSTILE_PICKLES.values() if len(content) < 5000]
    return [
        *((REFERENCE / f"weights_{kind}.pth").read_bytes() for kind in ("zip", "legacy")),
        *(weights.legacy(small, numbers) for _ in range(20)),  # as often as hostile ones, which are refused early
        *(weights.zipped(small, numbers, kind) for kind in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)),
        *map(weights.legacy, hostile),
        *(weights.zipped(content) for content in hostile[:4]),
    ]


def _safetensors() -> list[bytes]:
    entries = {
        "a": weights.entry("F32", [2, 1], 0, 8),
        "b": weights.entry("BF16", [3], 8, 14),
        "c": weights.entry("I64", [], 14, 22),
        "d": weights.entry("F16", [0, 5], 22, 22),
        "__metadata__": {"format": "pt"},
    }
    unread = {"a": weights.entry("F8_E4M3", [2], 0, 2)}
    return [weights.safetensors(entries, bytes(22)), weights.safetensors(unread, bytes(2)), weights.safetensors({})]


TARGETS = {
    "off": Target(_mesh(".off"), _off),
    "obj": Target(_mesh(".obj"), _obj),
    "stl": Target(_mesh(".stl"), _stl),
    "ply": Target(_mesh(".ply"), _ply),
    "glb": Target(_mesh(".glb"), _glb),
    "dae": Target(_mesh(".dae"), _dae),
    "3mf": Target(_mesh(".3mf"), _3mf),
    "zip": Target(_file(_read_zip, ".zip"), _zip),
    "npz": Target(_file(_read_npz, ".npz"), _npz),
    "pth": Target(_file(_read_weights, ".pth"), _pth),
    "safetensors": Target(_file(_read_weights, ".safetensors"), _safetensors),
    "system": Target(_read_system, _systems),
}


@cache
def starts(name: str) -> list[bytes]:
    """Returns the sound inputs of a reader and those that once went wrong."""
    return TARGETS[name].seeds() + [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]


_PIECES = [
    *(b"", b"-1", b"0", b"3", b"nan", b"-inf", b"1e400", b"99999999999999999999", b"4294967295", b"2147483648", b" ", b"\n"),
    *(b"\r", b"\t", b"#", b"/", b"\\", b"\0", b"\xff", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xef\xbb\xbf"),
    *(b"\xff\xfe", b"{", b"]", b"\x01\0\0\0", b"PK\x05\x06", b"true", b"null", b"<", b">", b"&#0;", b"e", b".", b"-"),
]  # fmt: skip
"""What is put in place of some bytes, beside random ones."""


@st.composite
def mutated(draw: st.DrawFn, name: str, most: int = 8) -> bytes:
    """Returns an input of a reader with up to eight mutations, or another number of them."""
    content = bytearray(draw(st.sampled_from(starts(name))))
    for _ in range(draw(st.integers(1, most))):
        at = draw(st.integers(0, max(len(content) - 1, 0)))
        kind = draw(st.integers(0, 8))
        if kind == 0:  # one bit
            content[at : at + 1] = bytes(byte ^ (1 << draw(st.integers(0, 7))) for byte in content[at : at + 1])
        elif kind == 1:  # cut off the end
            del content[at:]
        elif kind == 2:  # take out some bytes
            del content[at : at + draw(st.integers(1, 30))]
        elif kind == 3:  # a part again, or a part of elsewhere
            start = draw(st.integers(0, max(len(content) - 1, 0)))
            content[at:at] = content[start : start + draw(st.integers(1, 60))]
        elif kind > 5:  # what knows the formats is drawn as often as what does not
            content = bytearray(draw(changed(bytes(content))))
        else:
            piece = draw(st.sampled_from(_PIECES) if kind == 4 else st.binary(min_size=1, max_size=8))
            content[at : at + draw(st.integers(0, len(piece)))] = piece
    return bytes(content)


def generated(inputs: int) -> settings:
    """Settings of a test of so many new inputs, none of which is kept or made smaller."""
    return settings(
        max_examples=inputs,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
