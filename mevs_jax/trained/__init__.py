"""Trained systems: one folder that describes itself, and everything that is needed to use it."""

from mevs_jax.beliefs.strangeness import Strangeness as Strangeness
from mevs_jax.beliefs.strangeness import fit_strangeness as fit_strangeness
from mevs_jax.trained.description import CloudInput as CloudInput
from mevs_jax.trained.description import DataDescription as DataDescription
from mevs_jax.trained.description import Description as Description
from mevs_jax.trained.description import ImageInput as ImageInput
from mevs_jax.trained.files import UnreadableSystem as UnreadableSystem
from mevs_jax.trained.files import from_pretrained as from_pretrained
from mevs_jax.trained.files import load as load
from mevs_jax.trained.files import verify as verify
from mevs_jax.trained.parts import Network as Network
from mevs_jax.trained.parts import Parts as Parts
from mevs_jax.trained.system import TrainedSystem as TrainedSystem

save = TrainedSystem.save
