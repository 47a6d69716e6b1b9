"""Does learning to fuse views beat adding their logits? The set fusion, trained on the classifier's features, on the same sets.

The features of training objects come from a classifier that was trained on them, so they are surer than those of new objects;
validation objects, which it never saw, decide which epoch is kept and fit the temperatures.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from data_pipeline.builder import DatasetStatistics
from data_pipeline.files import read_json, write_json
from data_pipeline.meshes import DataError
from data_pipeline.progress import console
from eval.comparison import intervals
from eval.view_tables import made_by, network_outputs, objects_of, stored_array
from mevs_jax.calibration import expected_calibration_error, fit_temperature, negative_log_likelihood
from mevs_jax.fusion import SetFusion
from mevs_jax.models import ResNet
from train.checkpoints import Checkpoints
from train.classifier import ClassifierTask
from train.fusion import Features, FusionConfig, new_fusion, train_fusion
from train.loop import load_best

DRAWS = 16
"""Random sets of each size for each object."""
_OBJECTS_AT_ONCE = 128


def _features(network: ResNet, images: Array) -> Array:
    features = network.features(images)
    return jnp.concatenate([features, network.head(features)], axis=-1)


def classifier_features(out: Path, split: str, statistics: DatasetStatistics, task: ClassifierTask) -> Features:
    """Of every view of a split; kept in `out/features` until the classifier is another."""
    labels = objects_of(out / "data", split, statistics)[1]
    both = stored_array(
        out / "features" / f"{split}.npz",
        made_by(statistics, out / "classifier"),
        lambda: network_outputs(out / "data", split, task, load_best(task, out / "classifier"), _features),
    )
    directions = jnp.array(statistics.viewpoints, jnp.float32)
    classes = len(statistics.classes)
    return Features(
        jnp.asarray(both[..., :-classes]), jnp.asarray(both[..., -classes:]), jnp.asarray(labels), directions
    )


def _identity(out: Path, statistics: DatasetStatistics, config: FusionConfig) -> dict[str, Any]:
    return {"made_by": made_by(statistics, out / "classifier"), "config": asdict(config)}


def fuse(out: Path, statistics: DatasetStatistics, task: ClassifierTask, config: FusionConfig) -> None:
    """Trains the set fusion on the features of the training objects, unless it is there."""
    if fusion_identity(out, statistics, config) is not None:
        return
    folder, identity = out / "fusion", _identity(out, statistics, config)
    path = folder / "summary.json"
    train, validation = (classifier_features(out, split, statistics, task) for split in ("train", "val"))
    console.print(f"Training the set fusion on {len(train.labels)} objects, {config.epochs} epochs")
    network, found = train_fusion(config, train, validation)
    path.unlink(missing_ok=True)
    with Checkpoints(folder) as checkpoints:
        step = checkpoints.latest_step("best") + 1
        checkpoints.save("best", step, nnx.state(network, nnx.Param), {"best_loss": found["best_loss"]})
    write_json(path, {"identity": identity, **found})
    console.print(f"set fusion: validation loss {found['best_loss']:.4f}")


def fusion_identity(out: Path, statistics: DatasetStatistics, config: FusionConfig) -> dict[str, Any] | None:
    """Of the trained fusion; None where there is none of this classifier and configuration."""
    path = out / "fusion" / "summary.json"
    if not path.exists() or (identity := read_json(path)["identity"]) != _identity(out, statistics, config):
        return None
    return identity


def load_fusion(out: Path, classes: int, task: ClassifierTask, config: FusionConfig) -> SetFusion:
    """The trained network, which is there (`fusion_identity`)."""
    network = new_fusion(config, 8 * task.network_config.width, classes)
    with Checkpoints(out / "fusion") as checkpoints:
        restored = checkpoints.restore("best", nnx.state(network, nnx.Param))
    if restored is None:
        raise DataError(f"no trained set fusion in {out / 'fusion'}; train one with: mevs fuse --out {out}")
    nnx.update(network, restored[0])
    return network


def sets_of_size(
    objects: int, views: int, size: int, draws: int, seed: int = 0
) -> Bool[np.ndarray, "objects draws views"]:
    """Random sets of views, the same for whatever is compared."""
    ranks = np.random.default_rng([seed, size]).permuted(
        np.broadcast_to(np.arange(views), (objects, draws, views)), axis=-1
    )
    return ranks < size


@partial(jax.jit, static_argnames="structure")
def _both(
    structure: nnx.GraphDef, state: nnx.State, data: Features, present: Array
) -> tuple[Float[Array, "objects draws classes"], Float[Array, "objects draws classes"]]:
    """Beliefs of sets (objects, draws, views): the sum of logits, and the learnt one."""
    network = nnx.merge(structure, state)

    def one(item: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        features, logits, present = item
        every = jnp.broadcast_to(features, (*present.shape, features.shape[-1]))
        directions = jnp.broadcast_to(data.directions, (*present.shape, 3))
        return present.astype(logits.dtype) @ logits, network(every, directions, present)

    return jax.lax.map(one, (data.features, data.logits, present), batch_size=_OBJECTS_AT_ONCE)


def fusion_study(network: SetFusion, validation: Features, test: Features, seed: int = 0) -> dict[str, Any]:
    """Both fusions after 1, 2, … random views: accuracy, their difference, and calibration with a temperature for each number.

    Temperatures are fitted on the validation objects, after fusion.
    """
    structure, state = nnx.split(network)
    views = test.features.shape[1]
    sizes = sorted({*range(1, min(views, 12) + 1), *(size for size in (16, 20, 40, views) if size <= views)})
    rows = []
    for size in sizes:
        draws = 1 if size == views else DRAWS
        found = {}
        for name, data in (("validation", validation), ("test", test)):
            sets = sets_of_size(len(data.labels), views, size, draws, seed)
            found[name] = _both(structure, state, data, jnp.asarray(sets))
        row: dict[str, Any] = {"views": size}
        right = {}
        for at, name in enumerate(("sum", "learnt")):
            fitted = found["validation"][at].reshape(-1, test.logits.shape[-1])
            temperature = fit_temperature(fitted, jnp.repeat(validation.labels, draws))
            beliefs = found["test"][at] / temperature
            truth = jnp.repeat(test.labels, draws)
            flat = beliefs.reshape(-1, beliefs.shape[-1])
            right[name] = np.asarray((jnp.argmax(beliefs, -1) == test.labels[:, None]).mean(axis=1))
            sure = jnp.max(jax.nn.softmax(flat), axis=-1)
            row[name] = {
                "accuracy": float(right[name].mean()),
                "interval": intervals(right[name]),
                "temperature": float(temperature),
                "calibration_error": float(expected_calibration_error(sure, jnp.argmax(flat, -1) == truth)),
                "likelihood": float(negative_log_likelihood(flat, truth)),
            }
        gain = right["learnt"] - right["sum"]
        rows.append(row | {"difference": float(gain.mean()), "difference_interval": intervals(gain)})
    return {"objects": len(test.labels), "draws": DRAWS, "rows": rows}
