"""Learnt fusion and learnt choice, on a real data set: what `mevs active` trains, and how it is measured.

Stages, each of which skips what is done: views from turned directions; a recogniser on them, and one for each part of the
training objects that never saw it; features of every view; the fusion on sets of all sizes; the view policy; walks of every
test object from every start. Everything that is chosen or fitted, temperatures among it, is so on validation objects.

In a run's folder: `active/turned/` (data), `active/seed_0/` with `recogniser/`, `fold_0/`, …, `features/`, `fusion/`, `policy/`;
and `active/metrics.json`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool

from data_pipeline.batches import fold_of
from data_pipeline.builder import DataConfig, DatasetStatistics, load_statistics, open_split, prepare
from data_pipeline.files import read_json, write_json
from data_pipeline.meshes import DataError
from data_pipeline.progress import console
from eval.active_study import OnLattice, study
from eval.view_tables import load_view_tables, made_by, network_outputs, objects_of, stored_array
from mevs_jax.calibration import class_weights, fit_temperature
from mevs_jax.fusion import CalibratedFusion, SetFusion
from mevs_jax.models import Recogniser, ViewPolicy
from train.checkpoints import Checkpoints
from train.fusion import Features, FusionConfig, sets_of_size, train_fusion
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
    fusion: FusionConfig = FusionConfig(largest_set=40, epochs=0)
    """of the fusion's training on features, after that with the encoder; none by default, since features of objects that the
    encoder was trained on are surer than those of others: on validation objects it was best before its first epoch"""
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

    @property
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
        statistics, task, folder = load_statistics(data), self.task(fold), self.recogniser_folder(fold)
        labels = objects_of(data, split, statistics)[1]
        both = stored_array(
            self.folder / "features" / f"{name}.npz",
            made_by(statistics, folder),
            lambda: network_outputs(data, split, task, load_best(task, folder), _see, chosen).astype(np.float32),
        )
        if chosen is not None:
            labels = labels[chosen]
        ends = np.cumsum([both.shape[-1] - len(statistics.classes) - 3, len(statistics.classes)])
        features, logits, directions = map(jnp.asarray, np.split(both, ends, axis=-1))
        return Features(features, logits - self.prior, jnp.asarray(labels), directions)

    @property
    def prior(self) -> Array:
        """Log-probabilities of the classes in training. ModelNet10 trains on 883 chairs and 88 bathtubs, and tests on about as
        many of each; nobody knows how often a robot meets which. So they are taken off all logits."""
        counts = np.array([self.statistics.counts["train"][name] for name in self.statistics.classes], np.float32)
        return jnp.log(jnp.asarray(counts / counts.sum()))

    def fusion(self, fold: int | None = None) -> CalibratedFusion:
        """The recogniser's fusion; trained on further, with its encoder as it is, where that is of all training objects."""
        own = self.recogniser_folder(fold)
        validation = self.features("turned_val" if fold is None else f"fold_{fold}_val", self.turned, "val", fold)
        recogniser = load_best(self.task(fold), own)
        assert isinstance(recogniser, Recogniser)
        network = recogniser.fusion
        if fold is None and self.config.fusion.epochs:
            network = self._fusion_of_all(network, validation)
        return calibrated(network, validation, self.prior)

    def _fusion_of_all(self, start: SetFusion, validation: Features) -> SetFusion:
        folder = self.folder / "fusion"
        identity = _plain(
            {"made_by": made_by(self.statistics, self.recogniser_folder()), "of": asdict(self.config.fusion)}
        )
        path = folder / "summary.json"
        if not path.exists() or read_json(path)["identity"] != identity:
            train = self.features("turned_train", self.turned, "train")
            console.print(f"Training the set fusion on {len(train.labels)} objects, {self.config.fusion.epochs} epochs")
            start, found = train_fusion(replace(self.config.fusion, seed=self.seed), train, validation, start)
            with Checkpoints(folder) as checkpoints:
                checkpoints.save("best", 0, nnx.state(start, nnx.Param), found)
            write_json(path, {"identity": identity, **found})
            return start
        return _restored(folder, start)

    def policy(self, config: PolicyConfig, name: str = "policy", cross_fit: bool = True) -> ViewPolicy:
        """The view policy, with labels by the recognisers of the parts, or by the one that was trained on every object."""
        folder, folds = self.folder / name, range(self.config.folds)
        made = [self.recogniser_folder(fold) for fold in folds] if cross_fit else []
        identity = _plain(
            {
                "made_by": made_by(self.statistics, self.recogniser_folder(), *made),
                "fusion": asdict(self.config.fusion),
                "of": asdict(config),
            }
        )
        path = folder / "summary.json"
        policy = new_policy(replace(config, seed=self.seed), len(self.statistics.classes))
        if path.exists() and read_json(path)["identity"] == identity:
            return _restored(folder, policy)
        main = self.fusion(), self.features("turned_val", self.turned, "val")
        if cross_fit:
            parts = []
            part_of = fold_of(len(open_split(self.turned, "train")), self.config.folds)
            for fold in folds:
                held_out = np.flatnonzero(part_of == fold)
                data = self.features(f"fold_{fold}_train", self.turned, "train", fold, held_out)
                parts.append((self.fusion(fold), data))
        else:
            parts = [(main[0], self.features("turned_train", self.turned, "train"))]
        console.print(f"Training the view policy, {config.rounds} rounds")
        policy, histories = train_policy(replace(config, seed=self.seed), parts, main)
        with Checkpoints(folder) as checkpoints:
            checkpoints.save("best", 0, nnx.state(policy, nnx.Param), {})
        write_json(path, {"identity": identity, "rounds": histories})
        return policy


def _plain(tree: Any) -> Any:
    import json

    return json.loads(json.dumps(tree))


def _restored(folder: Path, network: Any) -> Any:
    with Checkpoints(folder) as checkpoints:
        restored = checkpoints.restore("best", nnx.state(network, nnx.Param))
    assert restored is not None
    nnx.update(network, restored[0])
    return network


def _see(network: Recogniser, task: Task, batch: Batch) -> jax.Array:
    """Features, logits and direction of every view, side by side."""
    assert isinstance(task, RecogniserTask)
    return jnp.concatenate([network.see(task.inputs(batch)), task.directions(batch)], axis=-1)


def calibrated(
    network: SetFusion, validation: Features, prior: Float[Array, "classes"], draws: int = 4
) -> CalibratedFusion:
    """With temperatures fitted on random sets of views of validation objects, every class weighing the same.

    Args:
        prior: log-probabilities of the classes in training; the validation's logits of single views are without it already.
        draws: sets of each size for each object.
    """
    structure, state = nnx.split(network)
    objects, views, classes = validation.logits.shape
    sizes = [size for size in _CALIBRATED if size <= views]

    @jax.jit
    def temperature(present: Bool[Array, "draws objects views"]) -> Array:
        fuse = partial(nnx.merge(structure, state), validation.features, validation.directions)
        return fitted(jax.lax.map(fuse, present) - prior, jnp.tile(validation.labels, draws))

    def fitted(logits: Array, truth: Array) -> Array:
        return fit_temperature(logits.reshape(-1, classes), truth, class_weights(truth, classes))

    found = [float(temperature(sets_of_size(objects, views, size, draws))) for size in sizes]
    every = np.exp(np.interp(np.log(np.arange(1, views + 1)), np.log(sizes), np.log(found)))
    single = fitted(validation.logits, jnp.repeat(validation.labels, views))
    return CalibratedFusion(structure, state, prior, jnp.asarray(every, jnp.float32), single)


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
    stages.policy(stages.config.policy)


def measure(stages: Stages) -> dict[str, Any]:
    """What one seed's networks reach, by number of candidate views; each lattice's is kept in a file of the seed's folder."""
    config = stages.config
    return {
        "lattices": {
            str(views): _measure_on(stages, views) for views in (stages.dataset.capture.views, *config.lattices)
        }
    }


def _measure_on(stages: Stages, views: int) -> dict[str, Any]:
    config, path = stages.config, stages.folder / f"metrics_{views}.json"
    data = lattice_data(stages.dataset, stages.out, views)
    with_entropies = _entropies(stages.out, data, "test")[0] is not None
    identity = _plain(
        {
            "made_by": made_by(load_statistics(data), stages.recogniser_folder()),
            "fusion": asdict(config.fusion),
            "policy": read_json(stages.folder / "policy" / "summary.json")["identity"],
            "walks": [config.max_views, config.draws, with_entropies],
        }
    )
    if path.exists() and (found := read_json(path))["identity"] == identity:
        return found
    on = {
        split: OnLattice(stages.features(f"lattice_{views}_{split}", data, split), *_entropies(stages.out, data, split))
        for split in ("val", "test")
    }
    console.print(f"Walking {len(on['test'].features.labels)} test objects, {views} candidate views")
    found = study(
        stages.fusion(),
        {"learnt": stages.policy(config.policy)},
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
