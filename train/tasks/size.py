"""The size of objects as a further input of the recogniser, for data whose files have true sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from data_pipeline.errors import DataError
from mevs_jax.geometry.inputs import SizeInput


@dataclass(frozen=True)
class SizeConfig:
    """Use of the objects' size, for data whose files have true sizes."""

    metres: float = 0.0
    """metres in one unit of the files; 0: the size is not used"""
    withheld: float = 0.25
    """share of the training objects whose size is not told, so that the recogniser can do without"""
    error: float = 0.1
    """largest error of the radius, as a share of it"""


def used_size(config: SizeConfig, option: str) -> SizeConfig | None:
    """Returns the configuration, or None if sizes are not used.

    Args:
        option: the group of options that it was given by, for messages.

    Raises:
        DataError: for numbers out of their range.
    """
    for name, (least, most) in {"metres": (0, 1e6), "withheld": (0, 1), "error": (0, 0.9)}.items():
        if not least <= getattr(config, name) <= most:
            raise DataError(
                f"{option}.{name} {getattr(config, name):g} is not from {least:g} to {most:g}; choose another"
            )
    return config if config.metres else None


def check_sizes(config: SizeConfig, objects: Any, option: str) -> None:
    """Raises `DataError` if the objects of a data set do not have sizes that the recogniser can use.

    Args:
        objects: of the training split; a few of them are read.
        option: the group of options that `config` was given by, for messages.
    """
    if "radius" not in (examples := [objects[at] for at in range(min(len(objects), 32))])[0]:
        raise DataError(
            f"a data set of this run was made by a version that did not store radii, so that {option}.metres cannot be used; "
            "choose another --out"
        )
    known, radius = SizeInput(), float(np.median([example["radius"] for example in examples])) * config.metres
    if not known.smallest <= radius <= known.largest:
        beyond = "more" if radius > 1 else "less"
        raise DataError(
            f"half of the objects have radii of {radius:.3g} m or {beyond}, which is not from {known.smallest:g} to "
            f"{known.largest:g} m; {option}.metres is the metres in one unit of their files, 0.001 for millimetres"
        )


def radii_for_training(
    key: Array, radii: Float[Array, "objects views"], config: SizeConfig
) -> Float[Array, "objects views"]:
    """Returns radii with an error for each object; NaN for the objects whose size is withheld."""
    withhold, scale = jax.random.split(key)
    factor = 1 + config.error * jax.random.uniform(scale, (len(radii), 1), minval=-1.0)
    return jnp.where(jax.random.bernoulli(withhold, float(config.withheld), (len(radii), 1)), jnp.nan, radii * factor)
