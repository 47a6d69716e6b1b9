"""Calibration of a fusion: temperatures fitted on validation objects, one for each number of views."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from data_pipeline.errors import Diverged
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.calibration import class_weights, fit_temperature
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models.set_fusion import SetFusion, SumFusion
from train.choosing.features import Features, sets_of_size
from train.results.finite import check_outputs
from train.running.over_objects import over_objects

_CALIBRATED = (1, 2, 3, 4, 5, 6, 8, 12, 16, 24, 32, 40)
"""Numbers of views for which a temperature is fitted; temperatures between them are interpolated."""


def calibrated(
    network: SetFusion | SumFusion,
    validation: Features,
    prior: Float[Array, " classes"],
    posed: bool = True,
    draws: int = 4,
) -> CalibratedFusion:
    """Returns the fusion with temperatures fitted on random sets of views of validation objects; all classes weigh the same.

    Args:
        prior: log-probabilities of the classes in training; it is already subtracted from the single-view logits of `validation`.
        posed: whether the objects' pose is known.
        draws: number of sets of each size for each object.

    Raises:
        Diverged: if the fusion's beliefs or a temperature are infinite or NaN.
    """
    structure, weights = nnx.split(network)
    objects, views, classes = validation.logits.shape
    sizes = [size for size in _CALIBRATED if size <= views]
    uncalibrated = CalibratedFusion(structure, weights, prior, jnp.ones(1), jnp.float32(1), posed)

    def fitted(beliefs: AnyArray, truth: Array) -> Array:
        return fit_temperature(beliefs.reshape(-1, classes), truth, class_weights(truth, classes))

    def temperature(size: int) -> float:
        beliefs = beliefs_of_sets(uncalibrated, validation, sets_of_size(objects, views, size, draws))
        check_outputs(beliefs.swapaxes(0, 1), "recogniser's fusion", "validation objects")  # the fit would hide them
        return float(fitted(beliefs, jnp.tile(validation.labels, draws)))

    every = np.exp(np.interp(np.log(np.arange(1, views + 1)), np.log(sizes), np.log([*map(temperature, sizes)])))
    check_outputs(np.asarray(validation.logits), "recogniser", "validation objects")
    single = fitted(validation.logits, jnp.repeat(validation.labels, views))
    if not np.isfinite([*every, single]).all():
        raise Diverged(
            "a temperature of the recogniser's fusion is not finite; train the recogniser again in another --out"
        )
    return replace(uncalibrated, temperatures=jnp.asarray(every, jnp.float32), single=single)


def _beliefs_of_one(
    one: tuple[Features, Bool[Array, "draws views"]], fusion: CalibratedFusion
) -> Float[Array, "draws classes"]:
    data, sets = one
    return jax.vmap(lambda present: fusion(data.features, data.directions, present))(sets)


def beliefs_of_sets(
    fusion: CalibratedFusion, data: Features, present: Bool[AnyArray, "draws objects views"]
) -> Float[np.ndarray, "draws objects classes"]:
    """Returns the log-probabilities of the classes after each set of views."""
    sets = np.asarray(present).swapaxes(0, 1)
    return over_objects(_beliefs_of_one, (data, sets), fusion, at_once=16, by_all=True).swapaxes(0, 1)
