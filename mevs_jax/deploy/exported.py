"""Runs the artefacts of `mevs_jax.deploy.export`. Needs JAX and NumPy alone; a copy of this file lies beside the artefacts.

    import exported
    programs = exported.load("FOLDER")
    found = programs["recognise"](depth)              # depth (b, side, side) float32, in radii
    memory = exported.blank(programs["decide"])
    step = programs["decide"](memory, depth[0], pose, reachable, cost, 0)

`manifest.json` says names, shapes, frames and units.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

FORM = 1


@dataclass(frozen=True)
class Program:
    """One compiled program.

    Attributes:
        name: its name.
        about: its entry in the manifest.
    """

    name: str
    about: dict[str, Any]
    _call: Callable[..., Any]

    def __call__(self, *arguments: Any) -> dict[str, Any]:
        """Runs the program; arguments and results as in the manifest, results as NumPy arrays by name."""
        names = [given["name"] for given in self.about["inputs"]]
        if len(arguments) != len(names):
            raise ValueError(f"{self.name} takes {', '.join(names)}, got {len(arguments)} arguments")
        given = [_as(value, about) for value, about in zip(arguments, self.about["inputs"], strict=True)]
        return jax.tree.map(np.asarray, self._call(*given))


def _as(value: Any, about: dict[str, Any]) -> Any:
    if "arrays" in about:
        return {one["name"]: _as(value[one["name"]], one) for one in about["arrays"]}
    array = np.asarray(value)
    wanted = about["shape"]
    if array.ndim != len(wanted) or any(b not in ("b", a) for a, b in zip(array.shape, wanted, strict=True)):
        raise ValueError(f"{about['name']} must have shape {wanted}, got {list(array.shape)}")
    return jnp.asarray(array, about["dtype"])


def blank(program: Program) -> dict[str, np.ndarray]:
    """The memory of `decide` before the first view."""
    (memory,) = [given for given in program.about["inputs"] if "arrays" in given]
    return {one["name"]: np.zeros(one["shape"], one["dtype"]) for one in memory["arrays"]}


def load(folder: str | Path) -> dict[str, Program]:
    """Returns the programs in a folder by name.

    Raises:
        ValueError: if the manifest or a file is missing, damaged, or of another version.
    """
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
        form, programs = manifest["form"], manifest["programs"].items()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is no manifest of exported programs; export them again") from error
    if form != FORM:
        raise ValueError(f"{path} is of form {form!r}, this loader reads {FORM}; export the programs again")
    found = {}
    for name, about in programs:
        if not name.isidentifier():
            raise ValueError(f"{path} names a program {name!r:.40}, which is no name; export the programs again")
        file = path.parent / f"{name}.stablehlo"
        try:
            content = file.read_bytes()
        except OSError as error:
            raise ValueError(f"{file} cannot be read ({error.strerror}); export the programs again") from error
        if not isinstance(about, dict) or hashlib.sha256(content).hexdigest() != about.get("sha256"):
            raise ValueError(f"{file} is damaged, since its hash differs; export the programs again")
        try:
            call = jax.export.deserialize(bytearray(content)).call
        except Exception as error:  # of flatbuffers, of many kinds
            raise ValueError(
                f"{file} is no exported program ({type(error).__name__}); export the programs again"
            ) from error
        found[name] = Program(name, about, jax.jit(call))
    return found
