"""Compiled programs of a trained system as StableHLO, which need JAX and NumPy alone (`mevs_jax.deploy.exported` runs them).

A folder of artefacts holds `manifest.json`, one `.stablehlo` file for each program, and a copy of the loader. The programs
contain their weights, take any number of views or clouds where the manifest says `b`, and run on CPU, CUDA and TPU. JAX reads
artefacts of one version for at least six months.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mevs_jax.agent.candidates import candidates_of
from mevs_jax.agent.programs import Programs
from mevs_jax.points.ops import portable
from mevs_jax.trained.parts import features_of, logits_of
from mevs_jax.trained.system import TrainedSystem

PLATFORMS = ("cpu", "cuda", "tpu")
MANIFEST, LOADER = "manifest.json", "exported.py"
FORM = 1


def export(
    system: TrainedSystem,
    folder: str | Path,
    *,
    policy: str = "best",
    max_views: int = 8,
    platforms: Sequence[str] = PLATFORMS,
) -> Path:
    """Writes the programs of a system into a folder; returns the folder.

    `recognise` maps depth images to features and calibrated probabilities of single views, `entropies` maps clouds to the
    entropies of all views (if the system predicts them), and `decide` is one step of an agent: a new view changes the memory,
    and the next view is chosen.

    Args:
        system: from `mevs_jax.load`.
        folder: where to; its artefacts are replaced.
        policy: of `decide`; one of `system.policies`.
        max_views: largest number of views of an object.
        platforms: that the programs run on.

    Raises:
        ImportError: without the package flatbuffers.
        ValueError: for a policy that cannot be used.
    """
    try:
        import flatbuffers  # noqa: F401
    except ImportError as error:
        raise ImportError("writing StableHLO needs flatbuffers: pip install mevs-jax[export]") from error
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    programs = {"recognise": _recognise(system), "decide": _decide(system, policy, max_views)}
    if system.parts.entropy is not None:
        programs["entropies"] = _entropies(system)
    manifest: dict[str, Any] = {
        "form": FORM,
        "classes": list(system.classes),
        "viewpoints": system.viewpoints.tolist(),
        "camera": asdict(system.description.camera),
        "policy": system.description.best if policy == "best" else policy,
        "max_views": max_views,
        "frames": _FRAMES,
        "made_with": {"jax": version("jax"), "mevs-jax": version("mevs-jax")},
        "programs": {},
    }
    for name, (function, arguments, about) in programs.items():
        with portable():
            exported = jax.export.export(jax.jit(function), platforms=list(platforms))(*arguments)
        content = bytes(exported.serialize())
        (folder / f"{name}.stablehlo").write_bytes(content)
        manifest["programs"][name] = about | {
            "file": f"{name}.stablehlo",
            "sha256": hashlib.sha256(content).hexdigest(),
            "platforms": list(platforms),
        }
    from mevs_jax.deploy import exported as loader

    shutil.copyfile(str(loader.__file__), folder / LOADER)
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1))
    return folder


_FRAMES = {
    "object": "origin at the object's centre, z up, unit the object's radius",
    "camera": "x right, y down, z forward (OpenCV); poses map the camera's frame to the object's",
}

_Program = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]


def _described(name: str, shape: Sequence[Any], dtype: str, about: str) -> dict[str, Any]:
    return {"name": name, "shape": list(shape), "dtype": dtype, "about": about}


def _recognise(system: TrainedSystem) -> _Program:
    """Depth images to features and calibrated probabilities of single views."""
    description, parts = system.description, system.parts
    side, classes = description.camera.resolution, len(system.classes)
    (b,) = jax.export.symbolic_shape("b")

    def recognise(depth: Array, radius: Array | float = jnp.nan) -> dict[str, Array]:
        of, radii = description, jnp.broadcast_to(jnp.asarray(radius), depth.shape[:1])
        features = features_of(parts, depth, radii, image=of.image, size=of.size, camera=of.camera)
        logits = logits_of(parts, parts.encoder.module, features) / parts.single
        return {"features": features, "probabilities": jax.nn.softmax(logits, axis=-1)}

    about = {
        "inputs": [
            _described("depth", ["b", side, side], "float32", "radii along the optical axis; 0 where nothing is hit"),
            *_radius_input(system, ["b"]),
        ],
        "outputs": [
            _described("features", ["b", 8 * description.encoder.width], "float32", "of each view"),
            _described("probabilities", ["b", classes], "float32", "of the classes, from each view alone"),
        ],
    }
    depth, radius = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((b, side, side), (b,)))
    return recognise, (depth, radius) if description.size else (depth,), about


def _radius_input(system: TrainedSystem, shape: Sequence[Any]) -> list[dict[str, Any]]:
    """The input of a system that uses the size of objects; none for another one."""
    about = "of the object in metres; NaN if its size is unknown"
    return [_described("radius", shape, "float32", about)] if system.description.size else []


def _entropies(system: TrainedSystem) -> _Program:
    """Clouds to the predicted entropies of all views."""
    cloud, parts, views = system.description.cloud, system.parts, len(system.viewpoints)
    assert cloud is not None
    assert parts.entropy is not None
    network = parts.entropy
    (b,) = jax.export.symbolic_shape("b")

    def entropies(clouds: Array) -> dict[str, Array]:
        return {"entropies": network.module(clouds)}

    columns = "x, y, z" + (" and the unit vector to the camera" if cloud.directions else "")
    frame = (
        "the object's frame"
        if cloud.frame == "world"
        else "the camera's frame, its origin moved to the object's centre"
    )
    shape = ["b", cloud.points, cloud.columns]
    about = {
        "inputs": [_described("clouds", shape, "float32", f"{columns}, in {frame}, in radii")],
        "outputs": [
            _described("entropies", ["b", views], "float32", "of each view, relative to the largest in training")
        ],
    }
    return entropies, (jax.ShapeDtypeStruct((b, *shape[1:]), jnp.float32),), about


def _decide(system: TrainedSystem, policy: str, max_views: int) -> _Program:
    """One step of an agent whose candidates are the system's viewpoints."""
    programs = Programs(system, policy, True, max_views)
    views, side = len(system.viewpoints), system.description.camera.resolution
    lattice = candidates_of(system, None, views)

    def decide(
        memory: Any,
        depth: Array,
        pose: Array,
        reachable: Array,
        cost: Array,
        seed: Array,
        radius: Array | float = jnp.nan,
    ) -> dict[str, Any]:
        structure = jax.tree.structure(programs.blank())
        unpacked = jax.tree.unflatten(structure, [memory[name] for name in sorted(memory)])
        unpacked, (probabilities, strangeness) = programs.see_view(
            system.parts, unpacked, depth, pose, jnp.asarray(radius, jnp.float32), programs.temperatures(system.parts)
        )
        key = jax.random.key(seed)
        failed = jnp.zeros(views, bool)
        following, gains = programs.choose_next(system.parts, unpacked, lattice, failed, reachable, cost, key)
        return {
            "memory": dict(zip(sorted(memory), jax.tree.leaves(unpacked), strict=True)),
            "probabilities": probabilities,
            "strangeness": strangeness,
            "next": following,
            "gains": gains,
        }

    leaves = jax.tree.leaves(programs.blank())
    memory = {f"memory{index:02d}": jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for index, leaf in enumerate(leaves)}
    arguments = (
        memory,
        jax.ShapeDtypeStruct((side, side), jnp.float32),
        jax.ShapeDtypeStruct((4, 4), jnp.float32),
        jax.ShapeDtypeStruct((views,), bool),
        jax.ShapeDtypeStruct((views,), jnp.float32),
        jax.ShapeDtypeStruct((), jnp.uint32),
        *[jax.ShapeDtypeStruct((), jnp.float32)] * (system.description.size is not None),
    )
    about = {
        "inputs": [
            {
                "name": "memory",
                "about": f"zeros before the first view, then what the last call returned; at most {max_views} views, no more",
                "arrays": [_described(name, leaf.shape, str(leaf.dtype), "") for name, leaf in memory.items()],
            },
            _described("depth", [side, side], "float32", "radii along the optical axis; 0 where nothing is hit"),
            _described("pose", [4, 4], "float32", "of the camera, to the object's frame"),
            _described("reachable", [views], "bool", "viewpoints that the camera can go to"),
            _described("cost", [views], "float32", "subtracted from the scores of the viewpoints"),
            _described("seed", [], "uint32", "of random policies"),
            *_radius_input(system, []),
        ],
        "outputs": [
            {"name": "memory", "about": "after this view"},
            _described("probabilities", [len(system.classes)], "float32", "calibrated, of the classes"),
            _described("strangeness", [], "float32", "share of known objects that look less strange; NaN if unknown"),
            _described("next", [], "int32", "index of the next viewpoint; -1 if none is left"),
            _described(
                "gains", [views], "float32", "expected gain of each viewpoint in nats; NaN where it is not known"
            ),
        ],
    }
    return decide, arguments, about
