"""Colours of images as numbers from 0 to 1."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float


def colours_of(colours: Any, what: str) -> Float[np.ndarray, "*places 3"]:
    """Colours from 0 to 1, float32, from whole numbers of 8 or 16 bits or floating ones; raises `ValueError` for others."""
    given = np.asarray(colours)
    if given.ndim < 2 or given.shape[-1] != 3:
        raise ValueError(f"{what} must have red, green and blue along the last axis, got shape {given.shape}")
    if given.dtype in (np.uint8, np.uint16):
        return (given / np.float32(np.iinfo(given.dtype).max)).astype(np.float32)
    if given.dtype.kind != "f":
        raise ValueError(f"{what} must be of type uint8 or uint16, or floating from 0 to 1, got {given.dtype}")
    if ((given < 0) | (given > 1)).any():
        raise ValueError(
            f"{what} go from {np.nanmin(given):g} to {np.nanmax(given):g}, and floating colours from 0 to 1; divide by 255"
        )
    return given.astype(np.float32)
