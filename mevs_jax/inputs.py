"""The networks' inputs, from canonical views; see `mevs_jax.geometry.inputs`."""

from mevs_jax.geometry.inputs import depth_and_normals as depth_and_normals
from mevs_jax.geometry.inputs import depth_image as depth_image
from mevs_jax.geometry.inputs import view_cloud as view_cloud
