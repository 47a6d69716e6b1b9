"""Map projections of directions on the unit sphere, for figures of viewpoints."""

from __future__ import annotations

import numpy as np

MERCATOR_LIMIT = 85.0
"""Degrees of latitude beyond which the Mercator projection is cut off."""


def longitude_latitude(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude in degrees of unit vectors (..., 3), each (...)."""
    longitude = np.degrees(np.arctan2(directions[..., 1], directions[..., 0]))
    return longitude, np.degrees(np.arcsin(np.clip(directions[..., 2], -1, 1)))


def equal_area(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hammer's projection of unit vectors (..., 3): equal areas of the sphere are equal areas of the map.

    Returns:
        Abscissa in [−2√2, 2√2] and ordinate in [−√2, √2], each (...); the map is the ellipse with these half axes.
    """
    longitude = np.arctan2(directions[..., 1], directions[..., 0])
    height = np.clip(directions[..., 2], -1, 1)
    level = np.sqrt(1 - height**2)
    scale = np.sqrt(2 / (1 + level * np.cos(longitude / 2)))
    return 2 * scale * level * np.sin(longitude / 2), scale * height


def mercator_ordinate(latitude: np.ndarray) -> np.ndarray:
    """Height on a Mercator map in degrees of longitude, from latitude in degrees."""
    return np.degrees(np.log(np.tan(np.radians(45 + latitude / 2))))


def mercator(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and Mercator ordinate of unit vectors (..., 3), both in degrees of longitude."""
    longitude, latitude = longitude_latitude(directions)
    return longitude, mercator_ordinate(np.clip(latitude, -MERCATOR_LIMIT, MERCATOR_LIMIT))
