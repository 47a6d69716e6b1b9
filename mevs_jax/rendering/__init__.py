"""Renders meshes and volumes as array programs: to make data on an accelerator, and with gradients, to find good views."""

from mevs_jax.rendering.depth import Rendering, pad_triangles, render_depth
from mevs_jax.rendering.kato import render_silhouette
from mevs_jax.rendering.mesh import Softness, SoftRendering, render_mesh
from mevs_jax.rendering.objectives import (
    edge_content,
    opacity_entropy,
    silhouette_gaussian,
    soft_depth_entropy,
    visible_area,
)
from mevs_jax.rendering.optimise import Ascent, ascend, distinct_optima
from mevs_jax.rendering.volume import VolumeRendering, corners_of_cells, march, render_volume

__all__ = [
    "Ascent",
    "Rendering",
    "SoftRendering",
    "Softness",
    "VolumeRendering",
    "ascend",
    "corners_of_cells",
    "distinct_optima",
    "edge_content",
    "march",
    "opacity_entropy",
    "pad_triangles",
    "render_depth",
    "render_mesh",
    "render_silhouette",
    "render_volume",
    "silhouette_gaussian",
    "soft_depth_entropy",
    "visible_area",
]
