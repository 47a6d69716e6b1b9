"""Settings of the evaluation beyond the grid: the check of an agent, gradient ascent, and policies by rendering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class AgentConfig:
    """The check of an agent."""

    objects: int = 200
    """number of test objects that agents walk around"""
    max_views: int = 8
    """views of each walk"""
    shots: int = 20
    """random cameras around each object, at each distance"""
    distances: tuple[float, ...] = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0)
    """of these cameras from the object's centre, in radii"""
    calls: int = 400
    """decisions whose time is measured"""


@dataclass(frozen=True)
class AscentConfig:
    """Settings of the gradient ascent on one object."""

    object: str | None = None
    """name of the object in the data set; the first test object if not given"""
    method: Literal["volume", "mesh"] = "volume"
    """volume: opacity entropy of a grid of densities (after DiffDVR); mesh: depth entropy of a softly rendered mesh of at most
    500 faces"""
    starts: int = 40
    """number of start views"""
    resolution: int = 64
    """pixels along each side of the rendered images"""


@dataclass(frozen=True)
class RenderingConfig:
    """Settings of the policies by differentiable rendering."""

    objects: int = 200
    """number of test objects, spread evenly over the split"""
    starts: int = 6
    """number of start views of the gradient ascent"""
    resolution: int = 32
    """pixels along each side of the rendered images"""
    faces: int = 200
    """largest number of faces of a surface"""
