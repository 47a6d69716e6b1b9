"""The training stages of the learned study: views from random directions, a recogniser, features of every view, view policies.

Each stage is skipped if its result exists. Everything that is selected, fitted or learned from the recogniser's outputs, such as
temperatures and policies, uses validation objects; only the ablations `crossed` and `known` learn from training objects.

Folders within a run's folder: `learned/turned/` (data), `learned/seed_0/` with `recogniser/`, `features/`, `policies/`,
`fold_0/`, …, and `learned/seed_0_rotated/`, the same for objects turned by any rotation.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from data_pipeline.capture.viewpoints import is_file
from data_pipeline.dataset.batches import fold_of
from data_pipeline.dataset.builder import DataConfig, open_split, prepare
from data_pipeline.dataset.statistics import SUMMARY, DatasetStatistics, load_statistics
from data_pipeline.distributed import is_first
from data_pipeline.files import digest_of
from data_pipeline.progress import console
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models import Recogniser, ViewPolicy
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.models.pose import PoseHead
from mevs_jax.models.set_fusion import SumFusion
from train.choosing.calibrated import calibrated
from train.choosing.config import LearnedConfig
from train.choosing.expected import FITTED_AS, fit_expected_views
from train.choosing.features import Features
from train.choosing.looks import answers, embed, see, see_changed, see_in_reality, see_rotated
from train.choosing.policy import Lesson, PolicyConfig, Seen, Trained, new_policy, train_policies
from train.choosing.q_learning import QLearningConfig, train_by_q_learning
from train.choosing.variants import VARIANTS
from train.loop import fit, load_best
from train.many.seeds import train_seeds
from train.results.chance import warn_of_chance
from train.results.finite import check_outputs
from train.results.identity import identity_of, made_by, stamp_of
from train.results.kept import kept_array
from train.results.networks import is_stored, trained_once
from train.results.outputs import Ask, network_outputs
from train.results.records import as_json
from train.tasks.entropy import EntropyConfig, EntropyTask
from train.tasks.recogniser import RecogniserTask
from train.tasks.size import check_sizes, used_size
from train.weights.starting import StartingWeights

Aside = tuple[int, int]
"""Which of how many parts of the validation objects."""

_SIZE = "--learned.recogniser.size"


class Stages:
    """The stages of one seed of the study; each method returns its result, computed first if it is not stored.

    Args:
        config: settings of the study.
        dataset: settings of the run's data set.
        out: folder of the run.
        seed: number of the seed.
        entropy: settings of the run's entropy predictor, for policies that are given its embedding of clouds.
        upright: the stages of the same seed for upright objects, if these are the stages for objects turned by any rotation. Then
            recognisers start from those of `upright`, and features are of the views as if the object, and not the lattice around
            it, had been turned.
    """

    def __init__(
        self,
        config: LearnedConfig,
        dataset: DataConfig,
        out: Path,
        seed: int = 0,
        entropy: EntropyConfig | None = None,
        upright: Stages | None = None,
    ):
        self.config, self.dataset, self.out, self.seed, self.entropy = config, dataset, out, seed, entropy
        self.turned, self.upright = out / "learned" / "turned", upright
        self.folder = out / "learned" / (f"seed_{seed}" if upright is None else f"seed_{seed}_rotated")
        self._recognisers: dict[int | None, Recogniser] = {}
        self._fusions: dict[tuple, CalibratedFusion] = {}

    def rotated(self) -> Stages:
        """Returns the stages of this seed for objects turned by any rotation."""
        return Stages(self.config, self.dataset, self.out, self.seed, self.entropy, upright=self)

    def prepare(self) -> None:
        """Makes the data set of views from turned directions."""
        capture = replace(self.dataset.capture, turned=True)
        prepare(replace(self.dataset, capture=capture), self.turned)
        for data in (self.turned, self.out / "data"):
            self._check_sizes(data)

    def _check_sizes(self, data: Path) -> None:
        """Raises `DataError` if the recogniser uses sizes, and the objects of a data set have none that it can use."""
        size = used_size(self.config.recogniser.size, _SIZE)
        if size and (data / SUMMARY).exists():
            check_sizes(size, open_split(data, "train"), _SIZE)

    @property
    def _viewpoints(self) -> tuple[tuple[float, ...], ...]:
        """The lattice of the run."""
        return tuple(map(tuple, self.statistics.viewpoints))

    @cached_property
    def statistics(self) -> DatasetStatistics:
        return load_statistics(self.turned)

    def task(self, fold: int | None = None) -> RecogniserTask:
        """Returns the training task of the recogniser, or of the one trained without part `fold` of the training objects."""
        config, statistics = self.config, self.statistics
        optimiser = replace(config.recogniser.optimiser, seed=self.seed, data_seed=self.seed)
        if fold is not None and config.fold_epochs:
            optimiser = replace(optimiser, epochs=config.fold_epochs)
        augmentation = config.recogniser.augmentation
        if self.upright is not None:
            optimiser = replace(optimiser, epochs=config.rotation_epochs)
            augmentation = replace(augmentation, turn=True)
        part = None if fold is None else (fold, config.folds)
        recogniser = replace(config.recogniser, optimiser=optimiser, augmentation=augmentation)
        return RecogniserTask.of(recogniser, len(statistics.classes), statistics.camera, part)

    def recogniser_folder(self, fold: int | None = None) -> Path:
        return self.folder / ("recogniser" if fold is None else f"fold_{fold}")

    def train_recogniser(self, fold: int | None = None) -> None:
        """Trains the recogniser, or the one without part `fold`."""
        task, folder, option = (
            self.task(fold),
            self.recogniser_folder(fold),
            "--learned.recogniser.optimiser.learning-rate",
        )
        summary = fit(task, self.turned, self.statistics, folder, self._start(fold), rate_option=option)
        self._recognisers.pop(fold, None)
        warn_of_chance(task, summary, self.statistics)

    def recogniser(self, fold: int | None = None) -> Recogniser:
        """Returns the trained recogniser, or the one without part `fold`; it must not be changed."""
        if fold not in self._recognisers:
            recogniser = load_best(self.task(fold), self.recogniser_folder(fold))
            assert isinstance(recogniser, Recogniser)
            self._recognisers[fold] = recogniser
        return self._recognisers[fold]

    def _start(self, fold: int | None) -> StartingWeights | None:
        """Returns the initial weights of a recogniser: those for upright objects, or None for random ones."""
        if self.upright is None:
            return None
        task, folder = self.upright.task(fold), self.upright.recogniser_folder(fold)

        def put(network: nnx.Module) -> None:
            upright = load_best(task, folder)
            assert isinstance(upright, Recogniser)
            upright.pose = None  # azimuths; rotations are learned from the beginning
            nnx.update(network, nnx.state(upright))

        return StartingWeights(f"{task.name} {made_by(self.statistics, folder)}", put)

    def features(
        self,
        name: str,
        data: Path,
        split: str,
        fold: int | None = None,
        chosen: np.ndarray | None = None,
        ask: Ask | None = None,
    ) -> Features:
        """Returns the recogniser's features of every view, stored in `features/`; the prior is subtracted from the logits.

        Args:
            name: name of the file.
            data: folder of the data set.
            split: split of the data set.
            fold: if given, the recogniser without this part is used.
            chosen: positions of objects in the split; all if None.
            ask: computes the features of a batch; by default `see`, or `see_rotated` for turned objects.
        """
        task, folder, classes = self.task(fold), self.recogniser_folder(fold), len(self.statistics.classes)
        self._check_sizes(data)
        if ask is None:
            ask = see if self.upright is None else see_rotated(self._viewpoints)
        seen = kept_array(
            self.folder / "features" / f"{name}.npz",
            stamp_of("features", made_by(load_statistics(data), folder)),
            lambda: network_outputs(data, split, task, self.recogniser(fold), ask, chosen).astype(np.float32),
        )
        check_outputs(seen, task.name, f"objects in the features {name}")
        ends = np.cumsum([seen.shape[-1] - classes - 4, classes, 3])
        features, logits, directions, labels = np.split(seen, ends, axis=-1)
        known = jnp.asarray(labels[:, 0, 0].astype(np.int32))
        return Features(jnp.asarray(features), jnp.asarray(logits) - self.prior, known, jnp.asarray(directions))

    def changed(self, count: int) -> list[Features]:
        """Returns features of `count` augmented copies of the validation objects, by the views that a policy learns from."""
        return [
            self.features(f"turned_val_changed_{number}", self.turned, "val", ask=see_changed(number))
            for number in range(count)
        ]

    @property
    def prior(self) -> Array:
        """Log-probabilities of the classes in training; equal for all classes if training is balanced.

        They are subtracted from all logits: ModelNet10 trains on 883 chairs and 88 bathtubs, and tests on about as many of each,
        and how often a robot meets each class is unknown.
        """
        if self.config.recogniser.balanced:
            return jnp.full(len(self.statistics.classes), -jnp.log(len(self.statistics.classes)))
        counts = np.array([self.statistics.counts["train"][name] for name in self.statistics.classes], np.float32)
        return jnp.log(jnp.asarray(counts / counts.sum()))

    def expected_views(self) -> ExpectedViews:
        """Returns what the recogniser is expected to say of each class, fitted on the objects that it was trained on."""

        def fitted() -> np.ndarray:
            task, classes = self.task(), len(self.statistics.classes)
            ask = see if self.upright is None else see_rotated(self._viewpoints, own_frame=True)
            seen = np.asarray(
                network_outputs(self.turned, "train", task, self.recogniser(), answers(ask, classes)), np.float32
            )
            seen = seen.reshape(-1, seen.shape[-1])
            logits, directions, labels = np.split(seen, (classes, classes + 3), axis=1)
            temperature = self.fusion(posed=self.upright is None).single
            log_probabilities = jax.nn.log_softmax((logits - self.prior) / temperature, axis=-1)
            found = fit_expected_views(directions, np.asarray(log_probabilities), labels[:, 0].astype(int))
            return np.asarray(found.coefficients)

        path = self.folder / "features" / "expected_views.npz"
        made = f"{made_by(self.statistics, self.recogniser_folder())} {FITTED_AS}"
        return ExpectedViews(jnp.asarray(kept_array(path, stamp_of("features", made), fitted)))

    def pose_head(self) -> PoseHead | None:
        """Returns the recogniser's network for the pose of objects; None if it has none."""
        return self.recogniser().pose

    def fusion(self, fold: int | None = None, posed: bool = True, summed: bool = False) -> CalibratedFusion:
        """Returns the recogniser's fusion, or the sum of its logits, with temperatures, for objects of known or unknown pose.

        Temperatures are fitted on perfect images of validation objects; if the recogniser was trained with the errors of real
        images, on as many such images too.
        """
        wanted = fold, posed, summed
        if wanted not in self._fusions:
            name = "turned_val" if fold is None else f"fold_{fold}_val"
            validation, recogniser = self.features(name, self.turned, "val", fold), self.recogniser(fold)
            if self.task(fold).reality and self.upright is None:  # half perfect images, half such as it will meet
                real = self.features(f"{name}_in_reality", self.turned, "val", fold, ask=see_in_reality)
                validation = validation.and_of(real)
            network = SumFusion(recogniser.encoder.head, self.prior) if summed else recogniser.fusion
            self._fusions[wanted] = calibrated(network, validation, self.prior, posed)
        return self._fusions[wanted]

    @property
    def has_clouds(self) -> bool:
        """Whether the run has a trained PointNet++, which `clouds` needs."""
        return self.entropy is not None and (self.out / "entropy" / "summary.json").exists()

    def clouds(self, data: Path, split: str) -> Float[Array, "objects views embedding"]:
        """Returns PointNet++'s embedding of the partial cloud of every view, stored in `learned/clouds/` for all seeds."""
        folder, statistics = self.out / "entropy", load_statistics(self.out / "data")
        assert self.entropy is not None
        task = EntropyTask.of(self.entropy, statistics.views, statistics.entropy_max, statistics.camera)
        found = kept_array(
            self.out / "learned" / "clouds" / f"{data.name}_{split}.npz",
            stamp_of("features", made_by(load_statistics(data), folder)),
            lambda: network_outputs(data, split, task, load_best(task, folder), embed).astype(np.float32),
        )
        return jnp.asarray(check_outputs(found, task.name, f"{split} objects"))

    def parts(self) -> list[Seen]:
        """Returns the training objects in parts, each with features and fusion of the recogniser trained without it."""
        part_of, found = fold_of(len(open_split(self.turned, "train")), self.config.folds), []
        for fold in range(self.config.folds):
            held_out = np.flatnonzero(part_of == fold)
            found.append((self.fusion(fold), self.features(f"fold_{fold}_train", self.turned, "train", fold, held_out)))
        return found

    def policy_folder(self, name: str = "learned") -> Path:
        return self.folder / "policies" / name

    def policy(self, name: str = "learned", without: tuple[int, ...] = (), aside: Aside | None = None) -> ViewPolicy:
        """Returns a trained view policy; arguments are those of `policy_job`."""
        return trained_policies([self.policy_job(name, without, aside)])[0]

    def policy_job(self, name: str = "learned", without: tuple[int, ...] = (), aside: Aside | None = None) -> PolicyJob:
        """Returns the training of the view policy of a variant, once the recognisers that it learns from are trained.

        Args:
            name: name of the variant in `VARIANTS`.
            without: classes whose objects it is not trained on.
            aside: part of the validation objects that it is not trained on.
        """
        variant = VARIANTS[name]
        config = replace(self.config.policy, seed=self.seed, **variant.settings)
        if variant.q_learning:
            config = replace(self.config.q_learning, seed=self.seed)
        made = [self.recogniser_folder()]
        if variant.learns_from == "parts":
            for fold in range(self.config.folds):
                self.train_recogniser(fold)
                made.append(self.recogniser_folder(fold))
        cloud = 0
        if variant.cloud:
            assert self.entropy is not None
            made, cloud = [*made, self.out / "entropy"], self.entropy.network.global_layers[-1]
        changed = self.config.changed if variant.changed and variant.learns_from == "validation" else 0
        made_from = stamp_of("features", made_by(self.statistics, *made))
        identity = identity_of("network", made_by=made_from, of=asdict(config), changed=changed)
        left_out = [
            *(f"without_{label}" for label in without),
            *([] if aside is None else [f"aside_{aside[0]}_of_{aside[1]}"]),
        ]
        return PolicyJob(
            self.policy_folder("_".join((name, *left_out))),
            identity,
            nnx.eval_shape(lambda: new_policy(config, len(self.statistics.classes), variant.posed, cloud)),
            config,
            partial(self._lesson, name, changed, without, aside),
        )

    def _lesson(self, name: str, changed: int, without: tuple[int, ...], aside: Aside | None) -> Lesson:
        """Returns what the view policy of a variant learns from, with so many changed copies of the objects."""
        variant = VARIANTS[name]
        seen = self.features("turned_val", self.turned, "val")
        if variant.cloud:
            seen = replace(seen, clouds=self.clouds(self.turned, "val"))
        fusion = self.fusion(posed=variant.posed, summed=variant.summed)
        validation = fusion, seen.without(without)
        check = None
        if variant.learns_from == "validation":
            parts = [(fusion, seen), *((fusion, copy) for copy in self.changed(changed))]
            if aside is not None:
                kept = np.flatnonzero(fold_of(len(seen.labels), aside[1]) != aside[0])
                parts = [(fusion, data.some(kept)) for fusion, data in parts]
        elif variant.learns_from == "parts":
            parts, check = self.parts(), validation
        else:
            parts, check = [(fusion, self.features("turned_train", self.turned, "train"))], validation
        parts = [(fusion, data.without(without)) for fusion, data in parts]
        objects = sum(len(data.labels) for _, data in parts)
        console.print(f"The view policy ({name}) of seed {self.seed} learns from {objects} objects")
        return Lesson(self.seed, parts, check, f"view policy ({name}) of seed {self.seed}")


@dataclass(frozen=True)
class PolicyJob:
    """The training of one view policy.

    Attributes:
        folder: where it is stored.
        identity: what it depends on.
        untrained: a network of its shape.
        config: settings of its training.
        lesson: returns what it learns from.
    """

    folder: Path
    identity: dict[str, Any]
    untrained: ViewPolicy
    config: PolicyConfig
    lesson: Callable[[], Lesson]


UNFINISHED = "unfinished"
"""Folder of the state of a training that goes on."""


def trained_policies(jobs: Sequence[PolicyJob]) -> list[ViewPolicy]:
    """Returns the policies of some jobs, which differ in seeds alone; those that are not stored are trained together."""
    waiting = [job for job in jobs if not is_stored(job.folder, job.identity)]

    def train(some: Sequence[PolicyJob]) -> list[Trained]:
        config, lessons = some[0].config, [job.lesson() for job in some]
        folder = some[0].folder / UNFINISHED / digest_of([as_json(job.identity) for job in some])[:12]
        if isinstance(config, QLearningConfig):
            return train_by_q_learning(config, lessons, folder)
        return train_policies(config, lessons, folder)

    together = cache(lambda: train(waiting))

    def made(job: PolicyJob) -> tuple[ViewPolicy, dict[str, Any]]:
        known = job in waiting  # else it is stored, and cannot be read
        policy, histories = together()[waiting.index(job)] if known else train([job])[0]
        return policy, {"rounds": histories}

    trained = [trained_once(job.folder, job.identity, job.untrained, partial(made, job)) for job in jobs]
    for job in jobs if is_first() else ():
        shutil.rmtree(job.folder / UNFINISHED, ignore_errors=True)
    return trained


def train_recognisers(each: Sequence[Stages]) -> None:
    """Trains the recognisers of several seeds as one job; those that are trained already are left as they are."""
    first, tasks = each[0], [stages.task() for stages in each]
    summaries = train_seeds(
        tasks,
        first.turned,
        first.statistics,
        [stages.recogniser_folder() for stages in each],
        first.out / "learned" / "recognisers_together",
        rate_option="--learned.recogniser.optimiser.learning-rate",
    )
    for task, summary in zip(tasks, summaries, strict=True):
        warn_of_chance(task, summary, first.statistics)


def lattice_data(dataset: DataConfig, out: Path, views: int) -> Path:
    """Returns the folder of the data set with `views` candidate views, made first if it does not exist."""
    if dataset.capture.views == views:
        prepare(dataset, out / "data")
        return out / "data"
    lattice = "golden_angle" if is_file(dataset.capture.lattice) else dataset.capture.lattice
    folder = out / "learned" / f"lattice_{views}"
    prepare(replace(dataset, capture=replace(dataset.capture, views=views, lattice=lattice)), folder)
    return folder
