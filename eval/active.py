"""Learnt fusion and learnt choice, on a real data set: what `mevs active` trains, and how it is measured.

Stages, each of which skips what is done: views from turned directions; a recogniser on them, and one for each part of the
training objects that never saw it; features of every view; the view policy; walks of every
test object from every start. Everything that is chosen or fitted, temperatures among it, is so on validation objects.

In a run's folder: `active/turned/` (data), `active/seed_0/` with `recogniser/`, `fold_0/`, …, `features/`, `policy/`;
and `active/metrics.json`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool

from data_pipeline.batches import fold_of
from data_pipeline.builder import DataConfig, DatasetStatistics, load_statistics, open_split, prepare
from data_pipeline.files import as_read, read_json, write_json
from data_pipeline.meshes import DataError
from data_pipeline.progress import console
from eval.active_study import Learner, OnLattice, study
from eval.view_tables import load_view_tables, made_by, network_outputs, stored_array
from mevs_jax.calibration import class_weights, fit_temperature
from mevs_jax.fusion import CalibratedFusion, SetFusion
from mevs_jax.models import Recogniser, ViewPolicy
from train.checkpoints import Checkpoints
from train.fusion import Features, sets_of_size
from train.loop import fit, load_best
from train.policy import PolicyConfig, new_policy, train_policy
from train.recogniser import RecogniserConfig, RecogniserTask
from train.step import Batch, Task


@dataclass(frozen=True)
class ActiveConfig:
    """Learnt fusion and learnt choice."""

    recogniser: RecogniserConfig = RecogniserConfig()
    folds: int = 2
    """parts of the training objects, for labels by recognisers that never saw an object"""
    fold_epochs: int = 0
    """of those recognisers; 0 for as many as the recogniser itself"""
    policy: PolicyConfig = PolicyConfig()
    seeds: int = 1
    """whole trainings, each from other random weights"""
    max_views: int = 8
    """views of a walk"""
    draws: int = 8
    """walks per object and start of policies that draw"""
    lattices: tuple[int, ...] = (10,)
    """further numbers of candidate views to test on, never trained on"""


_CALIBRATED = (1, 2, 3, 4, 5, 6, 8, 12, 16, 24, 32, 40)
"""Numbers of views at which a temperature is fitted; between them it is interpolated."""


def check_active(config: ActiveConfig, views: int) -> None:
    """Raises `DataError` for a study that cannot be made."""
    if config.folds < 2 or config.seeds < 1:
        raise DataError("--active.folds must be at least 2, and --active.seeds at least 1")
    most, batch = max(config.policy.most_seen, config.max_views), config.recogniser.optimiser
    if not 2 <= most < views:
        raise DataError(
            f"walks of {most} views (--active.max-views, --active.policy.most-seen) need more than {most} candidate views, "
            f"and at least 2; there are {views}"
        )
    if not batch.validation_views or 256 % batch.validation_views or batch.validation_views > views:
        raise DataError(
            f"--active.recogniser.optimiser.validation-views must divide 256 and be at most {views}, got {batch.validation_views}"
        )


class Stages:
    """One seed of the study in its folder: every stage, made or found."""

    def __init__(self, config: ActiveConfig, dataset: DataConfig, out: Path, seed: int = 0):
        self.config, self.dataset, self.out, self.seed = config, dataset, out, seed
        self.turned = out / "active" / "turned"
        self.folder = out / "active" / f"seed_{seed}"

    def prepare(self) -> None:
        """The views from turned directions."""
        capture = replace(self.dataset.capture, turned=True)
        prepare(replace(self.dataset, capture=capture), self.turned)

    @cached_property
    def statistics(self) -> DatasetStatistics:
        return load_statistics(self.turned)

    def task(self, fold: int | None = None) -> RecogniserTask:
        config, statistics = self.config, self.statistics
        optimiser = replace(config.recogniser.optimiser, seed=self.seed, data_seed=self.seed)
        if fold is not None and config.fold_epochs:
            optimiser = replace(optimiser, epochs=config.fold_epochs)
        part = None if fold is None else (fold, config.folds)
        recogniser = replace(config.recogniser, optimiser=optimiser)
        return RecogniserTask.of(recogniser, len(statistics.classes), statistics.camera, part)

    def recogniser_folder(self, fold: int | None = None) -> Path:
        return self.folder / ("recogniser" if fold is None else f"fold_{fold}")

    def train_recogniser(self, fold: int | None = None) -> None:
        fit(self.task(fold), self.turned, self.statistics, self.recogniser_folder(fold))

    def features(
        self, name: str, data: Path, split: str, fold: int | None = None, chosen: np.ndarray | None = None
    ) -> Features:
        """What the recogniser sees of every view, kept in `features/` under this name."""
        task, folder, classes = self.task(fold), self.recogniser_folder(fold), len(self.statistics.classes)
        seen = stored_array(
            self.folder / "features" / f"{name}.npz",
            made_by(load_statistics(data), folder),
            lambda: network_outputs(data, split, task, load_best(task, folder), _see, chosen).astype(np.float32),
        )
        ends = np.cumsum([seen.shape[-1] - classes - 4, classes, 3])
        features, logits, directions, labels = np.split(seen, ends, axis=-1)
        known = jnp.asarray(labels[:, 0, 0].astype(np.int32))
        return Features(jnp.asarray(features), jnp.asarray(logits) - self.prior, known, jnp.asarray(directions))

    @property
    def prior(self) -> Array:
        """Log-probabilities of the classes in training. ModelNet10 trains on 883 chairs and 88 bathtubs, and tests on about as
        many of each; nobody knows how often a robot meets which. So they are taken off all logits. Equal where it is trained on
        as many of each."""
        if self.config.recogniser.balanced:
            return jnp.full(len(self.statistics.classes), -jnp.log(len(self.statistics.classes)))
        counts = np.array([self.statistics.counts["train"][name] for name in self.statistics.classes], np.float32)
        return jnp.log(jnp.asarray(counts / counts.sum()))

    def fusion(self, fold: int | None = None, posed: bool = True) -> CalibratedFusion:
        """The recogniser's fusion, with temperatures, for objects of known or of unknown pose."""
        validation = self.features("turned_val" if fold is None else f"fold_{fold}_val", self.turned, "val", fold)
        recogniser = load_best(self.task(fold), self.recogniser_folder(fold))
        assert isinstance(recogniser, Recogniser)
        return calibrated(recogniser.fusion, validation, self.prior, posed)

    def policy_folder(self, posed: bool = True) -> Path:
        return self.folder / ("policy" if posed else "policy_unposed")

    def policy(self, posed: bool = True) -> ViewPolicy:
        """The view policy, with labels by the recognisers of the parts, for objects of known or of unknown pose."""
        config, folds = replace(self.config.policy, seed=self.seed), range(self.config.folds)

        def train() -> tuple[ViewPolicy, dict[str, Any]]:
            main = self.fusion(posed=posed), self.features("turned_val", self.turned, "val")
            part_of = fold_of(len(open_split(self.turned, "train")), self.config.folds)
            parts = []
            for fold in folds:
                held_out = np.flatnonzero(part_of == fold)
                data = self.features(f"fold_{fold}_train", self.turned, "train", fold, held_out)
                parts.append((self.fusion(fold, posed), data))
            console.print(f"Training the view policy, {config.rounds} rounds")
            policy, histories = train_policy(config, parts, main)
            return policy, {"rounds": histories}

        made = (self.recogniser_folder(fold) for fold in (None, *folds))
        identity = {"made_by": made_by(self.statistics, *made), "of": asdict(self.config.policy)}
        return _made_once(
            self.policy_folder(posed), identity, new_policy(config, len(self.statistics.classes), posed), train
        )


Network = TypeVar("Network", bound=nnx.Module)


def _made_once(
    folder: Path, identity: dict[str, Any], like: Network, train: Callable[[], tuple[Network, dict[str, Any]]]
) -> Network:
    """The network that is kept in the folder under this identity; else the trained one, which is kept with what is told of it."""
    path, identity = folder / "summary.json", as_read(identity)
    with Checkpoints(folder) as checkpoints:
        if path.exists() and read_json(path)["identity"] == identity:
            restored = checkpoints.restore("best", nnx.state(like, nnx.Param))
            if restored is not None:
                nnx.update(like, restored[0])
                return like
        network, told = train()
        checkpoints.save("best", 0, nnx.state(network, nnx.Param), {})
    write_json(path, {"identity": identity, **told})
    return network


def _see(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
    """Features, logits, direction and label of every view, side by side."""
    assert isinstance(task, RecogniserTask)
    label = batch["label"][:, None].astype(jnp.float32)
    return jnp.concatenate([network.see(task.inputs(batch)), task.directions(batch), label], axis=-1)


def calibrated(
    network: SetFusion, validation: Features, prior: Float[Array, "classes"], posed: bool = True, draws: int = 4
) -> CalibratedFusion:
    """With temperatures fitted on random sets of views of validation objects, every class weighing the same.

    Args:
        prior: log-probabilities of the classes in training; the validation's logits of single views are without it already.
        posed: whether the objects' pose is known.
        draws: sets of each size for each object.
    """
    structure, state = nnx.split(network)
    objects, views, classes = validation.logits.shape
    sizes = [size for size in _CALIBRATED if size <= views]

    @jax.jit
    def temperature(present: Bool[Array, "draws objects views"]) -> Array:
        fuse = partial(nnx.merge(structure, state), validation.features, validation.directions, posed=posed)
        return fitted(jax.lax.map(fuse, present) - prior, jnp.tile(validation.labels, draws))

    def fitted(logits: Array, truth: Array) -> Array:
        return fit_temperature(logits.reshape(-1, classes), truth, class_weights(truth, classes))

    found = [float(temperature(sets_of_size(objects, views, size, draws))) for size in sizes]
    every = np.exp(np.interp(np.log(np.arange(1, views + 1)), np.log(sizes), np.log(found)))
    single = fitted(validation.logits, jnp.repeat(validation.labels, views))
    return CalibratedFusion(structure, state, prior, jnp.asarray(every, jnp.float32), single, posed)


def lattice_data(dataset: DataConfig, out: Path, views: int) -> Path:
    """The folder of the data set with so many candidate views, made if it is not there."""
    own = dataset.capture.views == views
    folder = out / "data" if own else out / "active" / f"lattice_{views}"
    prepare(replace(dataset, capture=replace(dataset.capture, views=views)), folder)
    return folder


def train_all(stages: Stages) -> None:
    """Every network of one seed."""
    stages.prepare()
    for fold in (None, *range(stages.config.folds)):
        stages.train_recogniser(fold)
    for posed in (True, False):
        stages.policy(posed)


def measure(stages: Stages) -> dict[str, Any]:
    """What one seed's networks reach: by number of candidate views, and where nobody knows which way the objects face. What is
    found on a lattice is kept in a file of the seed's folder."""
    own = stages.dataset.capture.views
    return {
        "lattices": {str(views): _measure_on(stages, views) for views in (own, *stages.config.lattices)},
        "unposed": {str(own): _measure_on(stages, own, posed=False)},
    }


def _measure_on(stages: Stages, views: int, posed: bool = True) -> dict[str, Any]:
    config, path = stages.config, stages.folder / f"metrics_{views}{'' if posed else '_unposed'}.json"
    data = lattice_data(stages.dataset, stages.out, views)
    with_entropies = _entropies(stages.out, data, "test")[0] is not None
    policy = stages.policy(posed)
    identity = as_read(
        {
            "made_by": made_by(load_statistics(data), stages.recogniser_folder()),
            "policy": read_json(stages.policy_folder(posed) / "summary.json")["identity"],
            "walks": [config.max_views, config.draws, with_entropies],
        }
    )
    if path.exists() and (found := read_json(path))["identity"] == identity:
        return found
    on = {
        split: OnLattice(stages.features(f"lattice_{views}_{split}", data, split), *_entropies(stages.out, data, split))
        for split in ("val", "test")
    }
    console.print(
        f"Walking {len(on['test'].features.labels)} test objects, {views} candidate views"
        + ("" if posed else ", which way they face unknown")
    )
    found = study(
        stages.fusion(posed=posed),
        [
            Learner("learnt", "view policy", policy),
            Learner("learnt_state", "… by what it expects of the state as it is", policy, "state"),
        ],
        on["val"],
        on["test"],
        max_views=config.max_views,
        draws=config.draws,
        seed=stages.seed,
    )
    write_json(path, found | {"identity": identity})
    return read_json(path)


def _entropies(out: Path, data: Path, split: str) -> tuple[np.ndarray | None, np.ndarray | None]:
    """What the entropy predictor of the run says of every view, and the true entropies, where `mevs run` has made them."""
    path = out / "tables" / f"{split}.npz"
    if data != out / "data" or not path.exists():
        return None, None
    tables = load_view_tables(path)
    return tables.utility, tables.entropy
