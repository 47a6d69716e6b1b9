"""Writes a trained system into a folder, with StableHLO programs; see `mevs_jax.deploy.export`."""

from mevs_jax.deploy.export import export as export
