"""Checks for numbers that are infinite or NaN."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.errors import Diverged


def all_finite(tree: Any) -> jax.Array:
    """Returns whether all floating-point numbers in a tree of arrays are finite, as a boolean array of shape ().

    It may be compiled, mapped over members, and applied to arrays that are spread over devices.
    """
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves])) if leaves else jnp.bool_(True)


def not_finite(numbers: Mapping[str, float]) -> list[str]:
    """Returns the names of the numbers that are infinite or NaN."""
    return [name for name, value in numbers.items() if not np.isfinite(value)]


def place_not_finite(content: Any, place: str = "") -> str | None:
    """Returns the place of the first number in nested dictionaries and lists that is infinite or NaN, such as `"losses.2"`.

    Returns None if all numbers are finite.
    """
    if isinstance(content, Mapping):
        items: Any = content.items()
    elif isinstance(content, list | tuple):
        items = enumerate(content)
    else:
        numbers = isinstance(content, float | np.ndarray | np.generic)
        bad = numbers and np.asarray(content).dtype.kind in "fc" and not np.isfinite(content).all()
        return place if bad else None
    found = (place_not_finite(value, f"{place}.{name}" if place else str(name)) for name, value in items)
    return next((one for one in found if one is not None), None)


def check_results(content: Any, made: str) -> Any:
    """Returns `content`, the results of a study, if all numbers in it are finite.

    Args:
        made: what was computed, for the message.

    Raises:
        Diverged: names the first number that is not finite.
    """
    if (place := place_not_finite(content)) is not None:
        raise Diverged(
            f"{made} cannot be computed: {place} is not finite, as happens when a training diverged; "
            f"train the networks with a lower learning rate and another --out"
        )
    return content


def check_outputs(outputs: np.ndarray, network: str, objects: str) -> np.ndarray:
    """Returns the outputs of a network, an array with a leading axis of objects, if they are finite.

    Args:
        network: name of the network, for the message.
        objects: what the objects are, for the message.

    Raises:
        Diverged: if an output is infinite or NaN.
    """
    bad = np.flatnonzero(~np.isfinite(outputs).reshape(len(outputs), -1).all(axis=1))
    if len(bad):
        raise Diverged(
            f"the outputs of the {network} are not finite for {len(bad)} of {len(outputs)} {objects} (first: object {bad[0]}), "
            f"so its training diverged; delete the folder of this network and train it again with a lower learning rate"
        )
    return outputs
