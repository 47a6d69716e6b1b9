"""Trained systems: one folder that describes itself, and everything that is needed to use it."""

from mevs_jax.beliefs.strangeness import Strangeness, fit_strangeness
from mevs_jax.trained.description import CloudInput, DataDescription, Description, ImageInput
from mevs_jax.trained.files import UnreadableSystem, from_pretrained, load, verify
from mevs_jax.trained.parts import Network, Parts
from mevs_jax.trained.system import TrainedSystem

save = TrainedSystem.save

__all__ = [
    "CloudInput",
    "DataDescription",
    "Description",
    "ImageInput",
    "Network",
    "Parts",
    "Strangeness",
    "TrainedSystem",
    "UnreadableSystem",
    "fit_strangeness",
    "from_pretrained",
    "load",
    "save",
    "verify",
]
