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

from mevs_jax.agent.agent import MOST_VIEWS
from mevs_jax.agent.candidates import candidates_of
from mevs_jax.agent.programs import Programs
from mevs_jax.arguments import whole
from mevs_jax.deploy import exported as loader
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

    `recognise` maps depth images to features and calibrated probabilities of single views (unless the system is a gallery),
    `entropies` maps clouds to the entropies of all views (if the system predicts them), and `decide` is one step of an agent: a
    new view changes the memory, and the next view is chosen.

    Args:
        system: from `mevs_jax.load`.
        folder: where to; its artefacts are replaced.
        policy: of `decide`; one of `system.policies`.
        max_views: largest number of views of an object.
        platforms: that the programs run on.

    Raises:
        ImportError: without the package flatbuffers.
        ValueError: for a policy that cannot be used, or a number of views or a platform that cannot be.
    """
    max_views = whole(max_views, f"max_views must be from 1 to {MOST_VIEWS}", 1, MOST_VIEWS)
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise ValueError(f"platforms must be one or more of {', '.join(PLATFORMS)}, got {platforms!r:.80}")
    try:
        import flatbuffers  # noqa: F401
    except ImportError as error:
        raise ImportError("writing StableHLO needs flatbuffers: pip install mevs-jax[export]") from error
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
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
    (b,) = jax.export.symbolic_shape("b")
    for name, (function, inputs, outputs) in programs_of(system, policy, max_views).items():
        exported = jax.export.export(jax.jit(function), platforms=list(platforms))(*arguments_like(inputs, b))
        content = bytes(exported.serialize())
        (folder / f"{name}.stablehlo").write_bytes(content)
        manifest["programs"][name] = {
            "inputs": inputs,
            "outputs": outputs,
            "file": f"{name}.stablehlo",
            "sha256": hashlib.sha256(content).hexdigest(),
            "platforms": list(platforms),
        }
    shutil.copyfile(str(loader.__file__), folder / LOADER)
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1))
    return folder


_FRAMES = {
    "object": "origin at the object's centre, z up, unit the object's radius",
    "camera": "x right, y down, z forward (OpenCV); poses map the camera's frame to the object's",
}

Program = tuple[Callable[..., Any], list[dict[str, Any]], list[dict[str, Any]]]
"""A function, and its inputs and outputs as the manifest describes them."""


def _array(name: str, shape: Sequence[Any], about: str, dtype: str = "float32") -> dict[str, Any]:
    return {"name": name, "shape": list(shape), "dtype": dtype, "about": about}


def arguments_like(inputs: Sequence[dict[str, Any]], b: Any) -> list[Any]:
    """The shapes of inputs, for an extent `b`."""

    def of(one: dict[str, Any]) -> Any:
        if "arrays" in one:
            return {part["name"]: of(part) for part in one["arrays"]}
        return jax.ShapeDtypeStruct([b if extent == "b" else extent for extent in one["shape"]], one["dtype"])

    return [of(one) for one in inputs]


def programs_of(system: TrainedSystem, policy: str, max_views: int) -> dict[str, Program]:
    """The programs of a system by name, as in `export`."""
    programs = {"decide": _decide(system, policy, max_views)}
    if system.parts.encoder is not None:
        programs["recognise"] = _recognise(system)
    if system.parts.entropy is not None:
        programs["entropies"] = _entropies(system)
    return programs


def _radius(system: TrainedSystem, shape: Sequence[Any]) -> list[dict[str, Any]]:
    """The input of a system that uses the size of objects; none for another one."""
    about = "of the object in metres; NaN if its size is unknown"
    return [_array("radius", shape, about)] if system.description.uses_size else []


def _recognise(system: TrainedSystem) -> Program:
    """Depth images to features and calibrated probabilities of single views."""
    of, parts = system.description, system.parts
    side = of.camera.resolution

    def recognise(depth: Array, radius: Array | float = jnp.nan) -> dict[str, Array]:
        radii = jnp.broadcast_to(jnp.asarray(radius), depth.shape[:1])
        features, _ = features_of(parts, depth, radii, of)
        logits = logits_of(parts, features) / parts.single
        return {"features": features, "probabilities": jax.nn.softmax(logits, axis=-1)}

    return (
        recognise,
        [
            _array("depth", ["b", side, side], "radii along the optical axis; 0 where nothing is hit"),
            *_radius(system, ["b"]),
        ],
        [
            _array("features", ["b", of.features], "of each view"),
            _array("probabilities", ["b", len(of.classes)], "of the classes, from each view alone"),
        ],
    )


def _entropies(system: TrainedSystem) -> Program:
    """Clouds to the predicted entropies of all views."""
    cloud, network, views = system.description.cloud, system.parts.entropy, len(system.viewpoints)
    assert cloud is not None
    assert network is not None
    columns = "x, y, z" + (" and the unit vector to the camera" if cloud.directions else "")
    moved = "the camera's frame, its origin moved to the object's centre"
    frame = "the object's frame" if cloud.frame == "world" else moved
    return (
        lambda clouds: {"entropies": network.module(clouds)},
        [_array("clouds", ["b", cloud.points, cloud.columns], f"{columns}, in {frame}, in radii")],
        [_array("entropies", ["b", views], "of each view, relative to the largest in training")],
    )


def _decide(system: TrainedSystem, policy: str, max_views: int) -> Program:
    """One step of an agent whose candidates are the system's viewpoints."""
    programs, parts = Programs(system, policy, True, max_views), system.parts
    views, side = len(system.viewpoints), system.description.camera.resolution
    lattice = candidates_of(system, None, views)
    leaves, structure = jax.tree.flatten(programs.blank())
    names = [f"memory{index:02d}" for index in range(len(leaves))]

    def decide(
        memory: Any, depth: Array, pose: Array, reachable: Array, cost: Array, seed: Array, radius: Any = jnp.nan
    ) -> dict[str, Any]:
        before = jax.tree.unflatten(structure, [memory[name] for name in names])
        after, (probabilities, strangeness, _) = programs.steps.see_view(
            parts, before, depth, pose, jnp.asarray(radius, jnp.float32), programs.temperatures(parts)
        )
        following, gains = programs.steps.choose_next(
            parts, after, lattice, jnp.zeros(views, bool), reachable, cost, jax.random.key(seed)
        )
        return {
            "memory": dict(zip(names, jax.tree.leaves(after), strict=True)),
            "probabilities": probabilities,
            "strangeness": strangeness,
            "next": following,
            "gains": gains,
        }

    before = f"zeros before the first view, then what the last call returned; at most {max_views} views, no more"
    arrays = [_array(name, leaf.shape, "", str(leaf.dtype)) for name, leaf in zip(names, leaves, strict=True)]
    inputs = [
        {"name": "memory", "about": before, "arrays": arrays},
        _array("depth", [side, side], "radii along the optical axis; 0 where nothing is hit"),
        _array("pose", [4, 4], "of the camera, to the object's frame"),
        _array("reachable", [views], "viewpoints that the camera can go to", "bool"),
        _array("cost", [views], "subtracted from the scores of the viewpoints"),
        _array("seed", [], "of random policies", "uint32"),
        *_radius(system, []),
    ]
    outputs = [
        {"name": "memory", "about": "after this view"},
        _array("probabilities", [len(system.classes)], "calibrated, of the classes"),
        _array("strangeness", [], "share of known objects that look less strange; NaN if unknown"),
        _array("next", [], "index of the next viewpoint; -1 if none is left", "int32"),
        _array("gains", [views], "expected gain of each viewpoint in nats; NaN where it is not known"),
    ]
    return decide, inputs, outputs
