"""Runs exported programs; see `mevs_jax.deploy.exported`."""

from mevs_jax.deploy.exported import Program as Program
from mevs_jax.deploy.exported import blank as blank
from mevs_jax.deploy.exported import load as load
