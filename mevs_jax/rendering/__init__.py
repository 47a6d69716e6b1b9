"""Images of a mesh as array programs: for making data on an accelerator, and with gradients."""

from mevs_jax.rendering.depth import Rendering, pad_triangles, render_depth

__all__ = ["Rendering", "pad_triangles", "render_depth"]
